/* The part of the Arduino API and of the nRF52840's registers that the sketches use, to compile and run them without a
 * board. The ports behave as those of the core "Arduino Mbed OS Boards" on the Nano 33 BLE. */
#ifndef ARDUINO_H
#define ARDUINO_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum { LOW = 0, HIGH = 1, INPUT = 0, OUTPUT = 1, INPUT_PULLUP = 2, LED_BUILTIN = 13, LEDB = 24, LED_PWR = 25,
       PIN_SERIAL_RX = 1 };

/* Serial (USB). Received bytes are lost if the ring is full. */
struct StubPort {
    static const size_t RING_BYTES = 256;
    uint8_t ring[RING_BYTES];
    size_t first, used;

    void begin(unsigned long) {}
    int available() { return (int)used; }
    int read();
    int availableForWrite() { return 0; }             /* Print's: no port of this core overrides it */
    size_t write(const uint8_t *bytes, size_t count); /* 0 without a terminal; else waits until it has read */
    operator bool();                                  /* sleeps for 1 ms */
};

/* Registers that act when they are written. */
struct StubTask {
    void (*act)();
    void operator=(uint32_t) { act(); }
};
struct StubSet {
    uint32_t bits;
    void operator=(uint32_t mask) { bits |= mask; }
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
struct StubFlash {
    volatile uint32_t ICACHECNF;
};
struct StubTimer {
    volatile uint32_t MODE, TASKS_START, TASKS_COUNT, TASKS_CLEAR, CC[1];
    StubTask TASKS_CAPTURE[1];
};
struct StubPpi {
    struct {
        volatile uint32_t EEP, TEP;
    } CH[20];
    StubSet CHENSET;
};
struct StubUart {
    volatile uint32_t TASKS_STARTRX, EVENTS_RXDRDY, EVENTS_ENDRX, EVENTS_RXSTARTED, SHORTS, ENABLE, BAUDRATE;
    struct {
        volatile uint32_t RXD;
    } PSEL;
    struct {
        volatile uint32_t PTR, MAXCNT;
    } RXD;
};
enum : uint32_t {
    UARTE_BAUDRATE_BAUDRATE_Baud921600 = 0x0F000000,
    UARTE_SHORTS_ENDRX_STARTRX_Msk = 32,
    UARTE_ENABLE_ENABLE_Enabled = 8
};

extern StubPort Serial;
extern StubWatchdog *NRF_WDT;
extern StubFactory *NRF_FICR;
extern StubRandom *NRF_RNG;
extern StubFlash *NRF_NVMC;
extern StubTimer *NRF_TIMER4;
extern StubPpi *NRF_PPI;
extern StubUart *NRF_UARTE1;

int digitalPinToPinName(int pin);
void pinMode(int pin, int mode);
void digitalWrite(int pin, int level);
int digitalRead(int pin);
uint32_t micros();
void setup();
void loop();

#endif
