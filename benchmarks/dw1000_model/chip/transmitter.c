/* The transmitter. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define POWER_UP_US 10.0
#define LOST_US 0.4 /* errata TX-1 */
#define PHR_SYMBOLS 21
#define TURNAROUND_US 6.5
#define KEPT_US 1000.0 /* longer than any flight, and what a receiver does at a frame's end */
enum { TXCLKS_PLL = 2 };

/* A tick of the chip is 1/64 units of a perfect clock; over a frame the difference does not matter. */
static instant bit_units(unsigned rate) {
    return (instant)(rate == 0 ? 524288 : rate == 1 ? 65536 : 8192) * UNITS_PER_TICK;
}

static unsigned preamble_symbols(unsigned code) {
    switch (code) { /* PE, then TXPSR */
    case 0x1: return 64;
    case 0x5: return 128;
    case 0x9: return 256;
    case 0xD: return 512;
    case 0x2: return 1024;
    case 0x6: return 1536;
    case 0xA: return 2048;
    case 0x3: return 4096;
    default: return 16;
    }
}

static void forget_old(dw1000_air *air) {
    for (transmission **at = &air->flying; *at != NULL;) {
        transmission *const frame = *at;
        if (frame->receivers == 0 && frame->end + MICROSECONDS(KEPT_US) < air->now) {
            *at = frame->next;
            free(frame);
        } else {
            at = &frame->next;
        }
    }
}

static void finished(dw1000_chip *chip, transmission *frame) {
    (void)frame;
    chip->tx = TX_OFF;
    chip->sending = NULL;
    dw1000_raise_status(chip, ST_TXFRS);
    if (chip->wait_for_response) {
        const double wait_us = (double)(dw1000_get(chip, ACK_RESP_T, 0, 4) & 0xFFFFF);
        dw1000_enable_receiver(chip, chip->air->now + MICROSECONDS(wait_us + TURNAROUND_US));
    }
}

/* Only now are octets taken from the buffer: what is written while a frame is being sent ends up in it (errata TX-2). */
static void take_payload(dw1000_chip *chip, transmission *frame) {
    const uint32_t control = (uint32_t)dw1000_get(chip, TX_FCTRL, 0, 4);
    const size_t offset = control >> 22;
    for (size_t i = 0; i < frame->length; i++) {
        frame->payload[i] = chip->tx_buffer[(offset + i) % FRAME_OCTETS];
    }
    if (frame->length >= 2) {
        const uint16_t check = dw1000_frame_check(frame->payload, frame->length - 2);
        frame->payload[frame->length - 2] = (uint8_t)check;
        frame->payload[frame->length - 1] = (uint8_t)(check >> 8);
    }
    dw1000_put(chip, TX_TIME, TX_RAWST, 5, frame->counter);
    dw1000_put(chip, TX_TIME, 0, 5, (frame->counter + dw1000_get(chip, TX_ANTD, 0, 2)) & COUNTER_MASK);
    dw1000_raise_status(chip, ST_TXPHS);
    dw1000_schedule(chip, GROUP_TX, frame->end, finished, frame);
}

static void preamble_sent(dw1000_chip *chip, transmission *frame) {
    dw1000_raise_status(chip, ST_TXPRS);
    dw1000_schedule(chip, GROUP_TX, frame->data, take_payload, frame);
}

/* TX_POWER by its two formats: smart power has an octet for each duration of a frame, at 6.8 Mbit/s only; without it
 * the third octet is for preamble and data, the second one for the PHR. */
static void choose_power(dw1000_chip *chip, const transmission *frame) {
    static const double BOOST_US[] = {500, 250, 125};
    unsigned data = 0;
    while (frame->rate == 2 && data < 3 && frame->end - frame->start <= MICROSECONDS(BOOST_US[data])) {
        data++;
    }
    const bool smart = (dw1000_get(chip, SYS_CFG, 0, 4) & CFG_DIS_STXP) == 0;
    chip->data_power = (uint8_t)dw1000_get(chip, TX_POWER, smart ? data : 2, 1);
    chip->header_power = (uint8_t)dw1000_get(chip, TX_POWER, smart ? data : 1, 1);
}

/* Bits 7:5: 18 dB in steps of -3, or nothing; bits 4:0: steps of 0.5 dB. */
static double decibels(unsigned octet) {
    return octet >> 5 == 7 ? -INFINITY : 18 - 3.0 * (octet >> 5) + 0.5 * (octet & 31u);
}

void dw1000_sent_power(const dw1000_chip *chip, double *data_db, double *header_db) {
    *data_db = decibels(chip->data_power);
    *header_db = decibels(chip->header_power);
}

static void on_air(dw1000_chip *chip, transmission *frame) {
    dw1000_air *const air = chip->air;
    choose_power(chip, frame);
    chip->tx = TX_ON;
    chip->status &= ~ST_TX; /* of a delayed frame only now: while it waits, those of the frame before stand */
    dw1000_raise_status(chip, ST_TXFRB);
    frame->next = air->flying;
    air->flying = frame;
    for (size_t i = 0; i < air->chip_count; i++) {
        if (chip->links[i] != NULL) {
            dw1000_consider(air->chips[i], frame);
            dw1000_disturb(air->chips[i], frame);
        }
    }
    dw1000_schedule(chip, GROUP_TX, frame->sfd, preamble_sent, frame);
}

/* A frame as TX_FCTRL describes it, but for its times. */
static transmission *describe(dw1000_chip *chip) {
    const uint32_t control = (uint32_t)dw1000_get(chip, TX_FCTRL, 0, 4);
    transmission *const frame = dw1000_memory(sizeof *frame);
    frame->serial = chip->air->serial++;
    frame->sender = chip;
    frame->mode = dw1000_transmit_mode(chip);
    frame->rate = control >> 13 & 3;
    frame->preamble_code = control >> 18 & 15;
    frame->preamble_symbols = preamble_symbols(frame->preamble_code);
    frame->phr_mode = (unsigned)(dw1000_get(chip, SYS_CFG, 0, 4) & CFG_PHR_MODE) >> 16;
    frame->ranging = control >> 15 & 1;
    frame->length = control & (frame->phr_mode == 3 ? 0x3FF : 0x7F);
    frame->symbol = dw1000_symbol_units(frame->mode.prf);
    return frame;
}

static instant header_units(const transmission *frame) {
    return (instant)(frame->preamble_symbols + frame->mode.sfd_symbols) * frame->symbol;
}

/* Send a frame whose marker leaves the transmitter when the counter is at `marker` units, on its grid of 512 ticks. */
static void send_at(dw1000_chip *chip, transmission *frame, uint64_t marker) {
    const instant bit = bit_units(frame->rate), coded = frame->rate == 0 ? bit : bit_units(1);
    const size_t bits = 8 * frame->length;
    frame->marker = dw1000_air_time(chip, marker + (uint64_t)chip->tx_delay * UNITS_PER_TICK);
    frame->sfd = frame->marker - (instant)frame->mode.sfd_symbols * frame->symbol;
    frame->start = frame->marker - header_units(frame);
    frame->data = frame->marker + PHR_SYMBOLS * coded;
    frame->end = frame->data + (instant)(bits + 48 * ((bits + 329) / 330)) * bit;
    frame->aborted = INT64_MAX;
    frame->counter = (marker / UNITS_PER_TICK) & COUNTER_MASK;
    chip->sending = frame;
    chip->tx = TX_WAIT;
    dw1000_schedule(chip, GROUP_TX, frame->start, on_air, frame);
}

static uint64_t next_grid(uint64_t units) {
    const uint64_t grid = (uint64_t)COUNTER_GRID * UNITS_PER_TICK;
    return (units + grid - 1) / grid * grid;
}

static void give_up(dw1000_chip *chip, transmission *frame) {
    (void)chip;
    free(frame);
}

void dw1000_start_transmission(dw1000_chip *chip, uint32_t command) {
    forget_old(chip->air);
    dw1000_cancel(chip, GROUP_TX);
    chip->status &= ~(ST_HPDWARN | ST_TXPUTE | (command & CTRL_TXDLYS ? 0 : ST_TX));
    dw1000_update_line(chip);
    chip->wait_for_response = (command & CTRL_WAIT4RESP) != 0;
    transmission *const frame = describe(chip);
    const uint64_t now = dw1000_local_units(chip, chip->air->now), power_up = (uint64_t)MICROSECONDS(POWER_UP_US);
    if (!(command & CTRL_TXDLYS)) {
        send_at(chip, frame, next_grid(now + power_up + (uint64_t)header_units(frame)));
        return;
    }
    const uint64_t wanted = dw1000_get(chip, DX_TIME, 0, 5) & ~(uint64_t)(COUNTER_GRID - 1);
    const uint64_t header = (uint64_t)header_units(frame) / UNITS_PER_TICK, ticks = now / UNITS_PER_TICK;
    const uint64_t lead = (wanted - header - ticks) & COUNTER_MASK; /* to the start of the preamble */
    const uint64_t lead_units = lead * UNITS_PER_TICK;
    const bool clock_held = (dw1000_get(chip, PMSC, PMSC_CTRL0, 1) >> 4 & 3) == TXCLKS_PLL;
    if (lead > COUNTER_MASK / 2) {
        dw1000_raise_status(chip, ST_HPDWARN); /* and it waits for a whole turn of the counter */
    } else if (lead_units < power_up) {
        dw1000_raise_status(chip, ST_TXPUTE);
        give_up(chip, frame);
        return;
    } else if (lead_units < power_up + (uint64_t)MICROSECONDS(LOST_US) && !clock_held) {
        chip->tx = TX_WAIT; /* and there it stays: errata TX-1 */
        give_up(chip, frame);
        return;
    }
    send_at(chip, frame, (ticks + lead + header) * UNITS_PER_TICK);
}

void dw1000_stop_transmitter(dw1000_chip *chip) {
    transmission *const frame = chip->sending;
    dw1000_cancel(chip, GROUP_TX);
    if (frame != NULL && chip->tx == TX_ON) {
        frame->aborted = chip->air->now;
    } else {
        free(frame); /* it is not referenced yet */
    }
    chip->sending = NULL;
    chip->tx = TX_OFF;
}
