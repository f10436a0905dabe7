/* A model of the DW1000, register by register, in virtual time: several chips share one air, and the program of each
 * chip's host is a coroutine. Any driver that talks to the chip through SPI runs on it; the README lists what
 * is modelled, and which errors of a driver show as on the chip.
 *
 * One air is used by one thread at a time; airs do not know of each other. The same seed and programs give the same run. */
#ifndef DW1000_MODEL_H
#define DW1000_MODEL_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct dw1000_air dw1000_air;
typedef struct dw1000_chip dw1000_chip;

/* Properties of a link. Fields that are 0 have defaults, so that `{.distance_m = 3}` is a clean link. */
typedef struct {
    double distance_m;       /* along the straight line, 0 to 100,000 */
    double excess_m;         /* excess path of the detected first path */
    const int16_t *iq;       /* real, imaginary, real, ...: copied. NULL = one path and a little noise */
    size_t samples;          /* complex ones, at most 1016; the chip's accumulator is filled up with zeros */
    double first_path_index; /* in samples, 1/64 is kept; 0 = where the accumulator first rises to half of a peak */
    uint16_t preamble_count; /* RXPACC, where accumulation stopped; 0 = at the end, with the SFD's symbols in it */
    uint16_t noise_threshold; /* LDE_THRESH; 0 = NTM of LDE_CFG1 times std_noise */
    uint16_t std_noise;       /* 0 = standard deviation of the magnitudes of samples 64 to 575 */
    double loss;              /* probability that a frame is not noticed at all */
    double damage;            /* probability that one is received with an error, of any of the kinds there are */
} dw1000_link_config;

/* NULL: no memory. Freeing an air frees its chips and stops their programs. */
dw1000_air *dw1000_air_new(uint64_t seed);
void dw1000_air_free(dw1000_air *air);

/* A chip that was powered a while ago and is idle. `ppm`: error of its crystal, positive if it is fast. `clock_ticks`: its 40-bit
 * counter at time 0; a reset does not change it. `tx_delay_ticks`, `rx_delay_ticks`: from counter to antenna and back,
 * which a driver has to know; the OTP memory holds their sum. */
dw1000_chip *dw1000_chip_new(dw1000_air *air, double ppm, uint64_t clock_ticks, uint16_t tx_delay_ticks,
                             uint16_t rx_delay_ticks);

/* Link two chips in both directions, in place of an earlier link; NULL: remove the link. A frame that is being received
 * keeps the link it began with. */
void dw1000_link(dw1000_air *air, dw1000_chip *a, dw1000_chip *b, const dw1000_link_config *config);

/* Start a program on a chip's host; it replaces the previous one. */
void dw1000_program(dw1000_chip *chip, void (*run)(dw1000_chip *chip, void *context), void *context);

/* Let `seconds` pass, or less if all programs end within them; returns the time reached, from the air's beginning. */
double dw1000_run(dw1000_air *air, double seconds);

/* From within a program. Called from outside of one, they let all programs run on meanwhile. */

/* One chip-select period, full duplex; `in` may be NULL. */
void dw1000_spi(dw1000_chip *chip, const uint8_t *out, uint8_t *in, size_t n, uint32_t hz);
/* The level of the IRQ line. To look at it, or at the time, takes a program 100 ns: one may wait by looking. */
int dw1000_irq(dw1000_chip *chip);
/* Until the IRQ line is high, or for `at_most_s`. */
void dw1000_wait(dw1000_chip *chip, double at_most_s);
void dw1000_delay(dw1000_chip *chip, double s);
/* Pull RSTn low for 1 ms, and let it float. */
void dw1000_reset_pin(dw1000_chip *chip);
/* Seconds since the air's beginning. */
double dw1000_now(dw1000_chip *chip);

/* Programs in languages that cannot be coroutines: each asks for one request after another. */
typedef enum { DW1000_SPI, DW1000_DELAY, DW1000_WAIT, DW1000_RESET_PIN } dw1000_request_kind;

typedef struct {
    int32_t kind; /* dw1000_request_kind */
    int32_t line; /* the IRQ line after the last request */
    double now_s; /* and the time */
    double seconds;
    const uint8_t *out;
    uint8_t *in;
    size_t n;
    uint32_t hz;
} dw1000_request;

/* `next` writes the next request, and returns 0 after the last one. It is called on the program's stack, and
 * has to return before anything else happens on the air. */
void dw1000_program_remote(dw1000_chip *chip, int (*next)(void *context, dw1000_request *request), void *context);

/* Beyond a driver's needs, for tests. */

/* How the host holds RSTn from now on. The chip drives the line too: held high, it is destroyed. */
typedef enum { DW1000_RESET_LOW, DW1000_RESET_FLOAT, DW1000_RESET_HIGH } dw1000_reset_level;
void dw1000_reset_drive(dw1000_chip *chip, dw1000_reset_level level);
/* Values that the on-chip sensors measure; 25 degrees Celsius and 3.3 V at first. */
void dw1000_environment(dw1000_chip *chip, double celsius, double volts);
/* Fraction of good frames, 0 to 1, in which the chip's detector finds no leading edge: LDEERR. */
void dw1000_lose_edges(dw1000_chip *chip, double probability);
/* Set a word of the OTP memory, 0x00 to 0x7F; registers that are loaded from it change with the next reset. */
void dw1000_program_otp(dw1000_chip *chip, unsigned address, uint32_t word);
/* Transmit power of the last frame for preamble and data, and for the PHR: dB above the lowest that TX_POWER can set. */
void dw1000_sent_power(const dw1000_chip *chip, double *data_db, double *header_db);
/* Cause of the destruction of the chip; NULL: the chip works. */
const char *dw1000_fault(const dw1000_chip *chip);

#ifdef __cplusplus
}
#endif
#endif
