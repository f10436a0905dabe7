#include <string.h>

#include "uwb_dw1000_registers.h"

/* Values of the User Manual, sections 7.2.x; pairs are for PRF 16 and 64 MHz. RF_TXCTRL and TC_PGDELAY of channel 5 are
 * those of manual 2.16 and later; they change together, and ranges with them. Power is in smart-power format. */
static const struct {
    uint32_t pll_config;
    uint32_t tx_control;
    uint32_t power[2];
    uint8_t number, pll_tune, pulse_delay, rx_control;
    uint8_t codes[2]; /* the first preamble code */
} channels[] = {
    {.number = 1, .pll_config = 0x09000407, .pll_tune = 0x1E, .tx_control = 0x00005C40, .rx_control = 0xD8,
     .pulse_delay = 0xC9, .power = {0x15355575, 0x07274767}, .codes = {1, 9}},
    {.number = 2, .pll_config = 0x08400508, .pll_tune = 0x26, .tx_control = 0x00045CA0, .rx_control = 0xD8,
     .pulse_delay = 0xC2, .power = {0x15355575, 0x07274767}, .codes = {3, 9}},
    {.number = 3, .pll_config = 0x08401009, .pll_tune = 0x56, .tx_control = 0x00086CC0, .rx_control = 0xD8,
     .pulse_delay = 0xC5, .power = {0x0F2F4F6F, 0x2B4B6B8B}, .codes = {5, 9}},
    {.number = 4, .pll_config = 0x08400508, .pll_tune = 0x26, .tx_control = 0x00045C80, .rx_control = 0xBC,
     .pulse_delay = 0x95, .power = {0x1F1F3F5F, 0x3A5A7A9A}, .codes = {7, 17}},
    {.number = 5, .pll_config = 0x0800041D, .pll_tune = 0xBE, .tx_control = 0x001E3FE3, .rx_control = 0xD8,
     .pulse_delay = 0xB5, .power = {0x0E082848, 0x25456585}, .codes = {3, 9}},
    {.number = 7, .pll_config = 0x0800041D, .pll_tune = 0xBE, .tx_control = 0x001E7DE0, .rx_control = 0xBC,
     .pulse_delay = 0x93, .power = {0x32527292, 0x5171B1D1}, .codes = {7, 17}},
};

static const struct {
    uint16_t symbols;
    uint8_t pac;
    uint8_t code; /* TXPSR and PE of TX_FCTRL */
} preambles[] = {
    {64, 8, 0x1},    {128, 8, 0x5},   {256, 16, 0x9},  {512, 16, 0xD},
    {1024, 32, 0x2}, {1536, 64, 0x6}, {2048, 64, 0xA}, {4096, 64, 0x3},
};

static const uint16_t rates[] = {110, 850, 6800};
static const uint8_t sfd_symbols[2][3] = {{64, 8, 8}, {64, 16, 8}};
static const uint16_t sfd_tune[2][3] = {{0x0A, 0x01, 0x01}, {0x16, 0x06, 0x02}};

/* LDE_REPC by preamble code, from 1 on. */
static const uint16_t replica[24] = {
    0x5998, 0x5998, 0x51EA, 0x428E, 0x451E, 0x2E14, 0x8000, 0x51EA, 0x28F4, 0x3332, 0x3AE0, 0x3D70,
    0x3AE0, 0x35C2, 0x2B84, 0x35C2, 0x3332, 0x35C2, 0x35C2, 0x47AE, 0x3AE0, 0x3850, 0x30A2, 0x3850,
};

const uwb_dw1000_settings uwb_dw1000_defaults = {
    .channel = 5, .prf_mhz = 64, .rate_kbps = 6800, .preamble = 128};

#define COUNT(array) (sizeof(array) / sizeof(array)[0])

/* Indices in the tables above; the number of entries if the value is not in the table. */
#define RETURN_INDEX(table, is_entry) \
    size_t i = 0; \
    while (i < COUNT(table) && !(is_entry)) { \
        i++; \
    } \
    return i

static size_t channel_index(const uwb_dw1000_settings *settings) {
    RETURN_INDEX(channels, channels[i].number == settings->channel);
}

static size_t preamble_index(const uwb_dw1000_settings *settings) {
    RETURN_INDEX(preambles, preambles[i].symbols == settings->preamble);
}

static size_t rate_index(const uwb_dw1000_settings *settings) {
    RETURN_INDEX(rates, rates[i] == settings->rate_kbps);
}

/* Two codes for each channel at 16 MHz, four at 64 MHz. */
static int is_valid_code(const uwb_dw1000_settings *settings, size_t channel) {
    const int fast = settings->prf_mhz == 64;
    const uint8_t first = channels[channel].codes[fast];
    return settings->preamble_code == 0 ||
           (settings->preamble_code >= first && settings->preamble_code < first + (fast ? 4 : 2));
}

int uwb_dw1000_settings_valid(const uwb_dw1000_settings *settings) {
    const size_t channel = channel_index(settings);
    return channel < COUNT(channels) && preamble_index(settings) < COUNT(preambles) &&
           rate_index(settings) < COUNT(rates) &&
           (settings->prf_mhz == 16 || settings->prf_mhz == 64) && settings->decawave_sfd <= 1 &&
           settings->antenna_delay <= 0x1FFFEu && is_valid_code(settings, channel);
}

uint32_t uwb_dw1000_sfd_symbols(const uwb_dw1000_settings *settings) {
    return sfd_symbols[settings->decawave_sfd][rate_index(settings)];
}

/* Duration of preamble and SFD, us. */
static uint32_t preamble_us(const uwb_dw1000_settings *settings) {
    const double symbol_us = settings->prf_mhz == 16 ? 0.99359 : 1.01763;
    return (uint32_t)((settings->preamble + uwb_dw1000_sfd_symbols(settings)) * symbol_us) + 1u;
}

uint32_t uwb_dw1000_airtime_us(const uwb_dw1000_settings *settings, size_t bytes) {
    const uint32_t bits = 8u * (uint32_t)(bytes + 2);
    const uint32_t coded = bits + 48u * ((bits + 329u) / 330u); /* Reed-Solomon */
    const double header_us = settings->rate_kbps == 110 ? 21 * 8.20513 : 21 * 1.02564;
    double bit_us = 0.128205;
    if (settings->rate_kbps == 110) {
        bit_us = 8.20513;
    } else if (settings->rate_kbps == 850) {
        bit_us = 1.02564;
    }
    return preamble_us(settings) + (uint32_t)(header_us + coded * bit_us) + 1u;
}

/* TX plus RX antenna delay in the OTP memory; 0 = not programmed. A TREK1000 kit (OTP revision 2 or 3) has a delay per
 * direction for each of its use cases, all others one total delay for each PRF. */
static uint32_t otp_antenna_delay(const uwb_dw1000 *chip, const uwb_dw1000_settings *settings) {
    const int fast = settings->prf_mhz == 64, slow_rate = settings->rate_kbps == 110;
    if (chip->otp_trek && settings->rate_kbps != 850 && (settings->channel == 2 || settings->channel == 5)) {
        const uint32_t word = chip->otp_trek_delay[(settings->channel == 5 ? 2 : 0) + slow_rate];
        const uint32_t delay = settings->anchor ? word >> 16 : word & 0xFFFFu;
        if (delay != 0 && delay != 0xFFFFu) {
            return 2 * delay;
        }
    }
    const uint32_t total = fast ? chip->otp_antenna_delay >> 16 : chip->otp_antenna_delay & 0xFFFFu;
    return total != 0xFFFFu ? total : 0;
}

/* The complete settings: zeros are replaced by OTP values or defaults. */
static uwb_dw1000_settings resolve_settings(const uwb_dw1000 *chip, const uwb_dw1000_settings *settings, size_t channel) {
    uwb_dw1000_settings resolved = *settings;
    const int fast = settings->prf_mhz == 64;
    const uint32_t power = chip->otp_tx_power[2 * channel + (size_t)fast];
    const uint32_t delay = otp_antenna_delay(chip, settings);
    if (resolved.preamble_code == 0) {
        resolved.preamble_code = channels[channel].codes[fast];
    }
    if (resolved.tx_power == 0) {
        resolved.tx_power = power != 0 && power != UINT32_MAX ? power : channels[channel].power[fast];
    }
    if (resolved.antenna_delay == 0) {
        resolved.antenna_delay = delay != 0 ? delay : UWB_DW1000_ANTENNA_DELAY;
    }
    return resolved;
}

/* DRX_TUNE2 by preamble acquisition chunk and PRF. */
static uint32_t drx_tune2(uint8_t pac, int fast) {
    static const uint32_t values[4][2] = {
        {0x311A002D, 0x313B006B}, {0x331A0052, 0x333B00BE}, {0x351A009A, 0x353B015E}, {0x371A011D, 0x373B0296}};
    size_t row = 0; /* for 8, 16, 32, 64 symbols */
    while (8u << row < pac) {
        row++;
    }
    return values[row][fast];
}

uwb_dw1000_status uwb_dw1000_configure(uwb_dw1000 *chip, const uwb_dw1000_settings *settings) {
    if (!uwb_dw1000_settings_valid(settings)) {
        return UWB_DW1000_BAD_ARGUMENT;
    }
    DW1000_TRY(uwb_dw1000_idle(chip));
    const size_t channel = channel_index(settings), rate = rate_index(settings), preamble = preamble_index(settings);
    const uwb_dw1000_settings now = resolve_settings(chip, settings, channel);
    const uint32_t fast = now.prf_mhz == 64, number = now.channel, sfd = now.decawave_sfd, code = now.preamble_code;
    const uint32_t symbols = sfd_symbols[sfd][rate], pac = preambles[preamble].pac;
    const uint32_t repeat = replica[code - 1] / (rate == 0 ? 8u : 1u);
    const uint32_t tx_delay = now.antenna_delay / 2;
    chip->settings = now;
    chip->tx_antenna_delay = (uint16_t)tx_delay;
    /* Smart power exists at 6.8 Mbit/s only: the chip boosts short frames, by the upper octets of the word. Without it,
     * octets 1 and 2 apply to PHR and data of any length, so that all octets get the level of long frames. */
    const int smart = now.rate_kbps == 6800;
    const uint32_t power = smart ? now.tx_power : (now.tx_power & 0xFFu) * 0x01010101u;
    uint32_t drx_tune1b = now.preamble == 64 ? 0x0010u : 0x0020u;
    if (rate == 0) {
        drx_tune1b = 0x0064u;
    }
    chip->sys_cfg = HIRQ_POL | DIS_DRXB | (smart ? 0 : DIS_STXP) | (rate == 0 ? RXM110K : 0);
    chip->wait_units = 0;
    chip->tx_bytes = 0;
    /* With the ranging bit. */
    chip->tx_fctrl = 1u << 15 | (uint32_t)rate << 13 | (fast ? 2u : 1u) << 16 | (uint32_t)preambles[preamble].code << 18;
    const uwb_dw1000_entry entries[] = {
        {SYS_CFG, 4, chip->sys_cfg},
        {PANADR, 4, UWB_DW1000_CANARY},
        {AGC_TUNE1, 2, fast ? 0x889Bu : 0x8870u},
        {AGC_TUNE2, 4, 0x2502A907},
        {AGC_TUNE3, 2, 0x0035},
        {DRX_TUNE0B, 2, sfd_tune[sfd][rate]},
        {DRX_TUNE1A, 2, fast ? 0x008Du : 0x0087u},
        {DRX_TUNE1B, 2, drx_tune1b},
        {DRX_TUNE2, 4, drx_tune2(preambles[preamble].pac, (int)fast)},
        {DRX_SFDTOC, 2, now.preamble + 1u + symbols - pac},
        {DRX_TUNE4H, 2, now.preamble == 64 ? 0x0010u : 0x0028u},
        {LDE_CFG1, 1, 0x6D},
        {LDE_CFG2, 2, fast ? 0x0607u : 0x1607u},
        {LDE_REPC, 2, repeat},
        {LDE_RXANTD, 2, now.antenna_delay - tx_delay},
        {TX_ANTD, 2, tx_delay},
        {FS_PLLCFG, 4, channels[channel].pll_config},
        {FS_PLLTUNE, 1, channels[channel].pll_tune},
        {RF_RXCTRLH, 1, channels[channel].rx_control},
        {RF_TXCTRL, 4, channels[channel].tx_control},
        {TC_PGDELAY, 1, channels[channel].pulse_delay},
        {USR_SFD, 1, symbols},
        {CHAN_CTRL, 4,
         number | number << 4 | sfd << 17 | (fast ? 2u : 1u) << 18 | sfd << 20 | sfd << 21 | code << 22 | code << 27},
        {TX_POWER, 4, power},
        {ACK_RESP_T, 3, 0},
        /* Both in one write initialise the SFD's logic, and send nothing (User Manual, 5.3.1.2). */
        {SYS_CTRL, 4, TXSTRT | TRXOFF},
        {SYS_STATUS, 4, RX_BITS | TX_BITS},
        {SYS_MASK, 4, UWB_DW1000_INTERRUPTS},
        {0, 0, 0},
    };
    return uwb_dw1000_write_list(chip, entries);
}

uwb_dw1000_status uwb_dw1000_check(uwb_dw1000 *chip) {
    uint64_t canary;
    DW1000_TRY(uwb_dw1000_get(chip, PANADR, 4, &canary));
    return canary == UWB_DW1000_CANARY ? UWB_DW1000_OK : UWB_DW1000_RESTARTED;
}

enum {
    RESET_SETTLE_US = 5000,
    SOFT_RESET_US = 20,
    LDE_LOAD_US = 300, /* the manual requires 150 */
    CLOCK_LOCK_US = 5000,
    XTI = 1 /* SYSCLKS: the crystal, 19.2 MHz */
};

static const uint32_t DEVICE = 0xDECA0130u;

/* OTP memory, addresses of words. */
enum { OTP_EUI = 0, OTP_LDOTUNE = 4, OTP_PART = 6, OTP_VOLTAGE = 8, OTP_TEMPERATURE = 9, OTP_POWER = 0x10,
       OTP_ANTENNA_DELAY = 0x1C, OTP_XTAL_TRIM = 0x1E, TREK_REVISION_FIRST = 2, TREK_REVISION_LAST = 3 };
static const uint8_t otp_trek_delay[4] = {0x0D, 0x0E, 0x0F, 0x1D};

static uwb_dw1000_status soft_reset(uwb_dw1000 *chip) {
    /* User Manual, 7.2.50.1: use the crystal, and disable the sequencing and the stored configuration of the AON block. */
    static const uwb_dw1000_entry before[] = {
        {PMSC_CTRL0, 1, XTI}, {PMSC_CTRL1, 2, 0}, {AON_WCFG, 2, 0}, {AON_CFG0, 1, 0},
        {AON_CTRL, 1, 0},     {AON_CTRL, 1, 2},   {PMSC_SOFTRESET, 1, 0}, {0, 0, 0},
    };
    DW1000_TRY(uwb_dw1000_write_list(chip, before));
    chip->io.sleep(chip->io.context, SOFT_RESET_US);
    DW1000_TRY(uwb_dw1000_set(chip, PMSC_SOFTRESET, 1, 0xF0));
    chip->io.sleep(chip->io.context, RESET_SETTLE_US);
    return UWB_DW1000_OK;
}

/* Read DEV_ID, up to three times. */
static uwb_dw1000_status identify(uwb_dw1000 *chip) {
    for (int attempt = 0; attempt < 3; attempt++) {
        uint64_t device;
        DW1000_TRY(uwb_dw1000_get(chip, DEV_ID, 4, &device));
        if (device == DEVICE) {
            return UWB_DW1000_OK;
        }
        chip->io.sleep(chip->io.context, 1000);
    }
    return UWB_DW1000_ABSENT;
}

/* Read one word of the OTP memory; works only with the clock of the crystal. */
static uwb_dw1000_status read_otp(uwb_dw1000 *chip, uint32_t address, uint32_t *word) {
    uint64_t value;
    const uwb_dw1000_entry steps[] = {{OTP_ADDR, 2, address}, {OTP_CTRL, 1, 3}, {OTP_CTRL, 1, 1}, {0, 0, 0}};
    DW1000_TRY(uwb_dw1000_write_list(chip, steps));
    DW1000_TRY(uwb_dw1000_get(chip, OTP_RDAT, 4, &value));
    *word = (uint32_t)value;
    return uwb_dw1000_set(chip, OTP_CTRL, 1, 0);
}

/* Memory that was never programmed reads as zeros, and on some modules as ones. */
static int is_programmed(uint64_t value, uint64_t ones) {
    return value != 0 && value != ones;
}

/* Read address, antenna delays, powers and sensor references; load LDO tune and crystal trim. */
static uwb_dw1000_status read_otp_memory(uwb_dw1000 *chip) {
    uint32_t eui[2], lot[2], word;
    for (uint32_t i = 0; i < 2; i++) {
        DW1000_TRY(read_otp(chip, OTP_EUI + i, &eui[i]));
        DW1000_TRY(read_otp(chip, OTP_PART + i, &lot[i]));
    }
    chip->eui = (uint64_t)eui[1] << 32 | eui[0];
    if (!is_programmed(chip->eui, UINT64_MAX)) {
        chip->eui = (uint64_t)lot[1] << 32 | lot[0];
    }
    DW1000_TRY(read_otp(chip, OTP_ANTENNA_DELAY, &chip->otp_antenna_delay));
    DW1000_TRY(read_otp(chip, OTP_VOLTAGE, &word));
    chip->otp_voltage = (uint8_t)word;
    DW1000_TRY(read_otp(chip, OTP_TEMPERATURE, &word));
    chip->otp_temperature = (uint8_t)word;
    for (uint32_t i = 0; i < 12; i++) {
        DW1000_TRY(read_otp(chip, OTP_POWER + i, &chip->otp_tx_power[i]));
    }
    DW1000_TRY(read_otp(chip, OTP_LDOTUNE, &word));
    if ((word & 0xFFu) != 0) {
        DW1000_TRY(uwb_dw1000_set(chip, OTP_SF, 1, 2)); /* load it */
    }
    DW1000_TRY(read_otp(chip, OTP_XTAL_TRIM, &word));
    const uint32_t revision = word >> 8 & 0xFFu;
    chip->otp_trek = revision >= TREK_REVISION_FIRST && revision <= TREK_REVISION_LAST;
    for (uint32_t i = 0; i < 4 && chip->otp_trek; i++) {
        DW1000_TRY(read_otp(chip, otp_trek_delay[i], &chip->otp_trek_delay[i]));
    }
    const uint32_t trim = (word & 0x1Fu) != 0 ? word & 0x1Fu : 0x10u; /* the middle */
    return uwb_dw1000_set(chip, FS_XTALT, 1, 0x60u | trim);
}

/* Load the microcode of the leading-edge detector, which timestamps need (User Manual, 2.5.5.10). */
static uwb_dw1000_status load_leading_edge_detector(uwb_dw1000 *chip) {
    static const uwb_dw1000_entry begin[] = {
        {PMSC_CTRL0, 1, 0x01}, {PMSC_CTRL0 + 1, 1, 0x03}, {OTP_CTRL, 2, 0x8000}, {0, 0, 0}};
    DW1000_TRY(uwb_dw1000_write_list(chip, begin));
    chip->io.sleep(chip->io.context, LDE_LOAD_US);
    return UWB_DW1000_OK;
}

/* Return the clock control to the chip and wait until the PLL has locked. CPLOCK is not reliable (errata): if it is
 * missing, the start continues with a warning. */
static uwb_dw1000_status start_clock(uwb_dw1000 *chip) {
    static const uwb_dw1000_entry automatic[] = {
        {SYS_STATUS, 4, (uint32_t)CPLOCK}, {PMSC_CTRL0, 1, 0x00}, {PMSC_CTRL0 + 1, 1, 0x02}, {AON_CFG1, 2, 0},
        {0, 0, 0}};
    DW1000_TRY(uwb_dw1000_write_list(chip, automatic));
    const uint64_t until_us = chip->io.now_us(chip->io.context) + CLOCK_LOCK_US;
    for (;;) {
        uint64_t status;
        DW1000_TRY(uwb_dw1000_get(chip, SYS_STATUS, 4, &status));
        if (status & CPLOCK) {
            return UWB_DW1000_OK;
        }
        if (chip->io.now_us(chip->io.context) > until_us) {
            chip->lock_unconfirmed = 1;
            return UWB_DW1000_OK;
        }
        chip->io.sleep(chip->io.context, 100);
    }
}

uwb_dw1000_status uwb_dw1000_start(uwb_dw1000 *chip, const uwb_dw1000_io *io, const uwb_dw1000_settings *settings) {
    memset(chip, 0, sizeof *chip);
    chip->io = *io;
    io->speed(io->context, 0);
    if (io->reset != NULL) {
        io->reset(io->context);
        io->sleep(io->context, RESET_SETTLE_US);
        DW1000_TRY(identify(chip));
    } else {
        DW1000_TRY(identify(chip));
        DW1000_TRY(soft_reset(chip));
    }
    DW1000_TRY(uwb_dw1000_set(chip, PMSC_CTRL0, 1, XTI));
    DW1000_TRY(uwb_dw1000_set(chip, EC_CTRL, 1, 4)); /* PLLLDT: makes CPLOCK valid */
    DW1000_TRY(read_otp_memory(chip));
    DW1000_TRY(load_leading_edge_detector(chip));
    DW1000_TRY(start_clock(chip));
    io->speed(io->context, 1);
    /* The chip sets this flag at a start: if it is set again, the chip was reset unexpectedly. */
    DW1000_TRY(uwb_dw1000_set(chip, SYS_STATUS, 4, SLP2INIT));
    DW1000_TRY(uwb_dw1000_configure(chip, settings != NULL ? settings : &uwb_dw1000_defaults));
    const uwb_dw1000_status status = uwb_dw1000_check(chip);
    return status == UWB_DW1000_RESTARTED && chip->lock_unconfirmed ? UWB_DW1000_NO_CLOCK : status;
}
