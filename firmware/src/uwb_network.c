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
    /* zeros | residual sum | zeros, which only a layer of even length reads | input */
    const size_t total = 2 * UWB_BLOCKS(model->samples) + 1 + (model->samples % 2 == 0);
    return total * UWB_BLOCK_WORDS * sizeof(uint32_t);
}

float *uwb_arena_window(const uwb_model *model, void *arena) {
    if (model->layer_count > 0) {
        uint8_t *const end = (uint8_t *)arena + uwb_arena_size(model);
        return (float *)(void *)(end - model->samples * sizeof(float));
    }
    /* The place of the residual sum is free until the first module: quantised samples, then the window. */
    uint32_t *const sum = (uint32_t *)arena + UWB_BLOCK_WORDS;
    return (float *)(void *)(sum + (UWB_BLOCKS(model->samples) * UWB_BLOCK + UWB_LONGEST_KERNEL + 1u) / 2u);
}

static void clear_input(uint32_t *x, uint32_t position) {
    uint32_t *const word = x + uwb_input_word(position, 0);
    const uint32_t kept = ~(0xFFu << uwb_input_shift(position));
    for (uint32_t channel = 0; channel < UWB_FILTERS; channel++) {
        word[4 * channel] &= kept;
    }
}

static void clear_sum(uint32_t *r, int32_t position) {
    uint32_t *const word = r + uwb_sum_word(position, 0);
    for (uint32_t pair = 0; pair < UWB_FILTERS / 2; pair++) {
        word[UWB_BLOCK * pair] = 0;
    }
}

static const uint32_t *run_remnet(const uwb_model *model, const float *window, uint32_t *arena) {
    uint32_t length = model->samples;
    uint32_t blocks = UWB_BLOCKS(length);
    uint32_t *const r = arena + UWB_BLOCK_WORDS;
    uint32_t *const x = r + (blocks + (length % 2 == 0)) * UWB_BLOCK_WORDS;

    uint16_t *const samples = (uint16_t *)r;
    const uint32_t lead = model->first_kernel / 2u;
    const uint32_t padded = blocks * UWB_BLOCK + model->first_kernel + 1u;
    uwb_quantise(window, samples + lead, length, &model->input_scale);
    memset(samples, 0, lead * sizeof *samples);
    memset(samples + lead + length, 0, (padded - lead - length) * sizeof *samples);
    uwb_conv_first(samples, x, blocks, model->first_weights, model->first, model->first_kernel);

    for (uint32_t i = 0; i < model->module_count; i++) {
        const uwb_module *const module = &model->modules[i];
        const uint32_t positions = length <= UWB_BLOCK / 2 ? UWB_BLOCK / 2 : blocks * UWB_BLOCK;
        if (length < positions) {
            clear_input(x, length);
        }
        uwb_conv_residual(x, r, positions / UWB_BLOCK, module);
        clear_sum(r, (int32_t)length);
        if (length % 2 != 0) {
            clear_sum(r, -1);
            uwb_conv_reduce_odd(r, x, blocks, module);
        } else {
            uwb_conv_reduce_even(r, x, blocks, module);
        }
        length = (length + 1) / 2;
        blocks = UWB_BLOCKS(length);
    }
    return x;
}

static const uint32_t *run_dense(const uwb_model *model, const float *window, uint16_t *arena, size_t half) {
    uint16_t *input = arena;
    uint16_t *output = arena + half;
    uwb_quantise(window, input, model->samples, &model->input_scale);
    memset(input + model->samples, 0, (model->layers[0].inputs - model->samples) * sizeof *input);
    for (uint32_t i = 0; i < model->layer_count; i++) {
        uwb_dense(input, output, &model->layers[i]);
        uint16_t *const swap = input;
        input = output;
        output = swap;
    }
    uint32_t *const words = (uint32_t *)(void *)output;
    for (uint32_t word = 0; word < model->head_inputs / 2u; word++) {
        words[word] = input[2 * word] | (uint32_t)input[2 * word + 1] << UWB_POSITION_SHIFT;
    }
    return words;
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
    const uint32_t *const features =
        model->layer_count > 0
            ? run_dense(model, window, arena, (needed - model->samples * sizeof(float)) / (2 * sizeof(uint16_t)))
            : run_remnet(model, window, arena);
    const int32_t accumulator = uwb_dot(features, model->head_weights, model->head_inputs, model->head_bias);
    *output_m = (float)accumulator * model->head_scale;
    return UWB_OK;
}
