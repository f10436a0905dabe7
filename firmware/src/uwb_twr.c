#include <math.h>
#include <string.h>

#include "uwb_mitigation.h"
#include "uwb_twr_exchange.h"

enum { START_AGAIN_US = 100000, NAP_US = 1000, MISSES_TO_RESTART = 100 };

const uwb_twr_config uwb_twr_usual = {
    {5, 64, 0, 0, 6800, 128, 0, 0, 0}, 0, 0x5542, UWB_ROLE_TAG, 0, 0, 0, 157, 1500, 6000, 0, {0},
};

uint64_t uwb_twr_now_us(const uwb_twr *twr) {
    return twr->io.now_us(twr->io.context);
}

void uwb_twr_nap(const uwb_twr *twr, uint64_t until_us) {
    for (uint64_t now_us = uwb_twr_now_us(twr); now_us < until_us; now_us = uwb_twr_now_us(twr)) {
        const uint64_t left_us = until_us - now_us;
        twr->io.sleep(twr->io.context, left_us < NAP_US ? (uint32_t)left_us : NAP_US);
    }
}

/* Marsaglia's xorshift64*. */
uint32_t uwb_twr_random(uwb_twr *twr) {
    twr->random ^= twr->random >> 12;
    twr->random ^= twr->random << 25;
    twr->random ^= twr->random >> 27;
    return (uint32_t)(twr->random * 0x2545F4914F6CDD1Du >> 32);
}

uint32_t uwb_twr_random_below(uwb_twr *twr, uint32_t limit) {
    return (uint32_t)((uint64_t)uwb_twr_random(twr) * limit >> 32);
}

uwb_twr_frame uwb_twr_frame_to(const uwb_twr *twr, uwb_twr_kind kind, uint64_t to, uint32_t tag_number,
                               uint32_t anchor_number) {
    uwb_twr_frame frame;
    memset(&frame, 0, sizeof frame);
    frame.kind = kind;
    frame.sequence = (uint8_t)tag_number;
    frame.pan = twr->config.pan;
    frame.to = to;
    frame.from = twr->address;
    frame.tag_number = tag_number;
    frame.anchor_number = anchor_number;
    return frame;
}

static int belongs(const uwb_twr *twr, const uwb_twr_frame *frame, const uwb_twr_frame *sent, uwb_twr_kind kind) {
    return frame->kind == kind && frame->pan == twr->config.pan && frame->to == twr->address &&
           (frame->from == sent->to || (sent->to == UWB_TWR_EVERYBODY && frame->from != twr->address)) &&
           frame->tag_number == sent->tag_number &&
           /* A tag learns the anchor's number from ANSWER, and then all frames bear it. */
           (kind == UWB_TWR_ANSWER || frame->anchor_number == sent->anchor_number);
}

uwb_dw1000_status uwb_twr_expect(uwb_twr *twr, const uwb_twr_frame *sent, uwb_twr_kind kind, uint64_t until_us,
                                 uwb_dw1000_frame *received, uwb_twr_frame *frame) {
    uwb_dw1000_status otherwise = UWB_DW1000_TIMEOUT;
    for (;;) {
        uwb_dw1000_status status = uwb_dw1000_receive(&twr->chip, received, until_us);
        if (status == UWB_DW1000_OK) {
            if (uwb_twr_read(received->octets, received->bytes, frame) && belongs(twr, frame, sent, kind)) {
                return UWB_DW1000_OK;
            }
            twr->counts.refused++;
        } else if (status == UWB_DW1000_DAMAGED) {
            otherwise = UWB_DW1000_DAMAGED;
        } else {
            return status == UWB_DW1000_TIMEOUT ? otherwise : status;
        }
        const uint64_t now_us = uwb_twr_now_us(twr);
        if (now_us >= until_us) {
            return otherwise;
        }
        status = uwb_dw1000_listen(&twr->chip, (uint32_t)(until_us - now_us));
        if (status != UWB_DW1000_OK) {
            return status;
        }
    }
}

uwb_dw1000_status uwb_twr_measure(uwb_twr *twr, const uwb_dw1000_frame *received, uint64_t tag, uint64_t anchor,
                                  double range_m, float *rx_power_dbm) {
    const uwb_dw1000_settings *const radio = &twr->chip.settings;
    uwb_range_cir_t *const fields = (uwb_range_cir_t *)(void *)twr->measurement;
    const size_t whole = UWB_DW1000_SAMPLES(radio->prf_mhz);
    const size_t count = twr->config.window < whole ? twr->config.window : whole;
    const size_t index = received->first_path_index / 64u;
    size_t first = index > UWB_WINDOW_LEAD ? index - UWB_WINDOW_LEAD : 0;
    first = first < whole - count ? first : whole - count;
    uwb_dw1000_quality quality;
    uwb_dw1000_status status = uwb_dw1000_read_quality(&twr->chip, received, &quality);
    if (status == UWB_DW1000_OK && count != 0) {
        /* The octet that means nothing falls on the last of the fields, which are written afterwards. */
        status = uwb_dw1000_read_cir(&twr->chip, first, count, twr->measurement + sizeof *fields - 1);
    }
    if (status == UWB_DW1000_OK) {
        status = uwb_dw1000_check(&twr->chip);
    }
    if (status != UWB_DW1000_OK) {
        return status;
    }
    if (twr->config.bias_correction) {
        const float power_dbm = uwb_dw1000_true_power_dbm(quality.rx_power_dbm, radio->prf_mhz);
        range_m -= uwb_dw1000_range_bias_m(power_dbm, radio->channel, radio->prf_mhz);
    }
    twr->measured_us = received->received_us;
    memset(fields, 0, sizeof *fields);
    fields->tag_id = tag;
    fields->anchor_id = anchor;
    fields->device_time = received->stamp;
    fields->sequence = twr->counts.tried;
    fields->range = (float)range_m;
    fields->sample_period = (float)(1 / (2 * 499.2e6));
    fields->first_path_index = (float)received->first_path_index / 64.0f;
    fields->scale = 1;
    fields->rx_power = quality.rx_power_dbm;
    fields->first_path_power = quality.first_path_power_dbm;
    fields->start_index = (int32_t)first;
    fields->preamble_count = received->preamble_count;
    fields->noise_threshold = quality.noise_threshold;
    fields->samples_offset = sizeof *fields;
    fields->sample_count = (uint16_t)(2 * count);
    fields->encoding = UWB_COMPLEX_INT16;
    fields->channel = radio->channel;
    fields->prf = radio->prf_mhz;
    if (rx_power_dbm != NULL) {
        *rx_power_dbm = quality.rx_power_dbm;
    }
    return UWB_DW1000_OK;
}

uwb_twr_event uwb_twr_lost(uwb_twr *twr, uwb_dw1000_status status, uint32_t *when_timed_out) {
    uint32_t *const counted = status == UWB_DW1000_TIMEOUT   ? when_timed_out
                              : status == UWB_DW1000_DAMAGED ? &twr->counts.damaged
                              : status == UWB_DW1000_LATE    ? &twr->counts.late
                              : status == UWB_DW1000_UNSENT  ? &twr->counts.time_out
                                                             : &twr->counts.broken;
    if (when_timed_out != NULL) {
        (*counted)++; /* of an exchange */
    }
    twr->misses++;
    if (status == UWB_DW1000_TIMEOUT || status == UWB_DW1000_DAMAGED || status == UWB_DW1000_LATE) {
        /* Nothing was wrong on this side, unless the chip has forgotten what it is to do. */
        const int hopeless = twr->misses % MISSES_TO_RESTART == 0;
        status = hopeless ? UWB_DW1000_RESTARTED : uwb_dw1000_check(&twr->chip);
        if (status == UWB_DW1000_OK) {
            return UWB_TWR_NOTHING;
        }
    }
    twr->running = 0;
    twr->fault = status;
    /* A chip that can be started again at once is no fault. */
    return status == UWB_DW1000_BUS ? UWB_TWR_FAULT : UWB_TWR_NOTHING;
}

void uwb_twr_start(uwb_twr *twr, const uwb_dw1000_io *io, const uwb_twr_config *config, uint64_t random,
                   uint8_t *measurement, size_t measurement_bytes) {
    memset(twr, 0, sizeof *twr);
    twr->io = *io;
    twr->random = random != 0 ? random : 1;
    twr->measurement = measurement;
    twr->measurement_bytes = measurement_bytes;
    if (!uwb_twr_configure(twr, config)) {
        twr->fault = UWB_DW1000_BAD_ARGUMENT;
    }
}

void uwb_twr_fill_times(uwb_twr_config *config, uint32_t reply_us, uint32_t patience_us) {
    uint32_t more_us = 0;
    if (uwb_dw1000_valid(&config->radio)) {
        const uint32_t air_us = uwb_dw1000_air_us(&config->radio, UWB_TWR_MAX_FRAME_BYTES);
        const uint32_t usual_us = uwb_dw1000_air_us(&uwb_twr_usual.radio, UWB_TWR_MAX_FRAME_BYTES);
        more_us = air_us > usual_us ? air_us - usual_us : 0;
    }
    if (config->reply_us == 0) {
        config->reply_us = reply_us + 2 * more_us; /* ANSWER's data, and FINAL's preamble */
    }
    if (config->patience_us == 0) {
        config->patience_us = patience_us + 4 * more_us; /* POLL, ANSWER, and what may be on the air before */
    }
}

const char *uwb_twr_refusal(const uwb_twr *twr, const uwb_twr_config *config) {
    if (!uwb_dw1000_valid(&config->radio)) {
        return "channel, PRF, preamble, code, rate or antenna delay is none that the chip has";
    }
    if (config->role > UWB_ROLE_ANCHOR) {
        return "no such role";
    }
    if (config->pan == 0xFFFF || config->address == UWB_TWR_EVERYBODY) {
        return "the address or the PAN is that of a broadcast";
    }
    if (config->anchor_count > UWB_TWR_MAX_ANCHORS) {
        return "more than 32 anchors";
    }
    const size_t whole = UWB_DW1000_SAMPLES(config->radio.prf_mhz);
    if (UWB_TWR_MEASUREMENT_BYTES(config->window < whole ? config->window : whole) > twr->measurement_bytes) {
        return "more samples than the board has memory for";
    }
    const uint32_t air_us = uwb_dw1000_air_us(&config->radio, UWB_TWR_MAX_FRAME_BYTES);
    if (config->reply_us < air_us || config->reply_us > 100000 || config->patience_us < 2 * air_us ||
        config->patience_us > 500000 || config->interval_us > 60000000) {
        return "a time is shorter than its frames last, or longer than 0.1 s (reply), 0.5 s (patience), 60 s (interval)";
    }
    return NULL;
}

int uwb_twr_configure(uwb_twr *twr, const uwb_twr_config *config) {
    if (uwb_twr_refusal(twr, config) != NULL) {
        return 0;
    }
    twr->config = *config;
    twr->config.radio.anchor = config->role == UWB_ROLE_ANCHOR;
    twr->reply_us = config->reply_us;
    twr->running = 0;
    twr->known = config->anchor_count;
    for (uint8_t i = 0; i < config->anchor_count; i++) {
        twr->anchors[i] = (uwb_twr_anchor){config->anchors[i], 0, 0, 0, 0, 0, 0, NAN};
    }
    twr->turn = 0;
    twr->next_us = 0;
    twr->seek_us = 0;
    return 1;
}

static uwb_twr_event start_chip(uwb_twr *twr, uint64_t until_us) {
    const uint64_t now_us = uwb_twr_now_us(twr);
    if (twr->config.radio.channel == 0 || now_us < twr->next_us) {
        uwb_twr_nap(twr, twr->next_us < until_us ? twr->next_us : until_us);
        return UWB_TWR_FAULT;
    }
    twr->fault = uwb_dw1000_start(&twr->chip, &twr->io, &twr->config.radio);
    if (twr->fault != UWB_DW1000_OK) {
        twr->next_us = now_us + START_AGAIN_US;
        return UWB_TWR_FAULT;
    }
    twr->address = twr->config.address != 0 ? twr->config.address : twr->chip.eui;
    twr->counts.restarts += twr->started;
    twr->started = 1;
    twr->running = 1;
    twr->next_us = 0;
    return UWB_TWR_NOTHING;
}

uwb_twr_event uwb_twr_turn(uwb_twr *twr, uint64_t until_us) {
    if (!twr->running) {
        const uwb_twr_event event = start_chip(twr, until_us);
        if (event != UWB_TWR_NOTHING) {
            return event;
        }
    }
    return twr->config.role == UWB_ROLE_TAG ? uwb_twr_tag_turn(twr, until_us) : uwb_twr_anchor_turn(twr, until_us);
}

size_t uwb_twr_measured_bytes(const uwb_twr *twr) {
    const uwb_range_cir_t *const fields = (const uwb_range_cir_t *)(const void *)twr->measurement;
    return sizeof *fields + 2u * fields->sample_count;
}
