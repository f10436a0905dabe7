#include <string.h>

#include "uwb_dw1000_registers.h"

enum {
    RESET_PULSE_SETTLES_US = 5000,
    SOFT_RESET_US = 20,
    LDE_LOAD_US = 300, /* the manual asks for 150 */
    CLOCK_LOCK_US = 5000,
    XTI = 1 /* SYSCLKS: the crystal, 19.2 MHz */
};

static const uint32_t DEVICE = 0xDECA0130u;

/* OTP memory, addresses of words. */
enum { OTP_EUI = 0, OTP_LDOTUNE = 4, OTP_PART = 6, OTP_VOLTAGE = 8, OTP_TEMPERATURE = 9, OTP_POWER = 0x10,
       OTP_ANTENNA_DELAY = 0x1C, OTP_XTAL_TRIM = 0x1E, TREK_REVISION_FIRST = 2, TREK_REVISION_LAST = 3 };
static const uint8_t otp_trek_delay[4] = {0x0D, 0x0E, 0x0F, 0x1D};

static uwb_dw1000_status soft_reset(uwb_dw1000 *chip) {
    /* User Manual, 7.2.50.1: on the crystal, with the sequencing and what would survive in the AON block switched off. */
    static const uwb_dw1000_entry before[] = {
        {PMSC_CTRL0, 1, XTI}, {PMSC_CTRL1, 2, 0}, {AON_WCFG, 2, 0}, {AON_CFG0, 1, 0},
        {AON_CTRL, 1, 0},     {AON_CTRL, 1, 2},   {PMSC_SOFTRESET, 1, 0}, {0, 0, 0},
    };
    DW1000_TRY(uwb_dw1000_set_all(chip, before));
    chip->io.sleep(chip->io.context, SOFT_RESET_US);
    DW1000_TRY(uwb_dw1000_set(chip, PMSC_SOFTRESET, 1, 0xF0));
    chip->io.sleep(chip->io.context, RESET_PULSE_SETTLES_US);
    return UWB_DW1000_OK;
}

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

/* One word of the OTP memory; on the crystal's clock only. */
static uwb_dw1000_status read_otp(uwb_dw1000 *chip, uint32_t address, uint32_t *word) {
    uint64_t value;
    const uwb_dw1000_entry steps[] = {{OTP_ADDR, 2, address}, {OTP_CTRL, 1, 3}, {OTP_CTRL, 1, 1}, {0, 0, 0}};
    DW1000_TRY(uwb_dw1000_set_all(chip, steps));
    DW1000_TRY(uwb_dw1000_get(chip, OTP_RDAT, 4, &value));
    *word = (uint32_t)value;
    return uwb_dw1000_set(chip, OTP_CTRL, 1, 0);
}

/* Memory that was never programmed reads as zeros, and on some modules as ones. */
static int programmed(uint64_t value, uint64_t ones) {
    return value != 0 && value != ones;
}

static uwb_dw1000_status read_memory(uwb_dw1000 *chip) {
    uint32_t eui[2], lot[2], word;
    for (uint32_t i = 0; i < 2; i++) {
        DW1000_TRY(read_otp(chip, OTP_EUI + i, &eui[i]));
        DW1000_TRY(read_otp(chip, OTP_PART + i, &lot[i]));
    }
    chip->eui = (uint64_t)eui[1] << 32 | eui[0];
    if (!programmed(chip->eui, UINT64_MAX)) {
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

/* Without its microcode the leading-edge detector gives no stamps (User Manual, 2.5.5.10). */
static uwb_dw1000_status load_leading_edge_detector(uwb_dw1000 *chip) {
    static const uwb_dw1000_entry begin[] = {
        {PMSC_CTRL0, 1, 0x01}, {PMSC_CTRL0 + 1, 1, 0x03}, {OTP_CTRL, 2, 0x8000}, {0, 0, 0}};
    DW1000_TRY(uwb_dw1000_set_all(chip, begin));
    chip->io.sleep(chip->io.context, LDE_LOAD_US);
    return UWB_DW1000_OK;
}

/* Give the clock back to the chip and wait until the PLL has locked. CPLOCK is not reliable (errata): without it the
 * start goes on, with a warning. */
static uwb_dw1000_status start_clock(uwb_dw1000 *chip) {
    static const uwb_dw1000_entry automatic[] = {
        {SYS_STATUS, 4, (uint32_t)CPLOCK}, {PMSC_CTRL0, 1, 0x00}, {PMSC_CTRL0 + 1, 1, 0x02}, {AON_CFG1, 2, 0},
        {0, 0, 0}};
    DW1000_TRY(uwb_dw1000_set_all(chip, automatic));
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
        io->sleep(io->context, RESET_PULSE_SETTLES_US);
        DW1000_TRY(identify(chip));
    } else {
        DW1000_TRY(identify(chip));
        DW1000_TRY(soft_reset(chip));
    }
    DW1000_TRY(uwb_dw1000_set(chip, PMSC_CTRL0, 1, XTI));
    DW1000_TRY(uwb_dw1000_set(chip, EC_CTRL, 1, 4)); /* PLLLDT: makes CPLOCK valid */
    DW1000_TRY(read_memory(chip));
    DW1000_TRY(load_leading_edge_detector(chip));
    DW1000_TRY(start_clock(chip));
    io->speed(io->context, 1);
    /* The chip's own mark of a start: seen again, it was reset behind our back. */
    DW1000_TRY(uwb_dw1000_set(chip, SYS_STATUS, 4, SLP2INIT));
    DW1000_TRY(uwb_dw1000_configure(chip, settings != NULL ? settings : &uwb_dw1000_usual));
    const uwb_dw1000_status status = uwb_dw1000_check(chip);
    return status == UWB_DW1000_RESTARTED && chip->lock_unconfirmed ? UWB_DW1000_NO_CLOCK : status;
}
