#include <float.h>
#include <math.h>

#include "uwb_mitigation.h"
#include "uwb_target.h"

/* Every step is one IEEE-754 operation, as in uwb_mitigation/preprocessing.py; checks are in its order. */

enum { SATURATED = INT16_MAX, PREAMBLE_DIVISOR = 60 };

/* Magnitudes of `count` samples in counts; sets the largest absolute value among them. */
static uwb_status magnitudes(const uwb_cir *cir, size_t start, size_t count, float *out, int32_t *peak) {
    int32_t largest = 0;
    if (cir->encoding == UWB_COMPLEX_INT16) {
        const int16_t *sample = cir->samples + 2 * start;
        for (size_t i = 0; i < count; i++, sample += 2) {
            const int32_t re = sample[0] < 0 ? -sample[0] : sample[0];
            const int32_t im = sample[1] < 0 ? -sample[1] : sample[1];
            largest = re > largest ? re : largest;
            largest = im > largest ? im : largest;
            out[i] = sqrtf((float)((uint32_t)(re * re) + (uint32_t)(im * im)));
        }
    } else {
        const int16_t *sample = cir->samples + start;
        for (size_t i = 0; i < count; i++) {
            if (sample[i] < 0) {
                return UWB_NEGATIVE;
            }
            largest = sample[i] > largest ? sample[i] : largest;
            out[i] = (float)sample[i];
        }
    }
    *peak = largest;
    return UWB_OK;
}

uwb_status uwb_preprocess(const uwb_model *model, const uwb_cir *cir, float *window) {
    if (model == NULL || cir == NULL || window == NULL || (cir->samples == NULL && cir->count != 0)) {
        return UWB_BAD_ARGUMENT;
    }
    if (cir->count == 0) {
        return UWB_EMPTY;
    }
    /* The host's limits are the binary64 numbers 1e-30 and 1e30, which lie below these binary32 ones. */
    if (!(cir->scale >= 1e-30f && cir->scale < 1e30f)) {
        return UWB_BAD_SCALE;
    }
    if (!(cir->first_path_index >= -FLT_MAX && cir->first_path_index <= FLT_MAX)) {
        return UWB_NO_FIRST_PATH;
    }
    if (model->scaling == UWB_SCALE_PREAMBLE && cir->preamble_count == 0) {
        return UWB_NO_PREAMBLE_COUNT;
    }
    /* start_index has 32 bits: a first path beyond 2^40 cannot be inside, and below it int64 is exact. */
    if (cir->first_path_index > 1.0e12f || cir->first_path_index < -1.0e12f) {
        return UWB_OUTSIDE;
    }
    const size_t length = cir->encoding == UWB_COMPLEX_INT16 ? cir->count / 2 : cir->count;
    const size_t samples = model->samples;
    const int64_t start = (int64_t)floorf(cir->first_path_index) - UWB_WINDOW_LEAD - cir->start_index;
    if (length < samples || start < 0 || (uint64_t)start > length - samples) {
        return UWB_OUTSIDE;
    }
    if (cir->encoding == UWB_COMPLEX_INT16 && cir->count % 2 != 0) {
        return UWB_ODD_LENGTH;
    }

    int32_t peak = 0;
    const uwb_status status = magnitudes(cir, (size_t)start, samples, window, &peak);
    if (status != UWB_OK) {
        return status;
    }
    if (peak == 0) {
        return UWB_ALL_ZERO;
    }
    if (peak >= SATURATED) {
        return UWB_SATURATED;
    }
    /* Multiplying by 1 changes nothing, so that the host's shortcut needs no counterpart. */
    float largest = 0.0f;
    for (size_t i = 0; i < samples; i++) {
        window[i] *= cir->scale;
        largest = window[i] > largest ? window[i] : largest;
    }
    const float count = (float)(PREAMBLE_DIVISOR * (int32_t)cir->preamble_count);
    for (size_t i = 0; i < samples; i++) {
        window[i] = model->scaling == UWB_SCALE_MAX ? window[i] / largest : sqrtf(window[i] / count);
    }
    return UWB_OK;
}

/* As in uwb_mitigation/mitigation/early_path.py, with its constants. */
enum {
    SEARCH_TAPS = 19,
    EDGE_TAPS = 3,
    NOISE_TAPS = 128,
    MIN_NOISE_RATIO = 3,
    MAX_NOISE_RATIO = 64,
    MAX_WINDOW_RATIO = 400
};

static const float TAP_M = 0.300272882f; /* light in one sample period */

static uint32_t tap_power(const uwb_cir *cir, size_t tap) {
    if (cir->encoding != UWB_COMPLEX_INT16) {
        const int32_t magnitude = cir->samples[tap];
        return (uint32_t)(magnitude * magnitude);
    }
    const int32_t re = cir->samples[2 * tap];
    const int32_t im = cir->samples[2 * tap + 1];
    return (uint32_t)(re * re) + (uint32_t)(im * im);
}

static uint32_t strongest(const uwb_cir *cir, size_t start, size_t stop) {
    uint32_t largest = 0;
    for (size_t tap = start; tap < stop; tap++) {
        const uint32_t power = tap_power(cir, tap);
        largest = power > largest ? power : largest;
    }
    return largest;
}

int uwb_early_path(const uwb_model *model, const uwb_cir *cir, float *error_m) {
    const float whole = floorf(cir->first_path_index);
    const size_t first = (size_t)((int64_t)whole - cir->start_index);
    if (first < SEARCH_TAPS + NOISE_TAPS) {
        return 0;
    }
    const size_t window = first - UWB_WINDOW_LEAD;
    const size_t stop = window + model->samples;
    const size_t begin = first - SEARCH_TAPS;
    const uint64_t noise = strongest(cir, begin - NOISE_TAPS, begin);
    const uint64_t least = strongest(cir, window, stop) / MAX_WINDOW_RATIO;
    const uint64_t threshold = MIN_NOISE_RATIO * noise > least ? MIN_NOISE_RATIO * noise : least;
    size_t top = begin;
    while (top <= first - EDGE_TAPS && tap_power(cir, top) <= threshold) {
        top++;
    }
    if (top > first - EDGE_TAPS) {
        return 0;
    }
    while (top + 1 < stop && tap_power(cir, top + 1) > tap_power(cir, top)) {
        top++;
    }
    const uint32_t peak = tap_power(cir, top);
    if (peak > MAX_NOISE_RATIO * noise) {
        return 0;
    }
    size_t low = top;
    while (low > begin && 4 * (uint64_t)tap_power(cir, low) > peak) {
        low--;
    }
    if (4 * (uint64_t)tap_power(cir, low) > peak) {
        return 0;
    }
    /* volatile: the host rounds every operation. */
    const volatile float half = sqrtf((float)peak) * 0.5f;
    const float below = sqrtf((float)tap_power(cir, low));
    const float above = sqrtf((float)tap_power(cir, low + 1));
    const volatile float fraction = above > below ? (half - below) / (above - below) : 0.0f;
    const volatile float taps = (float)(first - low) + (cir->first_path_index - whole);
    const volatile float error = (taps - fraction) * TAP_M;
    *error_m = error;
    return 1;
}
