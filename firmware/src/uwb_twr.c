#include <math.h>
#include <string.h>

#include "uwb_twr_common.h"

enum { RESTART_INTERVAL_US = 100000, SMART_POWER_REPLY_US = 1000 };

const uwb_twr_config uwb_twr_defaults = {
    .radio = {.channel = 5, .prf_mhz = 64, .rate_kbps = 6800, .preamble = 128},
    .pan = 0x5542,
    .role = UWB_ROLE_TAG,
    .window = 157,
    .reply_us = 1500,
    .timeout_us = 6000,
};

/* Initialise the state; the chip is started by the first step. */
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

/* Set times that are 0, plus the additional airtime of slow or long frames. */
void uwb_twr_set_default_times(uwb_twr_config *config, uint32_t reply_us, uint32_t timeout_us) {
    uint32_t extra_us = 0;
    if (uwb_dw1000_settings_valid(&config->radio)) {
        const uint32_t air_us = uwb_dw1000_airtime_us(&config->radio, UWB_TWR_MAX_FRAME_BYTES);
        const uint32_t default_us = uwb_dw1000_airtime_us(&uwb_twr_defaults.radio, UWB_TWR_MAX_FRAME_BYTES);
        extra_us = air_us > default_us ? air_us - default_us : 0;
    }
    if (config->reply_us == 0) {
        config->reply_us = reply_us + 2 * extra_us; /* data of ANSWER, preamble of FINAL */
    }
    if (config->timeout_us == 0) {
        config->timeout_us = timeout_us + 4 * extra_us; /* POLL, ANSWER, and frames that may precede them */
    }
}

/* Return the reason why a configuration is invalid, or NULL. */
const char *uwb_twr_config_error(const uwb_twr *twr, const uwb_twr_config *config) {
    if (!uwb_dw1000_settings_valid(&config->radio)) {
        return "the chip does not support this channel, PRF, preamble, code, rate or antenna delay";
    }
    if (config->role > UWB_ROLE_ANCHOR) {
        return "unknown role";
    }
    if (config->pan == 0xFFFF || config->address == UWB_TWR_BROADCAST) {
        return "the address or the PAN is the broadcast address";
    }
    if (config->anchor_count > UWB_MAX_ANCHORS) {
        return "more than 32 anchors";
    }
    const size_t max_count = UWB_DW1000_SAMPLES(config->radio.prf_mhz);
    if (UWB_TWR_MEASUREMENT_BYTES(config->window < max_count ? config->window : max_count) > twr->measurement_bytes) {
        return "the window needs more memory than the board has";
    }
    const uint32_t air_us = uwb_dw1000_airtime_us(&config->radio, UWB_TWR_MAX_FRAME_BYTES);
    if (config->reply_us < air_us || config->reply_us > 100000 || config->timeout_us < 2 * air_us ||
        config->timeout_us > 500000 || config->interval_us > 60000000) {
        return "a time is shorter than its frames, or longer than 0.1 s (reply), 0.5 s (timeout), 60 s (interval)";
    }
    /* The time from POLL to FINAL is longer than this, so that uwb_dw1000_send_at need not wait. */
    if (config->radio.rate_kbps == 6800 && config->reply_us < SMART_POWER_REPLY_US) {
        return "at 6.8 Mbit/s the reply time must be at least 1 ms: smart power allows one frame per millisecond";
    }
    return NULL;
}

/* Apply a configuration if it is valid; the next step starts the chip with it. */
int uwb_twr_configure(uwb_twr *twr, const uwb_twr_config *config) {
    if (uwb_twr_config_error(twr, config) != NULL) {
        return 0;
    }
    twr->config = *config;
    twr->config.radio.anchor = config->role == UWB_ROLE_ANCHOR;
    twr->reply_us = config->reply_us;
    twr->running = 0;
    twr->known = config->anchor_count;
    for (uint8_t i = 0; i < config->anchor_count; i++) {
        twr->anchors[i] = (uwb_twr_anchor){.address = config->anchors[i], .rx_power_dbm = NAN};
    }
    twr->last_polled = 0;
    twr->next_us = 0;
    twr->next_discovery_us = 0;
    return 1;
}

/* Start the chip; after a failure, wait before the next attempt. */
static uwb_twr_event start_chip(uwb_twr *twr, uint64_t until_us) {
    const uint64_t now_us = uwb_twr_now_us(twr);
    if (twr->config.radio.channel == 0 || now_us < twr->next_us) {
        uwb_twr_sleep_until(twr, twr->next_us < until_us ? twr->next_us : until_us);
        return UWB_TWR_FAULT;
    }
    twr->fault = uwb_dw1000_start(&twr->chip, &twr->io, &twr->config.radio);
    if (twr->fault != UWB_DW1000_OK) {
        twr->next_us = now_us + RESTART_INTERVAL_US;
        return UWB_TWR_FAULT;
    }
    twr->address = twr->config.address != 0 ? twr->config.address : twr->chip.eui;
    twr->counts.restarts += twr->started;
    twr->started = 1;
    twr->running = 1;
    twr->next_us = 0;
    return UWB_TWR_NOTHING;
}

/* Start the chip if necessary, then perform a step of the tag or the anchor. */
uwb_twr_event uwb_twr_step(uwb_twr *twr, uint64_t until_us) {
    if (!twr->running) {
        const uwb_twr_event event = start_chip(twr, until_us);
        if (event != UWB_TWR_NOTHING) {
            return event;
        }
    }
    return twr->config.role == UWB_ROLE_TAG ? uwb_twr_tag_step(twr, until_us) : uwb_twr_anchor_step(twr, until_us);
}

/* Return the size of the fields and the samples. */
size_t uwb_twr_measurement_bytes(const uwb_twr *twr) {
    const uwb_range_cir_t *const fields = (const uwb_range_cir_t *)(const void *)twr->measurement;
    return sizeof *fields + 2u * fields->sample_count;
}

/* Return the state in the terms of the wire protocol. */
uint8_t uwb_twr_state(const uwb_twr *twr) {
    if (twr->running) {
        return twr->chip.lock_unconfirmed ? UWB_RADIO_STATE_LOCK_UNCONFIRMED : UWB_RADIO_STATE_RUNNING;
    }
    switch (twr->fault) {
    case UWB_DW1000_BUS:
        return UWB_RADIO_STATE_BUS;
    case UWB_DW1000_ABSENT:
        return UWB_RADIO_STATE_ABSENT;
    case UWB_DW1000_NO_CLOCK:
        return UWB_RADIO_STATE_NO_CLOCK;
    default:
        return UWB_RADIO_STATE_RESTARTED;
    }
}
