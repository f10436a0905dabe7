#include "core.h"

#include <stdio.h>
#include <stdlib.h>

#include "USB/PluggableUSBSerial.h"
#include "drivers/Ticker.h"

static const uint32_t RELOAD = 0x6E524635u;
static const size_t PACKET_BYTES = 64;
static const uint64_t TRANSFER_US = 100;

static const uint64_t DMA_US = 5, MASKED_EVERY_US = 50000, MASKED_US = 3000;
static const int RX_PIN = 42;

StubPort Serial;
StubUsb _SerialUSB;
static void capture();
static StubWatchdog watchdog;
static StubFactory factory = {{0x386, 1}};
static StubRandom randomness = {0, 0, 1, 0};
StubWatchdog *NRF_WDT = &watchdog;
StubFactory *NRF_FICR = &factory;
StubRandom *NRF_RNG = &randomness;
static StubFlash flash;
static StubTimer timer = {0, 0, 0, 0, {0}, {{capture}}};
static StubPpi ppi;
static StubUart uart;
StubFlash *NRF_NVMC = &flash;
StubTimer *NRF_TIMER4 = &timer;
StubPpi *NRF_PPI = &ppi;
StubUart *NRF_UARTE1 = &uart;

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

/* UARTE1, from the product specification: DMA into a buffer that is latched when it starts, and events through the PPI.
 * A byte is counted before it is in memory. */
static uint8_t *buffer, *late;
static uint8_t late_byte;
static uint32_t amount, counter;
static uint64_t late_us;
static int overruns;

int digitalPinToPinName(int pin) {
    return pin == PIN_SERIAL_RX ? RX_PIN : 0;
}

static void capture() {
    timer.CC[0] = counter;
}

static bool connected(const volatile uint32_t &event, const volatile uint32_t &task) {
    for (uint32_t channel = 0; channel < 20; channel++) {
        if ((ppi.CHENSET.bits >> channel & 1u) && ppi.CH[channel].EEP == (uint32_t)(uintptr_t)&event &&
            ppi.CH[channel].TEP == (uint32_t)(uintptr_t)&task) {
            return timer.MODE == 1 && timer.TASKS_START;
        }
    }
    return false;
}

static void write_late_byte() {
    if (late != NULL) {
        *late = late_byte;
        late = NULL;
    }
}

static void start_buffer() {
    buffer = (uint8_t *)(uintptr_t)uart.RXD.PTR;
    amount = 0;
    overruns += uart.EVENTS_RXSTARTED != 0; /* the program has not set the next buffer */
    uart.EVENTS_RXSTARTED = 1;
}

void stub_receive(uint8_t byte) {
    if (uart.ENABLE != UARTE_ENABLE_ENABLE_Enabled || uart.PSEL.RXD != RX_PIN || !uart.TASKS_STARTRX ||
        uart.BAUDRATE != UARTE_BAUDRATE_BAUDRATE_Baud921600) {
        overruns++;
        return;
    }
    if (buffer == NULL) {
        start_buffer();
    }
    write_late_byte();
    late = buffer + amount++;
    late_byte = byte;
    late_us = now_us;
    counter += connected(uart.EVENTS_RXDRDY, timer.TASKS_COUNT);
    if (amount == uart.RXD.MAXCNT) {
        write_late_byte();
        counter = connected(uart.EVENTS_ENDRX, timer.TASKS_CLEAR) ? 0 : counter;
        if (uart.SHORTS == UARTE_SHORTS_ENDRX_STARTRX_Msk) {
            start_buffer();
        }
    }
}

int stub_overruns() {
    return overruns;
}

void stub_run_events(uint64_t now) {
    now_us = now;
    run_host();
    /* Other interrupts and critical sections delay this one. */
    if (tick != NULL && now_us >= tick_due_us && now_us % MASKED_EVERY_US >= MASKED_US) {
        tick_due_us += tick_interval_us;
        void (*const function)() = tick;
        tick = NULL; /* it calls micros(): not again */
        function();
        tick = function;
    }
    if (now_us >= late_us + DMA_US) {
        write_late_byte();
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

size_t StubPort::write(const uint8_t *bytes, size_t count) {
    size_t sent = 0;
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
    stub_pass(1000);
    return terminal;
}
