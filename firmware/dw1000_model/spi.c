/* The serial interface: header, data, and the time that they take. */
#include <string.h>

#include "model.h"

/* Chip select to first clock, last clock to chip select, chip select idle (datasheet 2.12, table 18). */
#define FRAMING_NS 96.0
/* A register that changes while it is read is seen as it is then: long reads are taken in pieces. */
#define PIECE 64

typedef struct {
    bool write;
    unsigned file, sub;
    size_t octets; /* of the header; 0 = cut off */
} header;

static header decode(const uint8_t *out, size_t n) {
    header read = {(out[0] & 0x80) != 0, out[0] & 0x3F, 0, 1};
    if (out[0] & 0x40) {
        read.octets = n >= 2 ? 2 : 0;
        read.sub = n >= 2 ? out[1] & 0x7Fu : 0;
        if (n >= 2 && (out[1] & 0x80)) {
            read.octets = n >= 3 ? 3 : 0;
            read.sub |= n >= 3 ? (unsigned)out[2] << 7 : 0;
        }
    }
    return read;
}

void dw1000_spi(dw1000_chip *chip, const uint8_t *out, uint8_t *in, size_t n, uint32_t hz) {
    dw1000_air *const air = chip->air;
    if (n == 0 || hz == 0) {
        return;
    }
    const double octet = 8.0 / hz * (double)UNITS_PER_SECOND;
    const instant began = air->now, ends = began + (instant)(octet * (double)n + FRAMING_NS * UNITS_PER_NS);
    const header to = decode(out, n);
    if (!dw1000_spi_works(chip, hz)) {
        if (in != NULL) {
            for (size_t i = 0; i < n; i++) {
                in[i] = chip->power == POWER_SLEEP || chip->power == POWER_WAKEUP
                            ? 0
                            : (uint8_t)dw1000_dice(air->seed ^ (uint64_t)began, i);
            }
        }
        dw1000_pass(air, ends);
        dw1000_wake_by_select(chip, ends - began);
        if (to.write && to.file == PMSC && n > to.octets && to.octets != 0 && dw1000_clocks_listen(chip, hz)) {
            dw1000_write_octets(chip, to.file, to.sub, out + to.octets, n - to.octets);
        }
        return;
    }
    if (to.octets == 0) {
        dw1000_pass(air, ends);
        return;
    }
    if (to.write) {
        if (in != NULL) {
            memset(in, 0, n);
        }
        dw1000_pass(air, ends);
        if (n > to.octets && !chip->in_reset) {
            dw1000_write_octets(chip, to.file, to.sub, out + to.octets, n - to.octets);
        } else if (n > to.octets && to.file == PMSC) {
            dw1000_write_octets(chip, to.file, to.sub, out + to.octets, n - to.octets);
        }
        return;
    }
    uint8_t unwanted[PIECE];
    if (in != NULL) {
        memset(in, 0, to.octets);
    }
    size_t done = to.octets;
    unsigned sub = to.sub;
    if (to.file == ACC_MEM && done < n) {
        /* The first octet of every read is what was in the pipe before. */
        const uint8_t stale = (uint8_t)(0x5A ^ air->order);
        if (in != NULL) {
            in[done] = stale;
        }
        done++;
    }
    while (done < n) {
        const size_t piece = n - done < PIECE ? n - done : PIECE;
        dw1000_read_octets(chip, to.file, sub, in != NULL ? in + done : unwanted, piece);
        done += piece;
        sub += (unsigned)piece;
        if (done < n) {
            dw1000_pass(air, began + (instant)(octet * (double)done));
        }
    }
    dw1000_pass(air, ends);
}
