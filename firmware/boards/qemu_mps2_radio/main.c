/* A board with a radio of its own, in the emulator: UART0 is the host's side, and over UART1 go SPI, time and waiting to a
 * modelled chip, whose time is the only one there is. qemu-system-arm -M mps2-an386 (ARM DDI 0479, section 4.3).
 *
 * A request is its kind, the length of what follows, 16 bits, and that; the answer the IRQ line, the time in us, 64 bits,
 * and for SPI as many octets as were sent. Compiled for a computer, UART0 is standard output and UART1 a socket at
 * standard input. */
#include <string.h>

#ifndef __arm__
#include <stdlib.h>
#include <unistd.h>
#endif

#include "uwb_ranger.h"

typedef struct {
    volatile uint32_t data, state, control, interrupt, divider;
} uart;

#define HOST_UART ((uart *)0x40004000u)
#define CHIP_UART ((uart *)0x40005000u)
enum { TX_FULL = 1, RX_FULL = 2, ENABLE = 3, ANY_DIVIDER = 16, WHOLE = 1016, MOST = 8 + 4 * WHOLE };
enum { SPI_SLOW, SPI_FAST, DELAY, WAIT, RESET };

static const uint64_t RANDOM = 0x9E3779B97F4A7C15u;

static uwb_ranger ranger;
static uint8_t queue[16384];
static uint64_t measurement[UWB_TWR_MEASUREMENT_BYTES(WHOLE) / 8 + 1];
static uint64_t now;
static int fast;

#ifdef __arm__
void board_exit(int code);

void board_exit(int code) {
    (void)code;
    for (;;) {
        __asm volatile("wfi");
    }
}

static void put(uart *port, const void *bytes, size_t count) {
    const uint8_t *at = bytes;
    while (count-- != 0) {
        while (port->state & TX_FULL) {
        }
        port->data = *at++;
    }
}

static void get(void *bytes, size_t count) {
    uint8_t *at = bytes;
    while (count-- != 0) {
        while (!(CHIP_UART->state & RX_FULL)) {
        }
        *at++ = (uint8_t)CHIP_UART->data;
    }
}

static void start_ports(void) {
    HOST_UART->divider = CHIP_UART->divider = ANY_DIVIDER;
    HOST_UART->control = CHIP_UART->control = ENABLE;
}
#else
static void put(uart *port, const void *bytes, size_t count) {
    if (count != 0 && write(port == HOST_UART ? STDOUT_FILENO : STDIN_FILENO, bytes, count) != (ssize_t)count) {
        exit(1);
    }
}

static void get(void *bytes, size_t count) {
    uint8_t *at = bytes;
    while (count != 0) {
        const ssize_t some = read(STDIN_FILENO, at, count);
        if (some <= 0) {
            exit(0);
        }
        at += some;
        count -= (size_t)some;
    }
}

static void start_ports(void) {
}
#endif

static void send_waiting(void) {
    const uint8_t *bytes;
    const size_t count = uwb_queue_peek(&ranger.board.queue, now, &bytes);
    put(HOST_UART, bytes, count);
    uwb_queue_drop(&ranger.board.queue, count);
}

static void ask(uint8_t kind, uint8_t *octets, size_t count) {
    const uint8_t head[3] = {kind, (uint8_t)count, (uint8_t)(count >> 8)};
    uint8_t line;
    put(CHIP_UART, head, sizeof head);
    put(CHIP_UART, octets, count);
    get(&line, 1);
    get(&now, sizeof now);
    if (kind == SPI_SLOW || kind == SPI_FAST) {
        get(octets, count);
    }
    send_waiting();
}

static int transfer(void *context, const uint8_t *header, size_t header_bytes, const uint8_t *out, uint8_t *in,
                    size_t bytes) {
    static uint8_t octets[MOST];
    (void)context;
    memset(octets, 0, header_bytes + bytes);
    memcpy(octets, header, header_bytes);
    if (out != NULL) {
        memcpy(octets + header_bytes, out, bytes);
    }
    ask(fast ? SPI_FAST : SPI_SLOW, octets, header_bytes + bytes);
    if (out == NULL) {
        memcpy(in, octets + header_bytes, bytes);
    }
    return 0;
}

static void speed(void *context, int wanted) {
    (void)context;
    fast = wanted;
}

static void reset(void *context) {
    (void)context;
    ask(RESET, NULL, 0);
}

static uint64_t now_us(void *context) {
    (void)context;
    return now;
}

static void await_line(void *context, uint64_t until_us) {
    (void)context;
    ask(WAIT, (uint8_t *)&until_us, sizeof until_us);
}

static void rest(void *context, uint32_t us) {
    uint64_t wide = us;
    (void)context;
    ask(DELAY, (uint8_t *)&wide, sizeof wide);
}

int main(void) {
    static const uwb_dw1000_io io = {NULL, transfer, speed, reset, now_us, await_line, rest};
    start_ports();
    uwb_board_config board;
    memset(&board, 0, sizeof board);
    board.queue = queue;
    board.queue_bytes = sizeof queue;
    uwb_ranger_start(&ranger, &board, &io, &uwb_twr_defaults, RANDOM, (uint8_t *)measurement,
                     sizeof measurement);
    for (;;) {
        (void)uwb_ranger_turn(&ranger);
    }
}
