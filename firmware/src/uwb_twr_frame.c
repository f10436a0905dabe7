#include <string.h>

#include "uwb_twr.h"

/* IEEE 802.15.4: a data frame, both ends in one PAN, addresses of 64 bits; a broadcast's destination has 16. */
static const uint8_t CONTROL[2][2] = {{0x41, 0xCC}, {0x41, 0xC8}};
static const uint16_t BROADCAST = 0xFFFF;
/* First octet of the payload, so that other data frames on the air are not taken for ours. */
static const uint8_t MARK = 0x75;

#define KNOWN_BYTES sizeof(((uwb_twr_frame *)0)->known)

/* Addresses, mark, kind, and for a SEEK the tag's number, time and `known`. All other frames have both numbers and room
 * for three stamps: they are equally long, so that the chip is not told the length anew for each. */
#define SEEK_BYTES (15u + 2u + 4u + 4u + KNOWN_BYTES)
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
    const int broadcast = frame->kind == UWB_TWR_SEEK;
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
    if ((!broadcast && octets[1] != CONTROL[0][1]) || bytes != (broadcast ? SEEK_BYTES : EXCHANGE_BYTES)) {
        return 0;
    }
    size_t at = 2;
    frame->sequence = (uint8_t)take(octets, &at, 1);
    frame->pan = (uint16_t)take(octets, &at, 2);
    frame->to = take(octets, &at, broadcast ? 2 : 8);
    frame->from = take(octets, &at, 8);
    const uint64_t mark = take(octets, &at, 1), kind = take(octets, &at, 1);
    if (mark != MARK || kind < UWB_TWR_SEEK || kind > UWB_TWR_REPORT || (kind == UWB_TWR_SEEK) != broadcast ||
        (broadcast && frame->to != BROADCAST)) {
        return 0;
    }
    frame->kind = (uwb_twr_kind)kind;
    frame->to = broadcast ? UWB_TWR_EVERYBODY : frame->to;
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
    return frame->sequence == (uint8_t)frame->tag_number && frame->from != UWB_TWR_EVERYBODY;
}
