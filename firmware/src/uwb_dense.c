#include "uwb_kernels.h"

#if !UWB_CORTEX_M4
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
#endif
