#include "uwb_link.h"

void uwb_queue_drop(uwb_queue *queue, size_t count) {
    const size_t left = queue->encoded - queue->sent;
    queue->sent += count < left ? count : left;
}
