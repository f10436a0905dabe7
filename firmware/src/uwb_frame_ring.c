#include "uwb_frame_ring.h"

enum { TIME_BYTES = 4 };

static void append(uwb_frame_ring *ring, uint32_t byte) {
    ring->bytes[ring->end & (ring->capacity - 1u)] = (uint8_t)byte;
    ring->end++;
}

void uwb_frame_ring_put(uwb_frame_ring *ring, uint8_t byte, uint32_t now_us) {
    const int starts = ring->end == ring->complete;
    if (byte == 0) {
        if (!starts) {
            append(ring, 0);
            ring->complete = ring->end;
        }
        ring->skips = 0;
        return;
    }
    if (ring->skips) {
        return;
    }
    /* One byte more for the delimiter. */
    const uint32_t needed = (starts ? TIME_BYTES : 0u) + 2u;
    if (ring->capacity - (ring->end - ring->first) < needed) {
        ring->end = ring->complete;
        ring->skips = 1;
        ring->lost++;
        return;
    }
    for (uint32_t shift = 0; starts && shift < 8u * TIME_BYTES; shift += 8u) {
        append(ring, now_us >> shift & 0xFFu);
    }
    append(ring, byte);
}

static uint8_t take(uwb_frame_ring *ring) {
    const uint8_t byte = ring->bytes[ring->first & (ring->capacity - 1u)];
    ring->first++;
    return byte;
}

size_t uwb_frame_ring_read(uwb_frame_ring *ring, uint8_t *bytes, size_t limit, uint32_t *start_us) {
    if (ring->first == ring->complete || limit == 0) {
        return 0;
    }
    if (!ring->reads_frame) {
        ring->start_us = 0;
        for (uint32_t shift = 0; shift < 8u * TIME_BYTES; shift += 8u) {
            ring->start_us |= (uint32_t)take(ring) << shift;
        }
        ring->reads_frame = 1;
    }
    size_t count = 0;
    while (count < limit && ring->reads_frame) {
        bytes[count] = take(ring);
        ring->reads_frame = bytes[count] != 0;
        count++;
    }
    *start_us = ring->start_us;
    return count;
}
