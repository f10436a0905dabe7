#include "uwb_kernels.h"

#if !UWB_CORTEX_M4
enum { PAIRS = UWB_FILTERS / 2, TAPS = 4 };

/* `first_tap` is where the window of three begins, relative to the sample that the skip reads. */
static void reduce(const uint16_t *r, uint16_t *y, uint32_t blocks, const uwb_module *module, int32_t first_tap) {
    static const int32_t taps[TAPS - 1] = {0, 2, 1};
    const int32_t positions = (int32_t)(blocks * UWB_BLOCK / 2);
    const int8_t *weights = module->reduce_weights;
    for (int32_t filter = 0; filter < UWB_FILTERS; filter++, weights += 2 * PAIRS * TAPS) {
        for (int32_t position = 0; position < positions; position++) {
            int32_t wide = module->reduce[filter].bias;
            int32_t narrow = module->skip[filter].bias;
            for (int32_t pair = 0; pair < PAIRS; pair++) {
                const uint32_t weight = (uint32_t)(pair * TAPS);
                for (uint32_t tap = 0; tap < TAPS - 1; tap++) {
                    const uint16_t *value = r + uwb_index_split(2 * position + first_tap + taps[tap], pair);
                    wide += uwb_weight(weights, weight + tap, 0) * value[0] +
                            uwb_weight(weights, weight + tap, 1) * value[1];
                }
                const uint16_t *value = r + uwb_index_split(2 * position, pair);
                narrow += uwb_weight(weights, weight + TAPS - 1, 0) * value[0] +
                          uwb_weight(weights, weight + TAPS - 1, 1) * value[1];
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
#endif
