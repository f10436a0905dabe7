/* Layers, each in portable C and in Cortex-M4 assembly, and how activations lie in memory. Internal.
 *
 * Activations are uint8, in two layouts. Both have blocks of eight positions and 64 words, so that every address inside of
 * a block is an immediate offset:
 *
 *     input of a module, or of the head: [channel][word], a word contains two positions, the second one shifted by
 *         UWB_POSITION_SHIFT: positions 0 and 2, 4 and 6, 1 and 3, 5 and 7
 *     residual sum: [channel pair][slot], a word contains two channels as uint16: positions 0, 2, 4, 6, 1, 3, 5, 7
 *
 * Kernels compute complete blocks: values that they write after `length` are undefined. Values before the first and after
 * the last position, if a layer reads them, must be zero. */
#ifndef UWB_KERNELS_H
#define UWB_KERNELS_H

#include "uwb_mitigation.h"
#include "uwb_target.h"

#ifdef __cplusplus
extern "C" {
#endif

#define UWB_BLOCK 8 /* positions */
#define UWB_BLOCK_WORDS 64
#define UWB_BLOCKS(length) (((length) + UWB_BLOCK - 1u) / UWB_BLOCK)
#define UWB_LONGEST_KERNEL 5u /* of the first layer */

/* Samples: round half to even (value / scale), clipped to uint8. */
void uwb_quantise(const float *values, uint16_t *quantised, uint32_t count, const float *scale);

/* x: uint8 samples, padded in front; 8 blocks + kernel + 1 of them are read. */
void uwb_conv_first(const uint16_t *x, uint32_t *y, uint32_t blocks, const int16_t *weights,
                    const uwb_channel *channels, uint32_t kernel);

/* r = relu(conv3(x)) + x; 0 blocks: four positions. It also writes position -1 of r, and reads up to 242 bytes before x. */
void uwb_conv_residual(const uint32_t *x, uint32_t *r, uint32_t blocks, const uwb_module *module);

/* y = relu(conv3 stride 2(r)) + relu(conv1 stride 2(r)); length of r is odd, or even: padding differs */
void uwb_conv_reduce_odd(const uint32_t *r, uint32_t *y, uint32_t blocks, const uwb_module *module);
void uwb_conv_reduce_even(const uint32_t *r, uint32_t *y, uint32_t blocks, const uwb_module *module);

void uwb_dense(const uint16_t *x, uint16_t *y, const uwb_dense_layer *layer);

/* bias + dot product; x: words of two positions */
int32_t uwb_dot(const uint32_t *x, const int16_t *weights, uint32_t inputs, int32_t bias);

/* Memory for the window, inside the arena. */
float *uwb_arena_window(const uwb_model *model, void *arena);

/* Value `half` (0, 1) of pair `index` in words p0 q0 p1 q1. */
static inline int32_t uwb_weight(const int8_t *weights, uint32_t index, uint32_t half) {
    return weights[4u * (index / 2u) + index % 2u + 2u * half];
}

static inline int32_t uwb_clip(int64_t value) {
    const int64_t at_most = value > 255 ? 255 : value;
    return (int32_t)(value < 0 ? 0 : at_most);
}

/* Right shifts of negative values: arithmetic on every compiler this runs on; C leaves it to them. */
static inline int32_t uwb_requantise(int32_t accumulator, const uwb_channel *channel) {
    const int64_t high = ((int64_t)accumulator * channel->multiplier) >> 32;
    return uwb_clip((high + channel->offset) >> UWB_REQUANTISATION_SHIFT);
}

static inline int32_t uwb_add(int32_t a, int32_t b, const uwb_sum *sum) {
    return uwb_clip(((int64_t)sum->first * a + (int64_t)sum->second * b + sum->offset) >> UWB_SUM_SHIFT);
}

/* Word of the layer input with a position, and the shift of the position in it. */
static inline uint32_t uwb_input_word(uint32_t position, uint32_t channel) {
    const uint32_t lane = position % UWB_BLOCK;
    return position / UWB_BLOCK * UWB_BLOCK_WORDS + 4u * channel + 2u * (lane % 2u) + lane / 4u;
}

static inline uint32_t uwb_input_shift(uint32_t position) {
    return position / 2u % 2u * UWB_POSITION_SHIFT;
}

/* Word of the residual sum with a position, which may be -1. */
static inline int32_t uwb_sum_word(int32_t position, int32_t pair) {
    const int32_t block = (position + UWB_BLOCK) / UWB_BLOCK - 1;
    const int32_t lane = (position + UWB_BLOCK) % UWB_BLOCK;
    return block * UWB_BLOCK_WORDS + pair * UWB_BLOCK + lane / 2 + 4 * (lane % 2);
}

#ifdef __cplusplus
}
#endif
#endif
