/* Functions shared by the two roles of an exchange. Internal. */
#ifndef UWB_TWR_COMMON_H
#define UWB_TWR_COMMON_H

#include "uwb_twr.h"

/* Perform one step of a tag; see uwb_twr_step. */
uwb_twr_event uwb_twr_tag_step(uwb_twr *twr, uint64_t until_us);

/* Perform one step of an anchor; see uwb_twr_step. */
uwb_twr_event uwb_twr_anchor_step(uwb_twr *twr, uint64_t until_us);

/* Return the time of io.now_us. */
uint64_t uwb_twr_now_us(const uwb_twr *twr);

/* Sleep until a time of io.now_us. */
void uwb_twr_sleep_until(const uwb_twr *twr, uint64_t until_us);

/* Return a random number below `limit`, which is not 0. */
uint32_t uwb_twr_random_below(uwb_twr *twr, uint32_t limit);

/* Return a random number of 32 bits. */
uint32_t uwb_twr_random(uwb_twr *twr);

/* Return a frame from this radio to `to`. */
uwb_twr_frame uwb_twr_make_frame(const uwb_twr *twr, uwb_twr_frame_type kind, uint64_t to, uint32_t tag_number,
                               uint32_t anchor_number);

/* Wait for the frame of type `kind` that answers `sent`, and decode it to `frame`. Other frames are refused, and the
 * wait continues. At `until_us` returns TIMEOUT, or DAMAGED if a damaged frame was received. */
uwb_dw1000_status uwb_twr_await_frame(uwb_twr *twr, const uwb_twr_frame *sent, uwb_twr_frame_type kind, uint64_t until_us,
                                 uwb_dw1000_frame *received, uwb_twr_frame *frame);

/* Read quality and CIR of the last frame from the chip, and write the measurement. `rx_power_dbm` may be NULL. */
uwb_dw1000_status uwb_twr_write_measurement(uwb_twr *twr, const uwb_dw1000_frame *received, uint64_t tag, uint64_t anchor,
                                  double range_m, float *rx_power_dbm);

/* Count a failed exchange, and request a restart of the chip if necessary. `timeout_count`: the count for a timeout;
 * NULL = no exchange had begun. */
uwb_twr_event uwb_twr_exchange_failed(uwb_twr *twr, uwb_dw1000_status status, uint32_t *timeout_count);

#endif
