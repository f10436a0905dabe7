#include "uwb_board.h"

void uwb_board_measure(uwb_board *board, const uint8_t *bytes, size_t count, uint64_t now_us) {
    for (size_t i = 0; i < count; i++) {
        if (board->radio.encoded == 0) {
            board->radio_began_us = now_us;
        }
        uwb_header_t header;
        const int32_t payload = uwb_decoder_push(&board->radio, bytes[i], &header);
        if (payload >= 0) {
            const uint8_t *const bytes_of_payload = board->radio.body.bytes + UWB_HEADER_BYTES;
            if (header.type != UWB_TYPE_RANGE_CIR ||
                !uwb_board_take(board, bytes_of_payload, (size_t)payload, board->radio_began_us)) {
                board->radio_faults++;
            }
        }
    }
}
