/* Arduino Nano 33 BLE Sense between an EVB1000 and the host: corrects ranges, or passes them on.
 *
 * Serial  (USB)     the host, wire protocol of docs/reference/protocol.md
 * Serial1 (D0, D1)  the EVB1000, 921600 baud: frames RANGE_CIR of the same protocol (docs/guides/boards.md)
 *
 * Green LED: the host reads. Orange LED: blinks with the measurements. Nothing in loop() waits, except that a
 * correction takes a few milliseconds: meanwhile the core's interrupt receives Serial1. */
#include <uwb_board.h>

#include "uwb_model.h"

/* The size of a USB packet. Packets are written completely, and only if there is room. */
static const size_t PACKET = 64;
static const uint32_t RADIO_BAUD = 921600;
static const uint32_t WATCHDOG_S = 4;

static uwb_board board;
static uint32_t arena[12288 / 4];
static uint8_t queue[16384];
static uint64_t wraps;
static uint32_t last_us;

/* micros() wraps after 71 minutes; loop() reads it far more often. */
static uint64_t uptime_us() {
    const uint32_t now = micros();
    if (now < last_us) {
        wraps += (uint64_t)1 << 32;
    }
    last_us = now;
    return wraps + now;
}

static uint32_t clock_us() {
    return micros();
}

/* nRF52840 product specification, section 6.36: once started it cannot be stopped, and resets a board that hangs. */
static void start_watchdog() {
    NRF_WDT->CONFIG = 1; /* also while asleep */
    NRF_WDT->CRV = 32768u * WATCHDOG_S - 1u;
    NRF_WDT->RREN = 1;
    NRF_WDT->TASKS_START = 1;
}

static void feed_watchdog() {
    NRF_WDT->RR[0] = 0x6E524635u;
}

/* Read the received bytes without blocking. */
template <typename Port> static size_t read_available(Port &port, uint8_t *bytes, size_t limit) {
    size_t count = 0;
    while (count < limit && port.available() > 0) {
        bytes[count++] = (uint8_t)port.read();
    }
    return count;
}

void setup() {
    pinMode(LED_BUILTIN, OUTPUT);
    pinMode(LED_PWR, OUTPUT);
    Serial.begin(RADIO_BAUD);
    Serial1.begin(RADIO_BAUD);

    uwb_board_config config = {};
    config.board_id = (uint64_t)NRF_FICR->DEVICEID[1] << 32 | NRF_FICR->DEVICEID[0];
    NRF_RNG->TASKS_START = 1;
    for (int i = 0; i < 4; i++) {
        NRF_RNG->EVENTS_VALRDY = 0;
        for (int tries = 0; tries < 100000 && NRF_RNG->EVENTS_VALRDY == 0; tries++) {
        }
        config.boot_id = config.boot_id << 8 | (NRF_RNG->VALUE & 0xFFu);
    }
    NRF_RNG->TASKS_STOP = 1;
    config.firmware_version[1] = 1;
    config.mode = UWB_MODE_DEVICE;
    memcpy(config.firmware_name, "nano33ble", 9);
    config.model = &uwb_model_data;
    config.arena = arena;
    config.arena_bytes = sizeof arena;
    config.queue = queue;
    config.queue_bytes = sizeof queue;
    config.clock_us = clock_us;
    uwb_board_start(&board, &config, uptime_us());
    start_watchdog();
}

void loop() {
    uint8_t bytes[PACKET];
    feed_watchdog();
    size_t count = read_available(Serial1, bytes, sizeof bytes);
    uwb_board_receive_from_radio(&board, bytes, count, uptime_us());
    count = read_available(Serial, bytes, sizeof bytes);
    uwb_board_receive(&board, bytes, count, uptime_us());
    uwb_board_tick(&board, uptime_us());

    const bool host_reads = (bool)Serial;
    if (host_reads) {
        const uint8_t *waiting;
        size_t length = uwb_queue_peek(&board.queue, uptime_us(), &waiting);
        /* One byte less than a packet: a transfer of full packets would have to end with an empty one. */
        length = length < PACKET - 1 ? length : PACKET - 1;
        if (length != 0 && Serial.availableForWrite() >= (int)length) {
            uwb_queue_drop(&board.queue, Serial.write(waiting, length));
        }
    }
    digitalWrite(LED_PWR, host_reads ? HIGH : LOW);
    digitalWrite(LED_BUILTIN, (board.measurements & 1u) ? HIGH : LOW);
}
