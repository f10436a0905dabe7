#include <math.h>

#include "uwb_dw1000_registers.h"

/* PMSC_CTRL0: FACE and RXCLKS in the first octet; AMCE and the value after the start in the second. */
enum { RX_CLOCK_PLL = 0x48, AMCE = 0x80, CTRL0_DEFAULT = 0x02 };

/* The 2.5 us of the manual are too short while the PLL clocks the chip. */
enum { SENSORS_US = 1000 };

/* Symbols of the SFD that RXPACC contains if it is not saturated (User Manual, table 18). */
static uint16_t sfd_preamble_count(const uwb_dw1000_settings *settings) {
    switch (uwb_dw1000_sfd_symbols(settings)) {
    case 8:
        return settings->decawave_sfd ? 10 : 5;
    case 16:
        return 18;
    default:
        return settings->decawave_sfd ? 82 : 64;
    }
}

uwb_dw1000_status uwb_dw1000_read_quality(uwb_dw1000 *chip, const uwb_dw1000_frame *frame,
                                          uwb_dw1000_quality *quality) {
    uint8_t fqual[8];
    uint64_t threshold, unsaturated;
    DW1000_TRY(uwb_dw1000_read(chip, RX_FQUAL, fqual, sizeof fqual));
    DW1000_TRY(uwb_dw1000_get(chip, LDE_THRESH, 2, &threshold));
    DW1000_TRY(uwb_dw1000_get(chip, RXPACC_NOSAT, 2, &unsaturated));
    quality->first_path_amplitude[0] = frame->first_path_amplitude;
    quality->first_path_amplitude[1] = (uint16_t)uwb_dw1000_from_little_endian(fqual + 2, 2);
    quality->first_path_amplitude[2] = (uint16_t)uwb_dw1000_from_little_endian(fqual + 4, 2);
    quality->power = (uint16_t)uwb_dw1000_from_little_endian(fqual + 6, 2);
    quality->noise_threshold = (uint16_t)threshold;

    const uint16_t sfd = sfd_preamble_count(&chip->settings);
    uint16_t count = frame->preamble_count;
    if (count == unsaturated && count > sfd) {
        count = (uint16_t)(count - sfd);
    }
    quality->preamble_count = count;
    const float reference_db = chip->settings.prf_mhz == 16 ? 113.77f : 121.74f;
    const float squared = (float)count * (float)count;
    float first = 0;
    for (int i = 0; i < 3; i++) {
        first += (float)quality->first_path_amplitude[i] * (float)quality->first_path_amplitude[i];
    }
    quality->rx_power_dbm =
        count != 0 && quality->power != 0 ? 10 * log10f((float)quality->power * 131072.0f / squared) - reference_db : NAN;
    quality->first_path_power_dbm = count != 0 && first > 0 ? 10 * log10f(first / squared) - reference_db : NAN;
    return UWB_DW1000_OK;
}

uwb_dw1000_status uwb_dw1000_read_cir(uwb_dw1000 *chip, size_t first, size_t count, uint8_t *octets) {
    const size_t samples = UWB_DW1000_SAMPLES(chip->settings.prf_mhz);
    if (count > samples || first > samples - count) {
        return UWB_DW1000_BAD_ARGUMENT;
    }
    /* Written octet by octet, because the chip may hang if both change together. Without these clocks the accumulator reads
     * as zeros or noise. */
    static const uwb_dw1000_entry on[] = {
        {PMSC_CTRL0, 1, RX_CLOCK_PLL}, {PMSC_CTRL0 + 1, 1, CTRL0_DEFAULT | AMCE}, {0, 0, 0}};
    static const uwb_dw1000_entry off[] = {{PMSC_CTRL0, 1, 0}, {PMSC_CTRL0 + 1, 1, CTRL0_DEFAULT}, {0, 0, 0}};
    DW1000_TRY(uwb_dw1000_write_list(chip, on));
    DW1000_TRY(uwb_dw1000_read(chip, ACC_MEM | (uint32_t)(4 * first), octets, 1 + 4 * count));
    return uwb_dw1000_write_list(chip, off);
}

uwb_dw1000_status uwb_dw1000_read_sensors(uwb_dw1000 *chip, float *temperature, float *voltage) {
    static const uwb_dw1000_entry entries[] = {
        {RF_SENSOR_1, 1, 0x80}, {RF_SENSOR_2, 1, 0x0A}, {RF_SENSOR_2, 1, 0x0F}, {TC_SARC, 1, 1}, {0, 0, 0}};
    uint8_t raw[2];
    DW1000_TRY(uwb_dw1000_write_list(chip, entries));
    chip->io.sleep(chip->io.context, SENSORS_US);
    DW1000_TRY(uwb_dw1000_read(chip, TC_SARL, raw, sizeof raw));
    DW1000_TRY(uwb_dw1000_set(chip, TC_SARC, 1, 0));
    *voltage = 3.3f + (float)(raw[0] - chip->otp_voltage) / 173.0f;
    *temperature = 23.0f + 1.14f * (float)(raw[1] - chip->otp_temperature);
    return UWB_DW1000_OK;
}

float uwb_dw1000_true_power_dbm(float rx_power_dbm, uint8_t prf_mhz) {
    const float over = rx_power_dbm + 88;
    const float slope = prf_mhz == 16 ? 2.3334f : 1.1667f;
    return over <= 0 ? rx_power_dbm : rx_power_dbm + over * slope;
}

float uwb_dw1000_range_bias_m(float true_power_dbm, uint8_t channel, uint8_t prf_mhz) {
    /* From -61 dBm in steps of -2 dB; mm for channels 500 MHz wide, 2 mm for those of 900 MHz. */
    static const int16_t bias[2][2][18] = {
        {{-198, -187, -179, -163, -143, -127, -109, -84, -59, -31, 0, 36, 65, 84, 97, 106, 110, 112},
         {-110, -105, -100, -93, -82, -69, -51, -27, 0, 21, 35, 42, 49, 62, 71, 76, 81, 86}},
        {{-137, -122, -105, -88, -69, -47, -25, 0, 21, 48, 79, 105, 127, 147, 160, 169, 178, 197},
         {-147, -133, -117, -99, -75, -50, -29, 0, 24, 45, 63, 76, 87, 98, 116, 122, 132, 142}},
    };
    const int wide = channel == 4 || channel == 7;
    const int16_t *const row = bias[wide][prf_mhz == 64];
    float position = (true_power_dbm + 61) * -0.5f;
    position = position > 0 ? position : 0; /* 0 for NaN */
    position = position < 17 ? position : 17;
    const int below = position < 16 ? (int)position : 16;
    const float mm = (float)row[below] + (position - (float)below) * (float)(row[below + 1] - row[below]);
    return mm * (wide ? 0.002f : 0.001f);
}
