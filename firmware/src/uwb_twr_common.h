/* Functions shared by the two roles of an exchange. Internal. */
#ifndef UWB_TWR_COMMON_H
#define UWB_TWR_COMMON_H

#include "uwb_twr.h"

uwb_twr_event uwb_twr_tag_step(uwb_twr *twr, uint64_t until_us);
uwb_twr_event uwb_twr_anchor_step(uwb_twr *twr, uint64_t until_us);

uint64_t uwb_twr_now_us(const uwb_twr *twr);
void uwb_twr_sleep_until(const uwb_twr *twr, uint64_t until_us);

/* A random number below `limit`, which is not 0; and one of 32 bits. */
uint32_t uwb_twr_random_below(uwb_twr *twr, uint32_t limit);
uint32_t uwb_twr_random(uwb_twr *twr);

/* A frame of ours to `to`. */
uwb_twr_frame uwb_twr_make_frame(const uwb_twr *twr, uwb_twr_kind kind, uint64_t to, uint32_t tag_number,
                               uint32_t anchor_number);

/* Wait for a frame that belongs to what `sent` began, and read it to `frame`. TIMEOUT, or DAMAGED if something came
 * that was no frame; others are refused, and the wait goes on. */
uwb_dw1000_status uwb_twr_await_frame(uwb_twr *twr, const uwb_twr_frame *sent, uwb_twr_kind kind, uint64_t until_us,
                                 uwb_dw1000_frame *received, uwb_twr_frame *frame);

/* Read what the chip knows of the last frame, and make it and the range a measurement. `*rx_power_dbm` may be NULL. */
uwb_dw1000_status uwb_twr_write_measurement(uwb_twr *twr, const uwb_dw1000_frame *received, uint64_t tag, uint64_t anchor,
                                  double range_m, float *rx_power_dbm);

/* Count a failed exchange, and restart the chip if necessary. */
uwb_twr_event uwb_twr_exchange_failed(uwb_twr *twr, uwb_dw1000_status status, uint32_t *when_timed_out);

#endif
