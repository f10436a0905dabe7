#include "uwb_kernels.h"

/* The layers in portable C, if there is no assembly for the target. */
#if !UWB_CORTEX_M4
enum { PAIRS = UWB_FILTERS / 2, RESIDUAL_TAPS = 3, REDUCE_TAPS = 4 };

void uwb_conv_first(const uint16_t *x, uint16_t *y, uint32_t blocks, const int16_t *weights,
                    const uwb_channel *channels, uint32_t kernel) {
    const int32_t positions = (int32_t)(blocks * UWB_BLOCK);
    for (int32_t filter = 0; filter < UWB_FILTERS; filter++, weights += kernel + 1) {
        for (int32_t position = 0; position < positions; position++) {
            int32_t sum = channels[filter].bias;
            for (uint32_t tap = 0; tap < kernel; tap++) {
                sum += weights[tap] * (int32_t)x[(uint32_t)position + tap];
            }
            y[uwb_index(position, filter / 2) + filter % 2] =
                (uint16_t)uwb_requantise(sum, channels[filter].multiplier);
        }
    }
}

void uwb_conv_residual(const uint16_t *x, uint16_t *r, uint32_t blocks, const uwb_module *module) {
    const int32_t positions = (int32_t)(blocks * UWB_BLOCK);
    const int8_t *weights = module->residual_weights;
    for (int32_t filter = 0; filter < UWB_FILTERS; filter++, weights += 2 * PAIRS * RESIDUAL_TAPS) {
        const uwb_channel channel = module->residual[filter];
        for (int32_t position = 0; position < positions; position++) {
            int32_t sum = channel.bias;
            for (int32_t pair = 0; pair < PAIRS; pair++) {
                for (int32_t tap = 0; tap < RESIDUAL_TAPS; tap++) {
                    const uint16_t *value = x + uwb_index(position + tap - 1, pair);
                    const uint32_t weight = (uint32_t)(pair * RESIDUAL_TAPS + tap);
                    sum += uwb_weight(weights, weight, 0) * value[0] + uwb_weight(weights, weight, 1) * value[1];
                }
            }
            const int32_t convolved = uwb_requantise(sum, channel.multiplier);
            const int32_t input = x[uwb_index(position, filter / 2) + filter % 2];
            r[uwb_index_split(position, filter / 2) + filter % 2] =
                (uint16_t)uwb_add(convolved, input, &module->residual_sum);
        }
    }
}

/* `first_tap` is where the window of three begins, relative to the sample that the skip reads. */
static void reduce(const uint16_t *r, uint16_t *y, uint32_t blocks, const uwb_module *module, int32_t first_tap) {
    static const int32_t taps[REDUCE_TAPS - 1] = {0, 2, 1};
    const int32_t positions = (int32_t)(blocks * UWB_BLOCK / 2);
    const int8_t *weights = module->reduce_weights;
    for (int32_t filter = 0; filter < UWB_FILTERS; filter++, weights += 2 * PAIRS * REDUCE_TAPS) {
        for (int32_t position = 0; position < positions; position++) {
            int32_t wide = module->reduce[filter].bias;
            int32_t narrow = module->skip[filter].bias;
            for (int32_t pair = 0; pair < PAIRS; pair++) {
                const uint32_t weight = (uint32_t)(pair * REDUCE_TAPS);
                for (uint32_t tap = 0; tap < REDUCE_TAPS - 1; tap++) {
                    const uint16_t *value = r + uwb_index_split(2 * position + first_tap + taps[tap], pair);
                    wide += uwb_weight(weights, weight + tap, 0) * value[0] +
                            uwb_weight(weights, weight + tap, 1) * value[1];
                }
                const uint16_t *value = r + uwb_index_split(2 * position, pair);
                narrow += uwb_weight(weights, weight + REDUCE_TAPS - 1, 0) * value[0] +
                          uwb_weight(weights, weight + REDUCE_TAPS - 1, 1) * value[1];
            }
            y[uwb_index(position, filter / 2) + filter % 2] =
                (uint16_t)uwb_add(uwb_requantise(wide, module->reduce[filter].multiplier),
                                  uwb_requantise(narrow, module->skip[filter].multiplier), &module->output_sum);
        }
    }
}

void uwb_conv_reduce_odd(const uint16_t *r, uint16_t *y, uint32_t blocks, const uwb_module *module) {
    reduce(r, y, blocks, module, -1);
}

void uwb_conv_reduce_even(const uint16_t *r, uint16_t *y, uint32_t blocks, const uwb_module *module) {
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
        y[output] = (uint16_t)uwb_requantise(sum, layer->channels[output].multiplier);
    }
}
int32_t uwb_dot(const uint16_t *x, const int8_t *weights, uint32_t inputs, int32_t bias) {
    int32_t sum = bias;
    for (uint32_t input = 0; input < inputs; input++) {
        sum += uwb_weight(weights, input / 2u, input % 2u) * x[input];
    }
    return sum;
}
#endif
