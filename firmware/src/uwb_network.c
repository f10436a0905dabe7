#include <string.h>

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

/* uint8 in uint16: round half to even (value / scale), clipped. */
static void quantise(const float *values, uint16_t *quantised, uint32_t count, float scale) {
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

static void clear_position(uint16_t *values, int32_t position, int split) {
    for (int32_t pair = 0; pair < UWB_FILTERS / 2; pair++) {
        uint16_t *const value =
            values + (split ? uwb_index_split(position, pair) : uwb_index(position, pair));
        value[0] = value[1] = 0;
    }
}

static const uint16_t *run_remnet(const uwb_model *model, const float *window, uint16_t *arena) {
    uint32_t length = model->samples;
    uint32_t blocks = UWB_BLOCKS(length);
    uint16_t *const x = arena + UWB_BLOCK_VALUES;
    uint16_t *const r = x + (blocks + 1) * UWB_BLOCK_VALUES;

    const uint32_t lead = model->first_kernel / 2u;
    const uint32_t padded = blocks * UWB_BLOCK + model->first_kernel + 1u;
    quantise(window, r + lead, length, model->input_scale);
    memset(r, 0, lead * sizeof *r);
    memset(r + lead + length, 0, (padded - lead - length) * sizeof *r);
    uwb_conv_first(r, x, blocks, model->first_weights, model->first, model->first_kernel);

    clear_position(x, -1, 0);
    clear_position(r, -1, 1);
    for (uint32_t i = 0; i < model->module_count; i++) {
        const uwb_module *const module = &model->modules[i];
        clear_position(x, (int32_t)length, 0);
        uwb_conv_residual(x, r, blocks, module);
        clear_position(r, (int32_t)length, 1);
        if (length % 2 != 0) {
            uwb_conv_reduce_odd(r, x, blocks, module);
        } else {
            uwb_conv_reduce_even(r, x, blocks, module);
        }
        length = (length + 1) / 2;
        blocks = UWB_BLOCKS(length);
    }
    return x;
}

static const uint16_t *run_dense(const uwb_model *model, const float *window, uint16_t *arena, size_t half) {
    uint16_t *input = arena;
    uint16_t *output = arena + half;
    quantise(window, input, model->samples, model->input_scale);
    memset(input + model->samples, 0, (model->layers[0].inputs - model->samples) * sizeof *input);
    for (uint32_t i = 0; i < model->layer_count; i++) {
        uwb_dense(input, output, &model->layers[i]);
        uint16_t *const swap = input;
        input = output;
        output = swap;
    }
    return input;
}

uwb_status uwb_network(const uwb_model *model, const float *window, void *arena, size_t arena_bytes,
                       float *output_m) {
    const size_t needed = uwb_arena_size(model);
    if (needed == 0 || window == NULL || output_m == NULL) {
        return UWB_BAD_ARGUMENT;
    }
    if (arena == NULL || arena_bytes < needed || (uintptr_t)arena % sizeof(uint32_t) != 0) {
        return UWB_BAD_ARENA;
    }
    const uint16_t *const features =
        model->layer_count > 0
            ? run_dense(model, window, arena, (needed - model->samples * sizeof(float)) / (2 * sizeof(uint16_t)))
            : run_remnet(model, window, arena);
    const int32_t accumulator = uwb_dot(features, model->head_weights, model->head_inputs, model->head_bias) / 256;
    *output_m = (float)accumulator * model->head_scale;
    return UWB_OK;
}
