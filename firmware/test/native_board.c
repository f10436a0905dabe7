/* A board with the model of uwb_model.h, and a decoder, behind functions that are easy to call from another language:
 * for the tests. */
#include <stdlib.h>
#include <string.h>

#include "uwb_board.h"
#include "uwb_model.h"

typedef struct {
    uwb_board board;
    uint32_t arena[4096];
    uint8_t queue[16384];
    uint64_t now_us;
} native_board;

native_board *native_board_new(int mode, int with_model, size_t queue_bytes) {
    native_board *const native = calloc(1, sizeof *native);
    if (native == NULL || queue_bytes > sizeof native->queue) {
        abort();
    }
    const uwb_board_config config = {
        .board_id = 0xE0,
        .boot_id = 1,
        .firmware_version = {0, 1, 0},
        .mode = (uint8_t)mode,
        .firmware_name = "emulated",
        .model = with_model ? &uwb_model_data : NULL,
        .arena = native->arena,
        .arena_bytes = sizeof native->arena,
        .queue = native->queue,
        .queue_bytes = queue_bytes,
    };
    uwb_board_start(&native->board, &config, 0);
    return native;
}

void native_board_free(native_board *native) {
    free(native);
}

void native_board_receive(native_board *native, const uint8_t *bytes, size_t count, uint64_t now_us) {
    native->now_us = now_us;
    uwb_board_receive(&native->board, bytes, count, now_us);
}

void native_board_receive_from_radio(native_board *native, const uint8_t *bytes, size_t count, uint64_t now_us) {
    native->now_us = now_us;
    uwb_board_receive_from_radio(&native->board, bytes, count, now_us);
}

void native_board_tick(native_board *native, uint64_t now_us) {
    native->now_us = now_us;
    uwb_board_tick(&native->board, now_us);
}

/* Take what waits to be sent, at most `limit` bytes, at the time of the last call. */
size_t native_board_output(native_board *native, uint8_t *bytes, size_t limit) {
    size_t taken = 0;
    const uint8_t *piece;
    size_t count;
    while (taken < limit && (count = uwb_queue_peek(&native->board.queue, native->now_us, &piece)) != 0) {
        count = count < limit - taken ? count : limit - taken;
        memcpy(bytes + taken, piece, count);
        uwb_queue_drop(&native->board.queue, count);
        taken += count;
    }
    return taken;
}

/* Decode one wire; returns the last frame's bytes of payload, or -1. Counts: frames, bad_cobs, bad_length, bad_crc,
 * oversize, foreign_versions. */
int native_decode(const uint8_t *bytes, size_t count, uwb_header_t *header, uint8_t *payload, uint32_t *counts) {
    uwb_decoder *const decoder = calloc(1, sizeof *decoder);
    if (decoder == NULL) {
        abort();
    }
    int32_t last = -1;
    for (size_t i = 0; i < count; i++) {
        const int32_t bytes_of_payload = uwb_decoder_push(decoder, bytes[i], header);
        if (bytes_of_payload >= 0) {
            last = bytes_of_payload;
            memcpy(payload, decoder->body.bytes + UWB_HEADER_BYTES, (size_t)last);
        }
    }
    memcpy(counts, &decoder->frames, 6 * sizeof *counts);
    free(decoder);
    return (int)last;
}

/* `wire` has UWB_MAX_WIRE_BYTES. */
size_t native_encode(const uwb_header_t *header, const uint8_t *payload, size_t payload_bytes, uint8_t *wire) {
    memcpy(wire + UWB_WIRE_HEADROOM, header, sizeof *header);
    memcpy(wire + UWB_WIRE_HEADROOM + sizeof *header, payload, payload_bytes);
    return uwb_encode_frame(wire, payload_bytes);
}
