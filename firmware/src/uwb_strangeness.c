#include <math.h>

#include "uwb_mitigation.h"
#include "uwb_target.h"

/* Every step is one IEEE-754 operation, as in uwb_mitigation/model/familiarity.py; volatile keeps a compiler from
 * fusing two. */

enum { LEAD_TAPS = 3, FIRST_PATH_TAP = 6, FIRST_PATH_TAPS = 3 };

/* The sum of the inputs' squares, from the first to the last; of their fourth powers if they are square roots. */
static float energy(uwb_scaling scaling, const float *window, size_t count) {
    float sum = 0.0f;
    for (size_t i = 0; i < count; i++) {
        const volatile float square = window[i] * window[i];
        const volatile float fourth = square * square;
        sum += scaling == UWB_SCALE_PREAMBLE ? fourth : square;
    }
    return sum;
}

/* 10 log10 within 0.03 dB: the exponent is exact, and a parabola stands for the mantissa's logarithm. */
static float level_db(float power) {
    const float bounded = power < 1e-30f ? 1e-30f : power > 1e30f ? 1e30f : power;
    int exponent;
    const float mantissa = frexpf(bounded, &exponent);
    const volatile float square = (-4.0f / 3.0f) * mantissa;
    const volatile float both = (square + 4.0f) * mantissa;
    const volatile float octaves = both - 8.0f / 3.0f;
    return ((float)exponent + octaves) * 3.01029992f;
}

float uwb_strangeness(const uwb_model *model, const float *window, float range_m, float rx_power_dbm,
                      float first_path_power_dbm) {
    if (model->familiarity == NULL) {
        return 0.0f;
    }
    const volatile float level = level_db(energy(model->scaling, window, model->samples));
    const size_t taps = model->samples < FIRST_PATH_TAP + FIRST_PATH_TAPS ? 2 : FIRST_PATH_TAPS; /* K = 8: two */
    const volatile float first_path_level = level_db(energy(model->scaling, window + FIRST_PATH_TAP, taps));
    const volatile float lead_level = level_db(energy(model->scaling, window, LEAD_TAPS));
    const volatile float free_space_loss = level_db(range_m * range_m); /* beyond that of the first metre */
    const float features[UWB_FEATURES] = {
        range_m,
        rx_power_dbm + free_space_loss,
        rx_power_dbm - first_path_power_dbm,
        level - rx_power_dbm,
        first_path_level - first_path_power_dbm,
        lead_level - level,
    };
    float score = -INFINITY;
    for (size_t i = 0; i < UWB_FEATURES; i++) {
        const uwb_band *const band = &model->familiarity->bands[i];
        if (band->per_unit == 0.0f) {
            continue;
        }
        const float below = band->low - features[i];
        const float above = features[i] - band->high;
        const float excess = (below > above ? below : above) * band->per_unit;
        if (isnan(excess)) {
            return NAN;
        }
        score = excess > score ? excess : score;
    }
    return score;
}
