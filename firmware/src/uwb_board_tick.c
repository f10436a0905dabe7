#include <string.h>

#include "uwb_board.h"

static uint32_t corrupt(const uwb_decoder *decoder) {
    return decoder->bad_cobs + decoder->bad_length + decoder->bad_crc + decoder->oversize;
}

/* Damage on the radio's side has no count in STATUS, so that a line of text tells of it. */
static void tell_radio_faults(uwb_board *board, uint64_t now_us) {
    static const char text[] = "frames from the radio's side are damaged, or no measurements";
    const uint32_t faults = board->radio_faults + corrupt(&board->radio) + board->radio.foreign_versions;
    if (faults != board->radio_faults_told) {
        uint8_t payload[sizeof(uwb_log_t) + sizeof text - 1] = {UWB_LOG_LEVEL_WARNING};
        memcpy(payload + sizeof(uwb_log_t), text, sizeof text - 1);
        board->radio_faults_told = faults;
        (void)uwb_board_send(board, UWB_TYPE_LOG, 0, now_us, payload, sizeof payload, 0);
    }
}

void uwb_board_tick(uwb_board *board, uint64_t now_us) {
    if (now_us < board->status_due_us) {
        return;
    }
    board->status_due_us = now_us + UWB_STATUS_INTERVAL_US;
    uwb_status_t status;
    memset(&status, 0, sizeof status);
    status.frames_received = board->host.frames;
    status.frames_dropped = corrupt(&board->host) + board->dropped;
    status.measurements = board->measurements;
    status.measurements_lost = board->measurements_lost;
    status.temperature = board->temperature;
    status.mode = board->mode;
    (void)uwb_board_send(board, UWB_TYPE_STATUS, 0, now_us, &status, sizeof status, 0);
    tell_radio_faults(board, now_us);
}
