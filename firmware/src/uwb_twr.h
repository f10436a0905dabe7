/* Two-way ranging with the DW1000: asymmetric double-sided, in data frames of IEEE 802.15.4.
 *
 *     tag                          anchor
 *     POLL   ─────────────────────────►
 *        ◄─────────────────────  ANSWER
 *     FINAL  ─────────────────────────►   timestamps of the tag: the anchor knows the range
 *        ◄─────────────────────  REPORT   timestamps of the anchor: the tag knows the range
 *
 * Each side draws a random number for each exchange, and all later frames of the exchange contain both. Repeated frames
 * and frames of other exchanges or networks are refused and counted. The channel impulse response of a range is that of
 * the last received frame: REPORT at a tag, FINAL at an anchor. It is therefore never read while the other side waits
 * for a frame with a fixed time of transmission.
 *
 * No allocation, no globals. One step is one exchange: of a tag with the next anchor, or of an anchor with any tag. All
 * waits are in the callbacks of uwb_dw1000_io and have a timeout. */
#ifndef UWB_TWR_H
#define UWB_TWR_H

#include "uwb_dw1000.h"
#include "uwb_protocol.h"

#ifdef __cplusplus
extern "C" {
#endif

#define UWB_TWR_STAMPS 3

/* Memory for a measurement with `samples` complex samples. */
#define UWB_TWR_MEASUREMENT_BYTES(samples) (sizeof(uwb_range_cir_t) + 4u * (samples))

#define UWB_TWR_SETTINGS_BYTES (sizeof(uwb_radio_t) + 8u * UWB_MAX_ANCHORS)
#define UWB_TWR_STATUS_BYTES (sizeof(uwb_radio_status_t) + UWB_MAX_ANCHORS * sizeof(uwb_radio_anchor_t))

/* Configuration of a tag or an anchor. Only tags use reply_us, timeout_us, interval_us and the list of anchors. */
typedef struct {
    uwb_dw1000_settings radio;
    uint64_t address; /* 0 = that of the chip */
    uint16_t pan;
    uint8_t role;          /* UWB_ROLE_* */
    uint8_t report;        /* an anchor also outputs its ranges; it then answers FINAL later */
    uint8_t bias_correction; /* APS011, for the output ranges; the models were trained without it */
    uint8_t anchor_count;  /* 0 = anchors found by broadcast */
    uint16_t window;       /* complex samples per measurement; 0 = none */
    uint32_t reply_us;     /* from the reception of ANSWER to FINAL; depends on bus, processor and airtime */
    uint32_t timeout_us;  /* for the frames of an anchor */
    uint32_t interval_us;  /* minimum time between the starts of two exchanges */
    uint64_t anchors[UWB_MAX_ANCHORS];
} uwb_twr_config;

/* Defaults: a tag with 157 samples that finds its anchors by broadcast, and times for the SPI of a microcontroller. */
extern const uwb_twr_config uwb_twr_defaults;

/* Started exchanges and their results: `tried` is the sum of the results. */
typedef struct {
    uint32_t tried;
    uint32_t ranged;
    uint32_t no_answer; /* POLL was not answered */
    uint32_t late;      /* FINAL could not be sent in time */
    uint32_t timeout;  /* FINAL or REPORT was not received */
    uint32_t damaged;   /* something was received that is not a valid frame */
    uint32_t implausible;    /* implausible timestamps */
    uint32_t broken;    /* the chip was reset, or the bus failed */

    uint32_t refused;  /* frames that do not belong to the exchange */
    uint32_t restarts; /* restarts of the chip, without the first start */
} uwb_twr_counts;

/* State of an anchor in the table of a tag. */
typedef struct {
    uint64_t address;
    uint64_t last_seen_us;
    uint64_t next_poll_us;
    uint32_t tried;
    uint32_t ranged;
    uint32_t answer_us; /* from POLL to ANSWER in the last exchange; 0 = none yet */
    uint32_t misses;    /* missed answers since its last answer */
    float rx_power_dbm;
} uwb_twr_anchor;

/* Types of frames. DISCOVER is a broadcast; anchors answer it with DISCOVER_REPLY. */
typedef enum {
    UWB_TWR_DISCOVER = 1,
    UWB_TWR_DISCOVER_REPLY,
    UWB_TWR_POLL,
    UWB_TWR_ANSWER,
    UWB_TWR_FINAL,
    UWB_TWR_REPORT
} uwb_twr_frame_type;

typedef struct {
    uwb_twr_frame_type kind;
    uint8_t sequence;
    uint16_t pan;
    uint64_t to; /* UWB_TWR_BROADCAST: a broadcast */
    uint64_t from;
    uint32_t tag_number;    /* random number of the tag; its low octet is the frame's sequence number */
    uint32_t anchor_number; /* random number of the anchor, from ANSWER on */
    uint32_t time_us;       /* DISCOVER: time to answer; POLL: time from ANSWER to FINAL */
    uint64_t stamps[UWB_TWR_STAMPS]; /* FINAL, REPORT */
    uint8_t known[32];               /* DISCOVER: Bloom filter of the anchors that need not answer */
} uwb_twr_frame;

#define UWB_TWR_BROADCAST UINT64_MAX
#define UWB_TWR_MAX_FRAME_BYTES 57u

/* Add an anchor to the Bloom filter of a DISCOVER. The hash differs between two DISCOVER frames. */
void uwb_twr_mark_known(uwb_twr_frame *discover, uint64_t address);
/* Return whether an anchor is in the Bloom filter of a DISCOVER, possibly by a collision. */
int uwb_twr_is_known(const uwb_twr_frame *discover, uint64_t address);

/* Encode a frame, without check sequence; returns its length. */
size_t uwb_twr_write(const uwb_twr_frame *frame, uint8_t *octets);

/* Decode a frame; returns whether it is well formed. */
int uwb_twr_read(const uint8_t *octets, size_t bytes, uwb_twr_frame *frame);

/* Compute the distance of the antennas, m, from the timestamps of the tag (POLL sent, ANSWER received, FINAL sent) and
 * of the anchor (POLL received, ANSWER sent, FINAL received), modulo 2^40; returns 0 if they are implausible. */
int uwb_twr_range_m(const uint64_t tag[UWB_TWR_STAMPS], const uint64_t anchor[UWB_TWR_STAMPS], double *range_m);

typedef struct {
    uwb_dw1000 chip;
    uwb_dw1000_io io;
    uwb_twr_config config;
    uint64_t address; /* active address; 0 until the chip was started */
    uint64_t random;
    uint64_t next_us; /* a tag: start of the next exchange; an anchor: next check of the chip */
    uint64_t next_discovery_us; /* when a tag sends DISCOVER again */
    uint32_t reply_us; /* is increased while FINAL is late */
    uint32_t misses;   /* consecutive missed answers of all anchors */
    uwb_twr_counts counts;
    uwb_dw1000_status fault; /* cause of the last UWB_TWR_FAULT */
    uint8_t running;
    uint8_t started; /* has been started before */
    uint8_t last_polled; /* index of the anchor that was polled last */
    uint8_t known;       /* anchors in the table */
    uwb_twr_anchor anchors[UWB_MAX_ANCHORS];
    uint64_t measured_us; /* time of io.now_us at the reception of the measurement's last frame */
    uint8_t *measurement;
    size_t measurement_bytes;
} uwb_twr;

typedef enum {
    UWB_TWR_NOTHING = 0, /* timeout, or a failed exchange */
    UWB_TWR_RANGED,      /* `measurement` contains a new range */
    UWB_TWR_FAULT        /* the chip does not work; the next step tries to start it again */
} uwb_twr_event;

/* Initialise a radio. `measurement`: UWB_TWR_MEASUREMENT_BYTES(config->window) bytes, aligned to 8 bytes, for a payload
 * of RANGE_CIR. `random`: seed, which should differ between two starts. */
void uwb_twr_start(uwb_twr *twr, const uwb_dw1000_io *io, const uwb_twr_config *config, uint64_t random,
                   uint8_t *measurement, size_t measurement_bytes);

/* Replace times that are 0 by the given times of a tag's bus and processor, plus the additional duration of frames that
 * are longer than those of the default settings. */
void uwb_twr_set_default_times(uwb_twr_config *config, uint32_t reply_us, uint32_t timeout_us);

/* Return the reason why a configuration is refused; NULL = it is valid. */
const char *uwb_twr_config_error(const uwb_twr *twr, const uwb_twr_config *config);

/* Use another configuration from the next step on; returns 0 if it is refused. The counts continue; anchors are
 * searched again. */
int uwb_twr_configure(uwb_twr *twr, const uwb_twr_config *config);

/* Perform one exchange, or return at `until_us`. An exchange that has begun is completed. */
uwb_twr_event uwb_twr_step(uwb_twr *twr, uint64_t until_us);

/* Return the state of the radio, a UWB_RADIO_STATE_*. */
uint8_t uwb_twr_state(const uwb_twr *twr);

/* Write a payload of RADIO with the active settings, or the requested ones if they are not NULL: at most
 * UWB_TWR_SETTINGS_BYTES, without a text. Returns its bytes. */
size_t uwb_twr_write_settings(const uwb_twr *twr, const uwb_twr_config *requested, uint8_t *payload);

/* Read a payload of SET_RADIO; the given times replace times of 0. Returns NULL, or the reason why it is malformed. */
const char *uwb_twr_read_settings(const uint8_t *payload, size_t bytes, uint32_t reply_us, uint32_t timeout_us,
                                  uwb_twr_config *config);

/* Write a payload of RADIO_STATUS: at most UWB_TWR_STATUS_BYTES. Returns its bytes. */
size_t uwb_twr_write_status(const uwb_twr *twr, float temperature, float voltage, uint8_t *payload);

/* Return the bytes of the measurement of the last exchange. */
size_t uwb_twr_measurement_bytes(const uwb_twr *twr);

#ifdef __cplusplus
}
#endif
#endif
