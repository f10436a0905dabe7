/* How the air is used: channel, pulse rate, code, SFD, as the registers set them. */
#include "model.h"

instant dw1000_symbol_units(unsigned prf) {
    return (prf == 2 ? 65024 : 63488) * UNITS_PER_TICK;
}

unsigned dw1000_acquisition_chunk(const dw1000_chip *chip) {
    return 8u << (((unsigned)dw1000_get(chip, DRX_CONF, DRX_TUNE2, 4) >> 25) & 3u);
}

double dw1000_carrier_hz(unsigned channel) {
    static const double HZ[] = {0, 3494.4e6, 3993.6e6, 4492.8e6, 3993.6e6, 6489.6e6, 0, 6489.6e6};
    return channel < sizeof HZ / sizeof *HZ && HZ[channel] > 0 ? HZ[channel] : 6489.6e6;
}

static bool tuned(const dw1000_chip *chip, unsigned channel) {
    static const uint32_t PLL[] = {0,          0x09000407, 0x08400508, 0x08401009,
                                   0x08400508, 0x0800041D, 0,          0x0800041D};
    return channel < sizeof PLL / sizeof *PLL && PLL[channel] != 0 &&
           dw1000_get(chip, FS_CTRL, FS_PLLCFG, 4) == PLL[channel];
}

static void choose_sfd(const dw1000_chip *chip, air_interface *mode, bool decawave, bool user) {
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
    air_interface mode = {channel & 15, frame >> 16 & 3, channel >> 22 & 31, false, 8, false, false};
    mode.tuned = tuned(chip, mode.channel);
    mode.slow = (frame >> 13 & 3) == 0;
    choose_sfd(chip, &mode, channel >> 17 & 1, channel >> 20 & 1);
    return mode;
}

air_interface dw1000_receive_mode(const dw1000_chip *chip) {
    const uint32_t channel = (uint32_t)dw1000_get(chip, CHAN_CTRL, 0, 4);
    air_interface mode = {channel >> 4 & 15, channel >> 18 & 3, channel >> 27, false, 8, false, false};
    mode.tuned = tuned(chip, mode.channel);
    mode.slow = (dw1000_get(chip, SYS_CFG, 0, 4) & CFG_RXM110K) != 0;
    choose_sfd(chip, &mode, channel >> 17 & 1, channel >> 21 & 1);
    return mode;
}
