#include "uwb_board.h"

float uwb_board_offset_m(const uwb_board *board, uint64_t tag_id, uint64_t anchor_id) {
    float anchor_m = 0.0f;
    float tag_m = 0.0f;
    int named = 0;
    for (uint16_t i = 0; i < board->offset_count; i++) {
        const uwb_offset_t *const entry = &board->offsets[i];
        const int tag = entry->tag_id == tag_id;
        const int anchor = entry->anchor_id == anchor_id;
        if (entry->of == UWB_OFFSET_OF_PAIR && tag && anchor) {
            return entry->offset;
        }
        if (entry->of == UWB_OFFSET_OF_ANCHOR && anchor) {
            anchor_m = entry->offset;
            named = 1;
        } else if (entry->of == UWB_OFFSET_OF_TAG && tag) {
            tag_m = entry->offset;
            named = 1;
        }
    }
    return named ? anchor_m + tag_m : board->default_offset_m;
}
