/* The receiver: when it is on, which frames it detects, the registers of a received frame, and how a reception ends. */
#include <math.h>
#include <string.h>

#include "model.h"

#define WARM_UP_US 16.0
#define DETECTION_CHUNKS 2 /* of preamble acquisition, until a preamble is detected */
#define LATE_EVENT_US 0.5
#define CAPTURE_RATIO 4.0 /* 6 dB: a frame that is stronger by this than a colliding one is received */
#define TIMEOUT_TICKS 65536 /* RX_FWTO's unit */
#define SAMPLES_AT_16MHZ 992
#define MIN_SHIFT_TICKS 256 /* minimum error of a timestamp after an error without a receiver reset */

/* Kinds of damage, chosen at random. */
enum { BAD_HEADER, BAD_CODE, BAD_CHECK, NO_SFD, DAMAGES };
/* Purposes of the random numbers of a frame. */
enum { FOR_LOSS = 1, FOR_DAMAGE, FOR_KIND, FOR_COLLISION, FOR_EDGE };

/* Random bits of a frame at a receiver; they do not depend on the order of calls. */
static uint64_t frame_random(const dw1000_chip *chip, const transmission *frame, unsigned what) {
    const uint64_t pair = (uint64_t)frame->sender->index << 32 | (uint64_t)chip->index;
    return dw1000_random_bits(dw1000_random_bits(chip->air->seed, pair), frame->serial << 3 | what);
}

static instant arrival(const dw1000_chip *chip, instant sent) {
    return sent + chip->pair->flight;
}

static void release_frame(dw1000_chip *chip) {
    dw1000_cancel(chip, GROUP_FRAME);
    if (chip->frame != NULL) {
        chip->frame->receivers--;
        dw1000_release_pair(chip->pair);
    }
    chip->pair = NULL;
    chip->frame = NULL;
    chip->collided = false;
}

void dw1000_stop_receiver(dw1000_chip *chip) {
    dw1000_cancel(chip, GROUP_RX);
    release_frame(chip);
    chip->rx = RX_OFF;
}

static void reception_failed(dw1000_chip *chip, uint64_t bit) {
    chip->needs_rx_reset = chip->needs_rx_reset || (bit & (ST_RXPHE | ST_RXRFSL | ST_RXRFTO | ST_RXFCE));
    dw1000_raise_status(chip, bit);
    dw1000_stop_receiver(chip);
}

static void frame_wait_timeout(dw1000_chip *chip, transmission *unused) {
    (void)unused;
    reception_failed(chip, ST_RXRFTO);
}

static void sfd_timeout(dw1000_chip *chip, transmission *unused) {
    (void)unused;
    if (chip->rx == RX_PREAMBLE) {
        reception_failed(chip, ST_RXSFDTO);
    }
}

static bool has_damage(const dw1000_chip *chip, unsigned kind) {
    const transmission *const frame = chip->frame;
    if (dw1000_uniform(frame_random(chip, frame, FOR_DAMAGE)) >= chip->pair->damage) {
        return false;
    }
    return frame_random(chip, frame, FOR_KIND) % DAMAGES == kind;
}

static bool was_aborted(const dw1000_chip *chip) {
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

static unsigned accumulated_symbols(const dw1000_chip *chip) {
    const unsigned given = chip->pair->preamble_count, all = chip->symbols;
    const unsigned count = given != 0 ? given : all;
    return count > 0xFFF ? 0xFFF : count;
}

static void report_header(dw1000_chip *chip) {
    const transmission *const frame = chip->frame;
    const unsigned psr = frame->preamble_code & 3, extension = frame->preamble_code >> 2;
    const uint32_t info = (uint32_t)frame->length | extension << 11 | frame->rate << 13 |
                          (uint32_t)frame->ranging << 15 | frame->mode.prf << 16 | psr << 18 |
                          accumulated_symbols(chip) << 20;
    dw1000_put(chip, RX_FINFO, 0, 4, info);
}

/* RX_TIME: the chip's counter when the marker was received, minus the antenna delay that the driver has set. */
static void report_time(dw1000_chip *chip, bool timed) {
    dw1000_air *const air = chip->air;
    const radio_pair *const pair = chip->pair;
    const uint64_t random = dw1000_random_bits(air->seed ^ (uint64_t)chip->index << 32, chip->receptions++);
    const instant at = chip->frame->marker + pair->flight + pair->excess;
    const uint64_t units = dw1000_counter_units(chip, at) + (uint64_t)chip->rx_delay * UNITS_PER_TICK;
    uint64_t raw = (units + UNITS_PER_TICK / 2) / UNITS_PER_TICK;
    if (!timed) {
        raw = random;
    } else if (chip->needs_rx_reset) {
        const uint64_t shift = MIN_SHIFT_TICKS + random % (3 * MIN_SHIFT_TICKS);
        raw = random >> 63 ? raw + shift : raw - shift;
    }
    dw1000_put(chip, RX_TIME, 0, 5, (raw - dw1000_get(chip, LDE_IF, LDE_RXANTD, 2)) & COUNTER_MASK);
    dw1000_put(chip, RX_TIME, RX_RAWST, 5, raw & COUNTER_MASK & ~(uint64_t)(COUNTER_GRID - 1));
}

static void report_channel(dw1000_chip *chip) {
    const radio_pair *const pair = chip->pair;
    const unsigned multiple = (unsigned)dw1000_get(chip, LDE_IF, LDE_CFG1, 1) & 31;
    const unsigned product = multiple * pair->std_noise;
    const unsigned computed = product > 0xFFFF ? 0xFFFF : product;
    const unsigned threshold = pair->threshold != 0 ? pair->threshold : computed;
    unsigned all = chip->symbols;
    if (pair->preamble_count != 0 && all <= pair->preamble_count) {
        all = pair->preamble_count + 1u; /* the accumulation stopped at the given number */
    }
    dw1000_put(chip, RX_FQUAL, 0, 2, pair->std_noise);
    dw1000_put(chip, RX_FQUAL, 2, 2, pair->fp_ampl[1]);
    dw1000_put(chip, RX_FQUAL, 4, 2, pair->fp_ampl[2]);
    dw1000_put(chip, RX_FQUAL, 6, 2, pair->cir_pwr);
    dw1000_put(chip, RX_TIME, FP_INDEX, 2, pair->fp_index);
    dw1000_put(chip, RX_TIME, FP_AMPL1, 2, pair->fp_ampl[0]);
    dw1000_put(chip, LDE_IF, LDE_THRESH, 2, threshold);
    dw1000_put(chip, DRX_CONF, RXPACC_NOSAT, 2, all);
    const size_t samples = chip->frame->mode.prf == 2 ? ACCUMULATOR_SAMPLES : SAMPLES_AT_16MHZ;
    memcpy(chip->accumulator, pair->iq, samples * 2 * sizeof *pair->iq);
}

static void report_frame(dw1000_chip *chip, const uint8_t *octets, bool timed) {
    report_header(chip);
    report_time(chip, timed);
    report_channel(chip);
    memcpy(chip->rx_buffer, octets, chip->frame->length);
}

static void frame_end(dw1000_chip *chip, transmission *frame) {
    if (was_aborted(chip) || chip->collided || has_damage(chip, BAD_CODE)) {
        reception_failed(chip, ST_RXRFSL);
        return;
    }
    uint8_t octets[FRAME_OCTETS];
    memcpy(octets, frame->payload, sizeof octets);
    if (has_damage(chip, BAD_CHECK)) {
        const uint64_t where = frame_random(chip, frame, FOR_COLLISION);
        octets[where % (frame->length ? frame->length : 1)] ^= (uint8_t)(1u << (where >> 32 & 7));
    }
    const bool detector = chip->lde_loaded && (dw1000_get(chip, PMSC, PMSC_CTRL1, 4) & (1u << 17));
    const bool timed = detector && dw1000_uniform(frame_random(chip, frame, FOR_EDGE)) >= chip->edge_loss;
    report_frame(chip, octets, timed);
    const size_t length = frame->length;
    const bool good = length >= 2 && dw1000_frame_check(octets, length - 2) ==
                                         (uint16_t)(octets[length - 2] | octets[length - 1] << 8);
    const uint64_t without_edge = detector ? ST_LDEERR : 0;
    const uint64_t done = timed ? ST_LDEDONE : without_edge;
    chip->needs_rx_reset = chip->needs_rx_reset || done == ST_LDEERR;
    dw1000_raise_status(chip, ST_RXDFR | done | (good ? ST_RXFCG : 0));
    if (good) {
        dw1000_stop_receiver(chip);
    } else {
        reception_failed(chip, ST_RXFCE);
    }
}

static void header_end(dw1000_chip *chip, transmission *frame) {
    const bool other_mode = frame->phr_mode != dw1000_get(chip, SYS_CFG, 2, 1) % 4;
    if (was_aborted(chip) || chip->collided || other_mode || has_damage(chip, BAD_HEADER)) {
        reception_failed(chip, ST_RXPHE);
        return;
    }
    chip->rx = RX_DATA;
    report_header(chip);
    dw1000_raise_status(chip, ST_RXPHD);
    dw1000_schedule(chip, GROUP_FRAME, arrival(chip, frame->end), frame_end, frame);
}

static void sfd_end(dw1000_chip *chip, transmission *frame) {
    const air_interface mode = dw1000_receive_mode(chip);
    const bool same = frame->mode.slow == mode.slow && frame->mode.decawave_sfd == mode.decawave_sfd &&
                      frame->mode.sfd_symbols == mode.sfd_symbols;
    const bool sfd_lost = chip->collided && (frame_random(chip, frame, FOR_COLLISION) & 1);
    if (!same || was_aborted(chip) || sfd_lost || has_damage(chip, NO_SFD)) {
        return; /* the wait for an SFD continues */
    }
    dw1000_cancel(chip, GROUP_FRAME);
    chip->rx = RX_HEADER;
    dw1000_raise_status(chip, ST_RXSFDD);
    const instant header = frame->data - frame->marker;
    dw1000_schedule(chip, GROUP_FRAME, arrival(chip, frame->marker + header), header_end, frame);
}

static void preamble_detected(dw1000_chip *chip, transmission *frame) {
    radio_pair *const pair = chip->pairs[frame->sender->index];
    if (chip->rx != RX_SEARCH || pair == NULL || frame->aborted < chip->air->now) {
        return;
    }
    pair->users++;
    frame->receivers++;
    chip->pair = pair;
    chip->frame = frame;
    chip->rx = RX_PREAMBLE;
    chip->collided = false;
    chip->symbols = (unsigned)((arrival(chip, frame->marker) - chip->air->now) / frame->symbol);
    dw1000_raise_status(chip, ST_RXPRD);
    for (transmission *other = chip->air->frames_on_air; other != NULL; other = other->next) {
        dw1000_check_collision(chip, other);
    }
    const unsigned timeout_symbols = (unsigned)dw1000_get(chip, DRX_CONF, DRX_SFDTOC, 2);
    dw1000_schedule(chip, GROUP_FRAME, arrival(chip, frame->marker), sfd_end, frame);
    if (timeout_symbols != 0) {
        dw1000_schedule(chip, GROUP_FRAME, chip->air->now + (instant)timeout_symbols * frame->symbol, sfd_timeout, frame);
    }
}

void dw1000_try_detect(dw1000_chip *chip, transmission *frame) {
    const radio_pair *const pair = chip->pairs[frame->sender->index];
    const air_interface mode = dw1000_receive_mode(chip);
    if (chip->rx != RX_SEARCH || pair == NULL || frame->aborted != INT64_MAX || !mode.tuned || !frame->mode.tuned ||
        mode.channel != frame->mode.channel || mode.prf != frame->mode.prf || mode.code != frame->mode.code) {
        return;
    }
    const instant arrival_time = frame->start + pair->flight;
    const unsigned chunk = 8u << (((unsigned)dw1000_get(chip, DRX_CONF, DRX_TUNE2, 4) >> 25) & 3u);
    const instant at = (arrival_time > chip->air->now ? arrival_time : chip->air->now) + (instant)(DETECTION_CHUNKS * chunk) * frame->symbol;
    if (at > frame->sfd + pair->flight || dw1000_uniform(frame_random(chip, frame, FOR_LOSS)) < pair->loss) {
        return;
    }
    dw1000_schedule(chip, GROUP_RX, at, preamble_detected, frame);
}

void dw1000_check_collision(dw1000_chip *chip, const transmission *frame) {
    const radio_pair *const pair = chip->pairs[frame->sender->index];
    if (chip->frame == NULL || frame == chip->frame || pair == NULL || frame->mode.channel != chip->frame->mode.channel ||
        frame->mode.prf != chip->frame->mode.prf || frame->mode.code != chip->frame->mode.code) {
        return;
    }
    const instant stops = frame->aborted < frame->end ? frame->aborted : frame->end;
    const bool overlaps = stops + pair->flight > chip->air->now &&
                          frame->start + pair->flight < arrival(chip, chip->frame->end);
    chip->collided = chip->collided || (overlaps && chip->pair->level < CAPTURE_RATIO * pair->level);
}

/* Search for preambles, including those that have already begun. */
static void start_search(dw1000_chip *chip, transmission *unused) {
    (void)unused;
    chip->rx = RX_SEARCH;
    for (transmission *frame = chip->air->frames_on_air; frame != NULL; frame = frame->next) {
        dw1000_try_detect(chip, frame);
    }
}

static void turn_receiver_on(dw1000_chip *chip, transmission *unused) {
    (void)unused;
    memset(chip->accumulator, 0, sizeof chip->accumulator);
    chip->rx = RX_WARMUP;
    dw1000_schedule(chip, GROUP_RX, chip->air->now + MICROSECONDS(WARM_UP_US), start_search, NULL);
    if (dw1000_get(chip, SYS_CFG, 0, 4) & CFG_RXWTOE) { /* the timeout begins at the enable, not at the end of the warm-up */
        const instant wait = (instant)dw1000_get(chip, RX_FWTO, 0, 2) * TIMEOUT_TICKS * UNITS_PER_TICK;
        dw1000_schedule(chip, GROUP_RX, chip->air->now + wait, frame_wait_timeout, NULL);
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
        dw1000_schedule(chip, GROUP_RX, at, turn_receiver_on, NULL);
    } else {
        turn_receiver_on(chip, NULL);
    }
}

/* An event that occurs while the host turns the receiver off is still latched. */
static void latch_error(dw1000_chip *chip, transmission *unused) {
    (void)unused;
    dw1000_raise_status(chip, ST_RXPHE);
}

void dw1000_schedule_late_event(dw1000_chip *chip) {
    if (chip->rx >= RX_PREAMBLE) {
        dw1000_schedule(chip, GROUP_LATE, chip->air->now + MICROSECONDS(LATE_EVENT_US), latch_error, NULL);
    }
}
