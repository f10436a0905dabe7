#include "uwb_dw1000_registers.h"

enum { WRITE = 0x80, SUB_ADDRESS = 0x40, EXTENDED = 0x80 };

/* Encode the header of a transaction, 1 to 3 octets (User Manual, 2.2.1); returns its length. */
static size_t encode_header(uint32_t at, uint8_t write, uint8_t *header) {
    const uint32_t sub = at & 0xFFFFu;
    header[0] = (uint8_t)(write | at >> 16);
    if (sub == 0) {
        return 1;
    }
    header[0] |= SUB_ADDRESS;
    header[1] = (uint8_t)(sub & 0x7Fu);
    if (sub < 0x80u) {
        return 2;
    }
    header[1] |= EXTENDED;
    header[2] = (uint8_t)(sub >> 7);
    return 3;
}

uwb_dw1000_status uwb_dw1000_read(uwb_dw1000 *chip, uint32_t at, uint8_t *octets, size_t bytes) {
    uint8_t header[3];
    const size_t length = encode_header(at, 0, header);
    return chip->io.transfer(chip->io.context, header, length, NULL, octets, bytes) == 0 ? UWB_DW1000_OK
                                                                                         : UWB_DW1000_BUS;
}

uwb_dw1000_status uwb_dw1000_write(uwb_dw1000 *chip, uint32_t at, const uint8_t *octets, size_t bytes) {
    uint8_t header[3];
    const size_t length = encode_header(at, WRITE, header);
    return chip->io.transfer(chip->io.context, header, length, octets, NULL, bytes) == 0 ? UWB_DW1000_OK
                                                                                         : UWB_DW1000_BUS;
}

uint64_t uwb_dw1000_from_little_endian(const uint8_t *octets, size_t bytes) {
    uint64_t value = 0;
    while (bytes != 0) {
        value = value << 8 | octets[--bytes];
    }
    return value;
}

uwb_dw1000_status uwb_dw1000_get(uwb_dw1000 *chip, uint32_t at, size_t bytes, uint64_t *value) {
    uint8_t octets[8];
    DW1000_TRY(uwb_dw1000_read(chip, at, octets, bytes));
    *value = uwb_dw1000_from_little_endian(octets, bytes);
    return UWB_DW1000_OK;
}

uwb_dw1000_status uwb_dw1000_set(uwb_dw1000 *chip, uint32_t at, size_t bytes, uint64_t value) {
    uint8_t octets[8];
    for (size_t i = 0; i < bytes; i++) {
        octets[i] = (uint8_t)(value >> 8 * i);
    }
    return uwb_dw1000_write(chip, at, octets, bytes);
}

uwb_dw1000_status uwb_dw1000_write_list(uwb_dw1000 *chip, const uwb_dw1000_entry *entries) {
    for (; entries->bytes != 0; entries++) {
        DW1000_TRY(uwb_dw1000_set(chip, entries->at, entries->bytes, entries->value));
    }
    return UWB_DW1000_OK;
}
