/* The receiver: when it is on, which frames it notices, what the registers report of a frame, how a reception ends. */
#include <math.h>
#include <string.h>

#include "model.h"

#define WARM_UP_US 16.0
#define DETECTION_CHUNKS 2 /* of preamble acquisition, before a preamble is noticed */
#define GLITCH_US 0.5
#define CAPTURE 4.0 /* 6 dB: a frame that is stronger than another one by this survives it */
#define TIMEOUT_TICKS 65536 /* RX_FWTO's unit */
#define SAMPLES_AT_16MHZ 992
#define SHIFT_TICKS 256 /* at least, of a stamp after an error without a receiver reset */

/* Kinds of damage, by dice. */
enum { BAD_HEADER, BAD_CODE, BAD_CHECK, NO_SFD, DAMAGES };
/* Purposes of the random numbers of a frame. */
enum { FOR_LOSS = 1, FOR_DAMAGE, FOR_KIND, FOR_CLASH, FOR_EDGE };

/* The same for a frame and a receiver, however often and in whatever order it is asked. */
static uint64_t fate(const dw1000_chip *chip, const transmission *frame, unsigned what) {
    const uint64_t pair = (uint64_t)frame->sender->index << 32 | (uint64_t)chip->index;
    return dw1000_dice(dw1000_dice(chip->air->seed, pair), frame->serial << 3 | what);
}

static instant arrival(const dw1000_chip *chip, instant sent) {
    return sent + chip->path->flight;
}

static void let_go(dw1000_chip *chip) {
    dw1000_cancel(chip, GROUP_FRAME);
    if (chip->frame != NULL) {
        chip->frame->receivers--;
        dw1000_drop_link(chip->path);
    }
    chip->path = NULL;
    chip->frame = NULL;
    chip->clashed = false;
}

void dw1000_stop_receiver(dw1000_chip *chip) {
    dw1000_cancel(chip, GROUP_RX);
    let_go(chip);
    chip->rx = RX_OFF;
}

static void failed(dw1000_chip *chip, uint64_t bit) {
    chip->stale = chip->stale || (bit & (ST_RXPHE | ST_RXRFSL | ST_RXRFTO | ST_RXFCE));
    dw1000_raise_status(chip, bit);
    dw1000_stop_receiver(chip);
}

static void frame_wait_over(dw1000_chip *chip, transmission *none) {
    (void)none;
    failed(chip, ST_RXRFTO);
}

static void sfd_wait_over(dw1000_chip *chip, transmission *none) {
    (void)none;
    if (chip->rx == RX_PREAMBLE) {
        failed(chip, ST_RXSFDTO);
    }
}

static bool damaged(const dw1000_chip *chip, unsigned kind) {
    const transmission *const frame = chip->frame;
    if (dw1000_chance(fate(chip, frame, FOR_DAMAGE)) >= chip->path->damage) {
        return false;
    }
    return fate(chip, frame, FOR_KIND) % DAMAGES == kind;
}

static bool cut_off(const dw1000_chip *chip) {
    const instant aborted = chip->frame->aborted;
    return aborted != INT64_MAX && arrival(chip, aborted) <= chip->air->now;
}

uint16_t dw1000_frame_check(const uint8_t *octets, size_t count) {
    uint16_t check = 0;
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

static void report_header(dw1000_chip *chip) {
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
    dw1000_put(chip, RX_TIME, 0, 5, (raw - dw1000_get(chip, LDE_IF, LDE_RXANTD, 2)) & COUNTER_MASK);
    dw1000_put(chip, RX_TIME, RX_RAWST, 5, raw & COUNTER_MASK & ~(uint64_t)(COUNTER_GRID - 1));
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
    dw1000_put(chip, DRX_CONF, RXPACC_NOSAT, 2, all);
    const size_t samples = chip->frame->mode.prf == 2 ? ACCUMULATOR_SAMPLES : SAMPLES_AT_16MHZ;
    memcpy(chip->accumulator, path->iq, samples * 2 * sizeof *path->iq);
}

static void report_frame(dw1000_chip *chip, const uint8_t *octets, bool timed) {
    report_header(chip);
    report_time(chip, timed);
    report_channel(chip);
    memcpy(chip->rx_buffer, octets, chip->frame->length);
}

static void frame_over(dw1000_chip *chip, transmission *frame) {
    if (cut_off(chip) || chip->clashed || damaged(chip, BAD_CODE)) {
        failed(chip, ST_RXRFSL);
        return;
    }
    uint8_t octets[FRAME_OCTETS];
    memcpy(octets, frame->payload, sizeof octets);
    if (damaged(chip, BAD_CHECK)) {
        const uint64_t where = fate(chip, frame, FOR_CLASH);
        octets[where % (frame->length ? frame->length : 1)] ^= (uint8_t)(1u << (where >> 32 & 7));
    }
    const bool detector = chip->lde_loaded && (dw1000_get(chip, PMSC, PMSC_CTRL1, 4) & (1u << 17));
    const bool timed = detector && dw1000_chance(fate(chip, frame, FOR_EDGE)) >= chip->edges_lost;
    report_frame(chip, octets, timed);
    const size_t length = frame->length;
    const bool good = length >= 2 && dw1000_frame_check(octets, length - 2) ==
                                         (uint16_t)(octets[length - 2] | octets[length - 1] << 8);
    const uint64_t done = timed ? ST_LDEDONE : detector ? ST_LDEERR : 0;
    chip->stale = chip->stale || done == ST_LDEERR;
    dw1000_raise_status(chip, ST_RXDFR | done | (good ? ST_RXFCG : 0));
    if (good) {
        dw1000_stop_receiver(chip);
    } else {
        failed(chip, ST_RXFCE);
    }
}

static void header_over(dw1000_chip *chip, transmission *frame) {
    const bool other_mode = frame->phr_mode != dw1000_get(chip, SYS_CFG, 2, 1) % 4;
    if (cut_off(chip) || chip->clashed || other_mode || damaged(chip, BAD_HEADER)) {
        failed(chip, ST_RXPHE);
        return;
    }
    chip->rx = RX_DATA;
    report_header(chip);
    dw1000_raise_status(chip, ST_RXPHD);
    dw1000_schedule(chip, GROUP_FRAME, arrival(chip, frame->end), frame_over, frame);
}

static void sfd_over(dw1000_chip *chip, transmission *frame) {
    const air_interface mode = dw1000_receive_mode(chip);
    const bool same = frame->mode.slow == mode.slow && frame->mode.decawave_sfd == mode.decawave_sfd &&
                      frame->mode.sfd_symbols == mode.sfd_symbols;
    const bool drowned = chip->clashed && (fate(chip, frame, FOR_CLASH) & 1);
    if (!same || cut_off(chip) || drowned || damaged(chip, NO_SFD)) {
        return; /* and the wait for an SFD goes on */
    }
    dw1000_cancel(chip, GROUP_FRAME);
    chip->rx = RX_HEADER;
    dw1000_raise_status(chip, ST_RXSFDD);
    const instant header = frame->data - frame->marker;
    dw1000_schedule(chip, GROUP_FRAME, arrival(chip, frame->marker + header), header_over, frame);
}

static void preamble_noticed(dw1000_chip *chip, transmission *frame) {
    link *const path = chip->links[frame->sender->index];
    if (chip->rx != RX_SEARCH || path == NULL || frame->aborted < chip->air->now) {
        return;
    }
    path->users++;
    frame->receivers++;
    chip->path = path;
    chip->frame = frame;
    chip->rx = RX_PREAMBLE;
    chip->clashed = false;
    chip->symbols = (unsigned)((arrival(chip, frame->marker) - chip->air->now) / frame->symbol);
    dw1000_raise_status(chip, ST_RXPRD);
    for (transmission *other = chip->air->flying; other != NULL; other = other->next) {
        dw1000_disturb(chip, other);
    }
    const unsigned patience = (unsigned)dw1000_get(chip, DRX_CONF, DRX_SFDTOC, 2);
    dw1000_schedule(chip, GROUP_FRAME, arrival(chip, frame->marker), sfd_over, frame);
    if (patience != 0) {
        dw1000_schedule(chip, GROUP_FRAME, chip->air->now + (instant)patience * frame->symbol, sfd_wait_over, frame);
    }
}

void dw1000_consider(dw1000_chip *chip, transmission *frame) {
    const link *const path = chip->links[frame->sender->index];
    const air_interface mode = dw1000_receive_mode(chip);
    if (chip->rx != RX_SEARCH || path == NULL || frame->aborted != INT64_MAX || !mode.tuned || !frame->mode.tuned ||
        mode.channel != frame->mode.channel || mode.prf != frame->mode.prf || mode.code != frame->mode.code) {
        return;
    }
    const instant heard = frame->start + path->flight;
    const unsigned chunk = 8u << (((unsigned)dw1000_get(chip, DRX_CONF, DRX_TUNE2, 4) >> 25) & 3u);
    const instant at = (heard > chip->air->now ? heard : chip->air->now) + (instant)(DETECTION_CHUNKS * chunk) * frame->symbol;
    if (at > frame->sfd + path->flight || dw1000_chance(fate(chip, frame, FOR_LOSS)) < path->loss) {
        return;
    }
    dw1000_schedule(chip, GROUP_RX, at, preamble_noticed, frame);
}

void dw1000_disturb(dw1000_chip *chip, const transmission *frame) {
    const link *const path = chip->links[frame->sender->index];
    if (chip->frame == NULL || frame == chip->frame || path == NULL || frame->mode.channel != chip->frame->mode.channel ||
        frame->mode.prf != chip->frame->mode.prf || frame->mode.code != chip->frame->mode.code) {
        return;
    }
    const instant stops = frame->aborted < frame->end ? frame->aborted : frame->end;
    const bool overlaps = stops + path->flight > chip->air->now &&
                          frame->start + path->flight < arrival(chip, chip->frame->end);
    chip->clashed = chip->clashed || (overlaps && chip->path->level < CAPTURE * path->level);
}

/* Search for preambles, also for those that are on the air already. */
static void search(dw1000_chip *chip, transmission *none) {
    (void)none;
    chip->rx = RX_SEARCH;
    for (transmission *frame = chip->air->flying; frame != NULL; frame = frame->next) {
        dw1000_consider(chip, frame);
    }
}

static void turn_on(dw1000_chip *chip, transmission *none) {
    (void)none;
    memset(chip->accumulator, 0, sizeof chip->accumulator);
    chip->rx = RX_WARMUP;
    dw1000_schedule(chip, GROUP_RX, chip->air->now + MICROSECONDS(WARM_UP_US), search, NULL);
    if (dw1000_get(chip, SYS_CFG, 0, 4) & CFG_RXWTOE) { /* it counts from the enable on, not from the end of the warm-up */
        const instant wait = (instant)dw1000_get(chip, RX_FWTO, 0, 2) * TIMEOUT_TICKS * UNITS_PER_TICK;
        dw1000_schedule(chip, GROUP_RX, chip->air->now + wait, frame_wait_over, NULL);
    }
}

void dw1000_enable_receiver(dw1000_chip *chip, instant at) {
    if (chip->rx_in_reset) {
        return;
    }
    dw1000_stop_receiver(chip);
    dw1000_clear_status(chip, ST_RX | ST_HPDWARN);
    chip->rx = RX_WAIT;
    if (at > chip->air->now) {
        dw1000_schedule(chip, GROUP_RX, at, turn_on, NULL);
    } else {
        turn_on(chip, NULL);
    }
}

/* An event may be on its way as the host turns the receiver off, and is latched all the same. */
static void latch(dw1000_chip *chip, transmission *none) {
    (void)none;
    dw1000_raise_status(chip, ST_RXPHE);
}

void dw1000_late_event(dw1000_chip *chip) {
    if (chip->rx >= RX_PREAMBLE) {
        dw1000_schedule(chip, GROUP_LATE, chip->air->now + MICROSECONDS(GLITCH_US), latch, NULL);
    }
}
