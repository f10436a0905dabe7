/* A board on the serial link, in the emulator: UART0 is the host's side, as a sketch's USB, and UART1 the radio's, as
 * its Serial1. qemu-system-arm -M mps2-an386 (ARM DAI 0386; UART and timer: ARM DDI 0479, sections 4.3 and 4.1).
 *
 * No interrupt is taken: they are masked, and only end WFI. */
#include "uwb_board.h"
#include "uwb_model.h"

typedef struct {
    volatile uint32_t data, state, control, interrupt, divider;
} uart;

#define HOST_UART ((uart *)0x40004000u)
#define RADIO_UART ((uart *)0x40005000u)
enum { TX_FULL = 1, RX_FULL = 2, ENABLE_ALL = 0xF, CLEAR_ALL = 0xF, ANY_DIVIDER = 16 };
enum { UART_IRQS = 0xF }; /* receive and transmit of UART0 and UART1 */

#define SYST_CSR (*(volatile uint32_t *)0xE000E010u)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014u)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018u)
#define ICSR (*(volatile uint32_t *)0xE000ED04u)
#define NVIC_ISER (*(volatile uint32_t *)0xE000E100u)
#define NVIC_ICPR (*(volatile uint32_t *)0xE000E280u)
enum { TICKS_PER_US = 25, RELOAD = 25 * 10000 - 1, PENDSTSET = 1 << 26, PENDSTCLR = 1 << 25 };

void board_exit(int code);

void board_exit(int code) {
    (void)code;
    for (;;) {
        __asm volatile("wfi");
    }
}

/* SysTick counts 10 ms down, again and again; its pending bit shows that it was reloaded. */
static uint64_t uptime_us(uint64_t *periods_us) {
    uint32_t left = SYST_CVR;
    if (ICSR & PENDSTSET) {
        ICSR = PENDSTCLR;
        *periods_us += (RELOAD + 1) / TICKS_PER_US;
        left = SYST_CVR;
    }
    return *periods_us + (RELOAD - left) / TICKS_PER_US;
}

/* The timer TIMER0 runs freely, for compute_us. */
static uint32_t clock_us(void) {
    return (0xFFFFFFFFu - *(volatile uint32_t *)0x40000004u) / TICKS_PER_US;
}

static size_t receive(uart *port, uint8_t *bytes, size_t limit) {
    size_t count = 0;
    while (count < limit && (port->state & RX_FULL)) {
        bytes[count++] = (uint8_t)port->data;
    }
    return count;
}

static size_t transmit(uart *port, uwb_queue *queue, uint64_t now_us) {
    const uint8_t *bytes;
    const size_t waiting = uwb_queue_peek(queue, now_us, &bytes);
    size_t count = 0;
    while (count < waiting && !(port->state & TX_FULL)) {
        port->data = bytes[count++];
    }
    uwb_queue_drop(queue, count);
    return count;
}

int main(void) {
    static uwb_board board;
    static uint32_t arena[12288 / 4];
    static uint8_t queue[16384];
    uart *const ports[2] = {HOST_UART, RADIO_UART};

    __asm volatile("cpsid i");
    for (int i = 0; i < 2; i++) {
        ports[i]->divider = ANY_DIVIDER;
        ports[i]->control = ENABLE_ALL;
    }
    NVIC_ISER = UART_IRQS;
    SYST_RVR = RELOAD;
    SYST_CVR = 0;
    SYST_CSR = 7; /* processor clock, with interrupt */
    *(volatile uint32_t *)0x40000004u = 0xFFFFFFFFu;
    *(volatile uint32_t *)0x40000008u = 0xFFFFFFFFu;
    *(volatile uint32_t *)0x40000000u = 1;

    uint64_t periods_us = 0;
    const uwb_board_config config = {
        .board_id = 0x386,
        .boot_id = 1,
        .firmware_version = {0, 1, 0},
        .mode = UWB_MODE_HOST,
        .firmware_name = "qemu_mps2",
        .model = &uwb_model_data,
        .arena = arena,
        .arena_bytes = sizeof arena,
        .queue = queue,
        .queue_bytes = sizeof queue,
        .clock_us = clock_us,
    };
    uwb_board_start(&board, &config, 0);
    for (;;) {
        uint8_t bytes[64];
        /* Clear before polling, so that bytes that arrive later end the WFI below. */
        for (int i = 0; i < 2; i++) {
            ports[i]->interrupt = CLEAR_ALL;
        }
        NVIC_ICPR = UART_IRQS;
        const uint64_t now_us = uptime_us(&periods_us);
        size_t moved = receive(HOST_UART, bytes, sizeof bytes);
        uwb_board_receive(&board, bytes, moved, now_us);
        /* Backpressure on the radio's side: the emulator's sender waits where a real radio would lose ranges. */
        if (board.queue.used < sizeof queue / 4) {
            const size_t count = receive(RADIO_UART, bytes, sizeof bytes);
            uwb_board_receive_from_radio(&board, bytes, count, now_us);
            moved += count;
        }
        uwb_board_tick(&board, now_us);
        moved += transmit(HOST_UART, &board.queue, uptime_us(&periods_us));
        if (moved == 0) {
            __asm volatile("wfi");
        }
    }
}
