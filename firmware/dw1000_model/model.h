/* What the model's files share. None of it is for users of the library; symbols have its prefix all the same, so that
 * a driver can define `get` or `control`. */
#ifndef DW1000_MODEL_INTERNAL_H
#define DW1000_MODEL_INTERNAL_H

#include <stdbool.h>

#include "dw1000_model.h"
#include "dw1000_remote.h"

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
#define LONGEST_LINK_M 100000.0

/* Register files. */
enum {
    DEV_ID = 0x00, EUI = 0x01, PANADR = 0x03, SYS_CFG = 0x04, SYS_TIME = 0x06, TX_FCTRL = 0x08, TX_BUFFER = 0x09,
    DX_TIME = 0x0A, RX_FWTO = 0x0C, SYS_CTRL = 0x0D, SYS_MASK = 0x0E, SYS_STATUS = 0x0F, RX_FINFO = 0x10,
    RX_BUFFER = 0x11, RX_FQUAL = 0x12, RX_TTCKI = 0x13, RX_TTCKO = 0x14, RX_TIME = 0x15, TX_TIME = 0x17,
    TX_ANTD = 0x18, SYS_STATE = 0x19, ACK_RESP_T = 0x1A, RX_SNIFF = 0x1D, TX_POWER = 0x1E, CHAN_CTRL = 0x1F,
    USR_SFD = 0x21, AGC_CTRL = 0x23, EXT_SYNC = 0x24, ACC_MEM = 0x25, GPIO_CTRL = 0x26, DRX_CONF = 0x27,
    RF_CONF = 0x28, TX_CAL = 0x2A, FS_CTRL = 0x2B, AON = 0x2C, OTP_IF = 0x2D, LDE_IF = 0x2E, DIG_DIAG = 0x2F,
    PMSC = 0x36
};

/* Sub-addresses that the model itself reads or writes. */
enum {
    RX_STAMP = 0, FP_INDEX = 5, FP_AMPL1 = 7, RX_RAWST = 9, TX_RAWST = 5, DRX_TUNE2 = 0x08, DRX_SFDTOC = 0x20,
    DRX_PRETOC = 0x24, DRX_CAR_INT = 0x28, RXPACC_NOSAT = 0x2C, RF_SAR_BIAS = 0x11, RF_SAR_SWITCH = 0x12,
    TC_SARC = 0x00, TC_SARL = 0x03, TC_SARW = 0x06, FS_PLLCFG = 0x07, AON_WCFG = 0x00, AON_CTRL = 0x02,
    AON_CFG0 = 0x06, AON_SLEEP_TIM = 0x08, AON_CFG1 = 0x0A,
    OTP_ADDR = 0x04, OTP_CTRL = 0x06, OTP_RDAT = 0x0A, LDE_THRESH = 0x0000, LDE_CFG1 = 0x0806,
    LDE_PPINDX = 0x1000, LDE_PPAMPL = 0x1002, LDE_RXANTD = 0x1804, EVC_CTRL = 0x00, PMSC_CTRL0 = 0x00,
    PMSC_CTRL1 = 0x04
};

/* SYS_CFG */
#define CFG_FFEN (1u << 0)
#define CFG_FFBC (1u << 1)
#define CFG_FFAB (1u << 2)
#define CFG_FFA4 (1u << 7)
#define CFG_FFA5 (1u << 8)
#define CFG_HIRQ_POL (1u << 9)
#define CFG_DIS_DRXB (1u << 12)
#define CFG_DIS_PHE (1u << 13)
#define CFG_DIS_RSDE (1u << 14)
#define CFG_FCS_INIT2F (1u << 15)
#define CFG_PHR_MODE (3u << 16)
#define CFG_DIS_STXP (1u << 18)
#define CFG_RXM110K (1u << 22)
#define CFG_RXWTOE (1u << 28)
#define CFG_RXAUTR (1u << 29)
#define CFG_AUTOACK (1u << 30)
#define CFG_AACKPEND (1u << 31)

/* SYS_CTRL */
#define CTRL_SFCST (1u << 0)
#define CTRL_TXSTRT (1u << 1)
#define CTRL_TXDLYS (1u << 2)
#define CTRL_TRXOFF (1u << 6)
#define CTRL_WAIT4RESP (1u << 7)
#define CTRL_RXENAB (1u << 8)
#define CTRL_RXDLYE (1u << 9)
#define CTRL_HRBPT (1u << 24)

/* SYS_STATUS */
#define BIT(n) (UINT64_C(1) << (n))
#define ST_IRQS BIT(0)
#define ST_CPLOCK BIT(1)
#define ST_AAT BIT(3)
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
#define ST_RXOVRR BIT(20)
#define ST_RXPTO BIT(21)
#define ST_SLP2INIT BIT(23)
#define ST_RXSFDTO BIT(26)
#define ST_HPDWARN BIT(27)
#define ST_TXBERR BIT(28)
#define ST_AFFREJ BIT(29)
#define ST_HSRBP BIT(30)
#define ST_ICRBP BIT(31)
#define ST_RXRSCS BIT(32)
#define ST_RXPREJ BIT(33)
#define ST_TXPUTE BIT(34)
/* Those that each of the two receive buffers has for itself. */
#define ST_SWINGING (ST_LDEDONE | ST_RXDFR | ST_RXFCG | ST_RXFCE)
#define ST_READ_ONLY (ST_IRQS | ST_RXOVRR | ST_HPDWARN | ST_HSRBP | ST_ICRBP | ST_TXPUTE)
#define ST_TX (ST_AAT | ST_TXFRB | ST_TXPRS | ST_TXPHS | ST_TXFRS | ST_TXBERR)
#define ST_RX                                                                                                        \
    (ST_RXPRD | ST_RXSFDD | ST_RXPHD | ST_RXPHE | ST_RXRFSL | ST_RXRFTO | ST_LDEERR | ST_RXPTO | ST_RXSFDTO |        \
     ST_AFFREJ | ST_RXRSCS | ST_RXPREJ | ST_SWINGING)

/* Event counters, in the order of their registers from DIG_DIAG:04. */
typedef enum {
    COUNT_PHE, COUNT_RSE, COUNT_FCG, COUNT_FCE, COUNT_FFR, COUNT_OVR, COUNT_STO, COUNT_PTO, COUNT_FWTO, COUNT_TXFS,
    COUNT_HPW, COUNT_TPW, COUNTERS
} counter;

/* What belongs together is cancelled together. */
typedef enum { GROUP_POWER, GROUP_LOAD, GROUP_SENSORS, GROUP_TX, GROUP_RX, GROUP_FRAME, GROUP_LATE, GROUPS } event_group;

typedef struct coroutine coroutine;
typedef struct transmission transmission;
typedef void handler(dw1000_chip *chip, transmission *frame);

typedef struct {
    instant at;
    uint64_t order; /* of those at the same time, the first to be scheduled comes first */
    handler *fire;  /* NULL = a coroutine goes on */
    dw1000_chip *chip;
    transmission *frame;
    coroutine *program;
    uint32_t epoch;
    event_group group;
} event;

/* What the receiver's registers tell of a link, worked out once. Shared by both directions. */
typedef struct {
    unsigned users;
    uint64_t key; /* of its dice */
    instant flight, excess;
    double loss, damage, level; /* level: received power, linear */
    uint16_t fp_index, fp_ampl[3], cir_pwr, std_noise, threshold, pp_index, pp_ampl, preamble_count;
    int16_t iq[2 * ACCUMULATOR_SAMPLES];
} link;

/* What sender and receiver must agree in. */
typedef struct {
    unsigned channel, prf, code;
    bool tuned; /* the synthesiser's registers are those of the channel */
    unsigned sfd_symbols;
    bool decawave_sfd, slow; /* slow: 110 kbit/s */
} air_interface;

/* One frame on the air; instants are those at the sender's antenna. */
struct transmission {
    transmission *next;
    unsigned receivers; /* that hold on to it */
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

typedef enum { POWER_SLEEP, POWER_WAKEUP, POWER_INIT, POWER_IDLE } power_state;
typedef enum { TX_OFF, TX_WAIT, TX_ON } tx_state;
typedef enum { RX_OFF, RX_WAIT, RX_WARMUP, RX_SEARCH, RX_PREAMBLE, RX_HEADER, RX_DATA } rx_state;

#define REGISTER_OCTETS 4096

struct dw1000_chip {
    dw1000_air *air;
    size_t index;
    link **links; /* by the other's index */
    const char *fault;
    uint32_t epoch[GROUPS];
    coroutine *program, *waiter;
    int (*next)(void *context, dw1000_request *request); /* of a remote program */

    uint64_t clock_offset; /* units */
    int64_t clock_rate;    /* 2^44 = without error */
    double ppm, celsius, volts, edges_lost;
    uint16_t tx_delay, rx_delay;
    uint32_t otp[0x80];

    power_state power;
    bool in_reset, lde_loaded, listens_on_wake;
    uint8_t octets[REGISTER_OCTETS], retained[REGISTER_OCTETS];
    uint8_t tx_buffer[FRAME_OCTETS];
    uint64_t status;
    bool line, glitch;

    tx_state tx;
    transmission *sending;
    bool suppress_fcs, wait_for_response, acknowledging;
    uint8_t data_power, header_power; /* of the frame sent last: octets of TX_POWER */

    rx_state rx;
    bool rx_in_reset, stale; /* stale: an error was not followed by a receiver reset */
    transmission *frame;     /* that is being received */
    link *path;              /* of that frame */
    unsigned symbols;        /* of its preamble that are accumulated */
    bool clashed;
    instant searching; /* since when */
    uint64_t receptions;

    /* The swinging set: what the receiver writes to and what the host sees. */
    struct {
        uint8_t octets[48], buffer[FRAME_OCTETS];
        uint64_t status;
        bool full;
    } set[2];
    unsigned chip_side, host_side;
    int16_t accumulator[2 * ACCUMULATOR_SAMPLES];
    bool counting;
};

struct dw1000_air {
    uint64_t seed, order, serial;
    instant now;
    event *events;
    size_t event_count, event_room;
    dw1000_chip **chips;
    size_t chip_count;
    transmission *flying;
    coroutine *outside, *current, *programs;
    bool running; /* within dw1000_run */
    size_t alive;
};

/* schedule.c */
void *dw1000_memory(size_t bytes); /* zeroed; ends the process where there is none */
void dw1000_schedule(dw1000_chip *chip, event_group group, instant at, handler *fire, transmission *frame);
void dw1000_cancel(dw1000_chip *chip, event_group group);
void dw1000_pass(dw1000_air *air, instant until);
void dw1000_wake(dw1000_chip *chip);
double dw1000_seconds_now(const dw1000_air *air);
void dw1000_free_programs(dw1000_air *air);
bool dw1000_start_outside(dw1000_air *air);

/* clock.c */
uint64_t dw1000_local_units(const dw1000_chip *chip, instant at); /* of the chip's counter, not wrapped */
instant dw1000_air_time(const dw1000_chip *chip, uint64_t units);
uint64_t dw1000_counter_now(const dw1000_chip *chip);
uint64_t dw1000_dice(uint64_t a, uint64_t b); /* 64 random bits that depend on nothing else */
double dw1000_chance(uint64_t bits);          /* in 0 to 1 */

/* registers.c */
void dw1000_prepare_map(void);
void dw1000_reset_registers(dw1000_chip *chip);
uint64_t dw1000_get(const dw1000_chip *chip, unsigned file, unsigned sub, unsigned octets);
void dw1000_put(dw1000_chip *chip, unsigned file, unsigned sub, unsigned octets, uint64_t value);
uint8_t *dw1000_place(dw1000_chip *chip, unsigned file, unsigned sub); /* of an octet; NULL = reserved */
void dw1000_read_octets(dw1000_chip *chip, unsigned file, unsigned sub, uint8_t *to, size_t count);
void dw1000_write_octets(dw1000_chip *chip, unsigned file, unsigned sub, const uint8_t *from, size_t count);

/* control.c */
uint64_t dw1000_status_of(const dw1000_chip *chip);
void dw1000_raise_status(dw1000_chip *chip, uint64_t bits);
void dw1000_clear_status(dw1000_chip *chip, uint64_t bits);
void dw1000_update_line(dw1000_chip *chip);
void dw1000_count_event(dw1000_chip *chip, counter which);
void dw1000_control(dw1000_chip *chip, uint32_t command);
void dw1000_acknowledge_status(dw1000_chip *chip, uint64_t bits); /* the host writes ones */
uint32_t dw1000_system_state(const dw1000_chip *chip);

/* power.c */
void dw1000_power_written(dw1000_chip *chip, unsigned file, unsigned sub, size_t count);
void dw1000_reset_chip(dw1000_chip *chip, instant until_init);
void dw1000_fill_otp(dw1000_chip *chip);
bool dw1000_spi_works(dw1000_chip *chip, uint32_t hz);
bool dw1000_clocks_listen(const dw1000_chip *chip, uint32_t hz);
void dw1000_wake_by_select(dw1000_chip *chip, instant held);
void dw1000_sleep_after(dw1000_chip *chip, unsigned enabling_bit);

/* transmit.c */
void dw1000_start_transmission(dw1000_chip *chip, uint32_t command);
void dw1000_start_acknowledgement(dw1000_chip *chip, uint8_t sequence);
void dw1000_stop_transmitter(dw1000_chip *chip);

/* receive.c */
void dw1000_enable_receiver(dw1000_chip *chip, instant at, bool by_itself);
void dw1000_delay_receiver(dw1000_chip *chip);
void dw1000_stop_receiver(dw1000_chip *chip);
void dw1000_consider(dw1000_chip *chip, transmission *frame); /* whether the receiver will notice it */
void dw1000_disturb(dw1000_chip *chip, const transmission *frame); /* by another frame than the one being received */
void dw1000_late_event(dw1000_chip *chip);
bool dw1000_doubly_buffered(const dw1000_chip *chip);

/* reception.c */
void dw1000_report_header(dw1000_chip *chip);
void dw1000_report_frame(dw1000_chip *chip, const uint8_t *octets, bool timed);
void dw1000_report_overrun(dw1000_chip *chip);
uint16_t dw1000_frame_check(const uint8_t *octets, size_t count, uint16_t start);

/* filter.c */
bool dw1000_accepted(const dw1000_chip *chip, const uint8_t *octets, size_t count);

/* link.c */
void dw1000_drop_link(link *path);

/* mode.c */
air_interface dw1000_transmit_mode(const dw1000_chip *chip);
air_interface dw1000_receive_mode(const dw1000_chip *chip);
instant dw1000_symbol_units(unsigned prf);
unsigned dw1000_acquisition_chunk(const dw1000_chip *chip);
double dw1000_carrier_hz(unsigned channel);

#endif
