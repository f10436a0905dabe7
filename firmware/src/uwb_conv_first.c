#include "uwb_kernels.h"

#if !UWB_CORTEX_M4
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
#endif
