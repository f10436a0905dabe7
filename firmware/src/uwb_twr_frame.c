#include <string.h>

#include "uwb_twr.h"

/* Frame control of IEEE 802.15.4: data frame, PAN id compression, 64-bit addresses; the broadcast address has 16 bits. */
static const uint8_t CONTROL[2][2] = {{0x41, 0xCC}, {0x41, 0xC8}};
static const uint16_t BROADCAST_SHORT = 0xFFFF;
/* First octet of the payload, to ignore data frames of other protocols. */
static const uint8_t PAYLOAD_MARK = 0x75;

#define KNOWN_BYTES sizeof(((uwb_twr_frame *)0)->known)

/* Addresses, mark, type, and for a DISCOVER the tag's number, time and `known`. All other frames have both numbers and
 * three timestamps: their lengths are equal, so that the length is written to the chip only once. */
#define DISCOVER_BYTES (15u + 2u + 4u + 4u + KNOWN_BYTES)
#define EXCHANGE_BYTES (21u + 2u + 4u + 4u + 5u * UWB_TWR_STAMPS)

/* Return the bit of an address in the Bloom filter. */
static uint32_t known_bit(const uwb_twr_frame *discover, uint64_t address) {
    return (uint32_t)((address ^ discover->tag_number) * 0x9E3779B97F4A7C15u >> 56);
}

/* Set the bit of an address. */
void uwb_twr_mark_known(uwb_twr_frame *discover, uint64_t address) {
    const uint32_t bit = known_bit(discover, address);
    discover->known[bit / 8] |= (uint8_t)(1u << bit % 8);
}

/* Return the bit of an address. */
int uwb_twr_is_known(const uwb_twr_frame *discover, uint64_t address) {
    const uint32_t bit = known_bit(discover, address);
    return discover->known[bit / 8] >> bit % 8 & 1;
}

/* Write a little-endian number; returns the position after it. */
static size_t write_le(uint8_t *octets, size_t at, uint64_t value, size_t bytes) {
    for (size_t i = 0; i < bytes; i++) {
        octets[at + i] = (uint8_t)(value >> 8 * i);
    }
    return at + bytes;
}

/* Read a little-endian number, and advance the position. */
static uint64_t read_le(const uint8_t *octets, size_t *at, size_t bytes) {
    uint64_t value = 0;
    for (size_t i = 0; i < bytes; i++) {
        value |= (uint64_t)octets[*at + i] << 8 * i;
    }
    *at += bytes;
    return value;
}

/* Return whether a type of frame has timestamps. */
static int has_stamps(uwb_twr_frame_type kind) {
    return kind == UWB_TWR_FINAL || kind == UWB_TWR_REPORT;
}

/* Write header, payload mark, type, numbers, and timestamps or times. */
size_t uwb_twr_write(const uwb_twr_frame *frame, uint8_t *octets) {
    const int broadcast = frame->kind == UWB_TWR_DISCOVER;
    octets[0] = CONTROL[broadcast][0];
    octets[1] = CONTROL[broadcast][1];
    octets[2] = frame->sequence;
    size_t at = write_le(octets, 3, frame->pan, 2);
    at = broadcast ? write_le(octets, at, BROADCAST_SHORT, 2) : write_le(octets, at, frame->to, 8);
    at = write_le(octets, at, frame->from, 8);
    octets[at++] = PAYLOAD_MARK;
    octets[at++] = (uint8_t)frame->kind;
    at = write_le(octets, at, frame->tag_number, 4);
    if (broadcast) {
        at = write_le(octets, at, frame->time_us, 4);
        memcpy(octets + at, frame->known, KNOWN_BYTES);
        return at + KNOWN_BYTES;
    }
    at = write_le(octets, at, frame->anchor_number, 4);
    for (int i = 0; i < UWB_TWR_STAMPS; i++) {
        const uint64_t time_us = i == 0 ? frame->time_us : 0;
        at = write_le(octets, at, has_stamps(frame->kind) ? frame->stamps[i] : time_us, 5);
    }
    return at;
}

/* Read a frame of the length and type that uwb_twr_write writes; refuse others. */
int uwb_twr_read(const uint8_t *octets, size_t bytes, uwb_twr_frame *frame) {
    if (bytes < 2 || octets[0] != CONTROL[0][0]) {
        return 0;
    }
    const int broadcast = octets[1] == CONTROL[1][1];
    if ((!broadcast && octets[1] != CONTROL[0][1]) || bytes != (broadcast ? DISCOVER_BYTES : EXCHANGE_BYTES)) {
        return 0;
    }
    size_t at = 2;
    frame->sequence = (uint8_t)read_le(octets, &at, 1);
    frame->pan = (uint16_t)read_le(octets, &at, 2);
    frame->to = read_le(octets, &at, broadcast ? 2 : 8);
    frame->from = read_le(octets, &at, 8);
    const uint64_t mark = read_le(octets, &at, 1), kind = read_le(octets, &at, 1);
    if (mark != PAYLOAD_MARK || kind < UWB_TWR_DISCOVER || kind > UWB_TWR_REPORT ||
        (kind == UWB_TWR_DISCOVER) != broadcast ||
        (broadcast && frame->to != BROADCAST_SHORT)) {
        return 0;
    }
    frame->kind = (uwb_twr_frame_type)kind;
    frame->to = broadcast ? UWB_TWR_BROADCAST : frame->to;
    frame->tag_number = (uint32_t)read_le(octets, &at, 4);
    if (broadcast) {
        frame->anchor_number = 0;
        frame->time_us = (uint32_t)read_le(octets, &at, 4);
        memcpy(frame->known, octets + at, KNOWN_BYTES);
    } else {
        frame->anchor_number = (uint32_t)read_le(octets, &at, 4);
        for (int i = 0; i < UWB_TWR_STAMPS; i++) {
            frame->stamps[i] = read_le(octets, &at, 5);
        }
        frame->time_us = (uint32_t)frame->stamps[0];
    }
    return frame->sequence == (uint8_t)frame->tag_number && frame->from != UWB_TWR_BROADCAST;
}

static const double METRES_PER_TICK = 299792458.0 / (128 * 499.2e6);

/* Limits of a plausible exchange: 1 s per reply, and the clock error of 60 ppm in that time or a distance of 2000 m.
 * With them, all products below fit into 63 bits. */
static const uint64_t MAX_INTERVAL_TICKS = (uint64_t)1 << 36;
static const int64_t MAX_FLIGHT_TICKS = (int64_t)1 << 23;

/* Return the ticks between two timestamps, modulo 2^40. */
static uint64_t ticks_between(uint64_t later, uint64_t earlier) {
    return (later - earlier) & UWB_DW1000_TICK_MASK;
}

/* Time of flight = (R1 R2 - P1 P2) / (R1 + R2 + P1 + P2), with round-trip times R and reply times P. With
 * R = P + f and a small f, the numerator is f1 P2 + f2 P1 + f1 f2, which is exact in 64-bit integers. */
int uwb_twr_range_m(const uint64_t tag[UWB_TWR_STAMPS], const uint64_t anchor[UWB_TWR_STAMPS], double *range_m) {
    const uint64_t round_1 = ticks_between(tag[1], tag[0]), reply_1 = ticks_between(anchor[1], anchor[0]);
    const uint64_t round_2 = ticks_between(anchor[2], anchor[1]), reply_2 = ticks_between(tag[2], tag[1]);
    if (round_1 > MAX_INTERVAL_TICKS || round_2 > MAX_INTERVAL_TICKS || reply_1 > MAX_INTERVAL_TICKS ||
        reply_2 > MAX_INTERVAL_TICKS || reply_1 == 0 ||
        reply_2 == 0) {
        return 0;
    }
    const int64_t flight_1 = (int64_t)round_1 - (int64_t)reply_1, flight_2 = (int64_t)round_2 - (int64_t)reply_2;
    if (flight_1 > MAX_FLIGHT_TICKS || flight_1 < -MAX_FLIGHT_TICKS || flight_2 > MAX_FLIGHT_TICKS ||
        flight_2 < -MAX_FLIGHT_TICKS) {
        return 0;
    }
    const int64_t product =
        flight_1 * (int64_t)reply_2 + flight_2 * (int64_t)reply_1 + flight_1 * flight_2;
    const int64_t sum = (int64_t)(round_1 + round_2 + reply_1 + reply_2);
    *range_m = (double)product / (double)sum * METRES_PER_TICK;
    return *range_m > -10 && *range_m < 2000;
}
