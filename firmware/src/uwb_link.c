#include <string.h>

#include "uwb_link.h"

/* CRC-32 of IEEE 802.3, continued from `crc`; 0 to begin with. */
static uint32_t crc32(uint32_t crc, const void *data, size_t bytes) {
    /* Half a byte at a time: 64 bytes of table for half of the steps. */
    static const uint32_t table[16] = {
        0x00000000u, 0x1db71064u, 0x3b6e20c8u, 0x26d930acu, 0x76dc4190u, 0x6b6b51f4u, 0x4db26158u, 0x5005713cu,
        0xedb88320u, 0xf00f9344u, 0xd6d6a3e8u, 0xcb61b38cu, 0x9b64c2b0u, 0x86d3d2d4u, 0xa00ae278u, 0xbdbdf21cu,
    };
    const uint8_t *at = data;
    crc = ~crc;
    for (size_t i = 0; i < bytes; i++) {
        crc ^= at[i];
        crc = (crc >> 4) ^ table[crc & 15u];
        crc = (crc >> 4) ^ table[crc & 15u];
    }
    return ~crc;
}

/* COBS adds at most a delimiter, a first code and one more for each 254 bytes: fewer than UWB_WIRE_HEADROOM, so that
 * nothing is written over before it is read. */
size_t uwb_encode_frame(uint8_t *wire, size_t payload_bytes) {
    uint8_t *const from = wire + UWB_WIRE_HEADROOM;
    const size_t checked = UWB_HEADER_BYTES + payload_bytes;
    const uint32_t crc = crc32(0, from, checked);
    memcpy(from + checked, &crc, sizeof crc);

    size_t to = 0;
    wire[to++] = 0; /* terminates preceding noise */
    size_t code_at = to++;
    uint8_t code = 1;
    int block_open = 1; /* whether a block is being written, whose length goes to code_at */
    for (size_t i = 0; i < checked + sizeof crc; i++) {
        const uint8_t byte = from[i];
        if (!block_open) {
            code_at = to++;
            code = 1;
            block_open = 1;
        }
        if (byte == 0) {
            wire[code_at] = code;
            code_at = to++;
            code = 1;
            continue;
        }
        wire[to++] = byte;
        code++;
        if (code == 0xFF) {
            wire[code_at] = code;
            block_open = 0;
        }
    }
    if (block_open) {
        wire[code_at] = code;
    }
    wire[to++] = 0;
    return to;
}

/* The CRC-32 of any message followed by its own CRC is this. */
static const uint32_t CRC_RESIDUE = 0x2144DF1Cu;

/* Append a decoded byte; bytes beyond the longest frame are counted and discarded. */
static void store_byte(uwb_decoder *decoder, uint8_t byte) {
    if (decoder->decoded < UWB_MAX_FRAME_BYTES) {
        decoder->body.bytes[decoder->decoded] = byte;
    }
    decoder->decoded++;
}

/* Check the segment between two delimiters; returns the bytes of payload, or -1 if it is no intact frame. */
static int32_t finish_frame(uwb_decoder *decoder, uwb_header_t *header) {
    const size_t length = decoder->decoded;
    if (decoder->remaining != 0) {
        decoder->bad_cobs++;
        return -1;
    }
    if (length < UWB_HEADER_BYTES + UWB_CRC_BYTES || length > UWB_MAX_FRAME_BYTES) {
        decoder->bad_length++;
        return -1;
    }
    if (crc32(0, decoder->body.bytes, length) != CRC_RESIDUE) {
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
        const int32_t payload = decoder->encoded != 0 && !decoder->overrun ? finish_frame(decoder, header) : -1;
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
        store_byte(decoder, byte);
        return -1;
    }
    if (decoder->encoded > 1 && decoder->code != 0xFF) {
        store_byte(decoder, 0);
    }
    decoder->code = byte;
    decoder->remaining = (uint8_t)(byte - 1);
    return -1;
}

static const uint64_t DEVICE_TIME_WRAP = (uint64_t)1 << 40;

int uwb_read_measurement(const uint8_t *payload, size_t payload_bytes, uwb_range_cir_t *fields, uwb_cir *cir) {
    if (payload_bytes < sizeof *fields) {
        return 0;
    }
    memcpy(fields, payload, sizeof *fields);
    const size_t offset = fields->samples_offset;
    const size_t count = fields->sample_count;
    if (fields->device_time >= DEVICE_TIME_WRAP || count > UWB_MAX_SAMPLES || offset < sizeof *fields ||
        offset % 2 != 0 || offset + 2 * count > payload_bytes || fields->encoding > UWB_MAGNITUDE) {
        return 0;
    }
    cir->samples = (const int16_t *)(const void *)(payload + offset);
    cir->count = count;
    cir->encoding = fields->encoding == UWB_MAGNITUDE ? UWB_MAGNITUDE : UWB_COMPLEX_INT16;
    cir->start_index = fields->start_index;
    cir->first_path_index = fields->first_path_index;
    cir->scale = fields->scale;
    cir->preamble_count = fields->preamble_count;
    cir->rx_power_dbm = fields->rx_power;
    cir->first_path_power_dbm = fields->first_path_power;
    return 1;
}

/* Bytes of a frame in the ring: the length of its payload, its header and its payload. */
#define QUEUED_BYTES(payload_bytes) (sizeof(uint16_t) + UWB_HEADER_BYTES + (payload_bytes))

/* Write bytes at `at`, wrapped; returns the position after them. */
static size_t ring_write(uwb_queue *queue, size_t at, const void *data, size_t bytes) {
    const size_t to_end = queue->capacity - at;
    const size_t first_part = bytes < to_end ? bytes : to_end;
    if (bytes != 0) {
        memcpy(queue->bytes + at, data, first_part);
        memcpy(queue->bytes, (const uint8_t *)data + first_part, bytes - first_part);
    }
    return (at + bytes) % queue->capacity;
}

/* Write a frame at `at`, wrapped, if it fits and leaves `reserve` bytes free; returns whether it was written. */
static int ring_write_frame(uwb_queue *queue, size_t at, const uwb_header_t *header, const void *payload,
                            size_t payload_bytes, size_t reserve) {
    const uint16_t length = (uint16_t)payload_bytes;
    const size_t free_bytes = queue->capacity - queue->used;
    const size_t needed = QUEUED_BYTES(payload_bytes);
    if (payload_bytes > UWB_MAX_PAYLOAD_BYTES || needed > free_bytes || reserve > free_bytes - needed) {
        return 0;
    }
    at = ring_write(queue, at % queue->capacity, &length, sizeof length);
    at = ring_write(queue, at, header, UWB_HEADER_BYTES);
    (void)ring_write(queue, at, payload, payload_bytes);
    queue->used += needed;
    return 1;
}

int uwb_queue_frame(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes,
                    size_t reserve) {
    return ring_write_frame(queue, queue->first + queue->used, header, payload, payload_bytes, reserve);
}

int uwb_queue_urgent(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes) {
    const size_t before = queue->first + queue->capacity - QUEUED_BYTES(payload_bytes);
    if (!ring_write_frame(queue, before, header, payload, payload_bytes, 0)) {
        return 0;
    }
    queue->first = before % queue->capacity;
    return 1;
}

/* Remove bytes from the start of the ring. */
static void ring_read(uwb_queue *queue, void *data, size_t bytes) {
    const size_t to_end = queue->capacity - queue->first;
    const size_t first_part = bytes < to_end ? bytes : to_end;
    memcpy(data, queue->bytes + queue->first, first_part);
    memcpy((uint8_t *)data + first_part, queue->bytes, bytes - first_part);
    queue->first = (queue->first + bytes) % queue->capacity;
    queue->used -= bytes;
}

size_t uwb_queue_peek(uwb_queue *queue, uint64_t now_us, const uint8_t **bytes) {
    if (queue->sent == queue->encoded && queue->used != 0) {
        uint16_t payload_bytes;
        uwb_header_t header;
        ring_read(queue, &payload_bytes, sizeof payload_bytes);
        ring_read(queue, &header, sizeof header);
        header.sequence = queue->sequence++;
        header.time_us = header.time_us == UWB_TIME_OF_SENDING ? now_us : header.time_us;
        memcpy(queue->wire + UWB_WIRE_HEADROOM, &header, sizeof header);
        ring_read(queue, queue->wire + UWB_WIRE_HEADROOM + sizeof header, payload_bytes);
        queue->encoded = uwb_encode_frame(queue->wire, payload_bytes);
        queue->sent = 0;
    }
    *bytes = queue->wire + queue->sent;
    return queue->encoded - queue->sent;
}

void uwb_queue_drop(uwb_queue *queue, size_t count) {
    const size_t unsent = queue->encoded - queue->sent;
    queue->sent += count < unsent ? count : unsent;
}

void uwb_queue_restart(uwb_queue *queue) {
    if (queue->sent != queue->encoded) {
        queue->sent = 0;
    }
}
