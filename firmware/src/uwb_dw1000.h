/* Driver of the Decawave DW1000, for microcontrollers and for computers. Callbacks reach the chip.
 *
 * No allocation and no globals; every wait is bounded, and every function returns a status. Register names are
 * those of the DW1000 User Manual. One frame is received at a time (single buffer, no automatic re-enabling): the
 * accumulator belongs to the frame that was received last until the receiver is enabled again. */
#ifndef UWB_DW1000_H
#define UWB_DW1000_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define UWB_DW1000_TICK_MASK (((uint64_t)1 << 40) - 1) /* stamps count 1 / (128 x 499.2 MHz), modulo 2^40 */
#define UWB_DW1000_TICKS_PER_US 63897.6
#define UWB_DW1000_ANTENNA_DELAY 32872u /* of transmitter and receiver together: Decawave's 16436 for each */
#define UWB_DW1000_MAX_FRAME_BYTES 127u /* with the two octets of the frame check sequence */

typedef enum {
    UWB_DW1000_OK = 0,
    UWB_DW1000_BAD_ARGUMENT, /* a setting that the chip does not have, or a length beyond its memory */
    UWB_DW1000_BUS,          /* the transfer callback failed */
    UWB_DW1000_ABSENT,       /* DEV_ID is not a DW1000's: wiring, supply, or SPI too fast */
    UWB_DW1000_NO_CLOCK,     /* the clock PLL did not report its lock, and the chip does not respond to fast SPI */
    UWB_DW1000_RESTARTED,    /* the chip has lost its settings: it was reset, or its supply failed */
    UWB_DW1000_TIMEOUT,      /* nothing was received in time */
    UWB_DW1000_DAMAGED,      /* the received frame is invalid: header, check sequence, decoder, leading edge */
    UWB_DW1000_LATE,         /* a delayed transmission would have begun in the past */
    UWB_DW1000_UNSENT        /* a transmission did not end in time */
} uwb_dw1000_status;

/* Callbacks that connect the driver to a chip. */
typedef struct {
    void *context;
    /* Transfer in one chip-select period: write `header`, then write `bytes` octets from `out`, or read them to `in` if
     * `out` is NULL. Returns 0, or another value if the bus failed. */
    int (*transfer)(void *context, const uint8_t *header, size_t header_bytes, const uint8_t *out, uint8_t *in,
                    size_t bytes);
    void (*speed)(void *context, int fast); /* SPI: at most 3 MHz, or if `fast` at most 20 MHz */
    void (*reset)(void *context); /* pull RSTn low, then let it float, never drive it high; NULL = not wired */
    uint64_t (*now_us)(void *context);
    /* Return when the IRQ line is high, at `until_us`, or earlier: the driver then reads SYS_STATUS. Other work may be
     * done during the wait. If IRQ is not wired, return immediately or after a pause. */
    void (*wait)(void *context, uint64_t until_us);
    void (*sleep)(void *context, uint32_t us); /* sleep at least this time */
} uwb_dw1000_io;

/* Both ends must have the same settings, except for the preamble's length and the power. */
typedef struct {
    uint8_t channel;         /* 1, 2, 3, 4, 5, 7 */
    uint8_t prf_mhz;         /* 16, 64 */
    uint8_t preamble_code;   /* 0 = the first that the standard has for channel and PRF */
    uint8_t decawave_sfd;    /* 0 = the standard's */
    uint16_t rate_kbps;      /* 110, 850, 6800 */
    uint16_t preamble;       /* symbols: 64, 128, 256, 512, 1024, 1536, 2048, 4096 */
    uint32_t tx_power;       /* TX_POWER in smart-power format, as in the OTP memory: from the lowest octet on for frames
                              * of any length, up to 500, 250 and 125 us; below 6.8 Mbit/s the lowest octet is used for
                              * all. 0 = the OTP memory's value, or the manual's if it is not programmed */
    uint32_t antenna_delay;  /* ticks of transmitter and receiver together; 0 = as in the OTP memory, else nominal */
    uint8_t anchor;          /* take a TREK1000 board's antenna delay as an anchor, not as a tag */
} uwb_dw1000_settings;

/* Channel 5, PRF 64 MHz, 6.8 Mbit/s, 128 symbols of preamble. */
extern const uwb_dw1000_settings uwb_dw1000_defaults;

typedef struct {
    uwb_dw1000_io io;
    uwb_dw1000_settings settings; /* active settings; zeros are replaced by the values of the chip */
    uint64_t eui;                 /* of the chip: from the OTP memory, or lot and part number if it is not programmed */
    uint32_t otp_antenna_delay;   /* OTP memory: TX + RX, 31:16 at 64 MHz, 15:0 at 16 MHz */
    uint32_t otp_trek_delay[4];   /* per direction, 31:16 anchor, 15:0 tag: channel 2 at 6.8M and 110k, channel 5 */
    uint32_t otp_tx_power[12];
    uint8_t otp_voltage;
    uint8_t otp_temperature;
    uint8_t otp_trek;         /* the OTP memory has the layout of the TREK1000 kit */
    uint8_t lock_unconfirmed; /* CPLOCK was not set (errata: not reliable): a warning, not an error */
    uint8_t listening;        /* the receiver may be on */
    uint8_t clock_forced;  /* the transmitter's, for a delayed transmission */
    uint16_t tx_antenna_delay;
    uint16_t wait_units; /* last value of RX_FWTO; 0 = not written yet */
    uint32_t sys_cfg;
    uint32_t tx_fctrl;   /* without the length */
    uint8_t tx_bytes;    /* last written length; 0 = not written yet */
    uint64_t next_send_us; /* smart power is legal for one frame per millisecond */
} uwb_dw1000;

/* A frame that was received, without its check sequence. */
typedef struct {
    uint64_t stamp;       /* RX_STAMP */
    uint64_t received_us; /* of io.now_us, when it was noticed */
    uint16_t first_path_index;     /* accumulator index times 64 */
    uint16_t first_path_amplitude; /* FP_AMPL1 */
    uint16_t preamble_count;       /* RXPACC */
    uint8_t bytes;
    uint8_t octets[UWB_DW1000_MAX_FRAME_BYTES];
} uwb_dw1000_frame;

/* Measurements of the chip on a received frame. */
typedef struct {
    uint16_t first_path_amplitude[3]; /* FP_AMPL1 to FP_AMPL3 */
    uint16_t preamble_count;          /* RXPACC without the part of the SFD */
    uint16_t noise_threshold; /* LDE_THRESH */
    uint16_t power;           /* CIR_PWR */
    float rx_power_dbm;         /* as in DecaRanging's logs: not corrected for the saturation above -88 dBm */
    float first_path_power_dbm; /* NaN if all amplitudes are 0 */
} uwb_dw1000_quality;

/* Reset the chip, configure its clocks, load the leading-edge detector, read the OTP memory, and apply the settings.
 * `settings` NULL: defaults. */
uwb_dw1000_status uwb_dw1000_start(uwb_dw1000 *chip, const uwb_dw1000_io *io, const uwb_dw1000_settings *settings);

/* Apply other settings to a started chip. After BAD_ARGUMENT the settings are unchanged. */
uwb_dw1000_status uwb_dw1000_configure(uwb_dw1000 *chip, const uwb_dw1000_settings *settings);

/* Return whether the settings are valid. */
int uwb_dw1000_settings_valid(const uwb_dw1000_settings *settings);

/* Check that the chip has kept its settings; otherwise returns RESTARTED. */
uwb_dw1000_status uwb_dw1000_check(uwb_dw1000 *chip);

/* Return the airtime of a frame of `bytes` octets without check sequence, us. */
uint32_t uwb_dw1000_airtime_us(const uwb_dw1000_settings *settings, size_t bytes);

#define UWB_DW1000_NO_LIMIT UINT32_MAX /* listen without a timeout */

/* Send a frame now, or with smart power 1 ms after the previous frame. If `answer_us` is not 0, then listen for that
 * time. */
uwb_dw1000_status uwb_dw1000_send(uwb_dw1000 *chip, const uint8_t *octets, size_t bytes, uint32_t answer_us);

/* Prepare the clock for uwb_dw1000_send_at, which does it itself if necessary. */
uwb_dw1000_status uwb_dw1000_force_clock(uwb_dw1000 *chip);

/* Return the TX_STAMP of a frame to be sent at about `at`, for the contents of that frame. */
uint64_t uwb_dw1000_tx_stamp(const uwb_dw1000 *chip, uint64_t at);

/* Send a frame at the TX_STAMP `stamp`, a result of uwb_dw1000_tx_stamp; then listen as in uwb_dw1000_send. */
uwb_dw1000_status uwb_dw1000_send_at(uwb_dw1000 *chip, const uint8_t *octets, size_t bytes, uint64_t stamp,
                                     uint32_t answer_us);

/* Return the clock control to the chip, after uwb_dw1000_await_sent. */
uwb_dw1000_status uwb_dw1000_release_clock(uwb_dw1000 *chip);

/* Wait until the frame was sent, and get its TX_STAMP; `stamp` may be NULL. The receiver stays on. */
uwb_dw1000_status uwb_dw1000_await_sent(uwb_dw1000 *chip, uint64_t until_us, uint64_t *stamp);

/* Turn the receiver on for `for_us`. */
uwb_dw1000_status uwb_dw1000_listen(uwb_dw1000 *chip, uint32_t for_us);

/* Wait for a frame until `until_us`, and read it. Afterwards the receiver is off. */
uwb_dw1000_status uwb_dw1000_receive(uwb_dw1000 *chip, uwb_dw1000_frame *frame, uint64_t until_us);

/* As uwb_dw1000_receive, but leave the receiver on if nothing is received until `until_us`. */
uwb_dw1000_status uwb_dw1000_receive_keep_on(uwb_dw1000 *chip, uwb_dw1000_frame *frame, uint64_t until_us);

/* Turn transmitter and receiver off. */
uwb_dw1000_status uwb_dw1000_idle(uwb_dw1000 *chip);

/* Read the quality of the last frame, before the receiver is enabled again. */
uwb_dw1000_status uwb_dw1000_read_quality(uwb_dw1000 *chip, const uwb_dw1000_frame *frame,
                                          uwb_dw1000_quality *quality);

/* Samples of the accumulator at 16 and 64 MHz. */
#define UWB_DW1000_SAMPLES(prf_mhz) ((prf_mhz) == 16 ? 992u : 1016u)

/* Read complex samples of the same frame to `octets`, 1 + 4 * count octets: an invalid one, then real and imaginary
 * parts, int16. Returns BAD_ARGUMENT for samples outside the accumulator. */
uwb_dw1000_status uwb_dw1000_read_cir(uwb_dw1000 *chip, size_t first, size_t count, uint8_t *octets);

/* Measure the temperature, degrees Celsius, and the supply voltage, V. */
uwb_dw1000_status uwb_dw1000_read_sensors(uwb_dw1000 *chip, float *temperature, float *voltage);

/* Return the true received power for the `rx_power_dbm` of uwb_dw1000_quality (fit of figure 22 of the manual). */
float uwb_dw1000_true_power_dbm(float rx_power_dbm, uint8_t prf_mhz);

/* Return the range error at a true power, m, positive if the range is too long (application note APS011). */
float uwb_dw1000_range_bias_m(float true_power_dbm, uint8_t channel, uint8_t prf_mhz);

/* Return from the calling function if the status is not OK. */
#define DW1000_TRY(call)                                                                                               \
    do {                                                                                                               \
        const uwb_dw1000_status tried_ = (call);                                                                       \
        if (tried_ != UWB_DW1000_OK) {                                                                                 \
            return tried_;                                                                                             \
        }                                                                                                              \
    } while (0)

#ifdef __cplusplus
}
#endif
#endif
