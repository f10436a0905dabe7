/* Two DW1000s measure the distance between them: a driver of a hundred lines on the model, from the facts of the
 * DW1000 user manual alone. It shows how any driver is put on the model; for real use take the one in firmware/src.
 *
 *     cc -I.. two_way.c ../[a-z]*.c -lm -o two_way && ./two_way 12.5 20
 */
#include <stdio.h>
#include <stdlib.h>

#include "dw1000_model.h"

#define DELAY_TICKS 16436u                 /* from the counter to the antenna, in each direction */
#define TICK_M (299792458.0 / 128 / 499.2e6)
#define REPLY_TICKS (UINT64_C(600) * 63898) /* 600 us */
#define MASK ((UINT64_C(1) << 40) - 1)
#define RXFCG (UINT64_C(1) << 14)
#define TXFRS (UINT64_C(1) << 7)
#define TROUBLE UINT64_C(0x2C2F9000) /* errors and time-outs of the receiver, HPDWARN */

static uint32_t hz;

static void transfer(dw1000_chip *chip, int write, unsigned file, unsigned sub, uint8_t *data, size_t count) {
    uint8_t out[160] = {0}, in[160];
    size_t header = 0;
    out[header++] = (uint8_t)((write ? 0xC0u : 0x40u) | file);
    if (sub < 0x80) {
        out[header++] = (uint8_t)sub;
    } else {
        out[header++] = (uint8_t)(0x80 | (sub & 0x7F));
        out[header++] = (uint8_t)(sub >> 7);
    }
    for (size_t i = 0; i < count; i++) {
        out[header + i] = write ? data[i] : 0;
    }
    dw1000_spi(chip, out, in, header + count, hz);
    for (size_t i = 0; i < count && !write; i++) {
        data[i] = in[header + i];
    }
}

static void set(dw1000_chip *chip, unsigned file, unsigned sub, uint64_t value, size_t count) {
    uint8_t data[8];
    for (size_t i = 0; i < count; i++) {
        data[i] = (uint8_t)(value >> (8 * i));
    }
    transfer(chip, 1, file, sub, data, count);
}

static uint64_t get(dw1000_chip *chip, unsigned file, unsigned sub, size_t count) {
    uint8_t data[8];
    uint64_t value = 0;
    transfer(chip, 0, file, sub, data, count);
    for (size_t i = count; i-- > 0;) {
        value = value << 8 | data[i];
    }
    return value;
}

static void start(dw1000_chip *chip) {
    hz = 2000000; /* until the PLL has locked */
    dw1000_reset_pin(chip);
    dw1000_delay(chip, 5e-3);
    if (get(chip, 0x00, 0, 4) != 0xDECA0130) {
        puts("no DW1000");
        exit(1);
    }
    set(chip, 0x36, 0, 0x0301, 2); /* load the leading-edge detector */
    set(chip, 0x2D, 6, 0x8000, 2);
    dw1000_delay(chip, 160e-6);
    set(chip, 0x36, 0, 0x0200, 2);
    dw1000_delay(chip, 1e-3);
    hz = 8000000;
    /* Channel 5, PRF 16 MHz, preamble 128, 6.8 Mbit/s are the reset's; what it leaves wrong: */
    set(chip, 0x23, 4, 0x8870, 2);
    set(chip, 0x27, 8, 0x311A002D, 4);
    set(chip, 0x2E, 0x0806, 0x6D, 1);
    set(chip, 0x2E, 0x1806, 0x1607, 2);
    set(chip, 0x2E, 0x2804, 0x428E, 2);
    set(chip, 0x18, 0, DELAY_TICKS, 2);
    set(chip, 0x2E, 0x1804, DELAY_TICKS, 2);
    set(chip, 0x0C, 0, 5000, 2); /* give up a reception after 5 ms */
    set(chip, 0x04, 0, 0x10001200, 4);
    set(chip, 0x0E, 0, RXFCG | TXFRS | TROUBLE, 4);
    set(chip, 0x0D, 0, 0x42, 1); /* TXSTRT with TRXOFF: nothing is sent */
}

static int await(dw1000_chip *chip, uint64_t wanted) {
    dw1000_wait(chip, 10e-3);
    const uint64_t status = get(chip, 0x0F, 0, 5);
    if (status & wanted) {
        return 1;
    }
    set(chip, 0x0D, 0, 0x40, 1);
    set(chip, 0x36, 3, 0xE0, 1); /* reset the receiver: the next stamp would be wrong */
    set(chip, 0x36, 3, 0xF0, 1);
    set(chip, 0x0F, 0, 0xFFFFFFFF, 4);
    return 0;
}

/* Send, now or when the counter is at `at`; the stamp, or 0. */
static uint64_t send(dw1000_chip *chip, uint8_t *data, size_t count, uint64_t at) {
    transfer(chip, 1, 0x09, 0, data, count);
    set(chip, 0x08, 0, 0x154000 | (count + 2), 3);
    if (at != 0) {
        set(chip, 0x0A, 0, at, 5);
    }
    set(chip, 0x0F, 0, 0xFFFFFFFF, 4);
    set(chip, 0x0D, 0, at != 0 ? 0x06 : 0x02, 1);
    return await(chip, TXFRS) ? get(chip, 0x17, 0, 5) : 0;
}

/* Receive `count` octets; the stamp, or 0. */
static uint64_t receive(dw1000_chip *chip, uint8_t *data, size_t count) {
    set(chip, 0x0F, 0, 0xFFFFFFFF, 4);
    set(chip, 0x0D, 1, 0x01, 1);
    if (!await(chip, RXFCG) || (get(chip, 0x10, 0, 2) & 0x7F) != count + 2) {
        return 0;
    }
    transfer(chip, 0, 0x11, 0, data, count);
    return get(chip, 0x15, 0, 5);
}

static uint64_t after(uint64_t stamp) {
    return (stamp + REPLY_TICKS) & MASK & ~UINT64_C(511);
}

typedef struct {
    double sum_m;
    int wanted, ranges;
} result;

static void initiator(dw1000_chip *chip, void *context) {
    result *const told = context;
    start(chip);
    for (int i = 0; i < told->wanted; i++) {
        uint8_t poll[4] = {0x41, 0x88, (uint8_t)i, 1}, answer[4], final[24] = {0x41, 0x88, (uint8_t)i, 3}, report[32];
        dw1000_delay(chip, 2e-3);
        const uint64_t t1 = send(chip, poll, sizeof poll, 0);
        const uint64_t t4 = t1 ? receive(chip, answer, sizeof answer) : 0;
        const uint64_t t5 = t4 ? send(chip, final, 4, after(t4)) : 0;
        if (t5 == 0 || receive(chip, report, 19) == 0) {
            continue;
        }
        uint64_t theirs[3] = {0};
        for (int k = 0; k < 15; k++) {
            theirs[k / 5] |= (uint64_t)report[4 + k] << (8 * (k % 5));
        }
        const double round1 = (double)((t4 - t1) & MASK), reply2 = (double)((t5 - t4) & MASK);
        const double reply1 = (double)((theirs[1] - theirs[0]) & MASK), round2 = (double)((theirs[2] - theirs[1]) & MASK);
        told->sum_m += TICK_M * (round1 * round2 - reply1 * reply2) / (round1 + round2 + reply1 + reply2);
        told->ranges++;
    }
}

static void responder(dw1000_chip *chip, void *context) {
    (void)context;
    start(chip);
    for (;;) {
        uint8_t frame[4], report[19] = {0x41, 0x88, 0, 4};
        uint8_t answer[4] = {0x41, 0x88, 0, 2};
        const uint64_t t2 = receive(chip, frame, sizeof frame);
        const uint64_t t3 = t2 ? send(chip, answer, sizeof answer, after(t2)) : 0;
        const uint64_t t6 = t3 ? receive(chip, frame, sizeof frame) : 0;
        const uint64_t stamps[3] = {t2, t3, t6};
        for (int k = 0; k < 15; k++) {
            report[4 + k] = (uint8_t)(stamps[k / 5] >> (8 * (k % 5)));
        }
        if (t6 != 0) {
            (void)send(chip, report, sizeof report, after(t6));
        }
    }
}

int main(int argc, char **argv) {
    const double distance_m = argc > 1 ? atof(argv[1]) : 12.5;
    dw1000_air *const air = dw1000_air_new(1);
    dw1000_chip *const a = dw1000_chip_new(air, 12.0, 0xFFF0000000, DELAY_TICKS, DELAY_TICKS);
    dw1000_chip *const b = dw1000_chip_new(air, -7.0, 12345678, DELAY_TICKS, DELAY_TICKS);
    const dw1000_link_config link = {.distance_m = distance_m};
    result told = {0, argc > 2 ? atoi(argv[2]) : 20, 0};
    dw1000_link(air, a, b, &link);
    dw1000_program(a, initiator, &told);
    dw1000_program(b, responder, NULL);
    const double reached_s = dw1000_run(air, 0.05 + 0.005 * told.wanted);
    printf("%d ranges in %.3f s of virtual time, mean %.3f m\n", told.ranges, reached_s,
           told.ranges ? told.sum_m / told.ranges : 0.0);
    dw1000_air_free(air);
    return told.ranges == told.wanted ? 0 : 1;
}
