/* The part of the Arduino SPI library that the sketch uses, on a modelled chip. */
#ifndef SPI_H
#define SPI_H

#include "Arduino.h"

enum { MSBFIRST = 1, SPI_MODE0 = 0 };

struct SPISettings {
    SPISettings(uint32_t hz, int, int) : hz(hz) {}
    uint32_t hz;
};

struct StubSpi {
    void begin() {}
    void beginTransaction(const SPISettings &settings) { hz = settings.hz; }
    void endTransaction() {}
    void transfer(void *bytes, size_t count);
    uint32_t hz;
};

extern StubSpi SPI;

#endif
