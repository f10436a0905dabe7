/* Payloads of the wire protocol with the settings and the state of a radio. */
#include <string.h>

#include "uwb_twr_common.h"

size_t uwb_twr_write_settings(const uwb_twr *twr, const uwb_twr_config *requested, uint8_t *payload) {
    const uwb_twr_config *const config = requested != NULL ? requested : &twr->config;
    const int chip_is_configured = twr->running && requested == NULL;
    const uwb_dw1000_settings *const radio = chip_is_configured ? &twr->chip.settings : &config->radio;
    const uwb_radio_t fixed = {
        .accepted = 1,
        .address = twr->address,
        .antenna_delay = radio->antenna_delay,
        .tx_power = radio->tx_power,
        .reply_us = config->reply_us,
        .timeout_us = config->timeout_us,
        .interval_us = config->interval_us,
        .pan = config->pan,
        .rate = radio->rate_kbps,
        .preamble = radio->preamble,
        .window = config->window,
        .channel = radio->channel,
        .prf = radio->prf_mhz,
        .preamble_code = radio->preamble_code,
        .decawave_sfd = radio->decawave_sfd,
        .role = config->role,
        .report = config->report,
        .bias_correction = config->bias_correction,
        .anchor_count = config->anchor_count,
    };
    memcpy(payload, &fixed, sizeof fixed);
    memcpy(payload + sizeof fixed, config->anchors, 8u * config->anchor_count);
    return sizeof fixed + 8u * config->anchor_count;
}

const char *uwb_twr_read_settings(const uint8_t *payload, size_t bytes, uint32_t reply_us, uint32_t timeout_us,
                                  uwb_twr_config *config) {
    uwb_set_radio_t fixed;
    if (bytes < sizeof fixed) {
        return "SET_RADIO is too short";
    }
    memcpy(&fixed, payload, sizeof fixed);
    if (fixed.anchor_count > UWB_MAX_ANCHORS || bytes < sizeof fixed + 8u * fixed.anchor_count) {
        return "more anchors than 32, or than SET_RADIO contains";
    }
    *config = (uwb_twr_config){
        .radio =
            {
                .channel = fixed.channel,
                .prf_mhz = fixed.prf,
                .preamble_code = fixed.preamble_code,
                .decawave_sfd = fixed.decawave_sfd,
                .rate_kbps = fixed.rate,
                .preamble = fixed.preamble,
                .tx_power = fixed.tx_power,
                .antenna_delay = fixed.antenna_delay,
            },
        .address = fixed.address,
        .pan = fixed.pan,
        .role = fixed.role,
        .report = fixed.report,
        .bias_correction = fixed.bias_correction,
        .anchor_count = fixed.anchor_count,
        .window = fixed.window,
        .reply_us = fixed.reply_us,
        .timeout_us = fixed.timeout_us,
        .interval_us = fixed.interval_us,
    };
    memcpy(config->anchors, payload + sizeof fixed, 8u * fixed.anchor_count);
    uwb_twr_set_default_times(config, reply_us, timeout_us);
    return NULL;
}

size_t uwb_twr_write_status(const uwb_twr *twr, float temperature, float voltage, uint8_t *payload) {
    const uwb_twr_counts *const counts = &twr->counts;
    const uint8_t known = twr->config.role == UWB_ROLE_TAG ? twr->known : 0;
    const uint64_t now_us = uwb_twr_now_us(twr);
    const uwb_radio_status_t fixed = {
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
        .temperature = temperature,
        .voltage = voltage,
        .state = uwb_twr_state(twr),
        .anchor_count = known,
    };
    memcpy(payload, &fixed, sizeof fixed);
    for (uint8_t i = 0; i < known; i++) {
        const uwb_twr_anchor *const anchor = &twr->anchors[i];
        const uint64_t age_ms = (now_us - anchor->last_seen_us) / 1000;
        const uwb_radio_anchor_t row = {
            .address = anchor->address,
            .tried = anchor->tried,
            .ranged = anchor->ranged,
            .rx_power = anchor->rx_power_dbm,
            .age_ms = anchor->last_seen_us == 0 || age_ms > UINT32_MAX ? UINT32_MAX : (uint32_t)age_ms,
        };
        memcpy(payload + sizeof fixed + i * sizeof row, &row, sizeof row);
    }
    return sizeof fixed + known * sizeof(uwb_radio_anchor_t);
}
