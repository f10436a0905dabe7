/* Feeds arbitrary bytes, as from the host and as from the radio's side, to a board, and stops on what breaks its
 * promises.
 *
 *     clang -fsanitize=fuzzer,address,undefined -DUWB_LIBFUZZER -Isrc -I<export> test/fuzz_link.c src/uwb_*.c
 *
 * Without a fuzzer it makes its own inputs: fuzz_link <inputs> <seed>. Half of the segments are
 * made into intact frames, so that inputs get past the CRC. */
#include "fuzz.h"
#include "uwb_board.h"
#include "uwb_model.h"

/* Read at most `limit` bytes of what the board sends. */
static void read_output(uwb_board *board, uwb_decoder *host, size_t limit) {
    const uint8_t *bytes;
    size_t count;
    while (limit != 0 && (count = uwb_queue_peek(&board->queue, 0, &bytes)) != 0) {
        count = count < limit ? count : limit;
        for (size_t i = 0; i < count; i++) {
            const uint32_t frames = host->frames;
            uwb_header_t header;
            (void)uwb_decoder_push(host, bytes[i], &header);
            check(host->frames == frames || header.sequence == frames, "frames are numbered as they leave");
        }
        uwb_queue_drop(&board->queue, count);
        limit -= count;
    }
    check(host->bad_cobs + host->bad_length + host->bad_crc + host->oversize == 0, "the board sends intact frames");
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    const size_t arena_bytes = uwb_arena_size(&uwb_model_data);
    uwb_board *const board = malloc(sizeof *board);
    uwb_decoder *const host = calloc(1, sizeof *host);
    uint8_t *const queue = malloc(9000);
    uint8_t *const wire = malloc(UWB_MAX_WIRE_BYTES);
    void *const arena = malloc(arena_bytes);
    check(board != NULL && host != NULL && queue != NULL && wire != NULL && arena != NULL, "memory");
    const uwb_board_config config = {
        .board_id = 1,
        .boot_id = 2,
        .firmware_version = {0, 1, 0},
        .mode = UWB_MODE_DEVICE,
        .firmware_name = "fuzzed",
        .model = &uwb_model_data,
        .arena = arena,
        .arena_bytes = arena_bytes,
        .queue = queue,
        .queue_bytes = 9000,
    };
    uwb_board_start(board, &config, 0);
    uint64_t now_us = 0;
    while (size > 4) {
        const uint8_t choice = data[0];
        size_t length = (size_t)data[1] | (size_t)(data[2] & 15) << 8;
        const uint8_t type = data[3] % 8 < 4 ? UWB_TYPE_RANGE_CIR : data[3];
        data += 4;
        size -= 4;
        length = length < size ? length : size;
        const uint8_t *bytes = data;
        size_t count = length;
        const uwb_header_t header = {.version = (uint8_t)((choice & 4) ? 1 : choice), .type = type, .sequence = 7};
        if (choice & 1) {
            memcpy(wire + UWB_WIRE_HEADROOM, &header, sizeof header);
            memcpy(wire + UWB_WIRE_HEADROOM + sizeof header, data, length);
            bytes = wire;
            count = uwb_encode_frame(wire, length);
        }
        if (choice & 2) {
            uwb_board_receive(board, bytes, count, now_us);
        } else {
            uwb_board_receive_from_radio(board, bytes, count, now_us);
        }
        now_us += 300000u;
        uwb_board_tick(board, now_us);
        check(board->queue.used <= board->queue.capacity && board->mode <= UWB_MODE_DEVICE, "bounds");
        if (choice & 8) {
            read_output(board, host, (choice & 16) ? (size_t)choice * 8 : SIZE_MAX);
        }
        data += length;
        size -= length;
    }
    read_output(board, host, SIZE_MAX);
    free(arena);
    free(wire);
    free(queue);
    free(host);
    free(board);
    return 0;
}

#ifndef UWB_LIBFUZZER
int main(int argc, char **argv) {
    fuzz_run(argc, argv, 20000);
    return 0;
}
#endif
