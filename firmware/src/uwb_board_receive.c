#include <string.h>

#include "uwb_board.h"

/* Whether the frame was one for the board. */
static int answer(uwb_board *board, const uwb_header_t *header, size_t payload_bytes, uint64_t now_us) {
    const uint8_t *const payload = board->host.body.bytes + UWB_HEADER_BYTES;
    switch (header->type) {
    case UWB_TYPE_GET_INFO:
        uwb_board_hello(board, &header->sequence, now_us);
        return 1;
    case UWB_TYPE_SET_MODE:
        if (payload_bytes < sizeof(uwb_set_mode_t) || payload[0] > UWB_MODE_BOTH) {
            return 0;
        }
        if (board->config.model != NULL || payload[0] == UWB_MODE_HOST) {
            board->mode = payload[0];
        }
        uwb_board_hello(board, &header->sequence, now_us);
        return 1;
    case UWB_TYPE_SET_OFFSETS:
        return uwb_board_set_offsets(board, payload, payload_bytes, header->sequence, now_us);
    case UWB_TYPE_TIME_SYNC: {
        uwb_time_sync_reply_t reply;
        memset(&reply, 0, sizeof reply);
        reply.request_sequence = header->sequence;
        reply.received_us = now_us;
        /* Before all that waits: the shorter the round trip, the better the host knows the clock. */
        const uwb_header_t first = {UWB_PROTOCOL_VERSION, UWB_TYPE_TIME_SYNC_REPLY, UWB_FLAG_ANSWER, 0,
                                    UWB_WHEN_IT_LEAVES};
        (void)uwb_queue_urgent(&board->queue, &first, &reply, sizeof reply);
        return 1;
    }
    case UWB_TYPE_RANGE_CIR: {
        uwb_range_cir_t fields;
        uwb_cir cir;
        if (board->config.model == NULL || !uwb_read_measurement(payload, payload_bytes, &fields, &cir)) {
            return 0;
        }
        if (!uwb_board_correct(board, &fields, &cir, UWB_FLAG_ANSWER, now_us)) {
            board->measurements_lost++;
        }
        return 1;
    }
    default:
        return board->config.other != NULL &&
               board->config.other(board->config.context, header, payload, payload_bytes, now_us);
    }
}

void uwb_board_receive(uwb_board *board, const uint8_t *bytes, size_t count, uint64_t now_us) {
    const uint32_t foreign = board->host.foreign_versions;
    for (size_t i = 0; i < count; i++) {
        uwb_header_t header;
        const int32_t payload = uwb_decoder_push(&board->host, bytes[i], &header);
        if (payload >= 0 && !answer(board, &header, (size_t)payload, now_us)) {
            board->dropped++;
        }
    }
    if (board->host.foreign_versions != foreign) {
        /* A host of another version learns from this which one the board speaks. */
        uwb_board_hello(board, NULL, now_us);
    }
}
