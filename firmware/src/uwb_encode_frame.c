#include <string.h>

#include "uwb_link.h"

/* COBS adds at most a delimiter, a first code and one more for each 254 bytes: fewer than UWB_WIRE_LEAD, so that
 * nothing is written over before it is read. */
size_t uwb_encode_frame(uint8_t *wire, size_t payload_bytes) {
    uint8_t *const from = wire + UWB_WIRE_LEAD;
    const size_t checked = UWB_HEADER_BYTES + payload_bytes;
    const uint32_t crc = uwb_crc32(0, from, checked);
    memcpy(from + checked, &crc, sizeof crc);

    size_t to = 0;
    wire[to++] = 0; /* closes whatever noise precedes */
    size_t code_at = to++;
    uint8_t code = 1;
    int open = 1; /* whether a block is being written, whose length goes to code_at */
    for (size_t i = 0; i < checked + sizeof crc; i++) {
        const uint8_t byte = from[i];
        if (!open) {
            code_at = to++;
            code = 1;
            open = 1;
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
            open = 0;
        }
    }
    if (open) {
        wire[code_at] = code;
    }
    wire[to++] = 0;
    return to;
}
