#include "uwb_dw1000_registers.h"

static uwb_dw1000_status read_frame(uwb_dw1000 *chip, uwb_dw1000_frame *frame) {
    uint64_t info;
    uint8_t time[9];
    DW1000_TRY(uwb_dw1000_get(chip, RX_FINFO, 4, &info));
    const size_t bytes = info & 0x3FF; /* RXFLEN and RXFLE */
    frame->preamble_count = (uint16_t)(info >> 20 & 0xFFF);
    frame->bytes = 0;
    if (bytes < 2 || bytes > UWB_DW1000_MAX_FRAME_BYTES) {
        return UWB_DW1000_OK;
    }
    frame->bytes = (uint8_t)(bytes - 2);
    if (frame->bytes != 0) {
        DW1000_TRY(uwb_dw1000_read(chip, RX_BUFFER, frame->octets, frame->bytes));
    }
    DW1000_TRY(uwb_dw1000_read(chip, RX_TIME, time, sizeof time));
    frame->stamp = uwb_dw1000_number(time, 5);
    frame->first_path_index = (uint16_t)uwb_dw1000_number(time + 5, 2);
    frame->first_path_amplitude = (uint16_t)uwb_dw1000_number(time + 7, 2);
    /* The chip clears these bits at the next receiver enable; the write makes the driver independent of that. */
    return uwb_dw1000_set(chip, SYS_STATUS, 4, RX_BITS);
}

/* TIMEOUT with the receiver still on if nothing happens by `until_us`. */
uwb_dw1000_status uwb_dw1000_receive_or_stay(uwb_dw1000 *chip, uwb_dw1000_frame *frame, uint64_t until_us) {
    for (;;) {
        uint64_t status;
        DW1000_TRY(uwb_dw1000_get(chip, SYS_STATUS, 4, &status));
        if (status & SLP2INIT) {
            return UWB_DW1000_RESTARTED;
        }
        if (status & RX_ERRORS) {
            DW1000_TRY(uwb_dw1000_idle(chip));
            return UWB_DW1000_DAMAGED;
        }
        if (status & RXFCG) {
            frame->received_us = chip->io.now_us(chip->io.context);
            DW1000_TRY(read_frame(chip, frame));
            if ((status & LDEDONE) == 0 || frame->bytes == 0) {
                DW1000_TRY(uwb_dw1000_idle(chip));
                return UWB_DW1000_DAMAGED;
            }
            chip->listening = 0;
            return UWB_DW1000_OK;
        }
        if (status & RX_TIMEOUTS) {
            DW1000_TRY(uwb_dw1000_idle(chip));
            return UWB_DW1000_TIMEOUT;
        }
        if (chip->io.now_us(chip->io.context) >= until_us) {
            return UWB_DW1000_TIMEOUT;
        }
        chip->io.wait(chip->io.context, until_us);
    }
}

uwb_dw1000_status uwb_dw1000_receive(uwb_dw1000 *chip, uwb_dw1000_frame *frame, uint64_t until_us) {
    const uwb_dw1000_status status = uwb_dw1000_receive_or_stay(chip, frame, until_us);
    if (status == UWB_DW1000_TIMEOUT && chip->listening) {
        DW1000_TRY(uwb_dw1000_idle(chip));
    }
    return status;
}
