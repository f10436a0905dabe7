#include <math.h>

#include "uwb_mitigation.h"
#include "uwb_target.h"

static const float MAX_POWER_DBM = 1000.0f;

float uwb_prior_m(const uwb_model *model, float rx_power_dbm, float first_path_power_dbm) {
    if (model->prior_per_rx_power == 0.0f && model->prior_per_power_gap == 0.0f) {
        return model->prior_offset_m;
    }
    if (!(fabsf(rx_power_dbm) <= MAX_POWER_DBM && fabsf(first_path_power_dbm) <= MAX_POWER_DBM)) {
        return NAN;
    }
    /* The host rounds every product and every sum. Without volatile a compiler may fuse them. */
    const volatile float level = model->prior_per_rx_power * rx_power_dbm;
    const volatile float slope = model->prior_per_power_gap * (rx_power_dbm - first_path_power_dbm);
    return model->prior_offset_m + level + slope;
}
