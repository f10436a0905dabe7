#include "uwb_kernels.h"

#if !UWB_CORTEX_M4
int32_t uwb_dot(const uint16_t *x, const int8_t *weights, uint32_t inputs, int32_t bias) {
    int32_t sum = bias;
    for (uint32_t input = 0; input < inputs; input++) {
        sum += uwb_weight(weights, input / 2u, input % 2u) * x[input];
    }
    return sum;
}
#endif
