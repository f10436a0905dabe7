/* The USB port as the core's own class: packets of 64 bytes, one in transfer. */
#ifndef PLUGGABLE_USB_SERIAL_H
#define PLUGGABLE_USB_SERIAL_H

#include "../Arduino.h"

struct StubUsb {
    bool connected();
    void send_nb(uint8_t *bytes, uint32_t count, uint32_t *accepted, bool now = true);
};

extern StubUsb _SerialUSB;

#endif
