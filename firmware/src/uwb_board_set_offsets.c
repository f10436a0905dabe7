#include <string.h>

#include "uwb_board.h"

static const float MAX_OFFSET_M = 10.0f;

/* NaN is none. */
static int is_offset(float offset_m) {
    return offset_m >= -MAX_OFFSET_M && offset_m <= MAX_OFFSET_M;
}

int uwb_board_set_offsets(uwb_board *board, const uint8_t *payload, size_t payload_bytes, uint32_t request,
                          uint64_t now_us) {
    uwb_set_offsets_t fixed;
    if (payload_bytes < sizeof fixed) {
        return 0;
    }
    memcpy(&fixed, payload, sizeof fixed);
    if (!is_offset(fixed.default_offset) || (payload_bytes - sizeof fixed) / sizeof(uwb_offset_t) < fixed.count) {
        return 0;
    }
    for (size_t i = 0; i < fixed.count; i++) {
        uwb_offset_t entry;
        memcpy(&entry, payload + sizeof fixed + i * sizeof entry, sizeof entry);
        if (!is_offset(entry.offset) || entry.of > UWB_OFFSET_OF_PAIR) {
            return 0;
        }
    }
    uwb_offsets_t answer;
    memset(&answer, 0, sizeof answer);
    answer.request_sequence = request;
    answer.slots = UWB_MAX_OFFSETS;
    answer.accepted = fixed.count <= UWB_MAX_OFFSETS;
    if (answer.accepted) {
        board->default_offset_m = fixed.default_offset;
        board->offset_count = fixed.count;
        memcpy(board->offsets, payload + sizeof fixed, fixed.count * sizeof(uwb_offset_t));
    }
    (void)uwb_board_send(board, UWB_TYPE_OFFSETS, UWB_FLAG_ANSWER, now_us, &answer, sizeof answer, 0);
    return 1;
}
