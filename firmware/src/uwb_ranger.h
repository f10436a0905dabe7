/* A board with a DW1000: it sends ranges to the host according to its mode, receives radio settings from the host and
 * reports the state of the radio. */
#ifndef UWB_RANGER_H
#define UWB_RANGER_H

#include "uwb_board.h"
#include "uwb_twr.h"

#ifdef __cplusplus
extern "C" {
#endif

#define UWB_RANGER_STEP_US 5000u /* frames of the host are handled between two steps */

typedef struct {
    uwb_board board;
    uwb_twr twr;
    uwb_twr_config new_config; /* requested by the host, used from the next step on */
    uint64_t status_due_us;      /* when the next RADIO_STATUS is due */
    float voltage;
    uint8_t config_changed;  /* `new_config` is not in use yet */
    uint8_t address_sent;
} uwb_ranger;

/* Start board and radio. `board`: as for uwb_board_start, except for `handle_other_frame` and `context`, which are
 * replaced. Other arguments: see uwb_twr_start. */
void uwb_ranger_start(uwb_ranger *ranger, const uwb_board_config *board, const uwb_dw1000_io *io,
                      const uwb_twr_config *config, uint64_t random, uint8_t *measurement, size_t measurement_bytes);

/* Perform one exchange, or wait a few milliseconds for one, and send the messages that are due. */
uwb_twr_event uwb_ranger_step(uwb_ranger *ranger);

#ifdef __cplusplus
}
#endif
#endif
