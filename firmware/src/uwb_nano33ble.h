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
static const uint32_t WATCHDOG_S = 4;

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
 * When the host closes the port the core discards the packet in transfer: the frame starts again. */
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

/* Serial1 receives into a ring of 256 bytes, which is full after 2.8 ms at 921,600 baud, and a correction takes longer.
 * An interrupt empties it every millisecond. */
static const std::chrono::microseconds EMPTY_INTERVAL(1000);
static uwb_frame_ring *radio_ring;
static mbed::Ticker ticker;

static inline void empty_serial1() {
    const uint32_t now_us = micros();
    for (int left = Serial1.available(); left > 0; left--) {
        uwb_frame_ring_put(radio_ring, (uint8_t)Serial1.read(), now_us);
    }
}

/* Receive frames on Serial1 (D0) into a ring. */
static inline void receive_frames(uwb_frame_ring *ring, unsigned long baud) {
    radio_ring = ring;
    Serial1.begin(baud);
    ticker.attach(empty_serial1, EMPTY_INTERVAL);
}

} // namespace nano33ble

#endif
