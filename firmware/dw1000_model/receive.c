/* The receiver: when it is on, what it notices, and how a reception ends. reception.c fills the registers. */
#include <string.h>

#include "model.h"

#define WARM_UP_US 16.0
#define DETECTION_CHUNKS 2 /* of preamble acquisition, before a preamble is noticed */
#define PHR_SYMBOLS 21
#define GLITCH_US 0.5
#define SNIFF_UNIT_US 1.0256
#define CAPTURE 4.0 /* 6 dB: by how much a frame must be stronger to survive another one */
#define TIMEOUT_TICKS 65536 /* RX_FWTO's unit */
enum { ARXSLP = 12 };

/* Kinds of damage, by dice. */
enum { BAD_HEADER, BAD_CODE, BAD_CHECK, NO_SFD, DAMAGES };
/* What a frame's dice are thrown for. */
enum { FOR_LOSS = 1, FOR_DAMAGE, FOR_KIND, FOR_CLASH, FOR_EDGE };

static uint32_t configuration(const dw1000_chip *chip) {
    return (uint32_t)dw1000_get(chip, SYS_CFG, 0, 4);
}

bool dw1000_doubly_buffered(const dw1000_chip *chip) {
    return (configuration(chip) & CFG_DIS_DRXB) == 0;
}

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

static void search(dw1000_chip *chip);

/* The receiver ends, or begins anew by itself. */
static void ended(dw1000_chip *chip, bool again) {
    dw1000_stop_receiver(chip);
    if (again) {
        dw1000_enable_receiver(chip, chip->air->now, true);
    } else {
        dw1000_sleep_after(chip, ARXSLP);
    }
}

static void failed(dw1000_chip *chip, uint64_t bit, counter which) {
    const bool again = (configuration(chip) & CFG_RXAUTR) && bit != ST_RXRFTO;
    chip->stale = chip->stale || (bit & (ST_RXPHE | ST_RXRFSL | ST_RXRFTO | ST_RXFCE | ST_RXOVRR));
    dw1000_raise_status(chip, bit);
    dw1000_count_event(chip, which);
    ended(chip, again);
}

static void frame_wait_over(dw1000_chip *chip, transmission *none) {
    (void)none;
    failed(chip, ST_RXRFTO, COUNT_FWTO);
}

static void preamble_wait_over(dw1000_chip *chip, transmission *none) {
    (void)none;
    if (chip->rx == RX_SEARCH) {
        failed(chip, ST_RXPTO, COUNT_PTO);
    }
}

static void sfd_wait_over(dw1000_chip *chip, transmission *none) {
    (void)none;
    if (chip->rx == RX_PREAMBLE) {
        failed(chip, ST_RXSFDTO, COUNT_STO);
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

static void frame_over(dw1000_chip *chip, transmission *frame) {
    const uint32_t setting = configuration(chip);
    if (cut_off(chip) || chip->clashed || damaged(chip, BAD_CODE)) {
        if (!(setting & CFG_DIS_RSDE)) {
            failed(chip, ST_RXRFSL, COUNT_RSE);
            return;
        }
    }
    uint8_t octets[FRAME_OCTETS];
    memcpy(octets, frame->payload, sizeof octets);
    if (damaged(chip, BAD_CHECK) || damaged(chip, BAD_CODE) || chip->clashed || cut_off(chip)) {
        const uint64_t where = fate(chip, frame, FOR_CLASH);
        octets[where % (frame->length ? frame->length : 1)] ^= (uint8_t)(1u << (where >> 32 & 7));
    }
    const bool detector = chip->lde_loaded && (dw1000_get(chip, PMSC, PMSC_CTRL1, 4) & (1u << 17));
    const bool timed = detector && dw1000_chance(fate(chip, frame, FOR_EDGE)) >= chip->edges_lost;
    dw1000_report_frame(chip, octets, timed);
    const bool ones = (setting & CFG_FCS_INIT2F) != 0;
    const size_t length = frame->length;
    const bool good = length >= 2 && dw1000_frame_check(octets, length - 2, ones ? 0xFFFF : 0) ==
                                         (uint16_t)(octets[length - 2] | octets[length - 1] << 8);
    const uint64_t done = timed ? ST_LDEDONE : detector ? ST_LDEERR : 0;
    chip->stale = chip->stale || done == ST_LDEERR;
    if (!good) {
        dw1000_raise_status(chip, ST_RXDFR | done);
        failed(chip, ST_RXFCE, COUNT_FCE);
        return;
    }
    dw1000_count_event(chip, COUNT_FCG);
    if ((setting & CFG_FFEN) && !dw1000_accepted(chip, octets, length - 2)) {
        /* The receiver and its time-out just continue (manual 2.12, p. 79). */
        dw1000_raise_status(chip, ST_AFFREJ);
        dw1000_count_event(chip, COUNT_FFR);
        memset(chip->accumulator, 0, sizeof chip->accumulator);
        let_go(chip);
        search(chip);
        return;
    }
    const bool asks = length > 4 && (octets[0] & 0x20) && ((octets[0] & 7) == 1 || (octets[0] & 7) == 3);
    dw1000_raise_status(chip, ST_RXDFR | ST_RXFCG | done | (asks ? ST_AAT : 0));
    const bool buffers = dw1000_doubly_buffered(chip);
    if (buffers) {
        chip->set[chip->chip_side].full = true;
        chip->chip_side ^= 1u;
        dw1000_update_line(chip);
    }
    if (asks && (setting & CFG_AUTOACK) && (setting & CFG_FFEN)) {
        dw1000_stop_receiver(chip);
        dw1000_start_acknowledgement(chip, octets[2]);
        return;
    }
    ended(chip, buffers && (setting & CFG_RXAUTR));
}

static void header_over(dw1000_chip *chip, transmission *frame) {
    const bool other_mode = frame->phr_mode != (configuration(chip) & CFG_PHR_MODE) >> 16;
    const bool bad = cut_off(chip) || chip->clashed || other_mode || damaged(chip, BAD_HEADER);
    if (bad && !(configuration(chip) & CFG_DIS_PHE)) {
        failed(chip, ST_RXPHE, COUNT_PHE);
        return;
    }
    if (dw1000_doubly_buffered(chip) && chip->set[chip->chip_side].full) {
        /* Both buffers are taken: what is known of the frame that the host has not read yet is spoilt. */
        dw1000_report_overrun(chip);
        failed(chip, ST_RXOVRR, COUNT_OVR);
        return;
    }
    chip->rx = RX_DATA;
    dw1000_report_header(chip);
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

/* When a preamble that is heard from `from` on is noticed, which takes `needed`: at once, or in sniff mode within one of
 * the times that the receiver is on (RX_SNIFF: chunks, and one more; about microseconds off). */
static instant noticed_at(const dw1000_chip *chip, instant from, instant needed, instant symbol) {
    const uint32_t sniff = (uint32_t)dw1000_get(chip, RX_SNIFF, 0, 4);
    const unsigned chunks = sniff & 15, units = sniff >> 8 & 0xFF;
    if (chunks == 0 || units == 0) {
        return from + needed;
    }
    const instant on = (instant)((chunks + 1) * dw1000_acquisition_chunk(chip)) * symbol;
    const instant turn = on + MICROSECONDS(units * SNIFF_UNIT_US), into = (from - chip->searching) % turn;
    return into + needed <= on ? from + needed : from - into + turn + needed;
}

void dw1000_consider(dw1000_chip *chip, transmission *frame) {
    const link *const path = chip->links[frame->sender->index];
    const air_interface mode = dw1000_receive_mode(chip);
    if (chip->rx != RX_SEARCH || path == NULL || frame->aborted != INT64_MAX || !mode.tuned || !frame->mode.tuned ||
        mode.channel != frame->mode.channel || mode.prf != frame->mode.prf || mode.code != frame->mode.code) {
        return;
    }
    const instant heard = frame->start + path->flight;
    const instant needed = (instant)(DETECTION_CHUNKS * dw1000_acquisition_chunk(chip)) * frame->symbol;
    const instant at = noticed_at(chip, heard > chip->air->now ? heard : chip->air->now, needed, frame->symbol);
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

/* Search for preambles: those that are on the air already, too. */
static void search(dw1000_chip *chip) {
    chip->rx = RX_SEARCH;
    chip->searching = chip->air->now;
    for (transmission *frame = chip->air->flying; frame != NULL; frame = frame->next) {
        dw1000_consider(chip, frame);
    }
}

static void listen(dw1000_chip *chip, transmission *none) {
    (void)none;
    const unsigned chunks = (unsigned)dw1000_get(chip, DRX_CONF, DRX_PRETOC, 2);
    if (chunks != 0) {
        const instant symbol = dw1000_symbol_units(dw1000_receive_mode(chip).prf);
        const instant wait = (instant)(chunks + 1) * (instant)dw1000_acquisition_chunk(chip) * symbol;
        dw1000_schedule(chip, GROUP_RX, chip->air->now + wait, preamble_wait_over, NULL);
    }
    search(chip);
}

static void turn_on(dw1000_chip *chip, transmission *none) {
    (void)none;
    const uint32_t setting = configuration(chip);
    memset(chip->accumulator, 0, sizeof chip->accumulator);
    chip->rx = RX_WARMUP;
    dw1000_schedule(chip, GROUP_RX, chip->air->now + MICROSECONDS(WARM_UP_US), listen, NULL);
    if (setting & CFG_RXWTOE) { /* it counts from the enable on, not from the end of the warm-up */
        const instant wait = (instant)dw1000_get(chip, RX_FWTO, 0, 2) * TIMEOUT_TICKS * UNITS_PER_TICK;
        dw1000_schedule(chip, GROUP_RX, chip->air->now + wait, frame_wait_over, NULL);
    }
}

void dw1000_enable_receiver(dw1000_chip *chip, instant at, bool by_itself) {
    if (chip->rx_in_reset) {
        return;
    }
    dw1000_stop_receiver(chip);
    if (!by_itself) {
        chip->status &= ~(ST_RX | ST_AAT | ST_RXOVRR | ST_HPDWARN);
        chip->set[chip->chip_side].status = 0;
        if (!dw1000_doubly_buffered(chip)) {
            chip->set[0].status = chip->set[1].status = 0;
        }
        dw1000_update_line(chip);
    }
    chip->rx = RX_WAIT;
    if (at > chip->air->now) {
        dw1000_schedule(chip, GROUP_RX, at, turn_on, NULL);
    } else {
        turn_on(chip, NULL);
    }
}

void dw1000_delay_receiver(dw1000_chip *chip) {
    const uint64_t now = dw1000_local_units(chip, chip->air->now) / UNITS_PER_TICK;
    const uint64_t wanted = dw1000_get(chip, DX_TIME, 0, 5) & ~(uint64_t)(COUNTER_GRID - 1);
    const uint64_t lead = (wanted - now) & COUNTER_MASK;
    dw1000_enable_receiver(chip, dw1000_air_time(chip, (now + lead) * UNITS_PER_TICK), false);
    if (lead > COUNTER_MASK / 2) {
        dw1000_raise_status(chip, ST_HPDWARN);
        dw1000_count_event(chip, COUNT_HPW);
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
