#include <float.h>
#include <math.h>

#include "uwb_kernels.h"

static const float MAX_POWER_DBM = 1000.0f;

/* Linear bias model, m; NaN if a power that it needs is not finite, or beyond 1000 dBm. */
static float linear_bias_m(const uwb_model *model, float rx_power_dbm, float first_path_power_dbm) {
    if (model->linear_bias_per_rx_power == 0.0f && model->linear_bias_per_power_gap == 0.0f) {
        return model->linear_bias_offset_m;
    }
    if (!(fabsf(rx_power_dbm) <= MAX_POWER_DBM && fabsf(first_path_power_dbm) <= MAX_POWER_DBM)) {
        return NAN;
    }
    /* The host rounds every product and every sum. Without volatile a compiler may fuse them. */
    const volatile float level = model->linear_bias_per_rx_power * rx_power_dbm;
    const volatile float slope = model->linear_bias_per_power_gap * (rx_power_dbm - first_path_power_dbm);
    return model->linear_bias_offset_m + level + slope;
}

/* OOD score. Every step is one IEEE-754 operation, as in uwb_mitigation/mitigation/model/ood.py; volatile prevents the
 * compiler from fusing two. */

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

/* 10 log10 within 0.03 dB: the exponent is exact, and a parabola approximates the logarithm of the mantissa. */
static float level_db(float power) {
    const float at_most = power > 1e30f ? 1e30f : power;
    const float bounded = power < 1e-30f ? 1e-30f : at_most;
    int exponent;
    const float mantissa = frexpf(bounded, &exponent);
    const volatile float square = (-4.0f / 3.0f) * mantissa;
    const volatile float both = (square + 4.0f) * mantissa;
    const volatile float octaves = both - 8.0f / 3.0f;
    return ((float)exponent + octaves) * 3.01029992f;
}

/* OOD score of a measurement with the input `window`. At most 0: in distribution; 1 or more, or NaN: out of
 * distribution. */
static float ood_score(const uwb_model *model, const float *window, float range_m, float rx_power_dbm,
                       float first_path_power_dbm) {
    if (model->ood_bands == NULL) {
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
        const uwb_band *const band = &model->ood_bands->bands[i];
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

static const float MAX_RANGE_M = 1.0e6f;

/* As in uwb_mitigation/mitigation/correction.py. */
static const float UNRELIABLE_VARIANCE_M2 = 0.25f;

/* As in uwb_mitigation/mitigation/early_path.py. */
static const float MIN_EARLY_RANGE_M = 0.3f;

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

/* The predicted error of the range, m, and the OOD score. The order of checks is that of the host, because it decides
 * the status. */
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
    const float bias_m = linear_bias_m(model, cir->rx_power_dbm, cir->first_path_power_dbm);
    if (!in_limits(bias_m, -FLT_MAX, FLT_MAX)) {
        return UWB_NO_POWER;
    }
    /* Before the network overwrites the window. */
    *score = ood_score(model, window, range_m, cir->rx_power_dbm, cir->first_path_power_dbm);
    /* volatile: the host rounds the network's product before it adds the linear bias. */
    volatile float rounded;
    float network_m;
    const volatile float unbiased_m = range_m - bias_m;
    if (!model->early_path || !uwb_early_path(model, cir, &network_m) ||
        !(unbiased_m - network_m >= MIN_EARLY_RANGE_M)) {
        status = uwb_network(model, window, arena, arena_bytes, &network_m);
        if (status != UWB_OK) {
            return status;
        }
    }
    rounded = network_m;
    *error_m = bias_m + rounded;
    if (!in_limits(*error_m, -FLT_MAX, FLT_MAX)) {
        return UWB_NOT_FINITE;
    }
    const int accepted = in_limits(*error_m, model->correction_low_m, model->correction_high_m) && *score < 1.0f;
    return accepted ? UWB_OK : UWB_OUT_OF_DISTRIBUTION;
}

/* Variance of a corrected range, m^2, by the size of its predicted error. */
static float corrected_variance_m2(const uwb_model *model, float error_m) {
    const float size_m = fabsf(error_m);
    const uwb_scale_line *line = model->scale;
    for (size_t i = 1; i < model->scale_count && model->scale[i].begin_m <= size_m; i++) {
        line++;
    }
    const volatile float growth_m = line->slope * size_m;
    const volatile float deviation_m = line->intercept_m + growth_m;
    const volatile float variance_m2 = deviation_m * deviation_m;
    return variance_m2;
}

/* Subtract the predicted error, weighted by the OOD score: the higher the score, the smaller the weight. As in
 * mitigation.py, every product and every sum is rounded: volatile prevents the compiler from fusing them. */
static void write_corrected(const uwb_model *model, float range_m, float offset_m, float error_m, float score,
                  uwb_corrected *corrected) {
    float correction_m = error_m;
    float variance_m2 = corrected_variance_m2(model, error_m);
    if (score > 0.0f) {
        const float known_m = model->ood_bands->known_offset_m;
        const volatile float shrunk = (1.0f - score) * (error_m - known_m);
        const volatile float uncorrected = score * model->variance_uncorrected_m2;
        correction_m = known_m + shrunk;
        variance_m2 += uncorrected;
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
    const float offset_range_m = offset_m != 0.0f ? range_m - offset_m : range_m;
    uwb_status status = predict(model, offset_range_m, cir, arena, arena_bytes, &error_m, &score);
    if (status == UWB_OK) {
        write_corrected(model, range_m, offset_m, error_m, score, corrected);
        status = corrected->range_m >= 0.0f ? UWB_OK : UWB_OUT_OF_DISTRIBUTION;
    }
    corrected->status = range_status(status);
    if (status == UWB_OK && corrected->variance_m2 > UNRELIABLE_VARIANCE_M2) {
        corrected->status = UWB_RANGE_UNRELIABLE;
    }
    if (status != UWB_OK) {
        const int valid = model != NULL && in_limits(offset_range_m, 0.0f, MAX_RANGE_M);
        corrected->range_m = offset_range_m;
        corrected->correction_m = offset_m;
        corrected->variance_m2 = valid ? model->variance_uncorrected_m2 : INFINITY;
        /* Without a CIR, the direct path may be lost. */
        if (status == UWB_EMPTY && corrected->variance_m2 < UNRELIABLE_VARIANCE_M2) {
            corrected->variance_m2 = UNRELIABLE_VARIANCE_M2;
        }
    }
    return status;
}
