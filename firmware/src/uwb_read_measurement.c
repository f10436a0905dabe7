#include <string.h>

#include "uwb_link.h"

static const uint64_t DEVICE_TIME_WRAP = (uint64_t)1 << 40;

int uwb_read_measurement(const uint8_t *payload, size_t payload_bytes, uwb_range_cir_t *fields, uwb_cir *cir) {
    if (payload_bytes < sizeof *fields) {
        return 0;
    }
    memcpy(fields, payload, sizeof *fields);
    const size_t offset = fields->samples_offset;
    const size_t count = fields->sample_count;
    if (fields->device_time >= DEVICE_TIME_WRAP || count > UWB_MAX_SAMPLES || offset < sizeof *fields ||
        offset % 2 != 0 || offset + 2 * count > payload_bytes || fields->encoding > UWB_MAGNITUDE) {
        return 0;
    }
    cir->samples = (const int16_t *)(const void *)(payload + offset);
    cir->count = count;
    cir->encoding = fields->encoding == UWB_MAGNITUDE ? UWB_MAGNITUDE : UWB_COMPLEX_INT16;
    cir->start_index = fields->start_index;
    cir->first_path_index = fields->first_path_index;
    cir->scale = fields->scale;
    cir->preamble_count = fields->preamble_count;
    cir->rx_power_dbm = fields->rx_power;
    cir->first_path_power_dbm = fields->first_path_power;
    return 1;
}
