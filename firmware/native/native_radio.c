/* A radio connected to a computer, with functions that are easy to call from another language. */
#include <stdlib.h>

#include "uwb_twr.h"

enum { MAX_SAMPLES = 1016 };

typedef struct {
    uwb_twr twr;
    uint64_t measurement[UWB_TWR_MEASUREMENT_BYTES(MAX_SAMPLES) / sizeof(uint64_t) + 1];
} native_radio;

/* Returns NULL if there is not enough memory. */
native_radio *native_radio_new(const uwb_dw1000_io *io, const uwb_twr_config *config, uint64_t random) {
    native_radio *const radio = calloc(1, sizeof *radio);
    if (radio != NULL) {
        uwb_twr_start(&radio->twr, io, config, random, (uint8_t *)radio->measurement, sizeof radio->measurement);
    }
    return radio;
}

void native_radio_free(native_radio *radio) {
    free(radio);
}

/* Returns NULL, or the reason why the configuration is refused. */
const char *native_radio_configure(native_radio *radio, const uwb_twr_config *config) {
    const char *const refusal = uwb_twr_config_error(&radio->twr, config);
    (void)uwb_twr_configure(&radio->twr, config);
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

/* Returns a UWB_RADIO_STATE_*. */
int native_radio_state(const native_radio *radio) {
    return uwb_twr_state(&radio->twr);
}

/* Active address; 0 until the chip has started. */
uint64_t native_radio_address(const native_radio *radio) {
    return radio->twr.address;
}

const uwb_dw1000_settings *native_radio_settings(const native_radio *radio) {
    return radio->twr.running ? &radio->twr.chip.settings : &radio->twr.config.radio;
}

const uwb_twr_counts *native_radio_counts(const native_radio *radio) {
    return &radio->twr.counts;
}

const uwb_twr_anchor *native_radio_anchors(const native_radio *radio, size_t *count) {
    *count = radio->twr.known;
    return radio->twr.anchors;
}

/* Call between two exchanges; returns a uwb_dw1000_status. */
int native_radio_sensors(native_radio *radio, float *temperature, float *voltage) {
    if (!radio->twr.running) {
        return UWB_DW1000_ABSENT;
    }
    const uwb_dw1000_status idle = uwb_dw1000_idle(&radio->twr.chip);
    return (int)(idle != UWB_DW1000_OK ? idle : uwb_dw1000_read_sensors(&radio->twr.chip, temperature, voltage));
}
