#include "uwb_twr_common.h"

enum {
    CHECK_INTERVAL_US = 100000, /* between two checks of the chip */
    MAX_WINDOW_US = 100000,     /* of a DISCOVER */
    MAX_REPLY_US = 200000,      /* of a POLL */
    FINAL_MARGIN_US = 2000,
    SEND_TIMEOUT_US = 20000     /* long enough for every bus */
};

/* Send a frame and wait until it was sent. */
static uwb_dw1000_status send_frame(uwb_twr *twr, const uwb_twr_frame *frame) {
    uint8_t octets[UWB_TWR_MAX_FRAME_BYTES];
    DW1000_TRY(uwb_dw1000_send(&twr->chip, octets, uwb_twr_write(frame, octets), 0));
    return uwb_dw1000_await_sent(&twr->chip, uwb_twr_now_us(twr) + SEND_TIMEOUT_US, NULL);
}

/* Answer a tag that looks for anchors, at a random time so that answers rarely collide. */
static uwb_dw1000_status reply_to_discovery(uwb_twr *twr, const uwb_twr_frame *request) {
    const uint32_t window_us = request->time_us < MAX_WINDOW_US ? request->time_us : MAX_WINDOW_US;
    const uwb_twr_frame reply = uwb_twr_make_frame(twr, UWB_TWR_DISCOVER_REPLY, request->from, request->tag_number, 0);
    uwb_twr_sleep_until(twr, uwb_twr_now_us(twr) + uwb_twr_random_below(twr, window_us + 1));
    return send_frame(twr, &reply);
}

/* Perform an exchange that a POLL begins. On failure, `*failure_count` is the count of its cause. */
static uwb_dw1000_status range_with_tag(uwb_twr *twr, const uwb_twr_frame *polled, uint64_t poll_received,
                                        uint32_t **failure_count) {
    uint8_t octets[UWB_TWR_MAX_FRAME_BYTES];
    uwb_dw1000_frame received;
    uwb_twr_frame final;
    double range_m;
    const uint32_t reply_us = polled->time_us < MAX_REPLY_US ? polled->time_us : MAX_REPLY_US;
    const uint32_t wait_us = reply_us + FINAL_MARGIN_US + reply_us / 2;
    const uwb_twr_frame answer =
        uwb_twr_make_frame(twr, UWB_TWR_ANSWER, polled->from, polled->tag_number, uwb_twr_random(twr));
    uwb_twr_frame report = answer;
    report.kind = UWB_TWR_REPORT;
    report.stamps[0] = poll_received;
    *failure_count = &twr->counts.timeout;
    DW1000_TRY(uwb_dw1000_send(&twr->chip, octets, uwb_twr_write(&answer, octets), UWB_DW1000_NO_LIMIT));
    const uint64_t until_us = uwb_twr_now_us(twr) + wait_us;
    DW1000_TRY(uwb_dw1000_await_sent(&twr->chip, until_us, &report.stamps[1]));
    DW1000_TRY(uwb_twr_await_frame(twr, &answer, UWB_TWR_FINAL, until_us, &received, &final));
    report.stamps[2] = received.stamp;
    if (!uwb_twr_range_m(final.stamps, report.stamps, &range_m)) {
        *failure_count = &twr->counts.implausible;
        DW1000_TRY(uwb_dw1000_check(&twr->chip));
        return UWB_DW1000_TIMEOUT;
    }
    if (twr->config.report) {
        DW1000_TRY(uwb_twr_write_measurement(twr, &received, polled->from, twr->address, range_m, NULL));
    }
    /* This side has its range even if REPORT is lost. A chip that was reset cannot send it. */
    (void)send_frame(twr, &report);
    return UWB_DW1000_OK;
}

/* Handle a received frame: answer DISCOVER, range after POLL, refuse others. */
static uwb_twr_event handle_frame(uwb_twr *twr, const uwb_dw1000_frame *received) {
    uwb_twr_frame frame;
    uint32_t *failure_count = NULL;
    uwb_dw1000_status status;
    if (!uwb_twr_read(received->octets, received->bytes, &frame) || frame.pan != twr->config.pan ||
        (frame.kind != UWB_TWR_DISCOVER && (frame.kind != UWB_TWR_POLL || frame.to != twr->address)) ||
        frame.from == twr->address) {
        twr->counts.refused++;
        return UWB_TWR_NOTHING;
    }
    if (frame.kind == UWB_TWR_DISCOVER) {
        if (uwb_twr_is_known(&frame, twr->address)) {
            return UWB_TWR_NOTHING;
        }
        status = reply_to_discovery(twr, &frame);
        return status == UWB_DW1000_OK ? UWB_TWR_NOTHING : uwb_twr_exchange_failed(twr, status, NULL);
    }
    twr->counts.tried++;
    status = range_with_tag(twr, &frame, received->stamp, &failure_count);
    if (status != UWB_DW1000_OK) {
        return uwb_twr_exchange_failed(twr, status, failure_count);
    }
    twr->counts.ranged++;
    twr->misses = 0;
    return twr->config.report ? UWB_TWR_RANGED : UWB_TWR_NOTHING;
}

/* Listen for a frame until `until_us` and handle it; check the chip at intervals. */
uwb_twr_event uwb_twr_anchor_step(uwb_twr *twr, uint64_t until_us) {
    uwb_dw1000_frame received;
    uwb_dw1000_status status = UWB_DW1000_OK;
    if (uwb_twr_now_us(twr) >= twr->next_us) {
        twr->next_us = uwb_twr_now_us(twr) + CHECK_INTERVAL_US;
        status = uwb_dw1000_check(&twr->chip);
    }
    if (status == UWB_DW1000_OK && !twr->chip.listening) {
        status = uwb_dw1000_listen(&twr->chip, UWB_DW1000_NO_LIMIT);
    }
    if (status == UWB_DW1000_OK) {
        const uint64_t wait_until_us = twr->next_us < until_us ? twr->next_us : until_us;
        status = uwb_dw1000_receive_keep_on(&twr->chip, &received, wait_until_us);
    }
    if (status == UWB_DW1000_OK) {
        return handle_frame(twr, &received);
    }
    if (status == UWB_DW1000_TIMEOUT || status == UWB_DW1000_DAMAGED) {
        return UWB_TWR_NOTHING;
    }
    return uwb_twr_exchange_failed(twr, status, NULL);
}
