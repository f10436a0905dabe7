/* The register map: what lies where, how long it is, who may write it, and what a reset leaves in it. */
#include <pthread.h>
#include <string.h>

#include "model.h"

typedef enum { RO, RW, SWINGING } access;

typedef struct {
    uint8_t file;
    uint16_t sub;
    uint8_t octets;
    access type;
    uint64_t reset;
} entry;

/* DW1000 user manual 2.09, section 7.2; in the order of addresses. The receive and transmit buffers, ACC_MEM and what is
 * computed as it is read are elsewhere. */
static const entry MAP[] = {
    {DEV_ID, 0x00, 4, RO, 0xDECA0130},
    {EUI, 0x00, 8, RW, 0},
    {PANADR, 0x00, 4, RW, 0xFFFFFFFF},
    {SYS_CFG, 0x00, 4, RW, CFG_HIRQ_POL | CFG_DIS_DRXB},
    {TX_FCTRL, 0x00, 5, RW, 0x15400C},
    {DX_TIME, 0x00, 5, RW, 0},
    {RX_FWTO, 0x00, 2, RW, 0},
    {SYS_MASK, 0x00, 4, RW, 0},
    {RX_FINFO, 0x00, 4, SWINGING, 0},
    {RX_FQUAL, 0x00, 8, SWINGING, 0},
    {RX_TTCKI, 0x00, 4, SWINGING, 0},
    {RX_TTCKO, 0x00, 5, SWINGING, 0},
    {RX_TIME, 0x00, 14, SWINGING, 0},
    {TX_TIME, 0x00, 10, RO, 0},
    {TX_ANTD, 0x00, 2, RW, 0},
    {ACK_RESP_T, 0x00, 4, RW, 0},
    {RX_SNIFF, 0x00, 4, RW, 0},
    {TX_POWER, 0x00, 4, RW, 0x1E080222},
    {CHAN_CTRL, 0x00, 4, RW, 0x21040055}, /* channel 5, PRF 16 MHz, code 4 */
    {USR_SFD, 0x00, 41, RW, 0},
    {AGC_CTRL, 0x02, 2, RW, 0x0001},
    {AGC_CTRL, 0x04, 2, RW, 0x889B},
    {AGC_CTRL, 0x0C, 4, RW, 0x2502A907},
    {AGC_CTRL, 0x12, 2, RW, 0x0055},
    {AGC_CTRL, 0x1E, 3, RO, 0},
    {EXT_SYNC, 0x00, 4, RW, 0},
    {EXT_SYNC, 0x04, 4, RO, 0},
    {EXT_SYNC, 0x08, 4, RO, 0},
    {GPIO_CTRL, 0x00, 4, RW, 0},
    {GPIO_CTRL, 0x08, 4, RW, 0},
    {GPIO_CTRL, 0x0C, 4, RW, 0},
    {GPIO_CTRL, 0x10, 4, RW, 0},
    {GPIO_CTRL, 0x14, 4, RW, 0},
    {GPIO_CTRL, 0x18, 4, RW, 0},
    {GPIO_CTRL, 0x1C, 4, RW, 0},
    {GPIO_CTRL, 0x20, 4, RW, 0},
    {GPIO_CTRL, 0x24, 4, RW, 0},
    {GPIO_CTRL, 0x28, 4, RO, 0},
    {DRX_CONF, 0x02, 2, RW, 0x0001},
    {DRX_CONF, 0x04, 2, RW, 0x0087},
    {DRX_CONF, 0x06, 2, RW, 0x0020},
    {DRX_CONF, DRX_TUNE2, 4, RW, 0x311E0035},
    {DRX_CONF, DRX_SFDTOC, 2, RW, 4161},
    {DRX_CONF, DRX_PRETOC, 2, RW, 0},
    {DRX_CONF, 0x26, 2, RW, 0x0028},
    {DRX_CONF, DRX_CAR_INT, 3, RO, 0},
    {DRX_CONF, RXPACC_NOSAT, 2, RO, 0},
    {RF_CONF, 0x00, 4, RW, 0},
    {RF_CONF, 0x0B, 1, RW, 0xD8},
    {RF_CONF, 0x0C, 3, RW, 0x1E3DE0},
    {RF_CONF, RF_SAR_BIAS, 1, RW, 0},
    {RF_CONF, RF_SAR_SWITCH, 1, RW, 0},
    {RF_CONF, 0x2C, 4, RO, 0},
    {RF_CONF, 0x30, 5, RW, 0x8888888888},
    {TX_CAL, TC_SARC, 2, RW, 0},
    {TX_CAL, TC_SARL, 3, RO, 0},
    {TX_CAL, 0x06, 2, RO, 0},
    {TX_CAL, 0x08, 1, RW, 0},
    {TX_CAL, 0x09, 2, RO, 0},
    {TX_CAL, 0x0B, 1, RW, 0xC5},
    {TX_CAL, 0x0C, 1, RW, 0},
    {FS_CTRL, FS_PLLCFG, 4, RW, 0x0800041D},
    {FS_CTRL, 0x0B, 1, RW, 0x46},
    {FS_CTRL, 0x0E, 1, RW, 0x60},
    {AON, AON_WCFG, 2, RW, 0},
    {AON, AON_CTRL, 1, RW, 0},
    {AON, 0x03, 1, RO, 0},
    {AON, 0x04, 1, RW, 0},
    {AON, AON_CFG0, 4, RW, 0},
    {AON, 0x0A, 2, RW, 0},
    {OTP_IF, 0x00, 4, RW, 0},
    {OTP_IF, OTP_ADDR, 2, RW, 0},
    {OTP_IF, OTP_CTRL, 2, RW, 0},
    {OTP_IF, 0x08, 2, RO, 0},
    {OTP_IF, OTP_RDAT, 4, RO, 0},
    {OTP_IF, 0x0E, 4, RO, 0},
    {OTP_IF, 0x12, 1, RW, 0},
    {LDE_IF, LDE_THRESH, 2, RO, 0},
    {LDE_IF, LDE_CFG1, 1, RW, 0x6C},
    {LDE_IF, LDE_PPINDX, 2, RO, 0},
    {LDE_IF, LDE_PPAMPL, 2, RO, 0},
    {LDE_IF, LDE_RXANTD, 2, RW, 0},
    {LDE_IF, 0x1806, 2, RW, 0},
    {LDE_IF, 0x2804, 2, RW, 0},
    {DIG_DIAG, EVC_CTRL, 4, RW, 0},
    {DIG_DIAG, 0x04, 24, RO, 0},
    {DIG_DIAG, 0x24, 2, RW, 0},
    {PMSC, PMSC_CTRL0, 4, RW, 0xF0300200},
    {PMSC, PMSC_CTRL1, 4, RW, 0x81020738},
    {PMSC, 0x0C, 1, RW, 0x40},
    {PMSC, 0x26, 2, RW, 0x0B74},
    {PMSC, 0x28, 4, RW, 0x00000100},
};
#define ENTRIES (sizeof MAP / sizeof *MAP)
#define LAST_HARMLESS 127u /* of the transmit buffer, while a frame waits in the second receive buffer */

/* Where the octets of an entry lie: those of the swinging set in it, all others one after another. */
typedef struct {
    const entry *found;
    size_t base;
} location;

static const entry *first_of[64];
static uint16_t base_of[ENTRIES];

static void lay_out(void) {
    size_t base = 0, swinging = 0;
    for (size_t i = 0; i < ENTRIES; i++) {
        size_t *const next = MAP[i].type == SWINGING ? &swinging : &base;
        base_of[i] = (uint16_t)*next;
        *next += MAP[i].octets;
        if (first_of[MAP[i].file] == NULL) {
            first_of[MAP[i].file] = &MAP[i];
        }
    }
}

void dw1000_prepare_map(void) {
    static pthread_once_t once = PTHREAD_ONCE_INIT;
    (void)pthread_once(&once, lay_out);
}

static location locate(unsigned file, unsigned sub) {
    for (const entry *at = first_of[file & 63]; at != NULL && at < MAP + ENTRIES && at->file == file; at++) {
        if (sub >= at->sub && sub < at->sub + (unsigned)at->octets) {
            return (location){at, (size_t)base_of[at - MAP] + (sub - at->sub)};
        }
    }
    return (location){NULL, 0};
}

uint8_t *dw1000_place(dw1000_chip *chip, unsigned file, unsigned sub) {
    const location at = locate(file, sub);
    if (at.found == NULL) {
        return NULL;
    }
    return at.found->type == SWINGING ? &chip->set[chip->chip_side].octets[at.base] : &chip->octets[at.base];
}

/* Values of registers as the chip itself sees them: of the swinging set the side that it writes to. */
uint64_t dw1000_get(const dw1000_chip *chip, unsigned file, unsigned sub, unsigned octets) {
    const location at = locate(file, sub);
    const uint8_t *const from =
        at.found->type == SWINGING ? &chip->set[chip->chip_side].octets[at.base] : &chip->octets[at.base];
    uint64_t value = 0;
    for (unsigned i = 0; i < octets; i++) {
        value |= (uint64_t)from[i] << (8 * i);
    }
    return value;
}

void dw1000_put(dw1000_chip *chip, unsigned file, unsigned sub, unsigned octets, uint64_t value) {
    uint8_t *const to = dw1000_place(chip, file, sub);
    for (unsigned i = 0; i < octets; i++) {
        to[i] = (uint8_t)(value >> (8 * i));
    }
}

void dw1000_reset_registers(dw1000_chip *chip) {
    for (size_t i = 0; i < ENTRIES; i++) {
        if (MAP[i].octets <= 8) {
            dw1000_put(chip, MAP[i].file, MAP[i].sub, MAP[i].octets, MAP[i].reset);
        } else {
            memset(dw1000_place(chip, MAP[i].file, MAP[i].sub), 0, MAP[i].octets);
        }
    }
    dw1000_put(chip, EUI, 0, 4, chip->otp[0]);
    dw1000_put(chip, EUI, 4, 4, chip->otp[1]);
    memset(chip->set, 0, sizeof chip->set);
}

/* Reserved registers read 0xDEADDEAD. */
static uint8_t reserved(unsigned sub) {
    return sub & 1 ? 0xDE : 0xAD;
}

static uint8_t octet_of(uint64_t value, unsigned sub, unsigned octets) {
    if (sub >= octets) {
        return reserved(sub);
    }
    return (uint8_t)(value >> (8 * sub));
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

void dw1000_read_octets(dw1000_chip *chip, unsigned file, unsigned sub, uint8_t *to, size_t count) {
    uint64_t value = 0;
    unsigned octets = 0;
    switch (file) {
    case SYS_TIME:
        value = dw1000_counter_now(chip) & ~(uint64_t)(COUNTER_GRID - 1);
        octets = 5;
        break;
    case SYS_STATUS:
        value = dw1000_status_of(chip);
        octets = 5;
        break;
    case SYS_STATE:
        value = dw1000_system_state(chip);
        octets = 5;
        break;
    case SYS_CTRL:
        octets = 4;
        break;
    default:
        break;
    }
    for (size_t i = 0; i < count; i++, sub++) {
        if (octets != 0) {
            to[i] = octet_of(value, sub, octets);
        } else if (file == ACC_MEM) {
            to[i] = accumulator_octet(chip, sub);
        } else if (file == RX_BUFFER) {
            to[i] = sub < FRAME_OCTETS ? chip->set[chip->host_side].buffer[sub] : reserved(sub);
        } else {
            const location at = locate(file, sub);
            if (at.found == NULL) {
                to[i] = reserved(sub);
            } else if (at.found->type == SWINGING) {
                to[i] = chip->set[chip->host_side].octets[at.base];
            } else {
                to[i] = chip->octets[at.base];
            }
        }
    }
}

void dw1000_write_octets(dw1000_chip *chip, unsigned file, unsigned sub, const uint8_t *from, size_t count) {
    if (file == SYS_STATUS || file == SYS_CTRL) {
        uint64_t value = 0;
        for (size_t i = 0; i < count && sub + i < 5; i++) {
            value |= (uint64_t)from[i] << (8 * (sub + i));
        }
        if (file == SYS_STATUS) {
            dw1000_acknowledge_status(chip, value & ~ST_READ_ONLY);
        } else {
            dw1000_control(chip, (uint32_t)value);
        }
        return;
    }
    for (size_t i = 0; i < count; i++) {
        const unsigned at = sub + (unsigned)i;
        if (file == TX_BUFFER) {
            if (at < FRAME_OCTETS) {
                chip->tx_buffer[at] = from[i];
            }
            if (at > LAST_HARMLESS && chip->set[1].full && dw1000_doubly_buffered(chip)) {
                chip->set[1].buffer[LAST_HARMLESS + 1] ^= 0xFF; /* errata RX-1 */
            }
            continue;
        }
        const location to = locate(file, at);
        if (to.found != NULL && to.found->type == RW) {
            chip->octets[to.base] = from[i];
        }
    }
    if (file == SYS_CFG || file == SYS_MASK) {
        dw1000_update_line(chip);
    }
    if (file == TX_BUFFER && chip->tx == TX_ON && chip->suppress_fcs) {
        dw1000_raise_status(chip, ST_TXBERR);
    }
    dw1000_power_written(chip, file, sub, count);
}
