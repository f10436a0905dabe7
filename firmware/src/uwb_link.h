/* The wire protocol: bytes to frames and back. docs/protocol.md specifies it, uwb_protocol.h is its table.
 *
 * No allocation and no globals; every function is bounded by what it is given. Fields of this header's structs are
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
    uint32_t bad_cobs;         /* stretches between delimiters that are not COBS */
    uint32_t bad_length;       /* shorter than header and CRC, or longer than the longest frame */
    uint32_t bad_crc;
    uint32_t oversize;         /* stretches longer than a frame can be encoded */
    uint32_t foreign_versions; /* intact frames of another version */
    uint16_t encoded;          /* bytes of the stretch so far */
    uint16_t decoded;
    uint8_t code;              /* of the block that is being read */
    uint8_t remaining;         /* bytes that it still has */
    uint8_t overrun;           /* the stretch is counted as oversize: skip to its end */
    union {
        uint64_t aligned;
        uint8_t bytes[UWB_MAX_FRAME_BYTES];
        int16_t values[UWB_MAX_FRAME_BYTES / 2];
    } body;
} uwb_decoder;

/* Take one byte. Returns the bytes of payload if it completes an intact frame, else -1. Its header and payload
 * stand in body.bytes until the next byte. */
int32_t uwb_decoder_push(uwb_decoder *decoder, uint8_t byte, uwb_header_t *header);

/* CRC-32 of IEEE 802.3, continued from `crc`; 0 to begin with. */
uint32_t uwb_crc32(uint32_t crc, const void *data, size_t bytes);

/* Bytes that wait to be sent, in a ring of the caller's memory. */
typedef struct {
    uint8_t *bytes;
    size_t capacity;
    size_t first;
    size_t used;
} uwb_queue;

/* Append a whole frame if it fits and then leaves `reserve` bytes free, else nothing; returns whether it did. */
int uwb_queue_frame(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes,
                    size_t reserve);

/* The longest stretch that lies in one piece at the front; returns its length. */
size_t uwb_queue_peek(const uwb_queue *queue, const uint8_t **bytes);

/* Forget `count` bytes at the front, which have been sent. */
void uwb_queue_drop(uwb_queue *queue, size_t count);

/* Read a RANGE_CIR at `payload`, which is aligned to 2 bytes: its fields, and a CIR whose samples stay where they
 * are. Returns whether it is well formed. */
int uwb_read_measurement(const uint8_t *payload, size_t payload_bytes, uwb_range_cir_t *fields, uwb_cir *cir);

#ifdef __cplusplus
}
#endif
#endif
