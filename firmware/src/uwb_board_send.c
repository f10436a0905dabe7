#include "uwb_board.h"

int uwb_board_send(uwb_board *board, uint8_t type, uint16_t flags, uint64_t time_us, const void *payload,
                   size_t payload_bytes, size_t reserve) {
    const uwb_header_t header = {UWB_PROTOCOL_VERSION, type, flags, board->sequence, time_us};
    if (!uwb_queue_frame(&board->queue, &header, payload, payload_bytes, reserve)) {
        return 0;
    }
    /* Only what is sent is numbered: the host takes a gap for a frame lost on the way. */
    board->sequence++;
    return 1;
}
