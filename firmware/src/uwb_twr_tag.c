#include <math.h>

#include "uwb_twr_common.h"

enum {
    DISCOVERY_WINDOW_US = 8000,      /* time in which anchors answer a DISCOVER */
    DISCOVERY_INTERVAL_US = 1000000,
    DISCOVERY_INTERVAL_WINDOWS = 32, /* minimum interval in windows, which limits the share of time on slow buses */
    DISCOVERY_REPEAT_US = 50000,     /* after a DISCOVER that found an anchor */
    JITTER_US = 400,                 /* prevents that two tags stay synchronised */
    MAX_REPLY_US = 50000,
    MISSES_TO_SKIP = 3,              /* missed answers after which an anchor is skipped for one timeout, */
    MAX_SKIP_SHIFT = 3,              /* doubled with each further miss, up to eight timeouts */
    STALE_US = 10000000              /* age after which a discovered anchor is removed */
};

/* Return the anchor with an address, or NULL. */
static uwb_twr_anchor *find_anchor(uwb_twr *twr, uint64_t address) {
    for (uint8_t i = 0; i < twr->known; i++) {
        if (twr->anchors[i].address == address) {
            return &twr->anchors[i];
        }
    }
    return NULL;
}

/* Add an anchor that answered a DISCOVER, or update it. */
static void add_anchor(uwb_twr *twr, uint64_t address, uint64_t now_us) {
    uwb_twr_anchor *anchor = find_anchor(twr, address);
    if (anchor == NULL && twr->known < UWB_MAX_ANCHORS) {
        anchor = &twr->anchors[twr->known++];
        *anchor = (uwb_twr_anchor){.address = address, .rx_power_dbm = NAN};
    }
    if (anchor != NULL) {
        anchor->last_seen_us = now_us;
        anchor->next_poll_us = 0;
    }
}

/* Remove discovered anchors that have not answered for STALE_US; configured anchors stay. */
static void remove_stale_anchors(uwb_twr *twr, uint64_t now_us) {
    for (uint8_t i = twr->known; i-- > 0 && twr->config.anchor_count == 0;) {
        if (now_us - twr->anchors[i].last_seen_us > STALE_US) {
            twr->anchors[i] = twr->anchors[--twr->known];
        }
    }
}

/* Send a frame, then listen for `answer_us`. */
static uwb_dw1000_status send_frame(uwb_twr *twr, const uwb_twr_frame *frame, uint32_t answer_us) {
    uint8_t octets[UWB_TWR_MAX_FRAME_BYTES];
    return uwb_dw1000_send(&twr->chip, octets, uwb_twr_write(frame, octets), answer_us);
}

/* Broadcast DISCOVER and add the anchors that answer. */
static uwb_twr_event discover_anchors(uwb_twr *twr) {
    uwb_twr_frame frame = uwb_twr_make_frame(twr, UWB_TWR_DISCOVER, UWB_TWR_BROADCAST, uwb_twr_random(twr), 0);
    const uint32_t window_us = DISCOVERY_WINDOW_US + twr->config.timeout_us;
    const uint64_t until_us = uwb_twr_now_us(twr) + window_us;
    uwb_dw1000_status status;
    const uint8_t known = twr->known;
    frame.time_us = DISCOVERY_WINDOW_US;
    for (uint8_t i = 0; i < known; i++) {
        uwb_twr_mark_known(&frame, twr->anchors[i].address);
    }
    status = send_frame(twr, &frame, window_us);
    if (status == UWB_DW1000_OK) {
        status = uwb_dw1000_await_sent(&twr->chip, until_us, NULL);
    }
    while (status == UWB_DW1000_OK) {
        uwb_dw1000_frame received;
        uwb_twr_frame reply;
        status = uwb_twr_await_frame(twr, &frame, UWB_TWR_DISCOVER_REPLY, until_us, &received, &reply);
        if (status == UWB_DW1000_OK) {
            const uint64_t now_us = uwb_twr_now_us(twr);
            add_anchor(twr, reply.from, now_us);
            twr->misses = 0;
            if (now_us >= until_us) {
                break;
            }
            status = uwb_dw1000_listen(&twr->chip, (uint32_t)(until_us - now_us));
        }
    }
    const uint64_t now_us = uwb_twr_now_us(twr);
    const uint32_t min_interval_us = DISCOVERY_INTERVAL_WINDOWS * window_us;
    uint32_t interval_us = min_interval_us > DISCOVERY_INTERVAL_US ? min_interval_us : DISCOVERY_INTERVAL_US;
    if (twr->known > known) {
        interval_us = DISCOVERY_REPEAT_US;
    } else if (twr->known == 0) {
        interval_us = uwb_twr_random_below(twr, DISCOVERY_REPEAT_US);
    }
    twr->next_discovery_us = now_us + interval_us;
    remove_stale_anchors(twr, now_us);
    if (status == UWB_DW1000_TIMEOUT || status == UWB_DW1000_DAMAGED) {
        status = twr->known != 0 ? UWB_DW1000_OK : uwb_dw1000_check(&twr->chip);
    }
    return status == UWB_DW1000_OK ? UWB_TWR_NOTHING : uwb_twr_exchange_failed(twr, status, NULL);
}

/* Return the next anchor in rotation that is not skipped, or the one that is due first. */
static uwb_twr_anchor *next_anchor(uwb_twr *twr, uint64_t now_us) {
    uwb_twr_anchor *first = NULL;
    for (uint8_t i = 1; i <= twr->known; i++) {
        uwb_twr_anchor *const anchor = &twr->anchors[(twr->last_polled + i) % twr->known];
        if (first == NULL || (first->next_poll_us > now_us && anchor->next_poll_us < first->next_poll_us)) {
            first = anchor;
        }
    }
    return first;
}

/* Convert microseconds to ticks of the chip. */
static uint64_t us_to_ticks(uint32_t us) {
    return (uint64_t)(us * UWB_DW1000_TICKS_PER_US);
}

/* Send POLL and receive ANSWER; then `*final` is complete, with its timestamps. On failure, `*failure_count` is the
 * count of a timeout. */
static uwb_dw1000_status poll_anchor(uwb_twr *twr, uwb_twr_anchor *anchor, uwb_twr_frame *final, uint32_t **failure_count) {
    uwb_dw1000_frame received;
    uwb_twr_frame answer;
    uwb_twr_frame frame = uwb_twr_make_frame(twr, UWB_TWR_POLL, anchor->address, uwb_twr_random(twr), 0);
    uint32_t wait_us = 2 * anchor->answer_us + 2000;
    wait_us = anchor->answer_us != 0 && wait_us < twr->config.timeout_us ? wait_us : twr->config.timeout_us;
    const uint64_t until_us = uwb_twr_now_us(twr) + wait_us;
    frame.time_us = twr->reply_us;
    *failure_count = &twr->counts.no_answer;
    DW1000_TRY(send_frame(twr, &frame, twr->config.timeout_us));
    DW1000_TRY(uwb_dw1000_await_sent(&twr->chip, until_us, &final->stamps[0]));
    DW1000_TRY(uwb_dw1000_force_clock(&twr->chip)); /* before ANSWER: afterwards the time may be too short */
    DW1000_TRY(uwb_twr_await_frame(twr, &frame, UWB_TWR_ANSWER, until_us, &received, &answer));
    const uint64_t polled = final->stamps[0];
    *final = uwb_twr_make_frame(twr, UWB_TWR_FINAL, anchor->address, frame.tag_number, answer.anchor_number);
    final->stamps[0] = polled;
    final->stamps[1] = received.stamp;
    final->stamps[2] = uwb_dw1000_tx_stamp(&twr->chip, received.stamp + us_to_ticks(twr->reply_us));
    anchor->last_seen_us = received.received_us;
    anchor->misses = 0;
    anchor->answer_us = (uint32_t)(((received.stamp - polled) & UWB_DW1000_TICK_MASK) / 63898u);
    return UWB_DW1000_OK;
}

/* Perform an exchange and write its measurement. On failure, `*failure_count` is the count of a timeout. */
static uwb_dw1000_status range_with_anchor(uwb_twr *twr, uwb_twr_anchor *anchor, uint32_t **failure_count) {
    uint8_t octets[UWB_TWR_MAX_FRAME_BYTES];
    uwb_dw1000_frame received;
    uwb_twr_frame final, report;
    uint64_t sent;
    double range_m;
    DW1000_TRY(poll_anchor(twr, anchor, &final, failure_count));
    *failure_count = &twr->counts.timeout;
    const uint64_t until_us = uwb_twr_now_us(twr) + twr->reply_us + twr->config.timeout_us;
    const size_t bytes = uwb_twr_write(&final, octets);
    DW1000_TRY(uwb_dw1000_send_at(&twr->chip, octets, bytes, final.stamps[2], twr->config.timeout_us));
    DW1000_TRY(uwb_dw1000_await_sent(&twr->chip, until_us, &sent));
    DW1000_TRY(uwb_dw1000_release_clock(&twr->chip));
    DW1000_TRY(uwb_twr_await_frame(twr, &final, UWB_TWR_REPORT, until_us, &received, &report));
    if (sent != final.stamps[2] || !uwb_twr_range_m(final.stamps, report.stamps, &range_m)) {
        *failure_count = &twr->counts.implausible;
        DW1000_TRY(uwb_dw1000_check(&twr->chip));
        return UWB_DW1000_TIMEOUT;
    }
    return uwb_twr_write_measurement(twr, &received, twr->address, anchor->address, range_m, &anchor->rx_power_dbm);
}

/* Send DISCOVER if it is due; otherwise range with the next anchor. */
uwb_twr_event uwb_twr_tag_step(uwb_twr *twr, uint64_t until_us) {
    const uint64_t now_us = uwb_twr_now_us(twr);
    if (twr->config.anchor_count == 0 && now_us >= twr->next_discovery_us) {
        return discover_anchors(twr);
    }
    uwb_twr_anchor *const anchor = next_anchor(twr, now_us);
    uint64_t due_us = twr->next_discovery_us;
    if (anchor != NULL) {
        due_us = anchor->next_poll_us > twr->next_us ? anchor->next_poll_us : twr->next_us;
    }
    uwb_twr_sleep_until(twr, due_us < until_us ? due_us : until_us);
    if (anchor == NULL || due_us >= until_us) {
        return UWB_TWR_NOTHING;
    }
    const uint64_t began_us = uwb_twr_now_us(twr);
    uint32_t *failure_count = NULL;
    twr->last_polled = (uint8_t)(anchor - twr->anchors);
    twr->counts.tried++;
    anchor->tried++;
    const uwb_dw1000_status status = range_with_anchor(twr, anchor, &failure_count);
    const uint64_t ended_us = uwb_twr_now_us(twr);
    uint32_t pause_us = JITTER_US;
    uwb_twr_event event = UWB_TWR_RANGED;
    if (status == UWB_DW1000_OK) {
        twr->counts.ranged++;
        anchor->ranged++;
        twr->misses = 0;
        if (twr->reply_us > twr->config.reply_us) {
            twr->reply_us -= (twr->reply_us - twr->config.reply_us + 255) / 256;
        }
    } else {
        /* Another tag may have interfered: wait for a random time that grows with each miss. */
        event = uwb_twr_exchange_failed(twr, status, failure_count);
        if (status == UWB_DW1000_LATE && twr->reply_us < MAX_REPLY_US) {
            twr->reply_us += twr->reply_us / 4;
        }
        pause_us <<= twr->misses < 5 ? twr->misses : 5;
        if (++anchor->misses >= MISSES_TO_SKIP) {
            const uint32_t times = anchor->misses - MISSES_TO_SKIP;
            const uint32_t skip_us = twr->config.timeout_us << (times < MAX_SKIP_SHIFT ? times : MAX_SKIP_SHIFT);
            anchor->next_poll_us = ended_us + skip_us + uwb_twr_random_below(twr, skip_us / 4);
        }
    }
    twr->next_us = ended_us + uwb_twr_random_below(twr, pause_us);
    if (twr->next_us < began_us + twr->config.interval_us) {
        twr->next_us = began_us + twr->config.interval_us;
    }
    return event;
}
