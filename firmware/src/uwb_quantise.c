#include "uwb_kernels.h"

void uwb_quantise(const float *values, uint16_t *quantised, uint32_t count, float scale) {
    for (uint32_t i = 0; i < count; i++) {
        float value = values[i] / scale;
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
