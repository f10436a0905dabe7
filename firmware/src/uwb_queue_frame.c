#include <string.h>

#include "uwb_link.h"

static size_t put(uwb_queue *queue, size_t at, const void *data, size_t bytes) {
    const size_t to_end = queue->capacity - at;
    const size_t piece = bytes < to_end ? bytes : to_end;
    if (bytes != 0) {
        memcpy(queue->bytes + at, data, piece);
        memcpy(queue->bytes, (const uint8_t *)data + piece, bytes - piece);
    }
    return (at + bytes) % queue->capacity;
}

/* The bytes that the frame needs, or 0 if it does not fit. */
static size_t fitting(const uwb_queue *queue, size_t payload_bytes, size_t reserve) {
    const size_t room = queue->capacity - queue->used;
    const size_t needed = sizeof(uint16_t) + UWB_HEADER_BYTES + payload_bytes;
    return payload_bytes <= UWB_MAX_PAYLOAD_BYTES && needed <= room && reserve <= room - needed ? needed : 0;
}

static void place(uwb_queue *queue, size_t at, const uwb_header_t *header, const void *payload,
                  size_t payload_bytes) {
    const uint16_t length = (uint16_t)payload_bytes;
    at = put(queue, at, &length, sizeof length);
    at = put(queue, at, header, UWB_HEADER_BYTES);
    (void)put(queue, at, payload, payload_bytes);
}

int uwb_queue_frame(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes,
                    size_t reserve) {
    const size_t needed = fitting(queue, payload_bytes, reserve);
    if (needed != 0) {
        place(queue, (queue->first + queue->used) % queue->capacity, header, payload, payload_bytes);
        queue->used += needed;
    }
    return needed != 0;
}

int uwb_queue_urgent(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes) {
    const size_t needed = fitting(queue, payload_bytes, 0);
    if (needed != 0) {
        queue->first = (queue->first + queue->capacity - needed) % queue->capacity;
        place(queue, queue->first, header, payload, payload_bytes);
        queue->used += needed;
    }
    return needed != 0;
}
