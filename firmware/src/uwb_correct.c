#include <float.h>
#include <math.h>

#include "uwb_kernels.h"

static const float MAX_RANGE_M = 1.0e6f;

static int in_limits(float value, float low, float high) {
    return value >= low && value <= high;
}

static uwb_range_status range_status(uwb_status status) {
    switch (status) {
    case UWB_OK:
        return UWB_RANGE_OK;
    case UWB_EMPTY:
        return UWB_RANGE_NO_CIR;
    case UWB_OUT_OF_DISTRIBUTION:
    case UWB_BAD_RANGE:
        return UWB_RANGE_OUT_OF_DISTRIBUTION;
    case UWB_BAD_ARGUMENT:
    case UWB_BAD_ARENA:
    case UWB_NOT_FINITE:
        return UWB_RANGE_MODEL_ERROR;
    default:
        return UWB_RANGE_BAD_CIR;
    }
}

/* The predicted error of the range, m, and how strange the measurement is. The order of checks is the host's: it
 * decides the status. */
static uwb_status predict(const uwb_model *model, float range_m, const uwb_cir *cir, void *arena,
                          size_t arena_bytes, float *error_m, float *score) {
    const size_t needed = uwb_arena_size(model);
    if (needed == 0) {
        return UWB_BAD_ARGUMENT;
    }
    if (arena == NULL || arena_bytes < needed || (uintptr_t)arena % sizeof(uint32_t) != 0) {
        return UWB_BAD_ARENA;
    }
    float *const window = uwb_arena_window(model, arena);
    uwb_status status = uwb_preprocess(model, cir, window);
    if (status != UWB_OK) {
        return status;
    }
    if (!in_limits(range_m, 0.0f, MAX_RANGE_M)) {
        return UWB_BAD_RANGE;
    }
    const float prior = uwb_prior_m(model, cir->rx_power_dbm, cir->first_path_power_dbm);
    if (!in_limits(prior, -FLT_MAX, FLT_MAX)) {
        return UWB_NO_POWER;
    }
    /* Before the network overwrites the window. */
    *score = uwb_strangeness(model, window, range_m, cir->rx_power_dbm, cir->first_path_power_dbm);
    /* volatile: the host rounds the network's product before it adds the prior. */
    volatile float rounded;
    float network_m;
    status = uwb_network(model, window, arena, arena_bytes, &network_m);
    if (status != UWB_OK) {
        return status;
    }
    rounded = network_m;
    *error_m = prior + rounded;
    if (!in_limits(*error_m, -FLT_MAX, FLT_MAX)) {
        return UWB_NOT_FINITE;
    }
    const int usual = in_limits(*error_m, model->correction_low_m, model->correction_high_m) && *score < 1.0f;
    return usual ? UWB_OK : UWB_OUT_OF_DISTRIBUTION;
}

/* The stranger a measurement is, the less of its predicted error is believed. As in the host's Grader: every
 * product and every sum is rounded, for which volatile keeps a compiler from fusing them. */
static void grade(const uwb_model *model, float range_m, float offset_m, float error_m, float score,
                  uwb_corrected *corrected) {
    const volatile float square = error_m * error_m;
    const volatile float growth = model->variance_per_m2 * square;
    float correction_m = error_m;
    float variance_m2 = model->variance_m2 + growth;
    if (score > 0.0f) {
        const float known_m = model->familiarity->known_offset_m;
        const volatile float shrunk = (1.0f - score) * (error_m - known_m);
        const volatile float strange = score * model->variance_uncorrected_m2;
        correction_m = known_m + shrunk;
        variance_m2 += strange;
    }
    correction_m = offset_m + correction_m;
    corrected->range_m = range_m - correction_m;
    corrected->correction_m = correction_m;
    corrected->variance_m2 = variance_m2;
}

uwb_status uwb_correct(const uwb_model *model, float range_m, float offset_m, const uwb_cir *cir, void *arena,
                       size_t arena_bytes, uwb_corrected *corrected) {
    if (corrected == NULL) {
        return UWB_BAD_ARGUMENT;
    }
    float error_m = 0.0f;
    float score = 0.0f;
    const float less_m = offset_m != 0.0f ? range_m - offset_m : range_m;
    const uwb_status status = predict(model, less_m, cir, arena, arena_bytes, &error_m, &score);
    corrected->status = range_status(status);
    if (status == UWB_OK) {
        grade(model, range_m, offset_m, error_m, score, corrected);
    } else {
        const int valid = model != NULL && in_limits(less_m, 0.0f, MAX_RANGE_M);
        corrected->range_m = less_m;
        corrected->correction_m = offset_m;
        /* Without an offset the variance contains the offsets of the training boards. */
        const int calibrated = status == UWB_EMPTY && offset_m != 0.0f;
        corrected->variance_m2 = !valid       ? INFINITY
                                 : calibrated ? model->variance_m2
                                              : model->variance_uncorrected_m2;
    }
    return status;
}
