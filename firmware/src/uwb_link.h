/* The wire protocol: bytes to frames and back. docs/reference/protocol.md specifies it, uwb_protocol.h is its table.
 *
 * No allocation and no globals; every function has bounded run time. Fields of this header's structs are
 * to be read, not written. */
#ifndef UWB_LINK_H
#define UWB_LINK_H

#include "uwb_mitigation.h"
#include "uwb_protocol.h"

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "frames are read in place: little-endian processors only"
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* Decoder of a byte stream; stores at most one frame. Initialise it with zeros. */
typedef struct {
    uint32_t frames;           /* intact, of this version */
    uint32_t bad_cobs;         /* segments between delimiters that are not COBS */
    uint32_t bad_length;       /* shorter than header and CRC, or longer than the longest frame */
    uint32_t bad_crc;
    uint32_t oversize;         /* segments longer than the longest encoded frame */
    uint32_t foreign_versions; /* intact frames of another version */
    uint16_t encoded;          /* bytes of the segment so far */
    uint16_t decoded;
    uint8_t code;              /* length code of the current COBS block */
    uint8_t remaining;         /* bytes left in this block */
    uint8_t overrun;           /* the segment is counted as oversize: skip to its end */
    union {
        uint64_t aligned;
        uint8_t bytes[UWB_MAX_FRAME_BYTES];
        int16_t values[UWB_MAX_FRAME_BYTES / 2];
    } body;
} uwb_decoder;

/* Decode one byte. Returns the bytes of payload if it completes an intact frame, else -1. Header and payload are in
 * body.bytes until the next call. */
int32_t uwb_decoder_push(uwb_decoder *decoder, uint8_t byte, uwb_header_t *header);

/* Before the encoding, header and payload are at UWB_WIRE_HEADROOM in a wire buffer. */
#define UWB_WIRE_HEADROOM 20
#define UWB_MAX_WIRE_BYTES (UWB_WIRE_HEADROOM + UWB_MAX_FRAME_BYTES)

/* Encode the header and the payload in `wire` in place, with delimiters; returns the length. The payload has at most
 * UWB_MAX_PAYLOAD_BYTES. */
size_t uwb_encode_frame(uint8_t *wire, size_t payload_bytes);

/* Queued frames, in a ring buffer of the caller, and the frame that is being sent. Frames are numbered when they are
 * sent, because the host counts gaps as lost frames. */
typedef struct {
    uint8_t *bytes; /* for each frame: length of the payload, header, payload */
    size_t capacity;
    size_t first;
    size_t used;
    uint32_t sequence; /* of the next frame */
    size_t encoded;    /* bytes in `wire`, of which `sent` were sent */
    size_t sent;
    uint8_t wire[UWB_MAX_WIRE_BYTES];
} uwb_queue;

#define UWB_TIME_OF_SENDING UINT64_MAX /* as time_us of a header: is replaced by the time of sending */

/* Append a frame if it fits and leaves `reserve` bytes free; returns whether it was queued. The sequence number in the
 * header is ignored. */
int uwb_queue_frame(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes,
                    size_t reserve);

/* Insert a frame before all others if it fits; returns whether it was queued. */
int uwb_queue_urgent(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes);

/* Get the unsent bytes of the current frame, or the complete next frame; returns their number, 0 if the queue is empty. */
size_t uwb_queue_peek(uwb_queue *queue, uint64_t now_us, const uint8_t **bytes);

/* Remove `count` bytes that were sent. */
void uwb_queue_drop(uwb_queue *queue, size_t count);

/* Send the current frame again from its first byte, unless it was sent completely: the host has closed the port. */
void uwb_queue_restart(uwb_queue *queue);

/* Parse a RANGE_CIR at `payload`, which is aligned to 2 bytes. The samples of the CIR stay in the payload. Returns
 * whether it is well formed. */
int uwb_read_measurement(const uint8_t *payload, size_t payload_bytes, uwb_range_cir_t *fields, uwb_cir *cir);

#ifdef __cplusplus
}
#endif
#endif
