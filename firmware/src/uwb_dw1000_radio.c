#include "uwb_dw1000_registers.h"

enum { TX_CLOCK_PLL = 2 << 4, POLL_US = 100, MAX_TIMEOUT_US = 60000, SMART_POWER_US = 1000 };
static const double WAIT_UNIT_US = 512 / 499.2;

uwb_dw1000_status uwb_dw1000_idle(uwb_dw1000 *chip) {
    /* The interrupts are masked, because an event may occur between TRXOFF and the clearing of the status. */
    static const uwb_dw1000_entry entries[] = {
        {SYS_MASK, 4, 0},
        {SYS_CTRL, 4, TRXOFF},
        {SYS_STATUS, 4, RX_BITS | TX_BITS},
        {SYS_MASK, 4, UWB_DW1000_INTERRUPTS},
        {0, 0, 0},
    };
    /* The manual requires it after most errors (4.1.6), because timestamps would be wrong. An error may just have occurred. */
    static const uwb_dw1000_entry reset_receiver[] = {{PMSC_SOFTRESET, 1, 0xE0}, {PMSC_SOFTRESET, 1, 0xF0}, {0, 0, 0}};
    DW1000_TRY(uwb_dw1000_write_list(chip, entries));
    if (chip->listening) {
        DW1000_TRY(uwb_dw1000_write_list(chip, reset_receiver));
        chip->listening = 0;
    }
    return uwb_dw1000_release_clock(chip);
}

/* Errata TX-1: if the sequencer controls the clock, a start time just above the limit for HPDWARN is missed without
 * a warning. */
uwb_dw1000_status uwb_dw1000_force_clock(uwb_dw1000 *chip) {
    if (chip->clock_forced) {
        return UWB_DW1000_OK;
    }
    DW1000_TRY(uwb_dw1000_set(chip, PMSC_CTRL0, 1, TX_CLOCK_PLL));
    chip->clock_forced = 1;
    return UWB_DW1000_OK;
}

uwb_dw1000_status uwb_dw1000_release_clock(uwb_dw1000 *chip) {
    if (!chip->clock_forced) {
        return UWB_DW1000_OK;
    }
    DW1000_TRY(uwb_dw1000_set(chip, PMSC_CTRL0, 1, 0));
    chip->clock_forced = 0;
    return UWB_DW1000_OK;
}

/* Set the receiver's own timeout; write it only if it has changed. */
static uwb_dw1000_status set_timeout(uwb_dw1000 *chip, uint32_t for_us) {
    const uint32_t units = for_us < MAX_TIMEOUT_US ? (uint32_t)(for_us / WAIT_UNIT_US) + 1u : 0;
    const uint32_t sys_cfg = units != 0 ? chip->sys_cfg | RXWTOE : chip->sys_cfg & ~RXWTOE;
    if (units != 0 && units != chip->wait_units) {
        DW1000_TRY(uwb_dw1000_set(chip, RX_FWTO, 2, units));
        chip->wait_units = (uint16_t)units;
    }
    if (sys_cfg != chip->sys_cfg) {
        DW1000_TRY(uwb_dw1000_set(chip, SYS_CFG, 4, sys_cfg));
        chip->sys_cfg = sys_cfg;
    }
    return UWB_DW1000_OK;
}

/* Write frame and length to the chip, and set the timeout of the answer. */
static uwb_dw1000_status prepare_frame(uwb_dw1000 *chip, const uint8_t *octets, size_t bytes, uint32_t answer_us) {
    if (bytes + 2 > UWB_DW1000_MAX_FRAME_BYTES) {
        return UWB_DW1000_BAD_ARGUMENT;
    }
    if (chip->listening) {
        DW1000_TRY(uwb_dw1000_idle(chip)); /* TXSTRT would be ignored */
    }
    if (answer_us != 0) {
        DW1000_TRY(set_timeout(chip, answer_us));
    }
    DW1000_TRY(uwb_dw1000_write(chip, TX_BUFFER, octets, bytes));
    if (chip->tx_bytes != bytes) {
        DW1000_TRY(uwb_dw1000_set(chip, TX_FCTRL, 4, chip->tx_fctrl | (uint32_t)(bytes + 2)));
        chip->tx_bytes = (uint8_t)bytes;
    }
    return UWB_DW1000_OK;
}

uwb_dw1000_status uwb_dw1000_send(uwb_dw1000 *chip, const uint8_t *octets, size_t bytes, uint32_t answer_us) {
    DW1000_TRY(prepare_frame(chip, octets, bytes, answer_us));
    const uint64_t now_us = chip->io.now_us(chip->io.context);
    if (now_us < chip->next_send_us) {
        chip->io.sleep(chip->io.context, (uint32_t)(chip->next_send_us - now_us));
    }
    DW1000_TRY(uwb_dw1000_set(chip, SYS_CTRL, 1, TXSTRT | (answer_us != 0 ? WAIT4RESP : 0)));
    chip->listening = answer_us != 0;
    return UWB_DW1000_OK;
}

uint64_t uwb_dw1000_tx_stamp(const uwb_dw1000 *chip, uint64_t at) {
    return ((at & ~(uint64_t)0x1FF) + chip->tx_antenna_delay) & UWB_DW1000_TICK_MASK;
}

uwb_dw1000_status uwb_dw1000_send_at(uwb_dw1000 *chip, const uint8_t *octets, size_t bytes, uint64_t stamp,
                                     uint32_t answer_us) {
    uint64_t status;
    DW1000_TRY(prepare_frame(chip, octets, bytes, answer_us));
    DW1000_TRY(uwb_dw1000_set(chip, DX_TIME, 5, (stamp - chip->tx_antenna_delay) & UWB_DW1000_TICK_MASK));
    DW1000_TRY(uwb_dw1000_force_clock(chip));
    DW1000_TRY(uwb_dw1000_set(chip, SYS_CTRL, 1, TXSTRT | TXDLYS | (answer_us != 0 ? WAIT4RESP : 0)));
    chip->listening = answer_us != 0;
    DW1000_TRY(uwb_dw1000_get(chip, SYS_STATUS, 5, &status));
    if (status & (HPDWARN | TXPUTE)) {
        DW1000_TRY(uwb_dw1000_idle(chip));
        return UWB_DW1000_LATE;
    }
    return UWB_DW1000_OK;
}

uwb_dw1000_status uwb_dw1000_await_sent(uwb_dw1000 *chip, uint64_t until_us, uint64_t *stamp) {
    for (;;) {
        uint64_t status;
        DW1000_TRY(uwb_dw1000_get(chip, SYS_STATUS, 4, &status));
        if (status & SLP2INIT) {
            return UWB_DW1000_RESTARTED;
        }
        if (status & TXFRS) {
            break;
        }
        const uint64_t now_us = chip->io.now_us(chip->io.context);
        if (now_us >= until_us) {
            DW1000_TRY(uwb_dw1000_idle(chip));
            return UWB_DW1000_UNSENT;
        }
        chip->io.wait(chip->io.context, until_us - now_us < POLL_US ? until_us : now_us + POLL_US);
    }
    if ((chip->sys_cfg & DIS_STXP) == 0) {
        chip->next_send_us = chip->io.now_us(chip->io.context) + SMART_POWER_US;
    }
    /* Clear TXFRS: while a delayed frame waits, the flag of the previous frame would stay set. */
    DW1000_TRY(uwb_dw1000_set(chip, SYS_STATUS, 4, TX_BITS));
    return stamp != NULL ? uwb_dw1000_get(chip, TX_TIME, 5, stamp) : UWB_DW1000_OK;
}

uwb_dw1000_status uwb_dw1000_listen(uwb_dw1000 *chip, uint32_t for_us) {
    if (chip->listening) {
        DW1000_TRY(uwb_dw1000_idle(chip));
    }
    DW1000_TRY(set_timeout(chip, for_us));
    DW1000_TRY(uwb_dw1000_set(chip, SYS_CTRL, 2, RXENAB));
    chip->listening = 1;
    return UWB_DW1000_OK;
}

/* Read contents, timestamp and first path of the received frame. */
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
    frame->stamp = uwb_dw1000_from_little_endian(time, 5);
    frame->first_path_index = (uint16_t)uwb_dw1000_from_little_endian(time + 5, 2);
    frame->first_path_amplitude = (uint16_t)uwb_dw1000_from_little_endian(time + 7, 2);
    /* The chip clears these bits at the next receiver enable; the write makes the driver independent of that. */
    return uwb_dw1000_set(chip, SYS_STATUS, 4, RX_BITS);
}

uwb_dw1000_status uwb_dw1000_receive_keep_on(uwb_dw1000 *chip, uwb_dw1000_frame *frame, uint64_t until_us) {
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
    const uwb_dw1000_status status = uwb_dw1000_receive_keep_on(chip, frame, until_us);
    if (status == UWB_DW1000_TIMEOUT && chip->listening) {
        DW1000_TRY(uwb_dw1000_idle(chip));
    }
    return status;
}
