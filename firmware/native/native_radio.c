/* A radio connected to a computer, with functions that are easy to call from another language. */
#include <math.h>
#include <stdlib.h>

#include "uwb_twr.h"

enum { MAX_SAMPLES = 1016 };

typedef struct {
    uwb_twr twr;
    uint64_t measurement[UWB_TWR_MEASUREMENT_BYTES(MAX_SAMPLES) / sizeof(uint64_t) + 1];
    float temperature;
    float voltage;
} native_radio;

void native_radio_free(native_radio *radio) {
    free(radio);
}

/* `settings`: a payload of SET_RADIO; the given times replace times of 0. Returns NULL if it is malformed, or if there is
 * not enough memory. */
native_radio *native_radio_new(const uwb_dw1000_io *io, const uint8_t *settings, size_t bytes, uint32_t reply_us,
                               uint32_t timeout_us, uint64_t random) {
    uwb_twr_config config;
    native_radio *const radio = calloc(1, sizeof *radio);
    if (radio == NULL || uwb_twr_read_settings(settings, bytes, reply_us, timeout_us, &config) != NULL) {
        native_radio_free(radio);
        return NULL;
    }
    radio->temperature = radio->voltage = NAN;
    uwb_twr_start(&radio->twr, io, &config, random, (uint8_t *)radio->measurement, sizeof radio->measurement);
    return radio;
}

/* Arguments as for native_radio_new. Returns NULL, or the reason why the settings are refused. */
const char *native_radio_configure(native_radio *radio, const uint8_t *settings, size_t bytes, uint32_t reply_us,
                                   uint32_t timeout_us) {
    uwb_twr_config config;
    const char *refusal = uwb_twr_read_settings(settings, bytes, reply_us, timeout_us, &config);
    refusal = refusal != NULL ? refusal : uwb_twr_config_error(&radio->twr, &config);
    if (refusal == NULL) {
        (void)uwb_twr_configure(&radio->twr, &config);
    }
    return refusal;
}

/* Returns a uwb_twr_event. */
int native_radio_exchange(native_radio *radio, uint64_t until_us) {
    return (int)uwb_twr_step(&radio->twr, until_us);
}

/* Measurement of the last exchange: a payload of RANGE_CIR. */
const uint8_t *native_radio_measurement(const native_radio *radio, size_t *bytes, uint64_t *measured_us) {
    *bytes = uwb_twr_measurement_bytes(&radio->twr);
    *measured_us = radio->twr.measured_us;
    return radio->twr.measurement;
}

/* Active address; 0 until the chip has started. */
uint64_t native_radio_address(const native_radio *radio) {
    return radio->twr.address;
}

/* Writes a payload of RADIO, at most UWB_TWR_SETTINGS_BYTES; returns its bytes. */
size_t native_radio_settings(const native_radio *radio, uint8_t *payload) {
    return uwb_twr_write_settings(&radio->twr, NULL, payload);
}

/* Writes a payload of RADIO_STATUS, at most UWB_TWR_STATUS_BYTES; returns its bytes. */
size_t native_radio_status(const native_radio *radio, uint8_t *payload) {
    return uwb_twr_write_status(&radio->twr, radio->temperature, radio->voltage, payload);
}

/* Measures temperature and voltage for the status. Call between two exchanges; returns a uwb_dw1000_status. */
int native_radio_sensors(native_radio *radio) {
    if (!radio->twr.running) {
        return UWB_DW1000_ABSENT;
    }
    const uwb_dw1000_status idle = uwb_dw1000_idle(&radio->twr.chip);
    return (int)(idle != UWB_DW1000_OK
                     ? idle
                     : uwb_dw1000_read_sensors(&radio->twr.chip, &radio->temperature, &radio->voltage));
}
