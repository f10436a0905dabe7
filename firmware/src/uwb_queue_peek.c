#include <string.h>

#include "uwb_link.h"

static void take(uwb_queue *queue, void *data, size_t bytes) {
    const size_t to_end = queue->capacity - queue->first;
    const size_t piece = bytes < to_end ? bytes : to_end;
    memcpy(data, queue->bytes + queue->first, piece);
    memcpy((uint8_t *)data + piece, queue->bytes, bytes - piece);
    queue->first = (queue->first + bytes) % queue->capacity;
    queue->used -= bytes;
}

size_t uwb_queue_peek(uwb_queue *queue, uint64_t now_us, const uint8_t **bytes) {
    if (queue->sent == queue->encoded && queue->used != 0) {
        uint16_t payload_bytes;
        uwb_header_t header;
        take(queue, &payload_bytes, sizeof payload_bytes);
        take(queue, &header, sizeof header);
        header.sequence = queue->sequence++;
        header.time_us = header.time_us == UWB_WHEN_IT_LEAVES ? now_us : header.time_us;
        memcpy(queue->wire + UWB_WIRE_LEAD, &header, sizeof header);
        take(queue, queue->wire + UWB_WIRE_LEAD + sizeof header, payload_bytes);
        queue->encoded = uwb_encode_frame(queue->wire, payload_bytes);
        queue->sent = 0;
    }
    *bytes = queue->wire + queue->sent;
    return queue->encoded - queue->sent;
}
