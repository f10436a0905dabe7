#include <string.h>

#include "uwb_board.h"

int uwb_board_correct(uwb_board *board, const uwb_range_cir_t *fields, const uwb_cir *cir, uint16_t flags,
                      uint64_t time_us) {
    const uwb_board_config *const config = &board->config;
    const uint32_t began_us = config->clock_us != NULL ? config->clock_us() : 0;
    uwb_corrected corrected;
    const float offset_m = uwb_board_offset_m(board, fields->tag_id, fields->anchor_id);
    (void)uwb_correct(config->model, fields->range, offset_m, cir, config->arena, config->arena_bytes, &corrected);

    uwb_range_corrected_t message;
    memset(&message, 0, sizeof message);
    message.tag_id = fields->tag_id;
    message.anchor_id = fields->anchor_id;
    message.device_time = fields->device_time;
    message.sequence = fields->sequence;
    message.model_id = config->model->model_id;
    message.range = corrected.range_m;
    message.range_raw = fields->range;
    message.correction = corrected.correction_m;
    message.variance = corrected.variance_m2;
    message.compute_us = config->clock_us != NULL ? config->clock_us() - began_us : 0;
    message.status = (uint8_t)corrected.status;
    return uwb_board_send(board, UWB_TYPE_RANGE_CORRECTED, flags, time_us, &message, sizeof message,
                          UWB_ANSWER_RESERVE_BYTES);
}
