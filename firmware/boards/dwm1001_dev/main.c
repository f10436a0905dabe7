/* Decawave DWM1001-DEV: an nRF52832 with a DW1000, on the wire to the host through the UART of its J-Link.
 *
 * It starts as an anchor, so that it can run without a host on a power bank; with the button BT2 held at the start, or when its
 * host says so, it is a tag. Not tested on a board: only built, checked for size, and its exchange run on a modelled chip. */
#include <string.h>

#include "nrf52832.h"
#include "uwb_model.h"
#include "uwb_ranger.h"

enum {
    SPI_SCK = 16, SPI_MOSI = 20, SPI_MISO = 18, SPI_CS = 17, RADIO_IRQ = 19, RADIO_RESET = 24,
    UART_TX = 5, UART_RX = 11, BUTTON = 2, LED_RED = 14, LED_GREEN = 30,
    DMA_MAX = 255, MAX_SAMPLES = 1016, RESET_US = 1000, WATCHDOG_S = 4, SMALL_TRANSFER = 64
};

static uwb_ranger ranger;
static uint32_t arena[12288 / 4];
static uint8_t queue[8192];
static uint64_t measurement[UWB_TWR_MEASUREMENT_BYTES(MAX_SAMPLES) / 8 + 1];

/* Shared with the interrupt handler. Each index is written on one side only. */
static struct {
    uint8_t received[1024];
    volatile uint32_t head, tail;
    const uint8_t *sending;
    volatile size_t remaining;
} line;

void board_exit(int code);
void uart_interrupt(void);

static void unexpected_interrupt(void) {
    board_exit(127);
}

__attribute__((section(".vectors.device"), used)) static void (*const vectors[16])(void) = {
    unexpected_interrupt, unexpected_interrupt, uart_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt, unexpected_interrupt,
};

/* The watchdog restarts the board. */
void board_exit(int code) {
    (void)code;
    GPIO_OUTCLR = 1u << LED_RED;
    for (;;) {
    }
}

void uart_interrupt(void) {
    while (UART_EVENTS_RXDRDY != 0) {
        UART_EVENTS_RXDRDY = 0;
        const uint8_t byte = (uint8_t)UART_RXD;
        if (line.head - line.tail < sizeof line.received) {
            line.received[line.head % sizeof line.received] = byte;
            line.head++;
        }
    }
    if (UART_EVENTS_ERROR != 0) {
        UART_EVENTS_ERROR = 0;
        UART_ERRORSRC = UART_ERRORSRC; /* the CRC detects damaged frames */
    }
    if (UART_EVENTS_TXDRDY != 0) {
        UART_EVENTS_TXDRDY = 0;
        if (line.remaining != 0 && --line.remaining != 0) {
            UART_TXD = *++line.sending;
        }
    }
}

static uint64_t uptime_us(void *context) {
    static uint32_t last;
    static uint64_t wraps;
    (void)context;
    TIMER_TASKS_CAPTURE0 = 1;
    const uint32_t now = TIMER_CC0;
    if (now < last) {
        wraps += (uint64_t)1 << 32;
    }
    last = now;
    return wraps + now;
}

static uint32_t clock_us(void) {
    return (uint32_t)uptime_us(NULL);
}

/* Pass the next bytes to the interrupt handler once it has sent the previous ones. Does not block. */
static void send_pending(void) {
    static size_t passed;
    if (line.remaining != 0) {
        return;
    }
    uwb_queue_drop(&ranger.board.queue, passed);
    passed = uwb_queue_peek(&ranger.board.queue, uptime_us(NULL), &line.sending);
    if (passed != 0) {
        line.remaining = passed;
        UART_TXD = *line.sending;
    }
}

static void receive_pending(void) {
    while (line.tail != line.head) {
        uwb_board_receive(&ranger.board, &line.received[line.tail % sizeof line.received], 1, uptime_us(NULL));
        line.tail++;
    }
}

static void spim(const uint8_t *out, size_t out_bytes, uint8_t *in, size_t in_bytes) {
    SPIM_TXD_PTR = (uint32_t)(uintptr_t)out;
    SPIM_TXD_MAXCNT = (uint32_t)out_bytes;
    SPIM_RXD_PTR = (uint32_t)(uintptr_t)in;
    SPIM_RXD_MAXCNT = (uint32_t)in_bytes;
    SPIM_EVENTS_END = 0;
    SPIM_TASKS_START = 1;
    while (SPIM_EVENTS_END == 0) {
    }
}

/* One chip-select period with several transfers. Workaround for anomaly 58 (a transfer that receives one octet and sends
 * at most one clocks a second octet): avoid such transfers. */
static int transfer(void *context, const uint8_t *header, size_t header_bytes, const uint8_t *out, uint8_t *in,
                    size_t bytes) {
    uint8_t sent[SMALL_TRANSFER], received[SMALL_TRANSFER];
    (void)context;
    GPIO_OUTCLR = 1u << SPI_CS;
    if (header_bytes + bytes <= SMALL_TRANSFER) {
        memset(sent, 0, sizeof sent);
        memcpy(sent, header, header_bytes);
        if (out != NULL) {
            memcpy(sent + header_bytes, out, bytes);
        }
        spim(sent, header_bytes + bytes, received, out == NULL ? header_bytes + bytes : 0);
        if (out == NULL) {
            memcpy(in, received + header_bytes, bytes);
        }
    } else {
        memcpy(sent, header, header_bytes); /* DMA reaches RAM only */
        spim(sent, header_bytes, NULL, 0);
        while (bytes != 0) {
            size_t piece = bytes < DMA_MAX ? bytes : DMA_MAX;
            piece -= bytes - piece == 1;
            spim(out, out != NULL ? piece : 0, in, out != NULL ? 0 : piece);
            out = out != NULL ? out + piece : NULL;
            in = out != NULL ? in : in + piece;
            bytes -= piece;
        }
    }
    GPIO_OUTSET = 1u << SPI_CS;
    send_pending();
    return 0;
}

static void speed(void *context, int fast) {
    (void)context;
    SPIM_FREQUENCY = fast ? SPIM_8_MHZ : SPIM_2_MHZ;
}

static void sleep(void *context, uint32_t us) {
    const uint64_t until_us = uptime_us(context) + us;
    do {
        send_pending();
    } while (uptime_us(context) < until_us);
}

/* The chip drives the line too: pull it low and release it, never drive it high. */
static void reset(void *context) {
    GPIO_OUTCLR = 1u << RADIO_RESET;
    GPIO_PIN_CNF(RADIO_RESET) = PIN_OPEN_DRAIN;
    sleep(context, RESET_US);
    GPIO_PIN_CNF(RADIO_RESET) = PIN_INPUT;
}

static void wait(void *context, uint64_t until_us) {
    while (!(GPIO_IN >> RADIO_IRQ & 1u) && uptime_us(context) < until_us) {
        send_pending();
    }
}

static uint64_t random_number(void) {
    uint64_t value = 0;
    RNG_TASKS_START = 1;
    for (int i = 0; i < 8; i++) {
        RNG_EVENTS_VALRDY = 0;
        while (RNG_EVENTS_VALRDY == 0) {
        }
        value = value << 8 | (RNG_VALUE & 0xFFu);
    }
    RNG_TASKS_STOP = 1;
    return value;
}

static void start_peripherals(void) {
    NVMC_ICACHECNF = 1; /* without the cache, code runs from flash with wait states */
    TASKS_HFCLKSTART = 1;
    while (EVENTS_HFCLKSTARTED == 0) {
    }
    TASKS_LFCLKSTART = 1; /* of the watchdog */
    TIMER_BITMODE = TIMER_32_BITS;
    TIMER_PRESCALER = TIMER_1_MHZ;
    TIMER_TASKS_START = 1;

    GPIO_OUTSET = 1u << SPI_CS | 1u << UART_TX | 1u << LED_RED | 1u << LED_GREEN;
    GPIO_DIRSET = 1u << SPI_CS | 1u << SPI_SCK | 1u << SPI_MOSI | 1u << UART_TX | 1u << LED_RED | 1u << LED_GREEN;
    GPIO_PIN_CNF(SPI_MISO) = PIN_INPUT;
    GPIO_PIN_CNF(RADIO_IRQ) = PIN_INPUT;
    GPIO_PIN_CNF(RADIO_RESET) = PIN_INPUT;
    GPIO_PIN_CNF(UART_RX) = PIN_INPUT;
    GPIO_PIN_CNF(BUTTON) = PIN_INPUT_PULLUP;
    SPIM_PSEL_SCK = SPI_SCK;
    SPIM_PSEL_MOSI = SPI_MOSI;
    SPIM_PSEL_MISO = SPI_MISO;
    SPIM_CONFIG = 0;
    SPIM_ENABLE = SPIM_ENABLED;

    UART_PSELTXD = UART_TX;
    UART_PSELRXD = UART_RX;
    UART_BAUDRATE = UART_921600;
    UART_ENABLE = UART_ENABLED;
    UART_INTENSET = UART_INT_RXDRDY | UART_INT_TXDRDY | UART_INT_ERROR;
    NVIC_ISER0 = 1u << UART_IRQ;
    UART_TASKS_STARTRX = 1;
    UART_TASKS_STARTTX = 1;

    WDT_CONFIG = WDT_ALSO_ASLEEP;
    WDT_CRV = WDT_HZ * WATCHDOG_S - 1u;
    WDT_RREN = 1;
    WDT_TASKS_START = 1;
}

int main(void) {
    start_peripherals();
    const uwb_dw1000_io io = {
        .transfer = transfer, .speed = speed, .reset = reset, .now_us = uptime_us, .wait = wait, .sleep = sleep};
    const uint64_t random = random_number();
    const uwb_board_config board = {
        .board_id = (uint64_t)FICR_DEVICEID(1) << 32 | FICR_DEVICEID(0),
        .boot_id = (uint32_t)random,
        .firmware_version = {0, 2, 0},
        .mode = UWB_MODE_HOST,
        .firmware_name = "dwm1001-dev",
        .model = &uwb_model_data,
        .arena = arena,
        .arena_bytes = sizeof arena,
        .queue = queue,
        .queue_bytes = sizeof queue,
        .clock_us = clock_us,
    };
    uwb_twr_config config = uwb_twr_defaults;
    config.role = (GPIO_IN >> BUTTON & 1u) != 0 ? UWB_ROLE_ANCHOR : UWB_ROLE_TAG;
    uwb_ranger_start(&ranger, &board, &io, &config, random, (uint8_t *)measurement, sizeof measurement);
    for (;;) {
        WDT_RR0 = WDT_RELOAD;
        receive_pending();
        (void)uwb_ranger_step(&ranger);
        /* Green flickers with the ranges; red: the radio does not work. */
        *(ranger.twr.counts.ranged & 1u ? &GPIO_OUTCLR : &GPIO_OUTSET) = 1u << LED_GREEN;
        *(ranger.twr.running ? &GPIO_OUTSET : &GPIO_OUTCLR) = 1u << LED_RED;
        send_pending();
    }
}
