/* Removes the range error of ultra-wideband ranging with an int8 network, bit for bit as on the host.
 *
 * No allocation and no globals: a model is constant data that `uwb-mitigation board export-c` writes, and the caller
 * provides the working memory. Functions are reentrant if arenas are not shared. */
#ifndef UWB_MITIGATION_H
#define UWB_MITIGATION_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define UWB_FILTERS 16
#define UWB_WINDOW_LEAD 5 /* samples of the window before floor(first path) */

typedef enum {
    UWB_OK = 0,
    UWB_BAD_ARGUMENT,        /* a null pointer, or a model that this library cannot run */
    UWB_BAD_ARENA,           /* smaller than uwb_arena_size, or not aligned to 4 bytes */
    UWB_EMPTY,               /* the CIR contains no samples */
    UWB_ODD_LENGTH,          /* a complex CIR contains an odd number of values */
    UWB_BAD_SCALE,           /* the CIR's scale is not between 1e-30 and 1e30 */
    UWB_NO_FIRST_PATH,       /* the first-path index is not finite */
    UWB_OUTSIDE,             /* the window around the first path is not inside the CIR */
    UWB_ALL_ZERO,            /* the window contains only zeros */
    UWB_NEGATIVE,            /* a magnitude is negative */
    UWB_SATURATED,           /* the window contains a saturated sample */
    UWB_NO_PREAMBLE_COUNT,   /* unknown, and the model's scaling needs it */
    UWB_NO_POWER,            /* receive or first-path power unknown, and the linear bias model needs it */
    UWB_OUT_OF_DISTRIBUTION, /* the predicted error is outside the model's limits, or the OOD score is 1 or more */
    UWB_BAD_RANGE,           /* the range is not finite, negative, or beyond 1000 km */
    UWB_NOT_FINITE           /* the predicted error */
} uwb_status;

typedef enum { UWB_COMPLEX_INT16 = 0, UWB_MAGNITUDE = 1 } uwb_encoding;
typedef enum { UWB_SCALE_MAX = 0, UWB_SCALE_PREAMBLE = 1 } uwb_scaling;

/* A channel impulse response from the accumulator of the radio. */
typedef struct {
    const int16_t *samples; /* interleaved re, im, or magnitudes */
    size_t count;           /* int16 values, not samples in time */
    uwb_encoding encoding;
    int32_t start_index;     /* accumulator index of the first sample */
    float first_path_index;  /* accumulator index, sub-sample */
    float scale;             /* accumulator units per count */
    uint16_t preamble_count; /* RXPACC; 0 = unknown */
    float rx_power_dbm;      /* NaN = unknown */
    float first_path_power_dbm;
} uwb_cir;

/* Requantisation of an accumulator: clip(((acc + bias) * multiplier >> 32) + offset >> 3, 0, 255). */
typedef struct {
    int32_t bias;
    int32_t multiplier;
    int32_t offset;
} uwb_channel;

/* Sum of two uint8: clip(first * a + second * b + offset >> 22, 0, 255). */
typedef struct {
    int32_t first;
    int32_t second;
    int32_t offset;
} uwb_sum;

/* One residual reduction module. */
typedef struct {
    const int32_t *residual_weights; /* [filter][channel]: tap 1, tap 2 + (tap 0 << 21) */
    const uwb_channel *residual;
    uwb_sum residual_sum; /* of the convolution (first) and the module's input (second) */
    const int16_t *reduce_weights; /* [filter][channel pair][tap 0, tap 2, tap 1, skip] pairs */
    const uwb_channel *reduce;
    const uwb_channel *skip;
    uwb_sum output_sum; /* of reduce (first) and skip (second) */
} uwb_module;

/* Dense layer with ReLU. Inputs and outputs are multiples of 8, padded with zeros. Weights are pairs of int8 for pairs of
 * inputs, and two pairs (p, q) share a word as the bytes p0 q0 p1 q1: SXTB16 unpacks a pair. */
typedef struct {
    const int8_t *weights; /* [output / 4][input / 4][output % 4] words of two pairs */
    const uwb_channel *channels;
    uint16_t inputs;
    uint16_t outputs;
} uwb_dense_layer;

enum { UWB_FEATURES = 6 };

/* Values from low to high are in distribution; 1 / per_unit beyond them the score is 1. per_unit 0: not checked. */
typedef struct {
    float low;
    float high;
    float per_unit;
} uwb_band;

/* What the model was trained on; uwb_mitigation/mitigation/model/ood.py defines the features. */
typedef struct {
    float known_offset_m; /* correction of a measurement that is out of distribution */
    uwb_band bands[UWB_FEATURES];
} uwb_ood_bands;

/* Standard deviation of a corrected range whose predicted error has a size of `begin_m` or more. */
typedef struct {
    float begin_m;
    float intercept_m;
    float slope;
} uwb_scale_line;

/* Either a REMNet (modules > 0) or dense layers, then a head with one output. */
typedef struct {
    uint32_t model_id;
    uint16_t samples; /* window length K */
    uwb_scaling scaling;
    float input_scale;

    uint16_t first_kernel; /* 3 or 5 */
    uint16_t module_count;
    const int16_t *first_weights; /* [filter][first_kernel + 1], the last one zero */
    const uwb_channel *first;
    const uwb_module *modules;

    uint16_t layer_count;
    const uwb_dense_layer *layers;

    const int16_t *head_weights; /* pairs, the first one 32-fold, in the order of the last activation in memory */
    uint16_t head_inputs;       /* a multiple of 8 */
    int32_t head_bias;
    float head_scale;           /* m per unit of the accumulator */

    float linear_bias_offset_m;
    float linear_bias_per_rx_power; /* m per dBm */
    float linear_bias_per_power_gap;
    float correction_low_m; /* with a predicted error outside, the input is out of distribution */
    float correction_high_m;
    float variance_uncorrected_m2;
    const uwb_scale_line *scale; /* ascending, the first one from 0 on */
    uint16_t scale_count;
    const uwb_ood_bands *ood_bands; /* NULL = unknown: no OOD score */
    int early_path; /* 1: a missed direct path replaces the output of the network */
} uwb_model;

/* Return the bytes of arena that the other functions need for `model`; 0 if it is null or cannot be run. */
size_t uwb_arena_size(const uwb_model *model);

/* Write the network's input for `cir`, model->samples values, to `window`; undefined on failure. */
uwb_status uwb_preprocess(const uwb_model *model, const uwb_cir *cir, float *window);

/* Return 1 and the range error that a missed direct path before the first path causes, m; 0 if there is none. Call it
 * after uwb_preprocess has accepted `cir`; it needs 168 samples before the first path. */
int uwb_early_path(const uwb_model *model, const uwb_cir *cir, float *error_m);

/* Compute the network's output for a window of model->samples values, m, without the linear bias. */
uwb_status uwb_network(const uwb_model *model, const float *window, void *arena, size_t arena_bytes,
                       float *output_m);

/* Status of a corrected range; the values of RangeCorrected.msg and of the wire protocol. */
typedef enum {
    UWB_RANGE_OK = 0,
    UWB_RANGE_NO_CIR = 1,
    UWB_RANGE_BAD_CIR = 2,
    UWB_RANGE_OUT_OF_DISTRIBUTION = 3,
    UWB_RANGE_MODEL_ERROR = 4,
    UWB_RANGE_UNRELIABLE = 5 /* corrected, but the standard deviation exceeds 0.5 m */
} uwb_range_status;

/* With any status except OK and UNRELIABLE, the raw range minus the offset is passed through, with a larger variance. */
typedef struct {
    float range_m;
    float correction_m; /* offset + predicted error (linear bias + network); only the offset if passed through */
    float variance_m2;  /* infinite where the range is not valid */
    uwb_range_status status;
} uwb_corrected;

/* Correct one range. `offset_m`: offset due to the antenna delays of the two radios; 0 = unknown. The result is always
 * usable; the returned status is the detailed reason why a range was passed through. */
uwb_status uwb_correct(const uwb_model *model, float range_m, float offset_m, const uwb_cir *cir, void *arena,
                       size_t arena_bytes, uwb_corrected *corrected);

#ifdef __cplusplus
}
#endif
#endif
