#include "uwb_link.h"

/* A frame that is being encoded at the end of a queue. */
typedef struct {
    uwb_queue *queue;
    size_t code_at; /* where the length of the block goes that is being written */
    uint8_t code;
    int open; /* whether there is such a block */
} encoder;

static size_t put(uwb_queue *queue, uint8_t byte) {
    const size_t at = (queue->first + queue->used) % queue->capacity;
    queue->bytes[at] = byte;
    queue->used++;
    return at;
}

static void open_block(encoder *encoder) {
    encoder->code_at = put(encoder->queue, 1);
    encoder->code = 1;
    encoder->open = 1;
}

static void encode(encoder *encoder, const void *data, size_t bytes) {
    const uint8_t *at = data;
    for (size_t i = 0; i < bytes; i++) {
        if (!encoder->open) {
            open_block(encoder);
        }
        if (at[i] == 0) {
            encoder->queue->bytes[encoder->code_at] = encoder->code;
            open_block(encoder);
            continue;
        }
        (void)put(encoder->queue, at[i]);
        encoder->code++;
        if (encoder->code == 0xFF) {
            encoder->queue->bytes[encoder->code_at] = encoder->code;
            encoder->open = 0;
        }
    }
}

int uwb_queue_frame(uwb_queue *queue, const uwb_header_t *header, const void *payload, size_t payload_bytes,
                    size_t reserve) {
    if (payload_bytes > UWB_MAX_PAYLOAD_BYTES) {
        return 0;
    }
    const size_t body = UWB_HEADER_BYTES + payload_bytes + UWB_CRC_BYTES;
    const size_t worst = 2 + body + (body + 253) / 254 + 1;
    const size_t room = queue->capacity - queue->used;
    if (worst > room || reserve > room - worst) {
        return 0;
    }
    uint32_t crc = uwb_crc32(0, header, UWB_HEADER_BYTES);
    crc = uwb_crc32(crc, payload, payload_bytes);
    /* The delimiter before closes whatever noise precedes. */
    (void)put(queue, 0);
    encoder encoder = {queue, 0, 0, 0};
    encode(&encoder, header, UWB_HEADER_BYTES);
    encode(&encoder, payload, payload_bytes);
    encode(&encoder, &crc, sizeof crc);
    if (encoder.open) {
        queue->bytes[encoder.code_at] = encoder.code;
    }
    (void)put(queue, 0);
    return 1;
}
