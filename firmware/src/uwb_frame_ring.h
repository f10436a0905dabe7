/* Ring of received frames between an interrupt, which puts bytes, and the loop, which reads complete frames.
 *
 * A correction takes longer than the receive buffers of small boards last. If the sender is faster than the loop,
 * complete frames are dropped and counted, never parts of one. */
#ifndef UWB_FRAME_RING_H
#define UWB_FRAME_RING_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The indices count bytes since the start and wrap with 2^32. Each is written by one side only. */
typedef struct {
    uint8_t *bytes; /* for each frame: time of its first byte, bytes of the wire with the delimiter */
    uint32_t capacity; /* a power of two */
    volatile uint32_t first;    /* of the loop: next byte to read */
    volatile uint32_t complete; /* of the interrupt: end of the last complete frame */
    volatile uint32_t lost;     /* frames without space */
    uint32_t end;               /* of the interrupt: end of the frame that is being received */
    uint32_t start_us;          /* of the loop: start of the frame that is being read */
    uint8_t skips;              /* of the interrupt: until the next delimiter */
    uint8_t reads_frame;        /* of the loop: the time of the frame was read */
} uwb_frame_ring;

/* Put a received byte; call it from one interrupt, or from one thread. `now_us` wraps with 2^32. */
void uwb_frame_ring_put(uwb_frame_ring *ring, uint8_t byte, uint32_t now_us);

/* Read at most `limit` bytes of one complete frame, and the time of its first byte; returns their number, 0 if there is
 * no complete frame. The last byte of a frame is its delimiter, 0. */
size_t uwb_frame_ring_read(uwb_frame_ring *ring, uint8_t *bytes, size_t limit, uint32_t *start_us);

#ifdef __cplusplus
}
#endif
#endif
