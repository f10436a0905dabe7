/* SYS_CTRL, SYS_STATUS and the interrupt line. */
#include "model.h"

#define GLITCH_US 0.5

uint64_t dw1000_status_of(const dw1000_chip *chip) {
    uint64_t status = chip->status | chip->set[chip->host_side].status;
    status |= chip->host_side ? ST_HSRBP : 0;
    status |= chip->chip_side ? ST_ICRBP : 0;
    const uint64_t mask = dw1000_get(chip, SYS_MASK, 0, 4) & UINT64_C(0x3FFFFFFE);
    return status & mask ? status | ST_IRQS : status;
}

void dw1000_update_line(dw1000_chip *chip) {
    const bool asserted = chip->glitch || (dw1000_status_of(chip) & ST_IRQS) != 0;
    const bool active_high = (dw1000_get(chip, SYS_CFG, 0, 4) & CFG_HIRQ_POL) != 0;
    const bool line = asserted == active_high;
    if (line && !chip->line) {
        dw1000_wake(chip);
    }
    chip->line = line;
}

void dw1000_raise_status(dw1000_chip *chip, uint64_t bits) {
    chip->status |= bits & ~ST_SWINGING;
    chip->set[chip->chip_side].status |= bits & ST_SWINGING;
    dw1000_update_line(chip);
}

void dw1000_clear_status(dw1000_chip *chip, uint64_t bits) {
    chip->status &= ~bits;
    chip->set[chip->host_side].status &= ~bits;
    dw1000_update_line(chip);
}

static void glitch_over(dw1000_chip *chip, transmission *none) {
    (void)none;
    chip->glitch = false;
    dw1000_update_line(chip);
}

/* Errata IRQ-1: to clear a bit that each buffer has for itself, unmasked, makes a pulse on the line (manual, 4.3.3). */
void dw1000_acknowledge_status(dw1000_chip *chip, uint64_t bits) {
    const uint64_t set = chip->set[chip->host_side].status & bits;
    dw1000_clear_status(chip, bits);
    if (dw1000_doubly_buffered(chip) && (set & dw1000_get(chip, SYS_MASK, 0, 4))) {
        chip->glitch = true;
        dw1000_schedule(chip, GROUP_LATE, chip->air->now + MICROSECONDS(GLITCH_US), glitch_over, NULL);
        dw1000_update_line(chip);
    }
}

void dw1000_count_event(dw1000_chip *chip, counter which) {
    if (chip->counting) {
        const unsigned sub = 4 + 2 * (unsigned)which;
        dw1000_put(chip, DIG_DIAG, sub, 2, (dw1000_get(chip, DIG_DIAG, sub, 2) + 1) & 0xFFF);
    }
}

uint32_t dw1000_system_state(const dw1000_chip *chip) {
    uint32_t whole = chip->power == POWER_IDLE ? 1 : 0;
    if (chip->tx != TX_OFF) {
        whole = chip->tx == TX_WAIT ? 2 : 4;
    } else if (chip->rx != RX_OFF) {
        whole = chip->rx == RX_WAIT ? 3 : 5;
    }
    return whole << 16;
}

/* One write to SYS_CTRL: its octets together, those that were not written as 0. */
void dw1000_control(dw1000_chip *chip, uint32_t command) {
    if (command & CTRL_HRBPT) {
        chip->set[chip->host_side].full = false;
        chip->host_side ^= 1u;
        dw1000_clear_status(chip, ST_RXOVRR);
    }
    if (command & CTRL_TRXOFF) {
        dw1000_late_event(chip);
        dw1000_stop_transmitter(chip);
        dw1000_stop_receiver(chip);
        dw1000_clear_status(chip, ST_HPDWARN | ST_TXPUTE);
        return; /* TXSTRT in the same write does not transmit */
    }
    if (chip->power != POWER_IDLE) {
        return;
    }
    if ((command & CTRL_TXSTRT) && chip->tx == TX_OFF && chip->rx == RX_OFF) {
        dw1000_start_transmission(chip, command);
    }
    if (!(command & CTRL_RXENAB) || chip->rx != RX_OFF) {
        return;
    }
    if (chip->tx != TX_OFF) {
        chip->wait_for_response = true; /* it comes after the frame */
    } else {
        if (command & CTRL_RXDLYE) {
            dw1000_delay_receiver(chip);
        } else {
            dw1000_enable_receiver(chip, chip->air->now, false);
        }
    }
}
