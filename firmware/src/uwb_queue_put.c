#include <string.h>

#include "uwb_queue.h"

static size_t put(uwb_queue *queue, size_t at, const void *data, size_t bytes) {
    const size_t to_end = queue->capacity - at;
    const size_t piece = bytes < to_end ? bytes : to_end;
    if (bytes != 0) {
        memcpy(queue->bytes + at, data, piece);
        memcpy(queue->bytes, (const uint8_t *)data + piece, bytes - piece);
    }
    return (at + bytes) % queue->capacity;
}

int uwb_queue_put(uwb_queue *queue, size_t at, const uwb_header_t *header, const void *payload, size_t payload_bytes,
                  size_t reserve) {
    const uint16_t length = (uint16_t)payload_bytes;
    const size_t room = queue->capacity - queue->used;
    const size_t needed = UWB_QUEUED_BYTES(payload_bytes);
    if (payload_bytes > UWB_MAX_PAYLOAD_BYTES || needed > room || reserve > room - needed) {
        return 0;
    }
    at = put(queue, at % queue->capacity, &length, sizeof length);
    at = put(queue, at, header, UWB_HEADER_BYTES);
    (void)put(queue, at, payload, payload_bytes);
    queue->used += needed;
    return 1;
}
