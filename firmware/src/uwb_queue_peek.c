#include "uwb_link.h"

size_t uwb_queue_peek(const uwb_queue *queue, const uint8_t **bytes) {
    const size_t to_end = queue->capacity - queue->first;
    *bytes = queue->bytes + queue->first;
    return queue->used < to_end ? queue->used : to_end;
}
