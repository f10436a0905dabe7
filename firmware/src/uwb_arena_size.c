#include "uwb_kernels.h"

static size_t widest_layer(const uwb_model *model) {
    size_t widest = 0;
    for (uint32_t i = 0; i < model->layer_count; i++) {
        widest = model->layers[i].inputs > widest ? model->layers[i].inputs : widest;
        widest = model->layers[i].outputs > widest ? model->layers[i].outputs : widest;
    }
    return widest;
}

size_t uwb_arena_size(const uwb_model *model) {
    if (model == NULL || model->samples == 0 || model->head_weights == NULL) {
        return 0;
    }
    if (model->layer_count > 0) {
        /* two halves, between which the layers alternate | window */
        return 2 * widest_layer(model) * sizeof(uint16_t) + model->samples * sizeof(float);
    }
    if (model->module_count == 0 || model->samples < UWB_BLOCK ||
        (model->first_kernel != 3 && model->first_kernel != UWB_LONGEST_KERNEL)) {
        return 0;
    }
    /* zeros | input | zeros | residual sum | zeros, which only a layer of even length reads */
    const size_t total = 2 * UWB_BLOCKS(model->samples) + 2 + (model->samples % 2 == 0);
    return total * UWB_BLOCK_VALUES * sizeof(uint16_t);
}
