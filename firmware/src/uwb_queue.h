/* How frames are put into the ring of bytes that wait to be sent. Internal. */
#ifndef UWB_QUEUE_H
#define UWB_QUEUE_H

#include "uwb_link.h"

/* Bytes of a frame in the ring: the length of its payload, its header and its payload. */
#define UWB_QUEUED_BYTES(payload_bytes) (sizeof(uint16_t) + UWB_HEADER_BYTES + (payload_bytes))

/* Write a frame at the place `at`, wrapped, if it fits and then leaves `reserve` bytes free; returns whether it did. */
int uwb_queue_put(uwb_queue *queue, size_t at, const uwb_header_t *header, const void *payload, size_t payload_bytes,
                  size_t reserve);

#endif
