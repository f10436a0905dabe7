/* The part of the Arduino API and of the nRF52840's registers that the sketch uses, to compile and run it without a
 * board. The declarations are those of the Arduino core API; what a real core does may differ. */
#ifndef ARDUINO_H
#define ARDUINO_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum { LOW = 0, HIGH = 1, INPUT = 0, OUTPUT = 1, INPUT_PULLUP = 2, LED_BUILTIN = 13, LED_PWR = 25 };

/* A port whose two ends are memory. */
struct StubPort {
    const uint8_t *input;
    size_t input_left;
    uint8_t output[1 << 16];
    size_t output_count;
    size_t longest_write;
    int room;

    void begin(unsigned long) {}
    int available() { return (int)input_left; }
    int read() {
        input_left--;
        return *input++;
    }
    int availableForWrite() { return room; }
    size_t write(const uint8_t *bytes, size_t count);
    explicit operator bool() { return true; }
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
