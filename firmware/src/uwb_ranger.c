#include "uwb_ranger.h"

#include <math.h>
#include <string.h>

enum { QUEUE_TIMEOUT_US = 20000, QUEUE_POLL_US = 250 };

static uint64_t now_us(const uwb_ranger *ranger) {
    return ranger->twr.io.now_us(ranger->twr.io.context);
}

/* Send RADIO: the answer to the host's frame `*request`, or unsolicited if that is NULL. */
static void send_radio(uwb_ranger *ranger, const uint32_t *request, const char *refusal) {
    struct {
        uwb_radio_t fixed;
        uint8_t tail[8 * UWB_MAX_ANCHORS + 120];
    } message;
    const uwb_twr_config *const requested = ranger->config_changed ? &ranger->new_config : NULL;
    size_t bytes = uwb_twr_write_settings(&ranger->twr, requested, (uint8_t *)&message);
    message.fixed.request_sequence = request != NULL ? *request : 0;
    message.fixed.accepted = refusal == NULL;
    for (; refusal != NULL && *refusal != 0 && bytes < sizeof message; refusal++) {
        ((uint8_t *)&message)[bytes++] = (uint8_t)*refusal;
    }
    const uint16_t flags = request != NULL ? UWB_FLAG_ANSWER : 0;
    (void)uwb_board_send(&ranger->board, UWB_TYPE_RADIO, flags, now_us(ranger), &message, bytes, 0);
}

/* Send RADIO_STATUS. */
static void send_status(uwb_ranger *ranger) {
    uint64_t message[UWB_TWR_STATUS_BYTES / sizeof(uint64_t)];
    const size_t bytes =
        uwb_twr_write_status(&ranger->twr, ranger->board.temperature, ranger->voltage, (uint8_t *)message);
    (void)uwb_board_send(&ranger->board, UWB_TYPE_RADIO_STATUS, 0, now_us(ranger), message, bytes,
                         UWB_ANSWER_RESERVE_BYTES);
}

/* Handle GET_RADIO and SET_RADIO; returns whether the frame has one of these types. */
static int handle_frame(void *context, const uwb_header_t *header, const uint8_t *payload, size_t bytes, uint64_t at_us) {
    uwb_ranger *const ranger = context;
    const char *refusal = NULL;
    (void)at_us;
    if (header->type == UWB_TYPE_SET_RADIO) {
        uwb_twr_config config;
        refusal = uwb_twr_read_settings(payload, bytes, uwb_twr_defaults.reply_us, uwb_twr_defaults.timeout_us, &config);
        refusal = refusal != NULL ? refusal : uwb_twr_config_error(&ranger->twr, &config);
        if (refusal == NULL) {
            ranger->new_config = config;
            ranger->config_changed = 1;
        }
    } else if (header->type != UWB_TYPE_GET_RADIO) {
        return 0;
    }
    send_radio(ranger, &header->sequence, refusal);
    return 1;
}

void uwb_ranger_start(uwb_ranger *ranger, const uwb_board_config *board, const uwb_dw1000_io *io,
                      const uwb_twr_config *config, uint64_t random, uint8_t *measurement, size_t measurement_bytes) {
    uwb_board_config board_config = *board;
    board_config.handle_other_frame = handle_frame;
    board_config.context = ranger;
    memset(ranger, 0, sizeof *ranger);
    ranger->voltage = NAN;
    uwb_twr_start(&ranger->twr, io, config, random, measurement, measurement_bytes);
    uwb_board_start(&ranger->board, &board_config, now_us(ranger));
}

/* Send what is due: STATUS, RADIO after a start of the chip, RADIO_STATUS. */
static void send_due_messages(uwb_ranger *ranger) {
    const uint64_t at_us = now_us(ranger);
    uwb_board_tick(&ranger->board, at_us);
    if (ranger->twr.running && !ranger->address_sent) {
        ranger->address_sent = 1;
        send_radio(ranger, NULL, NULL);
    }
    if (at_us >= ranger->status_due_us) {
        ranger->status_due_us = at_us + UWB_STATUS_INTERVAL_US;
        send_status(ranger);
        if (ranger->twr.running && uwb_dw1000_idle(&ranger->twr.chip) == UWB_DW1000_OK) {
            (void)uwb_dw1000_read_sensors(&ranger->twr.chip, &ranger->board.temperature, &ranger->voltage);
        }
    }
}

/* Limit the queue to one measurement behind the one being sent: if the line is slower than the tag, more measurements
 * would be dropped or outdated. */
static void wait_for_queue_space(const uwb_ranger *ranger) {
    const size_t max_bytes = UWB_TWR_MEASUREMENT_BYTES(ranger->twr.config.window);
    const uint64_t until_us = now_us(ranger) + QUEUE_TIMEOUT_US;
    while (ranger->twr.config.role == UWB_ROLE_TAG && ranger->board.mode != UWB_MODE_DEVICE &&
           ranger->board.queue.used > max_bytes && now_us(ranger) < until_us) {
        ranger->twr.io.sleep(ranger->twr.io.context, QUEUE_POLL_US);
    }
}

uwb_twr_event uwb_ranger_step(uwb_ranger *ranger) {
    wait_for_queue_space(ranger);
    if (ranger->config_changed) {
        ranger->config_changed = 0;
        ranger->address_sent = 0;
        (void)uwb_twr_configure(&ranger->twr, &ranger->new_config);
    }
    const uwb_twr_event event = uwb_twr_step(&ranger->twr, now_us(ranger) + UWB_RANGER_STEP_US);
    if (event == UWB_TWR_RANGED) {
        (void)uwb_board_process_measurement(&ranger->board, ranger->twr.measurement,
                                            uwb_twr_measurement_bytes(&ranger->twr), ranger->twr.measured_us);
    }
    send_due_messages(ranger);
    return event;
}
