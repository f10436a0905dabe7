#include "uwb_kernels.h"

#if !UWB_CORTEX_M4
enum { PAIRS = UWB_FILTERS / 2, TAPS = 3 };

void uwb_conv_residual(const uint16_t *x, uint16_t *r, uint32_t blocks, const uwb_module *module) {
    const int32_t positions = (int32_t)(blocks * UWB_BLOCK);
    const int8_t *weights = module->residual_weights;
    for (int32_t filter = 0; filter < UWB_FILTERS; filter++, weights += 2 * PAIRS * TAPS) {
        const uwb_channel channel = module->residual[filter];
        for (int32_t position = 0; position < positions; position++) {
            int32_t sum = channel.bias;
            for (int32_t pair = 0; pair < PAIRS; pair++) {
                for (int32_t tap = 0; tap < TAPS; tap++) {
                    const uint16_t *value = x + uwb_index(position + tap - 1, pair);
                    const uint32_t weight = (uint32_t)(pair * TAPS + tap);
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
#endif
