#include <math.h>
#include <string.h>

#include "uwb_board.h"

void uwb_board_start(uwb_board *board, const uwb_board_config *config, uint64_t now_us) {
    memset(board, 0, sizeof *board);
    board->config = *config;
    board->queue.bytes = config->queue;
    board->queue.capacity = config->queue_bytes;
    board->status_due_us = now_us + UWB_STATUS_INTERVAL_US;
    board->temperature = NAN;
    board->mode = config->model != NULL ? config->mode : UWB_MODE_HOST;
    uwb_board_hello(board, NULL, now_us);
}
