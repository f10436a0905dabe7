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

/* Radio channel of a pair of chips. Fields that are 0 have defaults: `{.distance_m = 3}` is an undisturbed channel. */
typedef struct {
    double distance_m;       /* along the straight line, 0 to 100,000 */
    double excess_m;         /* excess path of the detected first path */
    const int16_t *iq;       /* real, imaginary, real, ...: copied. NULL = one path and a little noise */
    size_t samples;          /* complex ones, at most 1016; the chip's accumulator is filled up with zeros */
    double first_path_index; /* in samples, 1/64 is kept; 0 = where the accumulator first rises to half of a peak */
    uint16_t preamble_count; /* RXPACC, where the accumulation stopped; 0 = complete, with the symbols of the SFD */
    uint16_t noise_threshold; /* LDE_THRESH; 0 = NTM of LDE_CFG1 times std_noise */
    uint16_t std_noise;       /* 0 = standard deviation of the magnitudes of samples 64 to 575 */
    double loss;              /* probability that a frame is not detected */
    double damage;            /* probability that a frame is received with an error of any kind */
} dw1000_pair_config;

/* Returns NULL if there is no memory. Freeing an air frees its chips and stops their programs. */
dw1000_air *dw1000_air_new(uint64_t seed);
void dw1000_air_free(dw1000_air *air);

/* Create a powered, idle chip. `ppm`: error of its crystal, positive if it is fast. `clock_ticks`: its 40-bit
 * counter at time 0; a reset does not change it. `tx_delay_ticks`, `rx_delay_ticks`: antenna delays, which a driver must
 * know; the OTP memory contains their sum. */
dw1000_chip *dw1000_chip_new(dw1000_air *air, double ppm, uint64_t clock_ticks, uint16_t tx_delay_ticks,
                             uint16_t rx_delay_ticks);

/* Set the properties of a pair of chips for both directions; NULL: the chips do not receive each other. A frame that is
 * being received keeps the previous properties. */
void dw1000_set_pair(dw1000_air *air, dw1000_chip *a, dw1000_chip *b, const dw1000_pair_config *config);

/* Start a program on a chip's host; it replaces the previous one. */
void dw1000_program(dw1000_chip *chip, void (*run)(dw1000_chip *chip, void *context), void *context);

/* Advance the time by `seconds`, or until all programs have ended; returns the time since the start of the air. */
double dw1000_run(dw1000_air *air, double seconds);

/* For programs. If called outside of a program, all programs run during the call. */

/* One chip-select period, full duplex; `in` may be NULL. */
void dw1000_spi(dw1000_chip *chip, const uint8_t *out, uint8_t *in, size_t n, uint32_t hz);
/* Return the level of the IRQ line. Reading it or the time takes a program 100 ns, so that polling loops end. */
int dw1000_irq(dw1000_chip *chip);
/* Wait until the IRQ line is high, at most for `at_most_s`. */
void dw1000_wait(dw1000_chip *chip, double at_most_s);
void dw1000_delay(dw1000_chip *chip, double s);
/* Pull RSTn low for 1 ms, and let it float. */
void dw1000_reset_pin(dw1000_chip *chip);
/* Seconds since the air's beginning. */
double dw1000_now(dw1000_chip *chip);

/* Programs in languages without coroutines return one request after another. */
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

/* For tests. */

/* Drive RSTn from now on. The chip drives the line too: driving it high destroys the chip. */
typedef enum { DW1000_RESET_LOW, DW1000_RESET_FLOAT, DW1000_RESET_HIGH } dw1000_reset_level;
void dw1000_reset_drive(dw1000_chip *chip, dw1000_reset_level level);
/* Set the values that the on-chip sensors measure; initially 25 degrees Celsius and 3.3 V. */
void dw1000_set_environment(dw1000_chip *chip, double celsius, double volts);
/* Set the fraction of good frames, 0 to 1, in which the chip's detector finds no leading edge: LDEERR. */
void dw1000_set_edge_loss(dw1000_chip *chip, double probability);
/* Set a word of the OTP memory, 0x00 to 0x7F; registers that are loaded from it change with the next reset. */
void dw1000_program_otp(dw1000_chip *chip, unsigned address, uint32_t word);
/* Get the transmit power of the last frame for preamble and data, and for the PHR: dB above the lowest that TX_POWER can set. */
void dw1000_sent_power(const dw1000_chip *chip, double *data_db, double *header_db);
/* Return the cause of the destruction of the chip; NULL: the chip works. */
const char *dw1000_fault(const dw1000_chip *chip);

#ifdef __cplusplus
}
#endif
#endif
