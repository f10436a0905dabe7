#include <string.h>

#include "uwb_twr.h"

/* IEEE 802.15.4: a data frame, both ends in one PAN, addresses of 64 bits; a broadcast's destination has 16. */
static const uint8_t CONTROL[2][2] = {{0x41, 0xCC}, {0x41, 0xC8}};
static const uint16_t BROADCAST = 0xFFFF;
/* First octet of the payload, so that other data frames on the air are ignored. */
static const uint8_t MARK = 0x75;

#define KNOWN_BYTES sizeof(((uwb_twr_frame *)0)->known)

/* Addresses, mark, kind, and for a DISCOVER the tag's number, time and `known`. All other frames have both numbers and room
 * for three stamps: they have equal lengths, so that the length is written to the chip only once. */
#define DISCOVER_BYTES (15u + 2u + 4u + 4u + KNOWN_BYTES)
#define EXCHANGE_BYTES (21u + 2u + 4u + 4u + 5u * UWB_TWR_STAMPS)

static uint32_t known_bit(const uwb_twr_frame *seek, uint64_t address) {
    return (uint32_t)((address ^ seek->tag_number) * 0x9E3779B97F4A7C15u >> 56);
}

void uwb_twr_mark_known(uwb_twr_frame *seek, uint64_t address) {
    const uint32_t bit = known_bit(seek, address);
    seek->known[bit / 8] |= (uint8_t)(1u << bit % 8);
}

int uwb_twr_is_known(const uwb_twr_frame *seek, uint64_t address) {
    const uint32_t bit = known_bit(seek, address);
    return seek->known[bit / 8] >> bit % 8 & 1;
}

static size_t put(uint8_t *octets, size_t at, uint64_t value, size_t bytes) {
    for (size_t i = 0; i < bytes; i++) {
        octets[at + i] = (uint8_t)(value >> 8 * i);
    }
    return at + bytes;
}

static uint64_t take(const uint8_t *octets, size_t *at, size_t bytes) {
    uint64_t value = 0;
    for (size_t i = 0; i < bytes; i++) {
        value |= (uint64_t)octets[*at + i] << 8 * i;
    }
    *at += bytes;
    return value;
}

static int has_stamps(uwb_twr_kind kind) {
    return kind == UWB_TWR_FINAL || kind == UWB_TWR_REPORT;
}

size_t uwb_twr_write(const uwb_twr_frame *frame, uint8_t *octets) {
    const int broadcast = frame->kind == UWB_TWR_DISCOVER;
    octets[0] = CONTROL[broadcast][0];
    octets[1] = CONTROL[broadcast][1];
    octets[2] = frame->sequence;
    size_t at = put(octets, 3, frame->pan, 2);
    at = broadcast ? put(octets, at, BROADCAST, 2) : put(octets, at, frame->to, 8);
    at = put(octets, at, frame->from, 8);
    octets[at++] = MARK;
    octets[at++] = (uint8_t)frame->kind;
    at = put(octets, at, frame->tag_number, 4);
    if (broadcast) {
        at = put(octets, at, frame->time_us, 4);
        memcpy(octets + at, frame->known, KNOWN_BYTES);
        return at + KNOWN_BYTES;
    }
    at = put(octets, at, frame->anchor_number, 4);
    for (int i = 0; i < UWB_TWR_STAMPS; i++) {
        at = put(octets, at, has_stamps(frame->kind) ? frame->stamps[i] : i == 0 ? frame->time_us : 0, 5);
    }
    return at;
}

int uwb_twr_read(const uint8_t *octets, size_t bytes, uwb_twr_frame *frame) {
    if (bytes < 2 || octets[0] != CONTROL[0][0]) {
        return 0;
    }
    const int broadcast = octets[1] == CONTROL[1][1];
    if ((!broadcast && octets[1] != CONTROL[0][1]) || bytes != (broadcast ? DISCOVER_BYTES : EXCHANGE_BYTES)) {
        return 0;
    }
    size_t at = 2;
    frame->sequence = (uint8_t)take(octets, &at, 1);
    frame->pan = (uint16_t)take(octets, &at, 2);
    frame->to = take(octets, &at, broadcast ? 2 : 8);
    frame->from = take(octets, &at, 8);
    const uint64_t mark = take(octets, &at, 1), kind = take(octets, &at, 1);
    if (mark != MARK || kind < UWB_TWR_DISCOVER || kind > UWB_TWR_REPORT || (kind == UWB_TWR_DISCOVER) != broadcast ||
        (broadcast && frame->to != BROADCAST)) {
        return 0;
    }
    frame->kind = (uwb_twr_kind)kind;
    frame->to = broadcast ? UWB_TWR_BROADCAST : frame->to;
    frame->tag_number = (uint32_t)take(octets, &at, 4);
    if (broadcast) {
        frame->anchor_number = 0;
        frame->time_us = (uint32_t)take(octets, &at, 4);
        memcpy(frame->known, octets + at, KNOWN_BYTES);
    } else {
        frame->anchor_number = (uint32_t)take(octets, &at, 4);
        for (int i = 0; i < UWB_TWR_STAMPS; i++) {
            frame->stamps[i] = take(octets, &at, 5);
        }
        frame->time_us = (uint32_t)frame->stamps[0];
    }
    return frame->sequence == (uint8_t)frame->tag_number && frame->from != UWB_TWR_BROADCAST;
}

static const double METRES_PER_TICK = 299792458.0 / (128 * 499.2e6);

/* Beyond these no exchange of ours goes: a second for each reply, and what clocks 60 ppm apart gain in it or a wave
 * travels in 2000 m. They keep all products below within 63 bits. */
static const uint64_t LONGEST = (uint64_t)1 << 36;
static const int64_t MOST_FLIGHT = (int64_t)1 << 23;

static uint64_t since(uint64_t later, uint64_t earlier) {
    return (later - earlier) & UWB_DW1000_TICK_MASK;
}

/* Time of flight = (R1 R2 - P1 P2) / (R1 + R2 + P1 + P2), with rounds R and replies P. A round is its reply and
 * something small, R = P + f, so that the numerator is f1 P2 + f2 P1 + f1 f2: exact in integers of 64 bits. */
int uwb_twr_range_m(const uint64_t tag[UWB_TWR_STAMPS], const uint64_t anchor[UWB_TWR_STAMPS], double *range_m) {
    const uint64_t round_1 = since(tag[1], tag[0]), reply_1 = since(anchor[1], anchor[0]);
    const uint64_t round_2 = since(anchor[2], anchor[1]), reply_2 = since(tag[2], tag[1]);
    if (round_1 > LONGEST || round_2 > LONGEST || reply_1 > LONGEST || reply_2 > LONGEST || reply_1 == 0 ||
        reply_2 == 0) {
        return 0;
    }
    const int64_t flight_1 = (int64_t)round_1 - (int64_t)reply_1, flight_2 = (int64_t)round_2 - (int64_t)reply_2;
    if (flight_1 > MOST_FLIGHT || flight_1 < -MOST_FLIGHT || flight_2 > MOST_FLIGHT || flight_2 < -MOST_FLIGHT) {
        return 0;
    }
    const int64_t product =
        flight_1 * (int64_t)reply_2 + flight_2 * (int64_t)reply_1 + flight_1 * flight_2;
    const int64_t sum = (int64_t)(round_1 + round_2 + reply_1 + reply_2);
    *range_m = (double)product / (double)sum * METRES_PER_TICK;
    return *range_m > -10 && *range_m < 2000;
}
