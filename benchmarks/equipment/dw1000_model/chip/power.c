/* Commands, resets, clocks, OTP memory, LDE microcode, sensors: the effects of writes to SYS_CTRL, PMSC, OTP_IF, TX_CAL. */
#include <math.h>
#include <string.h>

#include "model.h"

#define SLOW_SPI_HZ 3000000u
#define FAST_SPI_HZ 20000000u
#define LDE_LOAD_US 120.0 /* the manual requires 150; Decawave's driver waits for this time */
#define LOCK_US 5.0
#define RESET_PULSE_S 1e-3
#define CRYSTAL_START_US 1000.0 /* start-up time of the crystal after RSTn */
#define SENSORS_XTI_US 2.5
#define SENSORS_PLL_US 1000.0

enum { SYSCLKS_AUTO = 0, SYSCLKS_XTI = 1 };
#define LDE_CLOCKS 0x0301u
#define LDE_CLOCKS_MASK 0x0303u /* SYSCLKS, and the two bits for the loading in the manual */
#define ACCESS_OTP 0x3u
#define READ_OTP 0x2u
#define LDE_LOAD 0x8000u

static unsigned system_clock(const dw1000_chip *chip) {
    return (unsigned)dw1000_get(chip, PMSC, PMSC_CTRL0, 1) & 3u;
}

bool dw1000_spi_works(dw1000_chip *chip, uint32_t hz) {
    if (chip->fault != NULL || chip->power < POWER_INIT) {
        return false;
    }
    return hz <= (chip->power == POWER_IDLE ? FAST_SPI_HZ : SLOW_SPI_HZ);
}

/* While the crystal is the clock, writes to PMSC work at full SPI speed: drivers use them to reset chips. Reads return
 * random data, and writes to other registers are lost. */
bool dw1000_accepts_pmsc_writes(const dw1000_chip *chip, uint32_t hz) {
    return chip->fault == NULL && chip->power == POWER_INIT && hz <= FAST_SPI_HZ;
}

static void pll_locked(dw1000_chip *chip, transmission *unused) {
    (void)unused;
    chip->power = POWER_IDLE;
    dw1000_raise_status(chip, ST_CPLOCK);
}

static void update_clock(dw1000_chip *chip) {
    if (chip->power < POWER_INIT || chip->in_reset) {
        return;
    }
    if (system_clock(chip) == SYSCLKS_XTI) {
        dw1000_cancel(chip, GROUP_POWER);
        chip->power = POWER_INIT;
    } else if (chip->power == POWER_INIT) {
        dw1000_cancel(chip, GROUP_POWER);
        dw1000_schedule(chip, GROUP_POWER, chip->air->now + MICROSECONDS(LOCK_US), pll_locked, NULL);
    }
}

static void enter_init(dw1000_chip *chip, transmission *unused) {
    (void)unused;
    chip->power = POWER_INIT;
    dw1000_raise_status(chip, ST_SLP2INIT);
    update_clock(chip);
}

static void stop_all(dw1000_chip *chip) {
    dw1000_stop_transmitter(chip);
    dw1000_stop_receiver(chip);
    dw1000_cancel(chip, GROUP_LATE);
    dw1000_cancel(chip, GROUP_POWER);
    dw1000_cancel(chip, GROUP_LOAD);
    dw1000_cancel(chip, GROUP_SENSORS);
}

static void reset_chip(dw1000_chip *chip, instant until_init) {
    stop_all(chip);
    dw1000_reset_registers(chip);
    chip->status = 0;
    chip->lde_loaded = chip->in_reset = chip->rx_in_reset = chip->needs_rx_reset = false;
    dw1000_update_line(chip);
    chip->power = POWER_WAKEUP;
    if (until_init > 0) {
        dw1000_schedule(chip, GROUP_POWER, chip->air->now + until_init, enter_init, NULL);
    } else {
        enter_init(chip, NULL);
    }
}

void dw1000_reset_drive(dw1000_chip *chip, dw1000_reset_level level) {
    if (level == DW1000_RESET_HIGH) {
        chip->fault = "RSTn driven high against the chip's own output: pull it low, then let it float";
        stop_all(chip);
        dw1000_reset_registers(chip);
        chip->status = 0;
        chip->power = POWER_WAKEUP;
        dw1000_update_line(chip);
    } else if (level == DW1000_RESET_LOW) {
        reset_chip(chip, MICROSECONDS(CRYSTAL_START_US));
        dw1000_cancel(chip, GROUP_POWER);
    } else if (chip->power == POWER_WAKEUP && chip->fault == NULL) {
        dw1000_cancel(chip, GROUP_POWER);
        dw1000_schedule(chip, GROUP_POWER, chip->air->now + MICROSECONDS(CRYSTAL_START_US), enter_init, NULL);
    }
}

void dw1000_reset_pin(dw1000_chip *chip) {
    dw1000_reset_drive(chip, DW1000_RESET_LOW);
    dw1000_delay(chip, RESET_PULSE_S);
    dw1000_reset_drive(chip, DW1000_RESET_FLOAT);
}

const char *dw1000_fault(const dw1000_chip *chip) {
    return chip->fault;
}

/* Apply a write to PMSC_CTRL0: resets and clocks. */
static void handle_pmsc_write(dw1000_chip *chip, bool whole_reset_octet) {
    const uint32_t clocks = (uint32_t)dw1000_get(chip, PMSC, PMSC_CTRL0, 4);
    if (whole_reset_octet) {
        const unsigned lines = clocks >> 28;
        if (lines == 0 && !chip->in_reset) {
            reset_chip(chip, 0);
            dw1000_cancel(chip, GROUP_POWER);
            chip->power = POWER_INIT;
            chip->in_reset = true;
            dw1000_put(chip, PMSC, PMSC_CTRL0 + 3, 1, clocks >> 24);
            return;
        }
        if (chip->in_reset && lines == 0xF) {
            chip->in_reset = false;
        }
        const bool held = (lines & 1) == 0;
        if (held) {
            dw1000_stop_receiver(chip);
            chip->needs_rx_reset = false;
        }
        chip->rx_in_reset = held;
    }
    if ((clocks & LDE_CLOCKS_MASK) != LDE_CLOCKS) {
        dw1000_cancel(chip, GROUP_LOAD); /* too early: the microcode is not loaded */
    }
    update_clock(chip);
}

static void microcode_loaded(dw1000_chip *chip, transmission *unused) {
    (void)unused;
    chip->lde_loaded = true;
    dw1000_put(chip, OTP_IF, OTP_CTRL, 2, dw1000_get(chip, OTP_IF, OTP_CTRL, 2) & ~LDE_LOAD);
}

static void handle_otp_write(dw1000_chip *chip) {
    const unsigned command = (unsigned)dw1000_get(chip, OTP_IF, OTP_CTRL, 2);
    const unsigned clocks = (unsigned)dw1000_get(chip, PMSC, PMSC_CTRL0, 2);
    if (command & LDE_LOAD) {
        chip->lde_loaded = false;
        dw1000_cancel(chip, GROUP_LOAD);
        if ((clocks & LDE_CLOCKS_MASK) == LDE_CLOCKS) {
            dw1000_schedule(chip, GROUP_LOAD, chip->air->now + MICROSECONDS(LDE_LOAD_US), microcode_loaded, NULL);
        }
    }
    if ((command & ACCESS_OTP) == ACCESS_OTP) {
        const unsigned at = (unsigned)dw1000_get(chip, OTP_IF, OTP_ADDR, 2) & 0x7FF;
        uint32_t value = at < sizeof chip->otp / sizeof *chip->otp ? chip->otp[at] : 0;
        if (system_clock(chip) != SYSCLKS_XTI) {
            value = (uint32_t)dw1000_random_bits(chip->air->seed ^ (uint64_t)chip->air->now, at);
        }
        dw1000_put(chip, OTP_IF, OTP_RDAT, 4, value);
        dw1000_put(chip, OTP_IF, OTP_CTRL, 2, command & ~READ_OTP); /* the bit clears itself */
    }
}

static uint64_t to_octet(double value) {
    return (uint64_t)fmax(0.0, fmin(255.0, rint(value)));
}

/* Voltage and temperature, an octet each. */
static void write_sensor_values(dw1000_chip *chip, unsigned sub) {
    const double at_3v3 = chip->otp[8] & 0xFF, at_23c = chip->otp[9] & 0xFF;
    dw1000_put(chip, TX_CAL, sub, 1, to_octet(at_3v3 + (chip->volts - 3.3) * 173.0));
    dw1000_put(chip, TX_CAL, sub + 1, 1, to_octet(at_23c + (chip->celsius - 23.0) / 1.14));
}

void dw1000_set_environment(dw1000_chip *chip, double celsius, double volts) {
    chip->celsius = celsius;
    chip->volts = volts;
}

static void sensors_ready(dw1000_chip *chip, transmission *unused) {
    (void)unused;
    write_sensor_values(chip, TC_SARL);
}

/* The manual's 2.5 us are not enough while the PLL clocks the chip: Decawave's driver waits for 1 ms. */
static void handle_sensor_write(dw1000_chip *chip) {
    const bool on = dw1000_get(chip, RF_CONF, RF_SAR_BIAS, 1) == 0x80 &&
                    dw1000_get(chip, RF_CONF, RF_SAR_SWITCH, 1) == 0x0F;
    if (on && (dw1000_get(chip, TX_CAL, TC_SARC, 1) & 1)) {
        const double takes_us = chip->power == POWER_IDLE ? SENSORS_PLL_US : SENSORS_XTI_US;
        dw1000_schedule(chip, GROUP_SENSORS, chip->air->now + MICROSECONDS(takes_us), sensors_ready, NULL);
    }
}

static bool overlaps_register(unsigned sub, size_t count, unsigned at, unsigned octets) {
    return sub < at + octets && at < sub + count;
}

void dw1000_handle_register_write(dw1000_chip *chip, unsigned file, unsigned sub, size_t count) {
    if (file == PMSC && overlaps_register(sub, count, PMSC_CTRL0, 4)) {
        handle_pmsc_write(chip, overlaps_register(sub, count, PMSC_CTRL0 + 3, 1));
    } else if (file == OTP_IF && overlaps_register(sub, count, OTP_CTRL, 2)) {
        handle_otp_write(chip);
    } else if (file == TX_CAL && overlaps_register(sub, count, TC_SARC, 1)) {
        handle_sensor_write(chip);
    }
}

void dw1000_program_otp(dw1000_chip *chip, unsigned address, uint32_t word) {
    if (address < sizeof chip->otp / sizeof *chip->otp) {
        chip->otp[address] = word;
    }
}

void dw1000_fill_otp(dw1000_chip *chip) {
    static const uint32_t POWERS[] = {0x15355575, 0x07274767, 0x15355575, 0x07274767, 0x0F2F4F6F, 0x2B4B6B8B,
                                      0x1F1F3F5F, 0x3A5A7A9A, 0x0E082848, 0x25456585, 0x32527292, 0x5171B1D1};
    const uint32_t delay = (uint32_t)chip->tx_delay + chip->rx_delay;
    const uint32_t number = (uint32_t)chip->index + 1;
    chip->otp[0x00] = 0x00000000u | number;
    chip->otp[0x01] = 0xDECA0100u | (uint32_t)(dw1000_random_bits(chip->air->seed, number) & 0xFF);
    chip->otp[0x04] = 0x88888828;
    chip->otp[0x05] = 0x00000088;
    chip->otp[0x06] = 0x10000000u | number;
    chip->otp[0x07] = 0x00020000u | number;
    chip->otp[0x08] = 0x80;
    chip->otp[0x09] = 0x78;
    memcpy(&chip->otp[0x10], POWERS, sizeof POWERS);
    if (delay <= 0xFFFF) {
        chip->otp[0x1C] = delay << 16 | delay;
    }
    chip->otp[0x1E] = 0x0110;
}

/* Handle one write to SYS_CTRL; octets that were not written are 0. */
void dw1000_handle_sys_ctrl(dw1000_chip *chip, uint32_t command) {
    if (command & CTRL_TRXOFF) {
        dw1000_schedule_late_event(chip);
        dw1000_stop_transmitter(chip);
        dw1000_stop_receiver(chip);
        dw1000_clear_status(chip, ST_HPDWARN | ST_TXPUTE);
        return; /* TXSTRT in the same write does not transmit */
    }
    if (chip->power != POWER_IDLE) {
        return;
    }
    if ((command & CTRL_TXSTRT) && chip->tx == TX_OFF && chip->rx == RX_OFF) {
        dw1000_start_transmission(chip, command);
    }
    if (!(command & CTRL_RXENAB) || chip->rx != RX_OFF) {
        return;
    }
    if (chip->tx != TX_OFF) {
        chip->wait_for_response = true; /* after the frame */
    } else {
        dw1000_enable_receiver(chip, chip->air->now);
    }
}
