#include "uwb_link.h"

void uwb_queue_drop(uwb_queue *queue, size_t count) {
    count = count < queue->used ? count : queue->used;
    if (count != 0) {
        queue->first = (queue->first + count) % queue->capacity;
        queue->used -= count;
    }
}
