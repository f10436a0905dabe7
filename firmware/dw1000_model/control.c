/* SYS_CTRL, SYS_STATUS and the interrupt line. */
#include "model.h"

#define GLITCH_US 0.5

uint64_t status_of(const dw1000_chip *chip) {
    uint64_t status = chip->status | chip->set[chip->host_side].status;
    status |= chip->host_side ? ST_HSRBP : 0;
    status |= chip->chip_side ? ST_ICRBP : 0;
    const uint64_t mask = get(chip, SYS_MASK, 0, 4) & UINT64_C(0x3FFFFFFE);
    return status & mask ? status | ST_IRQS : status;
}

void update_line(dw1000_chip *chip) {
    const bool asserted = chip->glitch || (status_of(chip) & ST_IRQS) != 0;
    const bool active_high = (get(chip, SYS_CFG, 0, 4) & CFG_HIRQ_POL) != 0;
    const bool line = asserted == active_high;
    if (line && !chip->line) {
        wake(chip);
    }
    chip->line = line;
}

void raise_status(dw1000_chip *chip, uint64_t bits) {
    chip->status |= bits & ~ST_SWINGING;
    chip->set[chip->chip_side].status |= bits & ST_SWINGING;
    update_line(chip);
}

void clear_status(dw1000_chip *chip, uint64_t bits) {
    chip->status &= ~bits;
    chip->set[chip->host_side].status &= ~bits;
    update_line(chip);
}

static void glitch_over(dw1000_chip *chip, transmission *none) {
    (void)none;
    chip->glitch = false;
    update_line(chip);
}

/* Errata IRQ-1: to clear a bit that each buffer has for itself, unmasked, makes a pulse on the line (manual, 4.3.3). */
void acknowledge_status(dw1000_chip *chip, uint64_t bits) {
    const uint64_t set = chip->set[chip->host_side].status & bits;
    clear_status(chip, bits);
    if (doubly_buffered(chip) && (set & get(chip, SYS_MASK, 0, 4))) {
        chip->glitch = true;
        schedule(chip, GROUP_LATE, chip->air->now + MICROSECONDS(GLITCH_US), glitch_over, NULL);
        update_line(chip);
    }
}

void count_event(dw1000_chip *chip, counter which) {
    if (chip->counting) {
        const unsigned sub = 4 + 2 * (unsigned)which;
        put(chip, DIG_DIAG, sub, 2, (get(chip, DIG_DIAG, sub, 2) + 1) & 0xFFF);
    }
}

uint32_t system_state(const dw1000_chip *chip) {
    uint32_t whole = chip->power == POWER_IDLE ? 1 : 0;
    if (chip->tx != TX_OFF) {
        whole = chip->tx == TX_WAIT ? 2 : 4;
    } else if (chip->rx != RX_OFF) {
        whole = chip->rx == RX_WAIT ? 3 : 5;
    }
    return whole << 16;
}

/* One write to SYS_CTRL: its octets together, those that were not written as 0. */
void control(dw1000_chip *chip, uint32_t command) {
    if (command & CTRL_HRBPT) {
        chip->set[chip->host_side].full = false;
        chip->host_side ^= 1u;
        clear_status(chip, ST_RXOVRR);
    }
    if (command & CTRL_TRXOFF) {
        late_event(chip);
        stop_transmitter(chip);
        stop_receiver(chip);
        clear_status(chip, ST_HPDWARN | ST_TXPUTE);
        return; /* TXSTRT in the same write does not transmit */
    }
    if (chip->power != POWER_IDLE) {
        return;
    }
    if ((command & CTRL_TXSTRT) && chip->tx == TX_OFF && chip->rx == RX_OFF) {
        start_transmission(chip, command);
    }
    if (!(command & CTRL_RXENAB) || chip->rx != RX_OFF) {
        return;
    }
    if (chip->tx != TX_OFF) {
        chip->wait_for_response = true; /* it comes after the frame */
    } else {
        if (command & CTRL_RXDLYE) {
            delay_receiver(chip);
        } else {
            enable_receiver(chip, chip->air->now, false);
        }
    }
}
