/* Arduino Nano 33 BLE (nRF52840, core "Arduino Mbed OS Boards"): clock, watchdog, random numbers, serial ports. For one
 * sketch file; the library does not use it. Everything that is peculiar to this core is here. */
#ifndef UWB_NANO33BLE_H
#define UWB_NANO33BLE_H

#include <Arduino.h>
#include <USB/PluggableUSBSerial.h>
#include <drivers/Ticker.h>

#include "uwb_frame_ring.h"
#include "uwb_link.h"

namespace nano33ble {

/* One byte less than a USB packet: a transfer of full packets would have to end with an empty one. */
static const size_t SEND_BYTES = 63;
/* A started watchdog runs on while the boot loader writes the next sketch, and the boot loader does not feed it. The
 * largest sketch takes about 40 s; the next sketch may be reset once. */
static const uint32_t WATCHDOG_S = 60;

/* micros() wraps after 71 minutes; loop() calls this far more often. Not for interrupts. */
static inline uint64_t uptime_us() {
    static uint64_t wraps;
    static uint32_t last;
    const uint32_t now = micros();
    if (now < last) {
        wraps += (uint64_t)1 << 32;
    }
    last = now;
    return wraps + now;
}

static inline uint32_t clock_us() {
    return micros();
}

static inline uint64_t board_id() {
    return (uint64_t)NRF_FICR->DEVICEID[1] << 32 | NRF_FICR->DEVICEID[0];
}

static inline uint64_t random_number() {
    uint64_t value = 0;
    NRF_RNG->TASKS_START = 1;
    for (int i = 0; i < 8; i++) {
        NRF_RNG->EVENTS_VALRDY = 0;
        for (int tries = 0; tries < 100000 && NRF_RNG->EVENTS_VALRDY == 0; tries++) {
        }
        value = value << 8 | (NRF_RNG->VALUE & 0xFFu);
    }
    NRF_RNG->TASKS_STOP = 1;
    return value;
}

/* Code runs from flash with wait states unless the instruction cache is enabled, and the core does not enable it. */
static inline void enable_cache() {
    NRF_NVMC->ICACHECNF = 1;
}

/* nRF52840 product specification, section 6.36: once started it cannot be stopped, and resets a board that hangs. */
static inline void start_watchdog() {
    NRF_WDT->CONFIG = 1; /* also while asleep */
    NRF_WDT->CRV = 32768u * WATCHDOG_S - 1u;
    NRF_WDT->RREN = 1;
    NRF_WDT->TASKS_START = 1;
}

static inline void feed_watchdog() {
    NRF_WDT->RR[0] = 0x6E524635u;
}

/* Return whether the host has the port open. `(bool)Serial` is the same, but it sleeps for 1 ms. */
static inline bool host_connected() {
    return _SerialUSB.connected();
}

/* Read the bytes from the host without blocking. */
static inline size_t read_host(uint8_t *bytes, size_t limit) {
    size_t count = 0;
    while (count < limit && Serial.available() > 0) {
        bytes[count++] = (uint8_t)Serial.read();
    }
    return count;
}

/* Send queued frames for at most `limit_us`; 0 = at most one packet, without waiting.
 *
 * Serial.availableForWrite() is always 0 in this core, and Serial.write() waits without limit for a host that has the
 * port open and does not read: the watchdog would fire. send_nb() accepts a packet if the previous one was read, and
 * returns at once in any case. After a packet that was not read, the next calls do not wait until the host reads again.
 * When the host closes the port the core discards the packet in transfer: the frame starts again. Nothing shows that the
 * host has closed and opened it between two calls: then it gets the rest of a frame, which its decoder rejects. */
static inline void send_to_host(uwb_queue *queue, uint32_t limit_us) {
    static bool host_reads;
    if (!host_connected()) {
        uwb_queue_restart(queue);
        return;
    }
    const uint32_t began_us = micros();
    uint32_t accepted;
    do {
        const uint8_t *waiting;
        const size_t length = uwb_queue_peek(queue, uptime_us(), &waiting);
        if (length == 0) {
            return;
        }
        accepted = 0;
        /* The core copies the bytes; its parameter is not const. */
        _SerialUSB.send_nb(const_cast<uint8_t *>(waiting), length < SEND_BYTES ? length : SEND_BYTES, &accepted, true);
        uwb_queue_drop(queue, accepted);
        host_reads = host_reads || accepted != 0;
    } while (host_reads && micros() - began_us < limit_us);
    host_reads = accepted != 0 || (host_reads && limit_us == 0);
}

/* Reception of frames on pin RX with UARTE1, without Serial1.
 *
 * Serial1 takes two interrupts for each byte. It loses bytes if USB or another part of the core disables interrupts for
 * longer than a byte lasts (11 us at 921,600 baud), or if any interrupt handler takes longer than its 32 bytes last. Here
 * DMA fills two halves of a buffer in turn, and TIMER4 counts the bytes of the present half, by PPI. A periodic
 * interrupt only has to be faster than a half lasts. */
static const uint32_t HALF_BYTES = 512; /* 5.5 ms */
static const std::chrono::microseconds EMPTY_INTERVAL(1000);
static const uint32_t MIN_INTERVAL_US = 100;
static const uint32_t COUNT_CHANNEL = 18, CLEAR_CHANNEL = 19; /* of the PPI; the core allocates from 0 */
static uwb_frame_ring *radio_ring;
static volatile uint8_t received[2][HALF_BYTES];
static mbed::Ticker ticker;

static inline void empty_uart() {
    static uint32_t half = 1, position = HALF_BYTES, counted, counted_us;
    const uint32_t now_us = micros();
    if (now_us - counted_us < MIN_INTERVAL_US) {
        return; /* late calls follow each other at once */
    }
    /* A counted byte may still be on its way to memory: read those of the previous call. */
    uint32_t end = counted;
    const uint32_t end_us = counted_us;
    NRF_TIMER4->TASKS_CAPTURE[0] = 1;
    counted = NRF_TIMER4->CC[0];
    counted_us = now_us;
    const bool half_started = NRF_UARTE1->EVENTS_RXSTARTED != 0;
    end = half_started ? HALF_BYTES : end;
    for (; position < end; position++) {
        uwb_frame_ring_put(radio_ring, received[half][position], end_us);
    }
    if (half_started) {
        NRF_UARTE1->EVENTS_RXSTARTED = 0;
        half ^= 1u;
        NRF_UARTE1->RXD.PTR = (uint32_t)(uintptr_t)received[half ^ 1u]; /* for the next half */
        position = counted = 0;
    }
}

static inline void connect(uint32_t channel, volatile const uint32_t &event, volatile const uint32_t &task) {
    NRF_PPI->CH[channel].EEP = (uint32_t)(uintptr_t)&event;
    NRF_PPI->CH[channel].TEP = (uint32_t)(uintptr_t)&task;
    NRF_PPI->CHENSET = 1u << channel;
}

/* Receive frames at 921,600 baud on pin RX into a ring. */
static inline void receive_frames(uwb_frame_ring *ring) {
    radio_ring = ring;
    pinMode(PIN_SERIAL_RX, INPUT_PULLUP);
    NRF_TIMER4->MODE = 1; /* counter, 16 bits */
    NRF_TIMER4->TASKS_START = 1;
    connect(COUNT_CHANNEL, NRF_UARTE1->EVENTS_RXDRDY, NRF_TIMER4->TASKS_COUNT);
    connect(CLEAR_CHANNEL, NRF_UARTE1->EVENTS_ENDRX, NRF_TIMER4->TASKS_CLEAR);
    NRF_UARTE1->PSEL.RXD = (uint32_t)digitalPinToPinName(PIN_SERIAL_RX);
    NRF_UARTE1->BAUDRATE = UARTE_BAUDRATE_BAUDRATE_Baud921600;
    NRF_UARTE1->SHORTS = UARTE_SHORTS_ENDRX_STARTRX_Msk;
    NRF_UARTE1->ENABLE = UARTE_ENABLE_ENABLE_Enabled;
    NRF_UARTE1->RXD.PTR = (uint32_t)(uintptr_t)received[0];
    NRF_UARTE1->RXD.MAXCNT = HALF_BYTES;
    NRF_UARTE1->TASKS_STARTRX = 1;
    ticker.attach(empty_uart, EMPTY_INTERVAL);
}

} // namespace nano33ble

#endif
