#include "uwb_kernels.h"

/* The layers in portable C, if there is no assembly for the target. */
#if !UWB_CORTEX_M4
enum { PAIRS = UWB_FILTERS / 2, REDUCE_TAPS = 4, LOW_HALF = 0xFFFF, BYTE = 0xFF };

/* Replace the bits `mask` of a word. */
static void store(uint32_t *word, uint32_t mask, uint32_t shift, int32_t value) {
    *word = (*word & ~(mask << shift)) | (uint32_t)value << shift;
}

static void store_input(uint32_t *x, uint32_t position, uint32_t channel, int32_t value) {
    store(x + uwb_input_word(position, channel), BYTE, uwb_input_shift(position), value);
}

void uwb_quantise(const float *values, uint16_t *quantised, uint32_t count, const float *scale) {
    for (uint32_t i = 0; i < count; i++) {
        float value = values[i] / *scale;
        if (!(value > 0.0f)) {
            value = 0.0f;
        } else if (value > 255.0f) {
            value = 255.0f;
        }
        /* Adding 2^23 leaves no fraction bits: the FPU rounds half to even, without the C library. */
        union {
            float real;
            uint32_t bits;
        } rounded;
        rounded.real = value + 8388608.0f;
        quantised[i] = (uint16_t)(rounded.bits & 0x1FFu);
    }
}

void uwb_conv_first(const uint16_t *x, uint32_t *y, uint32_t blocks, const int16_t *weights,
                    const uwb_channel *channels, uint32_t kernel) {
    for (uint32_t word = 0; word < blocks * UWB_BLOCK_WORDS; word++) {
        y[word] = 0;
    }
    for (uint32_t filter = 0; filter < UWB_FILTERS; filter++, weights += kernel + 1) {
        for (uint32_t position = 0; position < blocks * UWB_BLOCK; position++) {
            int32_t sum = channels[filter].bias;
            for (uint32_t tap = 0; tap < kernel; tap++) {
                sum += weights[tap] * (int32_t)x[position + tap];
            }
            store_input(y, position, filter, uwb_requantise(sum, &channels[filter]));
        }
    }
}

void uwb_conv_residual(const uint32_t *x, uint32_t *r, uint32_t blocks, const uwb_module *module) {
    enum { AROUND = UWB_BLOCK + 2 };
    const int32_t *weights = module->residual_weights;
    const uint32_t end = blocks == 0 ? UWB_BLOCK / 2 : blocks * UWB_BLOCK;
    for (uint32_t filter = 0; filter < UWB_FILTERS; filter++, weights += 2 * UWB_FILTERS) {
        const uwb_channel *const channel = &module->residual[filter];
        for (uint32_t start = 0; start < end; start += UWB_BLOCK) {
            int32_t sums[UWB_BLOCK], own[UWB_BLOCK] = {0};
            for (uint32_t lane = 0; lane < UWB_BLOCK; lane++) {
                sums[lane] = channel->bias;
            }
            for (uint32_t input = 0; input < UWB_FILTERS; input++) {
                const int32_t tap1 = weights[2 * input];
                const int32_t tap0 = (weights[2 * input + 1] + (1 << (UWB_POSITION_SHIFT - 1))) >> UWB_POSITION_SHIFT;
                const int32_t tap2 = weights[2 * input + 1] - tap0 * (1 << UWB_POSITION_SHIFT);
                int32_t values[AROUND]; /* from the position before the block to the one after it */
                for (uint32_t i = 0; i < AROUND; i++) {
                    const uint32_t position = start + i - 1u;
                    const int outside = (start == 0 && i == 0) || position >= end;
                    values[i] = outside ? 0 : (int32_t)(x[uwb_input_word(position, input)] >> uwb_input_shift(position) & BYTE);
                }
                for (uint32_t lane = 0; lane < UWB_BLOCK; lane++) {
                    sums[lane] += tap0 * values[lane] + tap1 * values[lane + 1] + tap2 * values[lane + 2];
                    own[lane] = input == filter ? values[lane + 1] : own[lane];
                }
            }
            for (uint32_t lane = 0; lane < UWB_BLOCK; lane++) {
                const int32_t sum = uwb_add(uwb_requantise(sums[lane], channel), own[lane], &module->residual_sum);
                store(r + uwb_sum_word((int32_t)(start + lane), (int32_t)filter / 2), LOW_HALF, 16u * (filter % 2u), sum);
            }
        }
    }
}

/* `first_tap` is where the window of three begins, relative to the sample that the skip reads. */
static void reduce(const uint32_t *r, uint32_t *y, uint32_t blocks, const uwb_module *module, int32_t first_tap) {
    static const int32_t taps[REDUCE_TAPS] = {0, 2, 1};
    const uint32_t positions = blocks * UWB_BLOCK / 2;
    const int16_t *weights = module->reduce_weights;
    for (uint32_t filter = 0; filter < UWB_FILTERS; filter++, weights += 2 * PAIRS * REDUCE_TAPS) {
        for (uint32_t position = 0; position < positions; position++) {
            int32_t sums[2] = {module->reduce[filter].bias, module->skip[filter].bias};
            for (int32_t pair = 0; pair < PAIRS; pair++) {
                for (int32_t tap = 0; tap < REDUCE_TAPS; tap++) {
                    const int skip = tap == REDUCE_TAPS - 1;
                    const int32_t read = 2 * (int32_t)position + (skip ? 0 : first_tap + taps[tap]);
                    const uint32_t values = r[uwb_sum_word(read, pair)];
                    const int16_t *const weight = weights + 2 * (REDUCE_TAPS * pair + tap);
                    sums[skip] += weight[0] * (int32_t)(values & LOW_HALF) + weight[1] * (int32_t)(values >> 16);
                }
            }
            const int32_t wide = uwb_requantise(sums[0], &module->reduce[filter]);
            const int32_t narrow = uwb_requantise(sums[1], &module->skip[filter]);
            store_input(y, position, filter, uwb_add(wide, narrow, &module->output_sum));
        }
    }
}

void uwb_conv_reduce_odd(const uint32_t *r, uint32_t *y, uint32_t blocks, const uwb_module *module) {
    reduce(r, y, blocks, module, -1);
}

void uwb_conv_reduce_even(const uint32_t *r, uint32_t *y, uint32_t blocks, const uwb_module *module) {
    reduce(r, y, blocks, module, 0);
}

void uwb_dense(const uint16_t *x, uint16_t *y, const uwb_dense_layer *layer) {
    for (uint32_t output = 0; output < layer->outputs; output++) {
        /* Four outputs' words for the same inputs lie side by side. */
        const int8_t *weights = layer->weights + (output / 4u) * 4u * layer->inputs + 4u * (output % 4u);
        int32_t sum = layer->channels[output].bias;
        for (uint32_t input = 0; input < layer->inputs; input += 4, weights += 16) {
            sum += uwb_weight(weights, 0, 0) * x[input] + uwb_weight(weights, 0, 1) * x[input + 1] +
                   uwb_weight(weights, 1, 0) * x[input + 2] + uwb_weight(weights, 1, 1) * x[input + 3];
        }
        y[output] = (uint16_t)uwb_requantise(sum, &layer->channels[output]);
    }
}

int32_t uwb_dot(const uint32_t *x, const int16_t *weights, uint32_t inputs, int32_t bias) {
    enum { FOLD = 1 << (UWB_POSITION_SHIFT - 16) }; /* as in uwb_dot.S */
    int32_t sum = bias * FOLD;
    for (uint32_t word = 0; word < inputs / 2u; word++) {
        sum += weights[2 * word] * (int32_t)(x[word] & 0xFFFFu) + weights[2 * word + 1] * (int32_t)(x[word] >> 16);
    }
    return sum / FOLD;
}
#endif
