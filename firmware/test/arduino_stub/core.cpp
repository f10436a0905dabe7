#include "core.h"

#include <stdio.h>
#include <stdlib.h>

#include "USB/PluggableUSBSerial.h"
#include "drivers/Ticker.h"

static const uint32_t RELOAD = 0x6E524635u;
static const size_t PACKET_BYTES = 64;
static const uint64_t TRANSFER_US = 100;

StubPort Serial = {true, {}, 0, 0, 0}, Serial1 = {};
StubUsb _SerialUSB;
static StubWatchdog watchdog;
static StubFactory factory = {{0x386, 1}};
static StubRandom randomness = {0, 0, 1, 0};
StubWatchdog *NRF_WDT = &watchdog;
StubFactory *NRF_FICR = &factory;
StubRandom *NRF_RNG = &randomness;

static uint64_t now_us;

static const char *prefix;
static StubHost special;
static uint64_t special_from_us, special_until_us;
static FILE *session;
static int sessions;
static bool terminal;

static uint8_t packet[PACKET_BYTES];
static size_t packet_bytes; /* 0 = no transfer */
static uint64_t packet_us;

static void (*tick)();
static uint64_t tick_interval_us, tick_due_us, fed_us;

void stub_start(const char *files, StubHost host, uint64_t from_us, uint64_t until_us) {
    prefix = files;
    special = host;
    special_from_us = from_us;
    special_until_us = until_us;
}

StubHost stub_host_of(const char *name) {
    return strcmp(name, "silent") == 0 ? HOST_SILENT : strcmp(name, "closed") == 0 ? HOST_CLOSED : HOST_READS;
}

void stub_finish() {
    if (session != NULL) {
        fclose(session);
        session = NULL;
    }
}

static void run_host() {
    StubHost host = now_us >= special_from_us && now_us < special_until_us ? special : HOST_READS;
    const bool in_frame = packet_bytes != 0 && packet[packet_bytes - 1] != 0;
    if (host == HOST_CLOSED && terminal && !in_frame) {
        host = HOST_READS;
    }
    if (host == HOST_CLOSED) {
        terminal = false;
        packet_bytes = 0; /* the core aborts the transfer */
        stub_finish();
    } else if (!terminal) {
        char path[4096];
        snprintf(path, sizeof path, "%s%d", prefix, sessions++);
        session = fopen(path, "wb");
        terminal = true;
    }
    if (host == HOST_READS && packet_bytes != 0 && now_us - packet_us >= TRANSFER_US) {
        fwrite(packet, 1, packet_bytes, session);
        packet_bytes = 0;
    }
}

void stub_run_events(uint64_t now) {
    now_us = now;
    run_host();
    if (tick != NULL && now_us >= tick_due_us) {
        tick_due_us += tick_interval_us;
        void (*const function)() = tick;
        tick = NULL; /* it calls micros(): not again */
        function();
        tick = function;
    }
    if (watchdog.RR[0] == RELOAD) {
        watchdog.RR[0] = 0;
        fed_us = now_us;
    }
    if (watchdog.TASKS_START != 0 && now_us - fed_us > (watchdog.CRV + 1ull) * 1000000u / 32768u) {
        exit(3);
    }
}

void mbed::Ticker::attach(void (*function)(), std::chrono::microseconds interval) {
    tick = function;
    tick_interval_us = (uint64_t)interval.count();
    tick_due_us = now_us + tick_interval_us;
}

bool StubUsb::connected() {
    return terminal;
}

void StubUsb::send_nb(uint8_t *bytes, uint32_t count, uint32_t *accepted, bool) {
    *accepted = 0;
    if (terminal && packet_bytes == 0) {
        *accepted = count < PACKET_BYTES ? count : PACKET_BYTES;
        memcpy(packet, bytes, *accepted);
        packet_bytes = *accepted;
        packet_us = now_us;
    }
}

int StubPort::read() {
    if (used == 0) {
        return -1;
    }
    const uint8_t byte = ring[first];
    first = (first + 1) % RING_BYTES;
    used--;
    return byte;
}

void StubPort::put(uint8_t byte) {
    if (used == RING_BYTES) {
        overrun++;
        return;
    }
    ring[(first + used++) % RING_BYTES] = byte;
}

size_t StubPort::write(const uint8_t *bytes, size_t count) {
    size_t sent = 0;
    if (!is_usb) {
        return count;
    }
    if (!terminal) {
        return 0;
    }
    while (terminal && sent < count) {
        uint32_t accepted;
        _SerialUSB.send_nb(const_cast<uint8_t *>(bytes) + sent, (uint32_t)(count - sent), &accepted);
        sent += accepted;
        stub_pass(10);
    }
    return count;
}

StubPort::operator bool() {
    if (is_usb) {
        stub_pass(1000);
    }
    return is_usb ? terminal : true;
}
