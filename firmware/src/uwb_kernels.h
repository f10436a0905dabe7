/* Layers, each in portable C and in Cortex-M4 assembly, and how activations lie in memory. Internal.
 *
 * Activations are uint8 values in uint16, two channels to a 32-bit word. Eight positions make a block of
 * 64 words, [channel pair][slot], so that every address inside a block is an immediate offset:
 *
 *     layer input and output:  slot of position p = p % 8
 *     residual sum:            even positions first: slot = (p % 8) / 2 + 4 * (p % 2)
 *
 * Position -1, and `length` if the layer reads it, must contain zeros. Kernels compute complete blocks: values that they
 * write after `length` are undefined. */
#ifndef UWB_KERNELS_H
#define UWB_KERNELS_H

#include "uwb_mitigation.h"
#include "uwb_target.h"

#ifdef __cplusplus
extern "C" {
#endif

#define UWB_BLOCK 8                                 /* positions */
#define UWB_BLOCK_VALUES (UWB_BLOCK * UWB_FILTERS)  /* uint16 */
#define UWB_BLOCKS(length) (((length) + UWB_BLOCK - 1u) / UWB_BLOCK)
#define UWB_LONGEST_KERNEL 5u /* of the first layer */

/* x: uint8 samples, padded in front; 8 blocks + kernel + 1 of them are read. */
void uwb_conv_first(const uint16_t *x, uint16_t *y, uint32_t blocks, const int16_t *weights,
                    const uwb_channel *channels, uint32_t kernel);

/* r = relu(conv3(x)) + x */
void uwb_conv_residual(const uint16_t *x, uint16_t *r, uint32_t blocks, const uwb_module *module);

/* y = relu(conv3 stride 2(r)) + relu(conv1 stride 2(r)); length of r is odd, or even: padding differs */
void uwb_conv_reduce_odd(const uint16_t *r, uint16_t *y, uint32_t blocks, const uwb_module *module);
void uwb_conv_reduce_even(const uint16_t *r, uint16_t *y, uint32_t blocks, const uwb_module *module);

void uwb_dense(const uint16_t *x, uint16_t *y, const uwb_dense_layer *layer);

/* bias + 256 * dot product */
int32_t uwb_dot(const uint16_t *x, const int8_t *weights, uint32_t inputs, int32_t bias);

/* Memory for the window, inside the arena. */
float *uwb_arena_window(const uwb_model *model, void *arena);

/* Channel pairs p0 q0 p1 q1: value `half` (0, 1) of pair `index`, times 256. */
static inline int32_t uwb_weight(const int8_t *weights, uint32_t index, uint32_t half) {
    return (int32_t)weights[4u * (index / 2u) + index % 2u + 2u * half] * 256;
}

static inline int32_t uwb_clip(int64_t value) {
    const int64_t at_most = value > 255 ? 255 : value;
    return (int32_t)(value < 0 ? 0 : at_most);
}

/* Right shifts of negative values: arithmetic on every compiler this runs on; C leaves it to them. */
static inline int32_t uwb_requantise(int32_t accumulator, int32_t multiplier) {
    return uwb_clip(((int64_t)accumulator * multiplier) >> (32 + UWB_REQUANTISATION_SHIFT));
}

static inline int32_t uwb_add(int32_t a, int32_t b, const uwb_sum *sum) {
    return uwb_clip(((int64_t)sum->first * a + (int64_t)sum->second * b + sum->offset) >> UWB_SUM_SHIFT);
}

/* Index of channel 2 * pair at a position, which may be -1. */
static inline int32_t uwb_index(int32_t position, int32_t pair) {
    const int32_t block = (position + UWB_BLOCK) / UWB_BLOCK - 1;
    return block * UWB_BLOCK_VALUES + 2 * (pair * UWB_BLOCK + (position + UWB_BLOCK) % UWB_BLOCK);
}

static inline int32_t uwb_index_split(int32_t position, int32_t pair) {
    const int32_t block = (position + UWB_BLOCK) / UWB_BLOCK - 1;
    const int32_t lane = (position + UWB_BLOCK) % UWB_BLOCK;
    return block * UWB_BLOCK_VALUES + 2 * (pair * UWB_BLOCK + lane / 2 + 4 * (lane % 2));
}

#ifdef __cplusplus
}
#endif
#endif
