#include "uwb_queue.h"

int uwb_queue_frame(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes,
                    size_t reserve) {
    return uwb_queue_put(queue, queue->first + queue->used, header, payload, payload_bytes, reserve);
}
