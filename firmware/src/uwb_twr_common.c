#include <string.h>

#include "uwb_mitigation.h"
#include "uwb_twr_common.h"

enum { MAX_SLEEP_US = 1000, MISSES_TO_RESTART = 100 };

/* Return the time of io.now_us. */
uint64_t uwb_twr_now_us(const uwb_twr *twr) {
    return twr->io.now_us(twr->io.context);
}

/* Sleep in short intervals, because io.sleep takes 32 bits. */
void uwb_twr_sleep_until(const uwb_twr *twr, uint64_t until_us) {
    for (uint64_t now_us = uwb_twr_now_us(twr); now_us < until_us; now_us = uwb_twr_now_us(twr)) {
        const uint64_t left_us = until_us - now_us;
        twr->io.sleep(twr->io.context, left_us < MAX_SLEEP_US ? (uint32_t)left_us : MAX_SLEEP_US);
    }
}

/* Return 32 bits of Marsaglia's xorshift64*. */
uint32_t uwb_twr_random(uwb_twr *twr) {
    twr->random ^= twr->random >> 12;
    twr->random ^= twr->random << 25;
    twr->random ^= twr->random >> 27;
    return (uint32_t)(twr->random * 0x2545F4914F6CDD1Du >> 32);
}

/* Scale 32 random bits to 0 to limit - 1. */
uint32_t uwb_twr_random_below(uwb_twr *twr, uint32_t limit) {
    return (uint32_t)((uint64_t)uwb_twr_random(twr) * limit >> 32);
}

/* Fill in addresses, PAN and numbers; other fields are 0. */
uwb_twr_frame uwb_twr_make_frame(const uwb_twr *twr, uwb_twr_frame_type kind, uint64_t to, uint32_t tag_number,
                               uint32_t anchor_number) {
    return (uwb_twr_frame){
        .kind = kind,
        .sequence = (uint8_t)tag_number,
        .pan = twr->config.pan,
        .to = to,
        .from = twr->address,
        .tag_number = tag_number,
        .anchor_number = anchor_number,
    };
}

/* Return whether a frame is the answer of type `kind` to `sent`. */
static int is_expected(const uwb_twr *twr, const uwb_twr_frame *frame, const uwb_twr_frame *sent, uwb_twr_frame_type kind) {
    return frame->kind == kind && frame->pan == twr->config.pan && frame->to == twr->address &&
           (frame->from == sent->to || (sent->to == UWB_TWR_BROADCAST && frame->from != twr->address)) &&
           frame->tag_number == sent->tag_number &&
           /* A tag learns the anchor's number from ANSWER; all later frames contain it. */
           (kind == UWB_TWR_ANSWER || frame->anchor_number == sent->anchor_number);
}

/* Receive until the expected frame or the timeout. */
uwb_dw1000_status uwb_twr_await_frame(uwb_twr *twr, const uwb_twr_frame *sent, uwb_twr_frame_type kind, uint64_t until_us,
                                 uwb_dw1000_frame *received, uwb_twr_frame *frame) {
    uwb_dw1000_status result = UWB_DW1000_TIMEOUT;
    for (;;) {
        const uwb_dw1000_status status = uwb_dw1000_receive(&twr->chip, received, until_us);
        if (status == UWB_DW1000_OK) {
            if (uwb_twr_read(received->octets, received->bytes, frame) && is_expected(twr, frame, sent, kind)) {
                return UWB_DW1000_OK;
            }
            twr->counts.refused++;
        } else if (status == UWB_DW1000_DAMAGED) {
            result = UWB_DW1000_DAMAGED;
        } else {
            return status == UWB_DW1000_TIMEOUT ? result : status;
        }
        const uint64_t now_us = uwb_twr_now_us(twr);
        if (now_us >= until_us) {
            return result;
        }
        DW1000_TRY(uwb_dw1000_listen(&twr->chip, (uint32_t)(until_us - now_us)));
    }
}

/* Write fields and samples to twr->measurement; the chip is checked after the read. */
uwb_dw1000_status uwb_twr_write_measurement(uwb_twr *twr, const uwb_dw1000_frame *received, uint64_t tag, uint64_t anchor,
                                  double range_m, float *rx_power_dbm) {
    const uwb_dw1000_settings *const radio = &twr->chip.settings;
    uwb_range_cir_t *const fields = (uwb_range_cir_t *)(void *)twr->measurement;
    const size_t max_count = UWB_DW1000_SAMPLES(radio->prf_mhz);
    const size_t count = twr->config.window < max_count ? twr->config.window : max_count;
    const size_t index = received->first_path_index / 64u;
    size_t first = index > UWB_WINDOW_LEAD ? index - UWB_WINDOW_LEAD : 0;
    first = first < max_count - count ? first : max_count - count;
    uwb_dw1000_quality quality;
    DW1000_TRY(uwb_dw1000_read_quality(&twr->chip, received, &quality));
    if (count != 0) {
        /* The first octet is invalid. It overwrites the last octet of the fields, which are written afterwards. */
        DW1000_TRY(uwb_dw1000_read_cir(&twr->chip, first, count, twr->measurement + sizeof *fields - 1));
    }
    DW1000_TRY(uwb_dw1000_check(&twr->chip));
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

/* Return the count of a failure. */
static uint32_t *failure_count_of(uwb_twr_counts *counts, uwb_dw1000_status status, uint32_t *timeout_count) {
    switch (status) {
    case UWB_DW1000_TIMEOUT:
        return timeout_count;
    case UWB_DW1000_DAMAGED:
        return &counts->damaged;
    case UWB_DW1000_LATE:
        return &counts->late;
    case UWB_DW1000_UNSENT:
        return &counts->timeout;
    default:
        return &counts->broken;
    }
}

/* Count the failure; check the chip, which is restarted if it has lost its settings or after too many misses. */
uwb_twr_event uwb_twr_exchange_failed(uwb_twr *twr, uwb_dw1000_status status, uint32_t *timeout_count) {
    if (timeout_count != NULL) {
        (*failure_count_of(&twr->counts, status, timeout_count))++;
    }
    twr->misses++;
    if (status == UWB_DW1000_TIMEOUT || status == UWB_DW1000_DAMAGED || status == UWB_DW1000_LATE) {
        /* No error on this side, unless the chip has lost its settings. */
        const int restart = twr->misses % MISSES_TO_RESTART == 0;
        status = restart ? UWB_DW1000_RESTARTED : uwb_dw1000_check(&twr->chip);
        if (status == UWB_DW1000_OK) {
            return UWB_TWR_NOTHING;
        }
    }
    twr->running = 0;
    twr->fault = status;
    /* A chip that can be restarted immediately is not a fault. */
    return status == UWB_DW1000_BUS ? UWB_TWR_FAULT : UWB_TWR_NOTHING;
}
