#include "uwb_board.h"

int uwb_board_send(uwb_board *board, uint8_t type, uint16_t flags, uint64_t time_us, const void *payload,
                   size_t payload_bytes, size_t reserve) {
    const uwb_header_t header = {UWB_PROTOCOL_VERSION, type, flags, 0, time_us};
    return uwb_queue_frame(&board->queue, &header, payload, payload_bytes, reserve);
}
