/* A board with its own DW1000: it sends ranges to the host as its mode says, takes the radio's settings from the host and
 * reports the state of the radio. */
#ifndef UWB_RANGER_H
#define UWB_RANGER_H

#include "uwb_board.h"
#include "uwb_twr.h"

#ifdef __cplusplus
extern "C" {
#endif

#define UWB_RANGER_STEP_US 5000u /* frames of the host are handled between two turns */

typedef struct {
    uwb_board board;
    uwb_twr twr;
    uwb_twr_config wanted; /* by the host, from the next turn on */
    uint64_t status_due_us;      /* when the next RADIO_STATUS is due */
    float voltage;
    uint8_t change;  /* whether `wanted` is to be used */
    uint8_t address_sent;
} uwb_ranger;

/* Start, with `board` as for uwb_board_start but for `other` and `context`, which are the ranger's; the rest as for
 * uwb_twr_start. */
void uwb_ranger_start(uwb_ranger *ranger, const uwb_board_config *board, const uwb_dw1000_io *io,
                      const uwb_twr_config *config, uint64_t random, uint8_t *measurement, size_t measurement_bytes);

/* One exchange, or a few milliseconds without; and what is due to the host. */
uwb_twr_event uwb_ranger_step(uwb_ranger *ranger);

#ifdef __cplusplus
}
#endif
#endif
