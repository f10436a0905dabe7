/* The transmitter. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define POWER_UP_US 10.0
#define ERRATA_TX1_US 0.4 /* errata TX-1 */
#define PHR_SYMBOLS 21
#define TURNAROUND_US 6.5
#define FRAME_LIFETIME_US 1000.0 /* longer than any time of flight and the handling of the end of a frame */
enum { TXCLKS_PLL = 2 };

/* A tick of the chip is 1/64 units of a perfect clock; over a frame the difference does not matter. */
static instant bit_units(unsigned rate) {
    static const instant TICKS[] = {524288, 65536, 8192, 8192};
    return TICKS[rate] * UNITS_PER_TICK;
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

static void free_old_frames(dw1000_air *air) {
    for (transmission **at = &air->frames_on_air; *at != NULL;) {
        transmission *const frame = *at;
        if (frame->receivers == 0 && frame->end + MICROSECONDS(FRAME_LIFETIME_US) < air->now) {
            *at = frame->next;
            free(frame);
        } else {
            at = &frame->next;
        }
    }
}

static void frame_sent(dw1000_chip *chip, transmission *frame) {
    (void)frame;
    chip->tx = TX_OFF;
    chip->sending = NULL;
    dw1000_raise_status(chip, ST_TXFRS);
    if (chip->wait_for_response) {
        const double wait_us = (double)(dw1000_get(chip, ACK_RESP_T, 0, 4) & 0xFFFFF);
        dw1000_enable_receiver(chip, chip->air->now + MICROSECONDS(wait_us + TURNAROUND_US));
    }
}

/* The payload is read from the buffer only now: writes during the transmission change the frame (errata TX-2). */
static void read_payload(dw1000_chip *chip, transmission *frame) {
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
    dw1000_schedule(chip, GROUP_TX, frame->end, frame_sent, frame);
}

static void preamble_sent(dw1000_chip *chip, transmission *frame) {
    dw1000_raise_status(chip, ST_TXPRS);
    dw1000_schedule(chip, GROUP_TX, frame->data, read_payload, frame);
}

/* TX_POWER by its two formats: smart power has an octet for each duration of a frame, at 6.8 Mbit/s only; without it
 * the third octet is for preamble and data, the second one for the PHR. */
static void set_power(dw1000_chip *chip, const transmission *frame) {
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
static double power_db(unsigned octet) {
    return octet >> 5 == 7 ? -INFINITY : 18 - 3.0 * (octet >> 5) + 0.5 * (octet & 31u);
}

void dw1000_sent_power(const dw1000_chip *chip, double *data_db, double *header_db) {
    *data_db = power_db(chip->data_power);
    *header_db = power_db(chip->header_power);
}

static void start_frame(dw1000_chip *chip, transmission *frame) {
    dw1000_air *const air = chip->air;
    set_power(chip, frame);
    chip->tx = TX_ON;
    chip->status &= ~ST_TX; /* for a delayed frame only now: until then, the flags of the previous frame stay set */
    dw1000_raise_status(chip, ST_TXFRB);
    frame->next = air->frames_on_air;
    air->frames_on_air = frame;
    for (size_t i = 0; i < air->chip_count; i++) {
        if (chip->pairs[i] != NULL) {
            dw1000_try_detect(air->chips[i], frame);
            dw1000_check_collision(air->chips[i], frame);
        }
    }
    dw1000_schedule(chip, GROUP_TX, frame->sfd, preamble_sent, frame);
}

/* Create a frame according to TX_FCTRL, without its times. */
static transmission *create_frame(dw1000_chip *chip) {
    const uint32_t control = (uint32_t)dw1000_get(chip, TX_FCTRL, 0, 4);
    transmission *const frame = dw1000_allocate(sizeof *frame);
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

static instant shr_units(const transmission *frame) {
    return (instant)(frame->preamble_symbols + frame->mode.sfd_symbols) * frame->symbol;
}

/* Schedule a frame whose marker leaves the transmitter when the counter is at `marker` units, a multiple of 512 ticks. */
static void schedule_frame(dw1000_chip *chip, transmission *frame, uint64_t marker) {
    const instant bit = bit_units(frame->rate), coded = frame->rate == 0 ? bit : bit_units(1);
    const size_t bits = 8 * frame->length;
    frame->marker = dw1000_air_time(chip, marker + (uint64_t)chip->tx_delay * UNITS_PER_TICK);
    frame->sfd = frame->marker - (instant)frame->mode.sfd_symbols * frame->symbol;
    frame->start = frame->marker - shr_units(frame);
    frame->data = frame->marker + PHR_SYMBOLS * coded;
    frame->end = frame->data + (instant)(bits + 48 * ((bits + 329) / 330)) * bit;
    frame->aborted = INT64_MAX;
    frame->counter = (marker / UNITS_PER_TICK) & COUNTER_MASK;
    chip->sending = frame;
    chip->tx = TX_WAIT;
    dw1000_schedule(chip, GROUP_TX, frame->start, start_frame, frame);
}

static uint64_t ceil_to_grid(uint64_t units) {
    const uint64_t grid = (uint64_t)COUNTER_GRID * UNITS_PER_TICK;
    return (units + grid - 1) / grid * grid;
}

static void discard_frame(dw1000_chip *chip, transmission *frame) {
    (void)chip;
    free(frame);
}

void dw1000_start_transmission(dw1000_chip *chip, uint32_t command) {
    free_old_frames(chip->air);
    dw1000_cancel(chip, GROUP_TX);
    chip->status &= ~(ST_HPDWARN | ST_TXPUTE | (command & CTRL_TXDLYS ? 0 : ST_TX));
    dw1000_update_line(chip);
    chip->wait_for_response = (command & CTRL_WAIT4RESP) != 0;
    transmission *const frame = create_frame(chip);
    const uint64_t now = dw1000_counter_units(chip, chip->air->now), power_up = (uint64_t)MICROSECONDS(POWER_UP_US);
    if (!(command & CTRL_TXDLYS)) {
        schedule_frame(chip, frame, ceil_to_grid(now + power_up + (uint64_t)shr_units(frame)));
        return;
    }
    const uint64_t wanted = dw1000_get(chip, DX_TIME, 0, 5) & ~(uint64_t)(COUNTER_GRID - 1);
    const uint64_t header = (uint64_t)shr_units(frame) / UNITS_PER_TICK, ticks = now / UNITS_PER_TICK;
    const uint64_t lead = (wanted - header - ticks) & COUNTER_MASK; /* to the start of the preamble */
    const uint64_t lead_units = lead * UNITS_PER_TICK;
    const bool clock_held = (dw1000_get(chip, PMSC, PMSC_CTRL0, 1) >> 4 & 3) == TXCLKS_PLL;
    if (lead > COUNTER_MASK / 2) {
        dw1000_raise_status(chip, ST_HPDWARN); /* the frame is sent after the counter has wrapped */
    } else if (lead_units < power_up) {
        dw1000_raise_status(chip, ST_TXPUTE);
        discard_frame(chip, frame);
        return;
    } else if (lead_units < power_up + (uint64_t)MICROSECONDS(ERRATA_TX1_US) && !clock_held) {
        chip->tx = TX_WAIT; /* the frame is never sent: errata TX-1 */
        discard_frame(chip, frame);
        return;
    }
    schedule_frame(chip, frame, (ticks + lead + header) * UNITS_PER_TICK);
}

void dw1000_stop_transmitter(dw1000_chip *chip) {
    transmission *const frame = chip->sending;
    dw1000_cancel(chip, GROUP_TX);
    if (frame != NULL && chip->tx == TX_ON) {
        frame->aborted = chip->air->now;
    } else {
        free(frame); /* it has no references yet */
    }
    chip->sending = NULL;
    chip->tx = TX_OFF;
}
