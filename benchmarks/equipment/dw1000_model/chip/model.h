/* Types and functions shared by the files of the model, not for users of the library. All symbols have the prefix, so
 * that they do not collide with those of a driver. */
#ifndef DW1000_MODEL_INTERNAL_H
#define DW1000_MODEL_INTERNAL_H

#include <stdbool.h>

#include "dw1000_model.h"

/* Time on the air in units of 1/64 tick of a clock without error: 244.5 fs, for 26 days. */
typedef int64_t instant;
#define UNITS_PER_TICK 64
#define UNITS_PER_SECOND (INT64_C(64) * 128 * 499200000)
#define UNITS_PER_NS ((double)UNITS_PER_SECOND * 1e-9)
#define MICROSECONDS(us) ((instant)((us) * 1e-6 * (double)UNITS_PER_SECOND))
#define COUNTER_MASK ((UINT64_C(1) << 40) - 1)
#define COUNTER_GRID 512 /* ticks, of SYS_TIME and of transmissions */

#define ACCUMULATOR_SAMPLES 1016
#define FRAME_OCTETS 1024
#define MAX_DISTANCE_M 100000.0

/* Register files. */
enum {
    DEV_ID = 0x00, EUI = 0x01, PANADR = 0x03, SYS_CFG = 0x04, SYS_TIME = 0x06, TX_FCTRL = 0x08, TX_BUFFER = 0x09,
    DX_TIME = 0x0A, RX_FWTO = 0x0C, SYS_CTRL = 0x0D, SYS_MASK = 0x0E, SYS_STATUS = 0x0F, RX_FINFO = 0x10,
    RX_BUFFER = 0x11, RX_FQUAL = 0x12, RX_TIME = 0x15, TX_TIME = 0x17,
    TX_ANTD = 0x18, ACK_RESP_T = 0x1A, TX_POWER = 0x1E, CHAN_CTRL = 0x1F, USR_SFD = 0x21, AGC_CTRL = 0x23,
    EXT_SYNC = 0x24, ACC_MEM = 0x25, DRX_CONF = 0x27, RF_CONF = 0x28, TX_CAL = 0x2A, FS_CTRL = 0x2B, AON = 0x2C,
    OTP_IF = 0x2D, LDE_IF = 0x2E, PMSC = 0x36
};

/* Sub-addresses that the model itself reads or writes. */
enum {
    FP_INDEX = 5, FP_AMPL1 = 7, RX_RAWST = 9, TX_RAWST = 5, DRX_TUNE2 = 0x08, DRX_SFDTOC = 0x20, RXPACC_NOSAT = 0x2C,
    RF_SAR_BIAS = 0x11, RF_SAR_SWITCH = 0x12, TC_SARC = 0x00, TC_SARL = 0x03, FS_PLLCFG = 0x07, OTP_ADDR = 0x04,
    OTP_CTRL = 0x06, OTP_RDAT = 0x0A, LDE_THRESH = 0x0000, LDE_CFG1 = 0x0806, LDE_RXANTD = 0x1804, PMSC_CTRL0 = 0x00,
    PMSC_CTRL1 = 0x04
};

/* SYS_CFG */
#define CFG_HIRQ_POL (1u << 9)
#define CFG_DIS_DRXB (1u << 12)
#define CFG_PHR_MODE (3u << 16)
#define CFG_DIS_STXP (1u << 18)
#define CFG_RXM110K (1u << 22)
#define CFG_RXWTOE (1u << 28)

/* SYS_CTRL */
#define CTRL_TXSTRT (1u << 1)
#define CTRL_TXDLYS (1u << 2)
#define CTRL_TRXOFF (1u << 6)
#define CTRL_WAIT4RESP (1u << 7)
#define CTRL_RXENAB (1u << 8)

/* SYS_STATUS */
#define BIT(n) (UINT64_C(1) << (n))
#define ST_IRQS BIT(0)
#define ST_CPLOCK BIT(1)
#define ST_TXFRB BIT(4)
#define ST_TXPRS BIT(5)
#define ST_TXPHS BIT(6)
#define ST_TXFRS BIT(7)
#define ST_RXPRD BIT(8)
#define ST_RXSFDD BIT(9)
#define ST_LDEDONE BIT(10)
#define ST_RXPHD BIT(11)
#define ST_RXPHE BIT(12)
#define ST_RXDFR BIT(13)
#define ST_RXFCG BIT(14)
#define ST_RXFCE BIT(15)
#define ST_RXRFSL BIT(16)
#define ST_RXRFTO BIT(17)
#define ST_LDEERR BIT(18)
#define ST_SLP2INIT BIT(23)
#define ST_RXSFDTO BIT(26)
#define ST_HPDWARN BIT(27)
#define ST_TXPUTE BIT(34)
#define ST_READ_ONLY (ST_IRQS | ST_HPDWARN | ST_TXPUTE)
#define ST_TX (ST_TXFRB | ST_TXPRS | ST_TXPHS | ST_TXFRS)
#define ST_RX                                                                                                        \
    (ST_RXPRD | ST_RXSFDD | ST_LDEDONE | ST_RXPHD | ST_RXPHE | ST_RXDFR | ST_RXFCG | ST_RXFCE | ST_RXRFSL |           \
     ST_RXRFTO | ST_LDEERR | ST_RXSFDTO)

/* Events of a group are cancelled together. */
typedef enum { GROUP_POWER, GROUP_LOAD, GROUP_SENSORS, GROUP_TX, GROUP_RX, GROUP_FRAME, GROUP_LATE, GROUPS } event_group;

typedef struct coroutine coroutine;
typedef struct transmission transmission;
typedef void handler(dw1000_chip *chip, transmission *frame);

typedef struct {
    instant at;
    uint64_t order; /* events at the same time are handled in the order of scheduling */
    handler *fire;  /* NULL = resume a coroutine */
    dw1000_chip *chip;
    transmission *frame;
    coroutine *program;
    uint32_t epoch;
    event_group group;
} event;

/* A pair, and the receiver's register values for it. Shared by both directions. */
typedef struct {
    unsigned users;
    uint64_t key; /* of its random numbers */
    instant flight, excess;
    double loss, damage, level; /* level: received power, linear */
    uint16_t fp_index, fp_ampl[3], cir_pwr, std_noise, threshold, preamble_count;
    int16_t iq[2 * ACCUMULATOR_SAMPLES];
} radio_pair;

/* Settings in which sender and receiver must agree. */
typedef struct {
    unsigned channel, prf, code;
    bool tuned; /* the synthesiser's registers are those of the channel */
    unsigned sfd_symbols;
    bool decawave_sfd, slow; /* slow: 110 kbit/s */
} air_interface;

/* One frame on the air; instants are those at the sender's antenna. */
struct transmission {
    transmission *next;
    unsigned receivers; /* number of receivers that reference it */
    uint64_t serial;
    dw1000_chip *sender;
    air_interface mode;
    unsigned rate, preamble_symbols, preamble_code, phr_mode;
    bool ranging;
    size_t length; /* with FCS */
    instant start, sfd, marker, data, end, aborted;
    uint64_t counter; /* of the sender, at the marker; ticks */
    instant symbol;
    uint8_t payload[FRAME_OCTETS];
};

typedef enum { POWER_WAKEUP, POWER_INIT, POWER_IDLE } power_state;
typedef enum { TX_OFF, TX_WAIT, TX_ON } tx_state;
typedef enum { RX_OFF, RX_WAIT, RX_WARMUP, RX_SEARCH, RX_PREAMBLE, RX_HEADER, RX_DATA } rx_state;

#define REGISTER_OCTETS 4096

struct dw1000_chip {
    dw1000_air *air;
    size_t index;
    radio_pair **pairs; /* by the other's index */
    const char *fault;
    uint32_t epoch[GROUPS];
    coroutine *program, *waiter;
    int (*next)(void *context, dw1000_request *request); /* of a remote program */

    uint64_t clock_offset; /* units */
    int64_t clock_rate;    /* 2^44 = without error */
    double ppm, celsius, volts, edge_loss;
    uint16_t tx_delay, rx_delay;
    uint32_t otp[0x80];

    power_state power;
    bool in_reset, lde_loaded;
    uint8_t octets[REGISTER_OCTETS], tx_buffer[FRAME_OCTETS], rx_buffer[FRAME_OCTETS];
    uint64_t status;
    bool line;

    tx_state tx;
    transmission *sending;
    bool wait_for_response;
    uint8_t data_power, header_power; /* of the frame sent last: octets of TX_POWER */

    rx_state rx;
    bool rx_in_reset, needs_rx_reset; /* an error was not followed by a receiver reset */
    transmission *frame;     /* that is being received */
    radio_pair *pair;              /* of that frame */
    unsigned symbols;        /* of its preamble that are accumulated */
    bool collided;
    uint64_t receptions;
    int16_t accumulator[2 * ACCUMULATOR_SAMPLES];
};

struct dw1000_air {
    uint64_t seed, order, serial;
    instant now;
    event *events;
    size_t event_count, event_capacity;
    dw1000_chip **chips;
    size_t chip_count;
    transmission *frames_on_air;
    coroutine *caller, *current, *programs;
    bool running; /* within dw1000_run */
    size_t running_programs;
};

/* The layers, lowest first: each calls only those above it in this list. */

/* registers.c: the register map, clocks, random numbers, and the air interface set by the registers. */
void dw1000_init_register_map(void);
void dw1000_reset_registers(dw1000_chip *chip);
uint64_t dw1000_get(const dw1000_chip *chip, unsigned file, unsigned sub, unsigned octets);
void dw1000_put(dw1000_chip *chip, unsigned file, unsigned sub, unsigned octets, uint64_t value);
uint8_t dw1000_read_octet(const dw1000_chip *chip, unsigned file, unsigned sub);
void dw1000_write_octet(dw1000_chip *chip, unsigned file, unsigned sub, uint8_t octet);
uint64_t dw1000_counter_units(const dw1000_chip *chip, instant at); /* of the chip's counter, in 1/64 tick */
instant dw1000_air_time(const dw1000_chip *chip, uint64_t units);
uint64_t dw1000_random_bits(uint64_t a, uint64_t b);
double dw1000_uniform(uint64_t bits);
air_interface dw1000_transmit_mode(const dw1000_chip *chip);
air_interface dw1000_receive_mode(const dw1000_chip *chip);
instant dw1000_symbol_units(unsigned prf);

/* events.c: virtual time, programs, SYS_STATUS and the IRQ line. */
void *dw1000_allocate(size_t bytes); /* zeroed; aborts if memory is exhausted */
void dw1000_schedule(dw1000_chip *chip, event_group group, instant at, handler *fire, transmission *frame);
void dw1000_cancel(dw1000_chip *chip, event_group group);
void dw1000_advance(dw1000_air *air, instant until);
double dw1000_seconds_now(const dw1000_air *air);
bool dw1000_create_caller(dw1000_air *air);
void dw1000_free_programs(dw1000_air *air);
uint64_t dw1000_status(const dw1000_chip *chip);
void dw1000_update_line(dw1000_chip *chip);
void dw1000_raise_status(dw1000_chip *chip, uint64_t bits);
void dw1000_clear_status(dw1000_chip *chip, uint64_t bits);

/* pair.c: the register values that follow from a pair's accumulator. */
void dw1000_release_pair(radio_pair *pair);

/* receiver.c */
void dw1000_enable_receiver(dw1000_chip *chip, instant at);
void dw1000_stop_receiver(dw1000_chip *chip);
void dw1000_try_detect(dw1000_chip *chip, transmission *frame); /* whether the receiver will detect it */
void dw1000_check_collision(dw1000_chip *chip, const transmission *frame); /* by another frame than the one being received */
void dw1000_schedule_late_event(dw1000_chip *chip);
uint16_t dw1000_frame_check(const uint8_t *octets, size_t count);

/* transmitter.c */
void dw1000_start_transmission(dw1000_chip *chip, uint32_t command);
void dw1000_stop_transmitter(dw1000_chip *chip);

/* power.c: commands, resets, clocks, memories, sensors. */
bool dw1000_spi_works(dw1000_chip *chip, uint32_t hz);
bool dw1000_accepts_pmsc_writes(const dw1000_chip *chip, uint32_t hz);
void dw1000_handle_sys_ctrl(dw1000_chip *chip, uint32_t command);
void dw1000_handle_register_write(dw1000_chip *chip, unsigned file, unsigned sub, size_t count);
void dw1000_fill_otp(dw1000_chip *chip);

#endif
