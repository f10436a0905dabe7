/* Arduino Nano 33 BLE Sense between a radio and the host: corrects ranges, or passes them on.
 *
 * Serial (USB)  the host, wire protocol of docs/reference/protocol.md
 * Pin RX        a radio with your own firmware, 921600 baud: frames RANGE_CIR of the same protocol (docs/guides/boards.md).
 *               No factory firmware sends them, that of an EVB1000 neither.
 *
 * Green LED: the host has the port open. Orange LED: blinks with the measurements. A correction takes a few
 * milliseconds; meanwhile DMA and an interrupt receive. uwb_model.h is the shipped model; another one:
 * uwb-mitigation board export-c -o UwbMitigation. */
#include <uwb_board.h>
#include <uwb_nano33ble.h>

#include "uwb_model.h"

/* For the frames of one measurement, so that the next is not late. */
static const uint32_t SEND_LIMIT_US = 1000;

static uwb_board board;
static uint32_t arena[12288 / 4];
static uint8_t queue[16384];
static uint8_t radio_bytes[8192];
static uwb_frame_ring radio;

void setup() {
    pinMode(LED_BUILTIN, OUTPUT);
    pinMode(LED_PWR, OUTPUT);
    nano33ble::enable_cache();
    Serial.begin(921600);

    uwb_board_config config = {};
    config.board_id = nano33ble::board_id();
    config.boot_id = (uint32_t)nano33ble::random_number();
    config.firmware_version[1] = 2;
    config.mode = UWB_MODE_DEVICE;
    memcpy(config.firmware_name, "nano33ble", 9);
    config.model = &uwb_model_data;
    config.arena = arena;
    config.arena_bytes = sizeof arena;
    config.queue = queue;
    config.queue_bytes = sizeof queue;
    config.clock_us = nano33ble::clock_us;
    uwb_board_start(&board, &config, nano33ble::uptime_us());
    radio.bytes = radio_bytes;
    radio.capacity = sizeof radio_bytes;
    nano33ble::receive_frames(&radio);
    nano33ble::start_watchdog();
}

/* Count the measurements that the ring had no space for. */
static void count_lost() {
    static uint32_t counted;
    const uint32_t lost = radio.lost - counted;
    counted += lost;
    board.measurements += lost;
    board.measurements_lost += lost;
}

void loop() {
    uint8_t bytes[64];
    uint32_t start_us = 0;
    nano33ble::feed_watchdog();
    size_t count = nano33ble::read_host(bytes, sizeof bytes);
    uwb_board_receive(&board, bytes, count, nano33ble::uptime_us());
    count = uwb_frame_ring_read(&radio, bytes, sizeof bytes, &start_us);
    const uint64_t now_us = nano33ble::uptime_us();
    uwb_board_receive_from_radio(&board, bytes, count, now_us - (uint32_t)((uint32_t)now_us - start_us));
    count_lost();
    uwb_board_tick(&board, nano33ble::uptime_us());
    nano33ble::send_to_host(&board.queue, SEND_LIMIT_US);
    digitalWrite(LED_PWR, nano33ble::host_connected() ? HIGH : LOW);
    digitalWrite(LED_BUILTIN, (board.measurements & 1u) ? HIGH : LOW);
}
