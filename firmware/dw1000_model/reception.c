/* What the registers say of a frame: its header, its stamp, its channel, its octets. */
#include <math.h>
#include <string.h>

#include "model.h"

#define SAMPLES_AT_16MHZ 992
#define SHIFT_TICKS 256 /* at least, of a stamp after an error without a receiver reset */

uint16_t dw1000_frame_check(const uint8_t *octets, size_t count, uint16_t start) {
    uint16_t check = start;
    for (size_t i = 0; i < count; i++) {
        check = (uint16_t)(check ^ octets[i]);
        for (int bit = 0; bit < 8; bit++) {
            check = (uint16_t)(check & 1 ? check >> 1 ^ 0x8408 : check >> 1);
        }
    }
    return check;
}

static unsigned accumulated(const dw1000_chip *chip) {
    const unsigned given = chip->path->preamble_count, all = chip->symbols;
    const unsigned count = given != 0 ? given : all;
    return count > 0xFFF ? 0xFFF : count;
}

void dw1000_report_header(dw1000_chip *chip) {
    const transmission *const frame = chip->frame;
    const unsigned psr = frame->preamble_code & 3, extension = frame->preamble_code >> 2;
    const uint32_t info = (uint32_t)frame->length | extension << 11 | frame->rate << 13 |
                          (uint32_t)frame->ranging << 15 | frame->mode.prf << 16 | psr << 18 |
                          accumulated(chip) << 20;
    dw1000_put(chip, RX_FINFO, 0, 4, info);
}

/* RX_TIME: when the marker reached the antenna by the chip's counter, less what the driver says of its delay. */
static void report_time(dw1000_chip *chip, bool timed) {
    dw1000_air *const air = chip->air;
    const link *const path = chip->path;
    const uint64_t random = dw1000_dice(air->seed ^ (uint64_t)chip->index << 32, chip->receptions++);
    const instant at = chip->frame->marker + path->flight + path->excess;
    const uint64_t units = dw1000_local_units(chip, at) + (uint64_t)chip->rx_delay * UNITS_PER_TICK;
    uint64_t raw = (units + UNITS_PER_TICK / 2) / UNITS_PER_TICK;
    if (!timed) {
        raw = random;
    } else if (chip->stale) {
        const uint64_t shift = SHIFT_TICKS + random % (3 * SHIFT_TICKS);
        raw = random >> 63 ? raw + shift : raw - shift;
    }
    dw1000_put(chip, RX_TIME, RX_STAMP, 5, (raw - dw1000_get(chip, LDE_IF, LDE_RXANTD, 2)) & COUNTER_MASK);
    dw1000_put(chip, RX_TIME, RX_RAWST, 5, raw & COUNTER_MASK & ~(uint64_t)(COUNTER_GRID - 1));
}

static void report_clock(dw1000_chip *chip) {
    const transmission *const frame = chip->frame;
    const double fast = (1 + frame->sender->ppm * 1e-6) / (1 + chip->ppm * 1e-6) - 1;
    const double interval = frame->mode.prf == 2 ? 0x01FC0000 : 0x01F00000;
    const double hz = 998.4e6 / 2 / (frame->mode.slow ? 8192 : 1024) / 131072;
    dw1000_put(chip, RX_TTCKI, 0, 4, (uint64_t)interval);
    dw1000_put(chip, RX_TTCKO, 0, 3, (uint64_t)llround(fast * interval) & 0x7FFFF);
    dw1000_put(chip, RX_TTCKO, 3, 2, dw1000_dice(chip->receptions, chip->index) & 0x7FFF);
    const int64_t integrated = llround(-fast * dw1000_carrier_hz(frame->mode.channel) / hz);
    dw1000_put(chip, DRX_CONF, DRX_CAR_INT, 3, (uint64_t)integrated & 0x1FFFFF);
}

static void report_channel(dw1000_chip *chip) {
    const link *const path = chip->path;
    const unsigned multiple = (unsigned)dw1000_get(chip, LDE_IF, LDE_CFG1, 1) & 31;
    const unsigned product = multiple * path->std_noise;
    const unsigned threshold = path->threshold != 0 ? path->threshold : product > 0xFFFF ? 0xFFFF : product;
    unsigned all = chip->symbols;
    if (path->preamble_count != 0 && all <= path->preamble_count) {
        all = path->preamble_count + 1u; /* what is given is where accumulation stopped */
    }
    dw1000_put(chip, RX_FQUAL, 0, 2, path->std_noise);
    dw1000_put(chip, RX_FQUAL, 2, 2, path->fp_ampl[1]);
    dw1000_put(chip, RX_FQUAL, 4, 2, path->fp_ampl[2]);
    dw1000_put(chip, RX_FQUAL, 6, 2, path->cir_pwr);
    dw1000_put(chip, RX_TIME, FP_INDEX, 2, path->fp_index);
    dw1000_put(chip, RX_TIME, FP_AMPL1, 2, path->fp_ampl[0]);
    dw1000_put(chip, LDE_IF, LDE_THRESH, 2, threshold);
    dw1000_put(chip, LDE_IF, LDE_PPINDX, 2, path->pp_index);
    dw1000_put(chip, LDE_IF, LDE_PPAMPL, 2, path->pp_ampl);
    dw1000_put(chip, DRX_CONF, RXPACC_NOSAT, 2, all);
    const size_t samples = chip->frame->mode.prf == 2 ? ACCUMULATOR_SAMPLES : SAMPLES_AT_16MHZ;
    memcpy(chip->accumulator, path->iq, samples * 2 * sizeof *path->iq);
}

void dw1000_report_overrun(dw1000_chip *chip) {
    dw1000_report_header(chip);
    report_time(chip, false);
    dw1000_put(chip, RX_FQUAL, 0, 8, 0);
}

void dw1000_report_frame(dw1000_chip *chip, const uint8_t *octets, bool timed) {
    dw1000_report_header(chip);
    report_time(chip, timed);
    report_clock(chip);
    report_channel(chip);
    memcpy(chip->set[chip->chip_side].buffer, octets, chip->frame->length);
}
