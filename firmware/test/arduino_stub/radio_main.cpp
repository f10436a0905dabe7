/* Runs the sketch with a radio on a modelled chip, with an anchor 7 m away: radio_main <prefix> <host> <from s>
 * <until s> <end s>, as main.cpp. Exit 2: it drove RSTn high or the clock of the SPI, or held the chip select wrongly; 3:
 * the watchdog fired. */
#include "SPI.h"
#include "core.h"

#include <stdio.h>
#include <stdlib.h>

extern "C" {
#include "dw1000_model.h"
#include "uwb_twr.h"
}

enum { CS = 10, IRQ = 2, RESET = 9, TAG_SWITCH = 3, CLOCK = 13 };

StubSpi SPI;
static dw1000_chip *chip;
static int modes[64], levels[64], wrong;

static void drive_reset() {
    static int held;
    const int pulled = modes[RESET] == OUTPUT && levels[RESET] == LOW;
    wrong |= modes[RESET] == OUTPUT && levels[RESET] == HIGH;
    if (pulled != held) {
        held = pulled;
        dw1000_reset_drive(chip, pulled ? DW1000_RESET_LOW : DW1000_RESET_FLOAT);
    }
}

void pinMode(int pin, int mode) {
    modes[pin] = mode;
    drive_reset();
}

void digitalWrite(int pin, int level) {
    wrong |= pin == CLOCK;
    levels[pin] = level;
    drive_reset();
}

int digitalRead(int pin) {
    return pin == IRQ ? dw1000_irq(chip) : LOW;
}

void stub_pass(uint32_t us) {
    dw1000_delay(chip, us * 1e-6);
    stub_run_events((uint64_t)(dw1000_now(chip) * 1e6));
}

uint32_t micros() {
    stub_pass(1);
    return (uint32_t)(dw1000_now(chip) * 1e6);
}

void StubSpi::transfer(void *bytes, size_t count) {
    static uint8_t sent[1 << 13];
    wrong |= levels[CS] != LOW || modes[CS] != OUTPUT;
    memcpy(sent, bytes, count);
    dw1000_spi(chip, sent, (uint8_t *)bytes, count, hz);
}

static void run_sketch(dw1000_chip *, void *) {
    setup();
    for (;;) {
        loop();
    }
}

/* The anchor. */
struct anchor_host {
    dw1000_chip *chip;
    uint32_t hz;
};

static int anchor_transfer(void *context, const uint8_t *header, size_t header_bytes, const uint8_t *out, uint8_t *in,
                           size_t bytes) {
    anchor_host *const host = (anchor_host *)context;
    uint8_t sent[256] = {0}, received[256];
    memcpy(sent, header, header_bytes);
    if (out != NULL) {
        memcpy(sent + header_bytes, out, bytes);
    }
    dw1000_spi(host->chip, sent, received, header_bytes + bytes, host->hz);
    if (out == NULL) {
        memcpy(in, received + header_bytes, bytes);
    }
    return 0;
}

static void anchor_speed(void *context, int fast) {
    ((anchor_host *)context)->hz = fast ? 8000000 : 2000000;
}

static uint64_t anchor_now(void *context) {
    return (uint64_t)(dw1000_now(((anchor_host *)context)->chip) * 1e6);
}

static void anchor_wait(void *context, uint64_t until_us) {
    dw1000_chip *const chip_of_anchor = ((anchor_host *)context)->chip;
    const double left_s = (double)until_us * 1e-6 - dw1000_now(chip_of_anchor);
    dw1000_wait(chip_of_anchor, left_s > 1e-6 ? left_s : 1e-6);
}

static void anchor_sleep(void *context, uint32_t us) {
    dw1000_delay(((anchor_host *)context)->chip, us * 1e-6);
}

static void run_anchor(dw1000_chip *anchor, void *context) {
    static uwb_twr twr;
    static uint64_t measurement[1024];
    anchor_host *const host = (anchor_host *)context;
    host->chip = anchor;
    const uwb_dw1000_io io = {host, anchor_transfer, anchor_speed, NULL, anchor_now, anchor_wait, anchor_sleep};
    uwb_twr_config config = uwb_twr_defaults;
    config.role = UWB_ROLE_ANCHOR;
    uwb_twr_start(&twr, &io, &config, 5, (uint8_t *)measurement, sizeof measurement);
    for (;;) {
        (void)uwb_twr_step(&twr, anchor_now(host) + 100000);
    }
}

int main(int argc, char **argv) {
    static anchor_host host;
    if (argc != 6) {
        return 2;
    }
    stub_start(argv[1], stub_host_of(argv[2]), (uint64_t)(atof(argv[3]) * 1e6), (uint64_t)(atof(argv[4]) * 1e6));
    dw1000_air *const air = dw1000_air_new(1);
    chip = dw1000_chip_new(air, 8, 0, 16436, 16436);
    dw1000_chip *const anchor = dw1000_chip_new(air, -5, 77, 16436, 16436);
    dw1000_pair_config pair = {};
    pair.distance_m = 7;
    dw1000_set_pair(air, chip, anchor, &pair);
    dw1000_program(chip, run_sketch, NULL);
    dw1000_program(anchor, run_anchor, &host);
    dw1000_run(air, atof(argv[5]));
    stub_finish();
    return wrong == 0 && dw1000_fault(chip) == NULL ? 0 : 2;
}
