#include "uwb_kernels.h"

float *uwb_arena_window(const uwb_model *model, void *arena) {
    if (model->layer_count > 0) {
        uint8_t *const end = (uint8_t *)arena + uwb_arena_size(model);
        return (float *)(void *)(end - model->samples * sizeof(float));
    }
    /* The place of the residual sum is free until the first module: quantised samples, then the window. */
    const size_t blocks = UWB_BLOCKS(model->samples);
    uint16_t *const sum = (uint16_t *)arena + (blocks + 2) * UWB_BLOCK_VALUES;
    return (float *)(void *)(sum + blocks * UWB_BLOCK + UWB_LONGEST_KERNEL + 1);
}
