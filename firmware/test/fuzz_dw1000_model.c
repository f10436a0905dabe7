/* Feeds arbitrary transactions to three chips of the DW1000's model, and stops on what breaks its promises.
 *
 *     clang -fsanitize=fuzzer,address,undefined -DUWB_LIBFUZZER -Idw1000_model test/fuzz_dw1000_model.c dw1000_model/[a-z]*.c -lm
 *
 * Without a fuzzer it makes its own inputs: fuzz_dw1000_model <inputs> <seed>. Half of the transactions are made into
 * commands that a driver gives, so that frames get on the air. */
#include "fuzz.h"
#include "dw1000_model.h"

#define CHIPS 3

typedef struct {
    const uint8_t *data;
    size_t left;
} source;

static unsigned next(source *from) {
    if (from->left == 0) {
        return 0;
    }
    from->left--;
    return *from->data++;
}

/* What drivers write: SYS_CTRL, SYS_STATUS, SYS_CFG, PMSC_CTRL0, the LDE's microcode, sleep, DX_TIME, TX_FCTRL. */
static const uint8_t COMMANDS[][7] = {
    {2, 0x8D, 0x02},       {2, 0x8D, 0x40},       {3, 0x8D, 0x00, 0x01},          {2, 0x8D, 0x82},
    {2, 0x8D, 0x06},       {3, 0x8D, 0x00, 0x03}, {5, 0x8D, 0x00, 0x00, 0, 1},    {5, 0x8F, 0xFF, 0xFF, 0xFF, 0xFF},
    {3, 0xF6, 0x00, 0x01}, {3, 0xF6, 0x00, 0x00}, {4, 0xF6, 0x00, 0x48, 0x82},    {4, 0xF6, 0x00, 0x01, 0x03},
    {4, 0xED, 0x06, 0, 0x80}, {3, 0xF6, 0x03, 0xE0}, {3, 0xF6, 0x03, 0xF0},       {3, 0xF6, 0x03, 0x00},
    {5, 0x84, 0x01, 0x02, 0x00, 0x30}, {5, 0x84, 0, 0x12, 0, 0}, {5, 0x84, 0xFF, 0x02, 0x03, 0x70},
    {3, 0xEC, 0x06, 0x07}, {3, 0xEC, 0x02, 0x02}, {5, 0x88, 0x0C, 0x40, 0x15, 0}, {5, 0x88, 0xFF, 0x43, 0x25, 0xFF},
    {6, 0x9F, 0x55, 0, 0x04, 0x21}, {3, 0xAF, 0x01, 0}, {3, 0xE7, 0x24, 5},       {5, 0x8E, 0xFF, 0xFF, 0xFF, 0x3F},
};
#define COMMAND_COUNT (sizeof COMMANDS / sizeof *COMMANDS)

static void transact(dw1000_chip *chip, source *from) {
    uint8_t out[300] = {0}, in[300];
    const unsigned how = next(from);
    size_t count;
    if (how & 1) {
        const uint8_t *const command = COMMANDS[next(from) % COMMAND_COUNT];
        count = command[0];
        memcpy(out, command + 1, count);
    } else {
        count = 1 + next(from) % (sizeof out - 1);
        const size_t given = count < 12 ? count : 12;
        for (size_t i = 0; i < given; i++) {
            out[i] = (uint8_t)next(from);
        }
    }
    const double before = dw1000_now(chip);
    dw1000_spi(chip, out, (how & 2) ? in : NULL, count, (how & 4) ? 16000000 : 2000000);
    check(dw1000_now(chip) > before, "a transaction takes time");
}

static void program(dw1000_chip *chip, void *context) {
    source *const from = context;
    for (int i = 0; i < 40 && from->left != 0; i++) {
        transact(chip, from);
        dw1000_delay(chip, next(from) * 1e-6);
        if (next(from) & 1) {
            dw1000_wait(chip, next(from) * 1e-5);
        }
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    source from = {data, size};
    int16_t *const iq = malloc(1016 * 2 * sizeof *iq);
    dw1000_air *const air = dw1000_air_new(next(&from));
    check(iq != NULL && air != NULL, "memory");
    const unsigned step = 1 + next(&from);
    for (size_t i = 0; i < 2032; i++) {
        iq[i] = (int16_t)(i * 7919 * step);
    }
    dw1000_chip *chips[CHIPS];
    for (unsigned i = 0; i < CHIPS; i++) {
        const uint64_t ticks = (uint64_t)next(&from) << 33;
        chips[i] = dw1000_chip_new(air, (double)next(&from) - 128, ticks, (uint16_t)(next(&from) << 8), 0xFFFF);
        check(chips[i] != NULL, "memory");
    }
    double reached = 0;
    while (from.left > 8) {
        const unsigned what = next(&from);
        dw1000_chip *const a = chips[what % CHIPS], *const b = chips[next(&from) % CHIPS];
        const unsigned value = next(&from);
        const dw1000_link_config link = {
            .distance_m = value * 500.0 - 1000.0,
            .excess_m = value,
            .iq = (value & 1) ? iq : NULL,
            .samples = value * 5,
            .first_path_index = value * 9.0,
            .preamble_count = (uint16_t)(value << 5),
            .loss = value / 300.0,
            .damage = value / 500.0,
        };
        switch (what >> 3 & 7) {
        case 0: dw1000_link(air, a, b, value & 7 ? &link : NULL); break;
        case 1: dw1000_program(a, program, &from); break;
        case 2: dw1000_reset_pin(a); break;
        case 3: dw1000_reset_drive(a, DW1000_RESET_LOW); break;
        case 4: dw1000_delay(a, value * 1e-4); break;
        default: transact(a, &from); break;
        }
        const double now = dw1000_run(air, (what & 0x40) ? value * 1e-5 : 0);
        check(now >= reached, "time does not run backwards");
        reached = now;
    }
    dw1000_air_free(air);
    free(iq);
    return 0;
}

#ifndef UWB_LIBFUZZER
int main(int argc, char **argv) {
    fuzz_run(argc, argv, 6000);
    return 0;
}
#endif
