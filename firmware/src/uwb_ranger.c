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
    const uwb_twr_config *const config = ranger->config_changed ? &ranger->new_config : &ranger->twr.config;
    const int chip_is_configured = ranger->twr.running && !ranger->config_changed;
    const uwb_dw1000_settings *const radio = chip_is_configured ? &ranger->twr.chip.settings : &config->radio;
    uwb_radio_t *const fixed = &message.fixed;
    memset(&message, 0, sizeof message);
    fixed->request_sequence = request != NULL ? *request : 0;
    fixed->accepted = refusal == NULL;
    fixed->address = ranger->twr.address;
    fixed->antenna_delay = radio->antenna_delay;
    fixed->tx_power = radio->tx_power;
    fixed->reply_us = config->reply_us;
    fixed->timeout_us = config->timeout_us;
    fixed->interval_us = config->interval_us;
    fixed->pan = config->pan;
    fixed->rate = radio->rate_kbps;
    fixed->preamble = radio->preamble;
    fixed->window = config->window;
    fixed->channel = radio->channel;
    fixed->prf = radio->prf_mhz;
    fixed->preamble_code = radio->preamble_code;
    fixed->decawave_sfd = radio->decawave_sfd;
    fixed->role = config->role;
    fixed->report = config->report;
    fixed->bias_correction = config->bias_correction;
    fixed->anchor_count = config->anchor_count;
    size_t at = 8u * config->anchor_count;
    memcpy(message.tail, config->anchors, at);
    for (; refusal != NULL && *refusal != 0 && at < sizeof message.tail; refusal++) {
        message.tail[at++] = (uint8_t)*refusal;
    }
    const uint16_t flags = request != NULL ? UWB_FLAG_ANSWER : 0;
    (void)uwb_board_send(&ranger->board, UWB_TYPE_RADIO, flags, now_us(ranger), &message, sizeof *fixed + at, 0);
}

/* Send RADIO_STATUS. */
static void send_status(uwb_ranger *ranger) {
    struct {
        uwb_radio_status_t fixed;
        uwb_radio_anchor_t anchors[UWB_MAX_ANCHORS];
    } message;
    const uwb_twr *const twr = &ranger->twr;
    const uwb_twr_counts *const counts = &twr->counts;
    const uint64_t at_us = now_us(ranger);
    const uint8_t known = twr->config.role == UWB_ROLE_TAG ? twr->known : 0;
    memset(&message, 0, sizeof message);
    message.fixed = (uwb_radio_status_t){
        .tried = counts->tried,
        .ranged = counts->ranged,
        .no_answer = counts->no_answer,
        .late = counts->late,
        .timeout = counts->timeout,
        .damaged = counts->damaged,
        .implausible = counts->implausible,
        .broken = counts->broken,
        .refused = counts->refused,
        .restarts = counts->restarts,
        .temperature = ranger->board.temperature,
        .voltage = ranger->voltage,
        .state = uwb_twr_state(twr),
        .anchor_count = known,
    };
    for (uint8_t i = 0; i < known; i++) {
        const uwb_twr_anchor *const anchor = &twr->anchors[i];
        const uint64_t age_ms = (at_us - anchor->last_seen_us) / 1000;
        message.anchors[i] = (uwb_radio_anchor_t){
            .address = anchor->address,
            .tried = anchor->tried,
            .ranged = anchor->ranged,
            .rx_power = anchor->rx_power_dbm,
            .age_ms = anchor->last_seen_us == 0 || age_ms > UINT32_MAX ? UINT32_MAX : (uint32_t)age_ms,
        };
    }
    const size_t bytes = sizeof message.fixed + known * sizeof message.anchors[0];
    (void)uwb_board_send(&ranger->board, UWB_TYPE_RADIO_STATUS, 0, at_us, &message, bytes, UWB_ANSWER_RESERVE_BYTES);
}

/* Parse SET_RADIO; returns NULL, or the reason why it is refused. */
static const char *parse_set_radio(const uwb_ranger *ranger, const uint8_t *payload, size_t bytes, uwb_twr_config *config) {
    uwb_set_radio_t fixed;
    if (bytes < sizeof fixed) {
        return "SET_RADIO is too short";
    }
    memcpy(&fixed, payload, sizeof fixed);
    if (fixed.anchor_count > UWB_MAX_ANCHORS || bytes < sizeof fixed + 8u * fixed.anchor_count) {
        return "more anchors than 32, or than SET_RADIO contains";
    }
    memset(config, 0, sizeof *config);
    config->radio = (uwb_dw1000_settings){
        .channel = fixed.channel,
        .prf_mhz = fixed.prf,
        .preamble_code = fixed.preamble_code,
        .decawave_sfd = fixed.decawave_sfd,
        .rate_kbps = fixed.rate,
        .preamble = fixed.preamble,
        .tx_power = fixed.tx_power,
        .antenna_delay = fixed.antenna_delay,
    };
    config->address = fixed.address;
    config->pan = fixed.pan;
    config->role = fixed.role;
    config->report = fixed.report;
    config->bias_correction = fixed.bias_correction;
    config->anchor_count = fixed.anchor_count;
    config->window = fixed.window;
    config->reply_us = fixed.reply_us;
    config->timeout_us = fixed.timeout_us;
    uwb_twr_set_default_times(config, uwb_twr_defaults.reply_us, uwb_twr_defaults.timeout_us);
    config->interval_us = fixed.interval_us;
    memcpy(config->anchors, payload + sizeof fixed, 8u * fixed.anchor_count);
    return uwb_twr_config_error(&ranger->twr, config);
}

/* Handle GET_RADIO and SET_RADIO; returns whether the frame has one of these types. */
static int handle_frame(void *context, const uwb_header_t *header, const uint8_t *payload, size_t bytes, uint64_t at_us) {
    uwb_ranger *const ranger = context;
    const char *refusal = NULL;
    (void)at_us;
    if (header->type == UWB_TYPE_SET_RADIO) {
        uwb_twr_config config;
        refusal = parse_set_radio(ranger, payload, bytes, &config);
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
