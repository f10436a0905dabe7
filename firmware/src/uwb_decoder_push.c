#include <string.h>

#include "uwb_link.h"

/* The CRC-32 of any message followed by its own CRC is this. */
static const uint32_t CRC_RESIDUE = 0x2144DF1Cu;

static void store(uwb_decoder *decoder, uint8_t byte) {
    if (decoder->decoded < UWB_MAX_FRAME_BYTES) {
        decoder->body.bytes[decoder->decoded] = byte;
    }
    decoder->decoded++;
}

/* What lies between two delimiters is complete. */
static int32_t finish(uwb_decoder *decoder, uwb_header_t *header) {
    const size_t length = decoder->decoded;
    if (decoder->remaining != 0) {
        decoder->bad_cobs++;
        return -1;
    }
    if (length < UWB_HEADER_BYTES + UWB_CRC_BYTES || length > UWB_MAX_FRAME_BYTES) {
        decoder->bad_length++;
        return -1;
    }
    if (uwb_crc32(0, decoder->body.bytes, length) != CRC_RESIDUE) {
        decoder->bad_crc++;
        return -1;
    }
    memcpy(header, decoder->body.bytes, sizeof *header);
    if (header->version != UWB_PROTOCOL_VERSION) {
        decoder->foreign_versions++;
        return -1;
    }
    decoder->frames++;
    return (int32_t)(length - UWB_HEADER_BYTES - UWB_CRC_BYTES);
}

int32_t uwb_decoder_push(uwb_decoder *decoder, uint8_t byte, uwb_header_t *header) {
    if (byte == 0) {
        const int32_t payload = decoder->encoded != 0 && !decoder->overrun ? finish(decoder, header) : -1;
        decoder->encoded = decoder->decoded = 0;
        decoder->code = decoder->remaining = decoder->overrun = 0;
        return payload;
    }
    if (decoder->overrun) {
        return -1;
    }
    if (decoder->encoded == UWB_MAX_ENCODED_BYTES) {
        decoder->oversize++;
        decoder->overrun = 1;
        return -1;
    }
    decoder->encoded++;
    if (decoder->remaining != 0) {
        decoder->remaining--;
        store(decoder, byte);
        return -1;
    }
    if (decoder->encoded > 1 && decoder->code != 0xFF) {
        store(decoder, 0);
    }
    decoder->code = byte;
    decoder->remaining = (uint8_t)(byte - 1);
    return -1;
}
