#include "uwb_board.h"

int uwb_board_take(uwb_board *board, const uint8_t *payload, size_t payload_bytes, uint64_t time_us) {
    uwb_range_cir_t fields;
    uwb_cir cir;
    int sent = 1;
    if (!uwb_read_measurement(payload, payload_bytes, &fields, &cir)) {
        return 0;
    }
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
    return 1;
}
