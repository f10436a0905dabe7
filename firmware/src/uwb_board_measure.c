#include "uwb_board.h"

static void take(uwb_board *board, const uwb_header_t *header, size_t payload_bytes) {
    const uint8_t *const payload = board->radio.body.bytes + UWB_HEADER_BYTES;
    uwb_range_cir_t fields;
    uwb_cir cir;
    if (header->type != UWB_TYPE_RANGE_CIR || !uwb_read_measurement(payload, payload_bytes, &fields, &cir)) {
        board->radio_faults++;
        return;
    }
    const uint64_t time_us = board->radio_began_us;
    int sent = 1;
    board->measurements++;
    if (board->mode != UWB_MODE_DEVICE) {
        sent = uwb_board_send(board, UWB_TYPE_RANGE_CIR, 0, time_us, payload, payload_bytes, UWB_ANSWER_RESERVE_BYTES);
    }
    if (board->mode != UWB_MODE_HOST) {
        sent = uwb_board_correct(board, &fields, &cir, 0, time_us) && sent;
    }
    if (!sent) {
        board->measurements_lost++;
    }
}

void uwb_board_measure(uwb_board *board, const uint8_t *bytes, size_t count, uint64_t now_us) {
    for (size_t i = 0; i < count; i++) {
        if (board->radio.encoded == 0) {
            board->radio_began_us = now_us;
        }
        uwb_header_t header;
        const int32_t payload = uwb_decoder_push(&board->radio, bytes[i], &header);
        if (payload >= 0) {
            take(board, &header, (size_t)payload);
        }
    }
}
