/* The SPI: header, data and duration; and programs in other languages that use it. */
#include <string.h>

#include "model.h"

/* Chip select to first clock, last clock to chip select, chip select idle (datasheet 2.12, table 18). */
#define FRAMING_NS 96.0
/* Registers may change during a read: long reads are done in chunks. */
#define READ_CHUNK 64

typedef struct {
    bool write;
    unsigned file, sub;
    size_t octets; /* of the header; 0 = incomplete */
} header;

static header decode(const uint8_t *out, size_t n) {
    header read = {.write = (out[0] & 0x80) != 0, .file = out[0] & 0x3F, .octets = 1};
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

static uint8_t accumulator_octet(const dw1000_chip *chip, unsigned sub) {
    const uint32_t clocks = (uint32_t)dw1000_get(chip, PMSC, PMSC_CTRL0, 4);
    const bool on = (clocks & (1u << 6)) && (clocks & (1u << 15));
    if (!on || sub >= sizeof chip->accumulator) {
        return 0;
    }
    const uint16_t value = (uint16_t)chip->accumulator[sub / 2];
    return (uint8_t)(sub & 1 ? value >> 8 : value);
}

/* Return whether a register is computed on reading, and set its value. */
static bool computed_register(const dw1000_chip *chip, unsigned file, uint64_t *value) {
    const uint64_t counter = dw1000_counter_units(chip, chip->air->now) / UNITS_PER_TICK & COUNTER_MASK;
    switch (file) {
    case SYS_TIME:
        *value = counter & ~(uint64_t)(COUNTER_GRID - 1);
        return true;
    case SYS_STATUS:
        *value = dw1000_status(chip);
        return true;
    case SYS_CTRL:
        *value = 0;
        return true;
    default:
        return false;
    }
}

static void read_octets(const dw1000_chip *chip, unsigned file, unsigned sub, uint8_t *to, size_t count) {
    uint64_t value = 0;
    unsigned octets = 0;
    if (computed_register(chip, file, &value)) {
        octets = file == SYS_CTRL ? 4 : 5;
    }
    for (size_t i = 0; i < count; i++, sub++) {
        if (sub < octets) {
            to[i] = (uint8_t)(value >> (8 * sub));
        } else if (file == ACC_MEM) {
            to[i] = accumulator_octet(chip, sub);
        } else if (file == RX_BUFFER && sub < FRAME_OCTETS) {
            to[i] = chip->rx_buffer[sub];
        } else {
            to[i] = dw1000_read_octet(chip, file, sub);
        }
    }
}

static void write_octets(dw1000_chip *chip, unsigned file, unsigned sub, const uint8_t *from, size_t count) {
    if (file == SYS_STATUS || file == SYS_CTRL) {
        uint64_t value = 0;
        for (size_t i = 0; i < count && sub + i < 5; i++) {
            value |= (uint64_t)from[i] << (8 * (sub + i));
        }
        if (file == SYS_STATUS) {
            dw1000_clear_status(chip, value & ~ST_READ_ONLY);
        } else {
            dw1000_handle_sys_ctrl(chip, (uint32_t)value);
        }
        return;
    }
    for (size_t i = 0; i < count; i++) {
        const unsigned at = sub + (unsigned)i;
        if (file == TX_BUFFER && at < FRAME_OCTETS) {
            chip->tx_buffer[at] = from[i];
        }
        dw1000_write_octet(chip, file, at, from[i]);
    }
    if (file == SYS_CFG || file == SYS_MASK) {
        dw1000_update_line(chip);
    }
    dw1000_handle_register_write(chip, file, sub, count);
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
                in[i] = chip->power == POWER_WAKEUP ? 0 : (uint8_t)dw1000_random_bits(air->seed ^ (uint64_t)began, i);
            }
        }
        dw1000_advance(air, ends);
        if (to.write && to.file == PMSC && n > to.octets && to.octets != 0 && dw1000_accepts_pmsc_writes(chip, hz)) {
            write_octets(chip, to.file, to.sub, out + to.octets, n - to.octets);
        }
        return;
    }
    if (to.octets == 0) {
        dw1000_advance(air, ends);
        return;
    }
    if (to.write) {
        if (in != NULL) {
            memset(in, 0, n);
        }
        dw1000_advance(air, ends);
        if (n > to.octets && (!chip->in_reset || to.file == PMSC)) {
            write_octets(chip, to.file, to.sub, out + to.octets, n - to.octets);
        }
        return;
    }
    uint8_t discarded[READ_CHUNK];
    if (in != NULL) {
        memset(in, 0, to.octets);
    }
    size_t done = to.octets;
    unsigned sub = to.sub;
    if (to.file == ACC_MEM && done < n) {
        /* The first octet of every read is a stale octet of the pipeline. */
        const uint8_t stale = (uint8_t)(0x5A ^ air->order);
        if (in != NULL) {
            in[done] = stale;
        }
        done++;
    }
    while (done < n) {
        const size_t chunk = n - done < READ_CHUNK ? n - done : READ_CHUNK;
        read_octets(chip, to.file, sub, in != NULL ? in + done : discarded, chunk);
        done += chunk;
        sub += (unsigned)chunk;
        if (done < n) {
            dw1000_advance(air, began + (instant)(octet * (double)done));
        }
    }
    dw1000_advance(air, ends);
}

static void run_remote(dw1000_chip *chip, void *context) {
    dw1000_request request = {.kind = DW1000_DELAY};
    for (;;) {
        request.line = chip->line;
        request.now_s = dw1000_seconds_now(chip->air);
        if (!chip->next(context, &request)) {
            return;
        }
        switch (request.kind) {
        case DW1000_SPI: dw1000_spi(chip, request.out, request.in, request.n, request.hz); break;
        case DW1000_WAIT: dw1000_wait(chip, request.seconds); break;
        case DW1000_RESET_PIN: dw1000_reset_pin(chip); break;
        default: dw1000_delay(chip, request.seconds); break;
        }
    }
}

void dw1000_program_remote(dw1000_chip *chip, int (*next)(void *context, dw1000_request *request), void *context) {
    chip->next = next;
    dw1000_program(chip, run_remote, context);
}
