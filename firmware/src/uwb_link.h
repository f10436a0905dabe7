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

/* Turns a stream of bytes into frames; keeps at most one. All zeros is a decoder that has seen nothing. */
typedef struct {
    uint32_t frames;           /* intact, of this version */
    uint32_t bad_cobs;         /* segments between delimiters that are not COBS */
    uint32_t bad_length;       /* shorter than header and CRC, or longer than the longest frame */
    uint32_t bad_crc;
    uint32_t oversize;         /* segments longer than the longest encoded frame */
    uint32_t foreign_versions; /* intact frames of another version */
    uint16_t encoded;          /* bytes of the segment so far */
    uint16_t decoded;
    uint8_t code;              /* of the block that is being read */
    uint8_t remaining;         /* bytes that it still has */
    uint8_t overrun;           /* the segment is counted as oversize: skip to its end */
    union {
        uint64_t aligned;
        uint8_t bytes[UWB_MAX_FRAME_BYTES];
        int16_t values[UWB_MAX_FRAME_BYTES / 2];
    } body;
} uwb_decoder;

/* Take one byte. Returns the bytes of payload if it completes an intact frame, else -1. Its header and payload
 * are in body.bytes until the next byte. */
int32_t uwb_decoder_push(uwb_decoder *decoder, uint8_t byte, uwb_header_t *header);

/* A wire buffer: header and payload are at UWB_WIRE_LEAD before they are encoded in place. */
#define UWB_WIRE_LEAD 20
#define UWB_MAX_WIRE_BYTES (UWB_WIRE_LEAD + UWB_MAX_FRAME_BYTES)

/* Make the header and the payload in `wire` a frame, delimiters included; returns its length. At most
 * UWB_MAX_PAYLOAD_BYTES of payload. */
size_t uwb_encode_frame(uint8_t *wire, size_t payload_bytes);

/* Frames that wait to be sent, in a ring of the caller's memory, and the one that is being sent. A frame is numbered
 * when it leaves: the host takes a gap for a frame lost on the way. */
typedef struct {
    uint8_t *bytes; /* for each frame the length of its payload, its header and its payload */
    size_t capacity;
    size_t first;
    size_t used;
    uint32_t sequence; /* of the frame that leaves next */
    size_t encoded;    /* bytes in `wire`, of which `sent` are on their way */
    size_t sent;
    uint8_t wire[UWB_MAX_WIRE_BYTES];
} uwb_queue;

#define UWB_TIME_OF_SENDING UINT64_MAX /* as a header's time_us: it becomes that of its leaving */

/* Put a frame behind all others if it fits and then leaves `reserve` bytes free, else do nothing; returns whether it
 * did. The header's sequence is of no meaning. */
int uwb_queue_frame(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes,
                    size_t reserve);

/* Put a frame before all others if it fits; returns whether it did. */
int uwb_queue_urgent(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes);

/* The rest of the frame that is being sent, or else the whole next one; returns its length, 0 if nothing waits. */
size_t uwb_queue_peek(uwb_queue *queue, uint64_t now_us, const uint8_t **bytes);

/* Forget `count` bytes of that, which have been sent. */
void uwb_queue_drop(uwb_queue *queue, size_t count);

/* Read a RANGE_CIR at `payload`, which is aligned to 2 bytes: its fields, and a CIR whose samples stay where they
 * are. Returns whether it is well formed. */
int uwb_read_measurement(const uint8_t *payload, size_t payload_bytes, uwb_range_cir_t *fields, uwb_cir *cir);

#ifdef __cplusplus
}
#endif
#endif
