#include <string.h>

#include "uwb_board.h"

void uwb_board_hello(uwb_board *board, const uint32_t *request, uint64_t now_us) {
    const uwb_board_config *const config = &board->config;
    uwb_hello_t hello;
    memset(&hello, 0, sizeof hello);
    hello.board_id = config->board_id;
    hello.model_id = config->model != NULL ? config->model->model_id : 0;
    hello.boot_id = config->boot_id;
    hello.request_sequence = request != NULL ? *request : 0;
    hello.window = config->model != NULL ? config->model->samples : 0;
    hello.max_payload = UWB_MAX_PAYLOAD_BYTES;
    hello.firmware_major = config->firmware_version[0];
    hello.firmware_minor = config->firmware_version[1];
    hello.firmware_patch = config->firmware_version[2];
    hello.mode = board->mode;
    memcpy(hello.firmware_name, config->firmware_name, sizeof hello.firmware_name);
    const uint16_t flags = request != NULL ? UWB_FLAG_ANSWER : 0;
    (void)uwb_board_send(board, UWB_TYPE_HELLO, flags, now_us, &hello, sizeof hello, 0);
}
