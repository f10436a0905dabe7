/* The part of the Arduino API and of the nRF52840's registers that the sketches use, to compile and run them without a
 * board. The ports behave as those of the core "Arduino Mbed OS Boards" on the Nano 33 BLE. */
#ifndef ARDUINO_H
#define ARDUINO_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum { LOW = 0, HIGH = 1, INPUT = 0, OUTPUT = 1, INPUT_PULLUP = 2, LED_BUILTIN = 13, LED_PWR = 25 };

/* Serial (USB) and Serial1. Received bytes are lost if the ring is full. */
struct StubPort {
    static const size_t RING_BYTES = 256;
    bool is_usb;
    uint8_t ring[RING_BYTES];
    size_t first, used;
    size_t overrun;

    void begin(unsigned long) {}
    int available() { return (int)used; }
    int read();
    int availableForWrite() { return 0; }              /* Print's: no port of this core overrides it */
    size_t write(const uint8_t *bytes, size_t count);  /* USB: 0 without a terminal; else waits until it has read */
    operator bool();                                   /* USB: sleeps for 1 ms */
    void put(uint8_t byte);
};

struct StubWatchdog {
    volatile uint32_t CONFIG, CRV, RREN, TASKS_START, RR[8];
};
struct StubFactory {
    volatile uint32_t DEVICEID[2];
};
struct StubRandom {
    volatile uint32_t TASKS_START, TASKS_STOP, EVENTS_VALRDY, VALUE;
};

extern StubPort Serial, Serial1;
extern StubWatchdog *NRF_WDT;
extern StubFactory *NRF_FICR;
extern StubRandom *NRF_RNG;

void pinMode(int pin, int mode);
void digitalWrite(int pin, int level);
int digitalRead(int pin);
uint32_t micros();
void setup();
void loop();

#endif
