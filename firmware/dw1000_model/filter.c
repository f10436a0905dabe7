/* Frame filtering (DW1000 user manual 2.09, section 5.2): which frames are for this chip. */
#include <string.h>

#include "model.h"

#define BROADCAST 0xFFFFu
enum { BEACON = 0, DATA = 1, COMMAND = 3 };
enum { NO_ADDRESS = 0, RESERVED = 1, SHORT = 2, LONG = 3 };

typedef struct {
    const uint8_t *octets;
    size_t left;
    bool short_of; /* the frame ended before its header did */
} cursor;

static uint64_t take(cursor *at, size_t octets) {
    uint64_t value = 0;
    if (at->left < octets) {
        at->short_of = true;
        return 0;
    }
    for (size_t i = 0; i < octets; i++) {
        value |= (uint64_t)at->octets[i] << (8 * i);
    }
    at->octets += octets;
    at->left -= octets;
    return value;
}

static bool type_allowed(uint32_t setting, unsigned type) {
    if (type <= COMMAND) {
        /* FFAB, FFAD, FFAA, FFAM stand in the order of the types. */
        return setting & (CFG_FFAB << type);
    }
    return setting & (type == 4 ? CFG_FFA4 : type == 5 ? CFG_FFA5 : 1u << 6);
}

bool dw1000_accepted(const dw1000_chip *chip, const uint8_t *octets, size_t count) {
    const uint32_t setting = (uint32_t)dw1000_get(chip, SYS_CFG, 0, 4);
    const unsigned own_pan = (unsigned)dw1000_get(chip, PANADR, 2, 2);
    const unsigned own_short = (unsigned)dw1000_get(chip, PANADR, 0, 2);
    cursor at = {octets, count, false};
    const unsigned control = (unsigned)take(&at, 2), type = control & 7;
    if (at.short_of || !type_allowed(setting, type) || (control >> 12 & 3) > 1) {
        return false;
    }
    if (type > COMMAND || type == 2) {
        return true;
    }
    (void)take(&at, 1);
    const unsigned to = control >> 10 & 3, from = control >> 14;
    unsigned to_pan = BROADCAST;
    uint64_t address = 0;
    if (to == RESERVED || from == RESERVED) {
        return false;
    }
    if (to != NO_ADDRESS) {
        to_pan = (unsigned)take(&at, 2);
        address = take(&at, to == LONG ? 8 : 2);
    }
    unsigned from_pan = to_pan;
    if (from != NO_ADDRESS) {
        if (!(control & 0x40)) {
            from_pan = (unsigned)take(&at, 2);
        }
        (void)take(&at, from == LONG ? 8 : 2);
    }
    if (at.short_of) {
        return false;
    }
    if (to == NO_ADDRESS) {
        if (type == BEACON) {
            return own_pan == BROADCAST || from_pan == own_pan;
        }
        return (setting & CFG_FFBC) && from_pan == own_pan;
    }
    const bool ours = to == LONG ? address == dw1000_get(chip, EUI, 0, 8) : address == own_short || address == BROADCAST;
    return ours && (to_pan == BROADCAST || to_pan == own_pan);
}
