/* The registers: where each is, its length, whether the host may write it, and its value after a reset. */
#include <pthread.h>
#include <string.h>

#include "model.h"

typedef enum { RO, RW } access;

typedef struct {
    uint8_t file;
    uint16_t sub;
    uint8_t octets;
    access type;
    uint64_t reset;
} entry;

/* DW1000 user manual 2.09, section 7.2; in the order of addresses. The buffers, ACC_MEM and registers that are
 * computed on reading are in spi.c. */
static const entry MAP[] = {
    {DEV_ID, 0x00, 4, RO, 0xDECA0130},
    {EUI, 0x00, 8, RW, 0},
    {PANADR, 0x00, 4, RW, 0xFFFFFFFF},
    {SYS_CFG, 0x00, 4, RW, CFG_HIRQ_POL | CFG_DIS_DRXB},
    {TX_FCTRL, 0x00, 5, RW, 0x15400C},
    {DX_TIME, 0x00, 5, RW, 0},
    {RX_FWTO, 0x00, 2, RW, 0},
    {SYS_MASK, 0x00, 4, RW, 0},
    {RX_FINFO, 0x00, 4, RO, 0},
    {RX_FQUAL, 0x00, 8, RO, 0},
    {RX_TIME, 0x00, 14, RO, 0},
    {TX_TIME, 0x00, 10, RO, 0},
    {TX_ANTD, 0x00, 2, RW, 0},
    {ACK_RESP_T, 0x00, 4, RW, 0},
    {TX_POWER, 0x00, 4, RW, 0x1E080222},
    {CHAN_CTRL, 0x00, 4, RW, 0x21040055}, /* channel 5, PRF 16 MHz, code 4 */
    {USR_SFD, 0x00, 41, RW, 0},
    {AGC_CTRL, 0x02, 2, RW, 0x0001},
    {AGC_CTRL, 0x04, 2, RW, 0x889B},
    {AGC_CTRL, 0x0C, 4, RW, 0x2502A907},
    {AGC_CTRL, 0x12, 2, RW, 0x0055},
    {EXT_SYNC, 0x00, 4, RW, 0},
    {DRX_CONF, 0x02, 2, RW, 0x0001},
    {DRX_CONF, 0x04, 2, RW, 0x0087},
    {DRX_CONF, 0x06, 2, RW, 0x0020},
    {DRX_CONF, DRX_TUNE2, 4, RW, 0x311E0035},
    {DRX_CONF, DRX_SFDTOC, 2, RW, 4161},
    {DRX_CONF, 0x24, 2, RW, 0},
    {DRX_CONF, 0x26, 2, RW, 0x0028},
    {DRX_CONF, RXPACC_NOSAT, 2, RO, 0},
    {RF_CONF, 0x00, 4, RW, 0},
    {RF_CONF, 0x0B, 1, RW, 0xD8},
    {RF_CONF, 0x0C, 3, RW, 0x1E3DE0},
    {RF_CONF, RF_SAR_BIAS, 1, RW, 0},
    {RF_CONF, RF_SAR_SWITCH, 1, RW, 0},
    {RF_CONF, 0x30, 5, RW, 0x8888888888},
    {TX_CAL, TC_SARC, 2, RW, 0},
    {TX_CAL, TC_SARL, 3, RO, 0},
    {TX_CAL, 0x08, 1, RW, 0},
    {TX_CAL, 0x0B, 1, RW, 0xC5},
    {TX_CAL, 0x0C, 1, RW, 0},
    {FS_CTRL, FS_PLLCFG, 4, RW, 0x0800041D},
    {FS_CTRL, 0x0B, 1, RW, 0x46},
    {FS_CTRL, 0x0E, 1, RW, 0x60},
    {AON, 0x00, 2, RW, 0},
    {AON, 0x02, 1, RW, 0},
    {AON, 0x04, 1, RW, 0},
    {AON, 0x06, 4, RW, 0},
    {AON, 0x0A, 2, RW, 0},
    {OTP_IF, 0x00, 4, RW, 0},
    {OTP_IF, OTP_ADDR, 2, RW, 0},
    {OTP_IF, OTP_CTRL, 2, RW, 0},
    {OTP_IF, OTP_RDAT, 4, RO, 0},
    {OTP_IF, 0x0E, 4, RO, 0},
    {OTP_IF, 0x12, 1, RW, 0},
    {LDE_IF, LDE_THRESH, 2, RO, 0},
    {LDE_IF, LDE_CFG1, 1, RW, 0x6C},
    {LDE_IF, LDE_RXANTD, 2, RW, 0},
    {LDE_IF, 0x1806, 2, RW, 0},
    {LDE_IF, 0x2804, 2, RW, 0},
    {PMSC, PMSC_CTRL0, 4, RW, 0xF0300200},
    {PMSC, PMSC_CTRL1, 4, RW, 0x81020738},
    {PMSC, 0x0C, 1, RW, 0x40},
    {PMSC, 0x26, 2, RW, 0x0B74},
    {PMSC, 0x28, 4, RW, 0x00000100},
};
#define ENTRIES (sizeof MAP / sizeof *MAP)
static const entry *first_of[64];
static uint16_t base_of[ENTRIES];

static void build_register_map(void) {
    size_t base = 0;
    for (size_t i = 0; i < ENTRIES; i++) {
        base_of[i] = (uint16_t)base;
        base += MAP[i].octets;
        if (first_of[MAP[i].file] == NULL) {
            first_of[MAP[i].file] = &MAP[i];
        }
    }
}

void dw1000_init_register_map(void) {
    static pthread_once_t once = PTHREAD_ONCE_INIT;
    (void)pthread_once(&once, build_register_map);
}

/* The entry that contains an octet, or NULL; `*at` becomes its index in the chip's octets. */
static const entry *locate(unsigned file, unsigned sub, size_t *at) {
    for (const entry *here = first_of[file & 63]; here != NULL && here < MAP + ENTRIES && here->file == file; here++) {
        if (sub >= here->sub && sub < here->sub + (unsigned)here->octets) {
            *at = (size_t)base_of[here - MAP] + (sub - here->sub);
            return here;
        }
    }
    return NULL;
}

uint64_t dw1000_get(const dw1000_chip *chip, unsigned file, unsigned sub, unsigned octets) {
    size_t at = 0;
    uint64_t value = 0;
    (void)locate(file, sub, &at);
    for (unsigned i = 0; i < octets; i++) {
        value |= (uint64_t)chip->octets[at + i] << (8 * i);
    }
    return value;
}

void dw1000_put(dw1000_chip *chip, unsigned file, unsigned sub, unsigned octets, uint64_t value) {
    size_t at = 0;
    (void)locate(file, sub, &at);
    for (unsigned i = 0; i < octets; i++) {
        chip->octets[at + i] = (uint8_t)(value >> (8 * i));
    }
}

/* An octet as the host reads it: reserved registers read 0xDEADDEAD. */
uint8_t dw1000_read_octet(const dw1000_chip *chip, unsigned file, unsigned sub) {
    size_t at;
    if (locate(file, sub, &at) == NULL) {
        return sub & 1 ? 0xDE : 0xAD;
    }
    return chip->octets[at];
}

void dw1000_write_octet(dw1000_chip *chip, unsigned file, unsigned sub, uint8_t octet) {
    size_t at;
    const entry *const found = locate(file, sub, &at);
    if (found != NULL && found->type == RW) {
        chip->octets[at] = octet;
    }
}

void dw1000_reset_registers(dw1000_chip *chip) {
    memset(chip->octets, 0, sizeof chip->octets);
    memset(chip->rx_buffer, 0, sizeof chip->rx_buffer);
    for (size_t i = 0; i < ENTRIES; i++) {
        dw1000_put(chip, MAP[i].file, MAP[i].sub, MAP[i].octets < 8 ? MAP[i].octets : 8, MAP[i].reset);
    }
    dw1000_put(chip, EUI, 0, 4, chip->otp[0]);
    dw1000_put(chip, EUI, 4, 4, chip->otp[1]);
}

/* Clocks and random numbers. */

__extension__ typedef __int128 wide;

#define RATE_BITS 44

uint64_t dw1000_counter_units(const dw1000_chip *chip, instant at) {
    return chip->clock_offset + (uint64_t)(((wide)at * chip->clock_rate) >> RATE_BITS);
}

instant dw1000_air_time(const dw1000_chip *chip, uint64_t units) {
    const wide scaled = (wide)(units - chip->clock_offset) << RATE_BITS;
    return (instant)((scaled + chip->clock_rate - 1) / chip->clock_rate);
}

/* The finaliser of splitmix64 (Steele, Lea, Flood 2014), twice. */
static uint64_t mix(uint64_t x) {
    x = (x ^ (x >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    x = (x ^ (x >> 27)) * UINT64_C(0x94D049BB133111EB);
    return x ^ (x >> 31);
}

uint64_t dw1000_random_bits(uint64_t a, uint64_t b) {
    return mix(mix(a + UINT64_C(0x9E3779B97F4A7C15)) + b + UINT64_C(0x9E3779B97F4A7C15));
}

double dw1000_uniform(uint64_t bits) {
    return (double)(bits >> 11) * 0x1p-53;
}

/* The air interface: channel, pulse rate, code and SFD as the registers set them. */

instant dw1000_symbol_units(unsigned prf) {
    return (prf == 2 ? 65024 : 63488) * UNITS_PER_TICK;
}

static bool tuned(const dw1000_chip *chip, unsigned channel) {
    static const uint32_t PLL[] = {0,          0x09000407, 0x08400508, 0x08401009,
                                   0x08400508, 0x0800041D, 0,          0x0800041D};
    return channel < sizeof PLL / sizeof *PLL && PLL[channel] != 0 &&
           dw1000_get(chip, FS_CTRL, FS_PLLCFG, 4) == PLL[channel];
}

static void set_sfd(const dw1000_chip *chip, air_interface *mode, bool decawave, bool user) {
    mode->decawave_sfd = decawave || user;
    if (mode->slow) {
        mode->sfd_symbols = 64;
    } else if (user) {
        const unsigned length = (unsigned)dw1000_get(chip, USR_SFD, 0, 1);
        mode->sfd_symbols = length >= 8 && length <= 64 ? length : 8;
    } else {
        mode->sfd_symbols = 8;
    }
}

air_interface dw1000_transmit_mode(const dw1000_chip *chip) {
    const uint32_t channel = (uint32_t)dw1000_get(chip, CHAN_CTRL, 0, 4);
    const uint32_t frame = (uint32_t)dw1000_get(chip, TX_FCTRL, 0, 4);
    air_interface mode = {.channel = channel & 15, .prf = frame >> 16 & 3, .code = channel >> 22 & 31};
    mode.tuned = tuned(chip, mode.channel);
    mode.slow = (frame >> 13 & 3) == 0;
    set_sfd(chip, &mode, channel >> 17 & 1, channel >> 20 & 1);
    return mode;
}

air_interface dw1000_receive_mode(const dw1000_chip *chip) {
    const uint32_t channel = (uint32_t)dw1000_get(chip, CHAN_CTRL, 0, 4);
    air_interface mode = {.channel = channel >> 4 & 15, .prf = channel >> 18 & 3, .code = channel >> 27};
    mode.tuned = tuned(chip, mode.channel);
    mode.slow = (dw1000_get(chip, SYS_CFG, 0, 4) & CFG_RXM110K) != 0;
    set_sfd(chip, &mode, channel >> 17 & 1, channel >> 21 & 1);
    return mode;
}
