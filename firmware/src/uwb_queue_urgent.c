#include "uwb_queue.h"

int uwb_queue_urgent(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes) {
    const size_t before = queue->first + queue->capacity - UWB_QUEUED_BYTES(payload_bytes);
    if (!uwb_queue_put(queue, before, header, payload, payload_bytes, 0)) {
        return 0;
    }
    queue->first = before % queue->capacity;
    return 1;
}
