/* Arduino Nano 33 BLE Sense with a DWM1000 module on its SPI: ranges, and corrects ranges if there is a model.
 *
 * 3.3 V only. D13 SPICLK, D12 SPIMISO, D11 SPIMOSI, D10 SPICSn, D2 IRQ, D9 RSTn, GND, 3V3 with 10 uF at the module: it
 * takes 150 mA at times. Serial (USB) is the host, wire protocol of docs/reference/protocol.md.
 *
 * It starts as an anchor, so that it can run without a host on a power bank; with D3 at GND at the start, or when its host
 * requests it, it is a tag. For corrections on the board put uwb_model.h next to this file: uwb-mitigation board export-c -o UwbRanger.
 *
 * SPI is done from loop() only, never from an interrupt, and in complete buffers: single bytes cost 20 us each. */
#include <SPI.h>
#include <uwb_nano33ble.h>
#include <uwb_ranger.h>

#if defined(__has_include)
#if __has_include("uwb_model.h")
#include "uwb_model.h"
#define HAS_MODEL 1
static uint32_t arena[12288 / 4];
#endif
#endif

static const int RADIO_CS = 10, RADIO_IRQ = 2, RADIO_RESET = 9, TAG_SWITCH = 3;
static const size_t MAX_SAMPLES = 1016;
static const SPISettings SLOW(2000000, MSBFIRST, SPI_MODE0), FAST(8000000, MSBFIRST, SPI_MODE0);

static uwb_ranger ranger;
static uint8_t queue[16384];
static uint64_t measurement[UWB_TWR_MEASUREMENT_BYTES(MAX_SAMPLES) / 8 + 1];
static uint8_t spi_buffer[8 + 4 * MAX_SAMPLES];
static bool spi_fast;

static uint64_t uptime_us(void *) {
    return nano33ble::uptime_us();
}

/* Without waiting: an exchange has deadlines of less than a millisecond. */
static void send_pending() {
    nano33ble::send_to_host(&ranger.board.queue, 0);
}

/* One chip-select period. */
static int transfer(void *, const uint8_t *header, size_t header_bytes, const uint8_t *out, uint8_t *in, size_t bytes) {
    const size_t total = header_bytes + bytes;
    if (total > sizeof spi_buffer) {
        return -1;
    }
    memset(spi_buffer, 0, total);
    memcpy(spi_buffer, header, header_bytes);
    if (out != nullptr) {
        memcpy(spi_buffer + header_bytes, out, bytes);
    }
    SPI.beginTransaction(spi_fast ? FAST : SLOW);
    digitalWrite(RADIO_CS, LOW);
    SPI.transfer(spi_buffer, total);
    digitalWrite(RADIO_CS, HIGH);
    SPI.endTransaction();
    if (out == nullptr) {
        memcpy(in, spi_buffer + header_bytes, bytes);
    }
    return 0;
}

static void speed(void *, int fast) {
    spi_fast = fast != 0;
}

static void sleep_us(void *, uint32_t us) {
    const uint64_t until_us = uptime_us(nullptr) + us;
    do {
        send_pending();
    } while (uptime_us(nullptr) < until_us);
}

/* The chip drives the line too: pull it low and release it, never drive it high. */
static void reset(void *) {
    digitalWrite(RADIO_RESET, LOW);
    pinMode(RADIO_RESET, OUTPUT);
    sleep_us(nullptr, 1000);
    pinMode(RADIO_RESET, INPUT);
}

static void wait(void *, uint64_t until_us) {
    while (digitalRead(RADIO_IRQ) == LOW && uptime_us(nullptr) < until_us) {
        send_pending();
    }
}

void setup() {
    nano33ble::enable_cache();
    pinMode(LEDB, OUTPUT);
    pinMode(LED_PWR, OUTPUT);
    pinMode(TAG_SWITCH, INPUT_PULLUP);
    pinMode(RADIO_IRQ, INPUT);
    pinMode(RADIO_RESET, INPUT);
    digitalWrite(RADIO_CS, HIGH);
    pinMode(RADIO_CS, OUTPUT);
    SPI.begin();
    Serial.begin(921600);

    const uint64_t random = nano33ble::random_number();
    uwb_board_config board = {};
    board.board_id = nano33ble::board_id();
    board.boot_id = (uint32_t)random;
    board.firmware_version[1] = 2;
    board.mode = UWB_MODE_HOST;
    memcpy(board.firmware_name, "nano33ble-dw1000", 16);
#ifdef HAS_MODEL
    board.model = &uwb_model_data;
    board.arena = arena;
    board.arena_bytes = sizeof arena;
#endif
    board.queue = queue;
    board.queue_bytes = sizeof queue;
    board.clock_us = nano33ble::clock_us;
    const uwb_dw1000_io io = {nullptr, transfer, speed, reset, uptime_us, wait, sleep_us};
    uwb_twr_config config = uwb_twr_defaults;
    config.role = digitalRead(TAG_SWITCH) == LOW ? UWB_ROLE_TAG : UWB_ROLE_ANCHOR;
    uwb_ranger_start(&ranger, &board, &io, &config, random, (uint8_t *)measurement, sizeof measurement);
    nano33ble::start_watchdog();
}

/* Power LED: the host has the port open. Blue LED: changes with each range; the orange one is on the clock of the SPI. */
void loop() {
    uint8_t bytes[64];
    nano33ble::feed_watchdog();
    const size_t count = nano33ble::read_host(bytes, sizeof bytes);
    uwb_board_receive(&ranger.board, bytes, count, uptime_us(nullptr));
    (void)uwb_ranger_step(&ranger);
    send_pending();
    digitalWrite(LED_PWR, nano33ble::host_connected() ? HIGH : LOW);
    digitalWrite(LEDB, (ranger.twr.counts.ranged & 1u) ? HIGH : LOW);
}
