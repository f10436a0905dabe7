/* Two-way ranging with the DW1000: asymmetric and double-sided, in data frames of IEEE 802.15.4.
 *
 *     tag                          anchor
 *     POLL   ─────────────────────────►
 *        ◄─────────────────────  ANSWER
 *     FINAL  ─────────────────────────►   the tag's stamps: the anchor has the range
 *        ◄─────────────────────  REPORT   the anchor's stamps: the tag has it too
 *
 * Each side draws a number for each exchange, and all later frames of the exchange contain both: frames of another
 * exchange or network, and repeated ones, are refused and counted. The channel impulse response that comes with a
 * range is that of the last frame received: REPORT at a tag, FINAL at an anchor; so it is never read while the other
 * side waits for a frame sent in time.
 *
 * No allocation, no globals. One call is one turn: a tag's exchange with the next anchor, or an anchor's with whoever
 * polls it. All waiting is done in the callbacks of uwb_dw1000_io, and ends. */
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

/* Configuration of a tag or an anchor. Only tags use reply_us, timeout_us, interval_us and the list of anchors. */
typedef struct {
    uwb_dw1000_settings radio;
    uint64_t address; /* 0 = the chip's */
    uint16_t pan;
    uint8_t role;          /* UWB_ROLE_* */
    uint8_t report;        /* an anchor gives its ranges too, and then answers FINAL later */
    uint8_t bias_correction; /* APS011, on ranges given; the models were trained without */
    uint8_t anchor_count;  /* 0 = those that a broadcast finds */
    uint16_t window;       /* complex samples that a measurement takes; 0 = none */
    uint32_t reply_us;     /* from the reception of ANSWER to FINAL; depends on the tag's bus and processor, and on airtime */
    uint32_t timeout_us;  /* for an anchor's frames */
    uint32_t interval_us;  /* between the beginnings of two exchanges, at least */
    uint64_t anchors[UWB_MAX_ANCHORS];
} uwb_twr_config;

/* Defaults: a tag with 157 samples that finds its anchors, and times for SPI of a microcontroller. */
extern const uwb_twr_config uwb_twr_defaults;

/* Started exchanges and their results: `tried` is the sum of the results. */
typedef struct {
    uint32_t tried;
    uint32_t ranged;
    uint32_t no_answer; /* to POLL */
    uint32_t late;      /* FINAL could not be sent in time */
    uint32_t timeout;  /* FINAL or REPORT did not come */
    uint32_t damaged;   /* something was received that is not a valid frame */
    uint32_t implausible;    /* implausible timestamps */
    uint32_t broken;    /* the chip was reset meanwhile, or the bus failed */

    uint32_t refused;  /* frames that do not belong to the exchange */
    uint32_t restarts; /* of the chip, but for the first */
} uwb_twr_counts;

/* State of an anchor at a tag. */
typedef struct {
    uint64_t address;
    uint64_t last_seen_us;
    uint64_t due_us;
    uint32_t tried;
    uint32_t ranged;
    uint32_t answer_us; /* from POLL to ANSWER in the last exchange; 0 = none yet */
    uint32_t misses;    /* missed answers since its last answer */
    float rx_power_dbm;
} uwb_twr_anchor;

/* Types of frames. */
typedef enum { UWB_TWR_DISCOVER = 1, UWB_TWR_DISCOVER_REPLY, UWB_TWR_POLL, UWB_TWR_ANSWER, UWB_TWR_FINAL, UWB_TWR_REPORT } uwb_twr_kind;

typedef struct {
    uwb_twr_kind kind;
    uint8_t sequence;
    uint16_t pan;
    uint64_t to; /* UWB_TWR_BROADCAST: a broadcast */
    uint64_t from;
    uint32_t tag_number;    /* that the tag drew; its low octet is the frame's sequence number */
    uint32_t anchor_number; /* from ANSWER on */
    uint32_t time_us;       /* DISCOVER: answer within; POLL: from ANSWER to FINAL */
    uint64_t stamps[UWB_TWR_STAMPS]; /* FINAL, REPORT */
    uint8_t known[32];               /* DISCOVER: anchors that need not answer, a bit for each, and for few others */
} uwb_twr_frame;

#define UWB_TWR_BROADCAST UINT64_MAX
#define UWB_TWR_MAX_FRAME_BYTES 57u

/* Enter an anchor to a DISCOVER, and whether it, or by chance another, is there. Its place differs from DISCOVER to DISCOVER. */
void uwb_twr_mark_known(uwb_twr_frame *seek, uint64_t address);
int uwb_twr_is_known(const uwb_twr_frame *seek, uint64_t address);

/* Write a frame, without check sequence; returns its length. */
size_t uwb_twr_write(const uwb_twr_frame *frame, uint8_t *octets);

/* Parse a frame; returns whether it is well formed. */
int uwb_twr_read(const uint8_t *octets, size_t bytes, uwb_twr_frame *frame);

/* Distance of antennas, m, from the stamps at the tag (POLL sent, ANSWER received, FINAL sent) and at the anchor (POLL
 * received, ANSWER sent, FINAL received), modulo 2^40; returns 0 where no exchange can have them. */
int uwb_twr_range_m(const uint64_t tag[UWB_TWR_STAMPS], const uint64_t anchor[UWB_TWR_STAMPS], double *range_m);

typedef struct {
    uwb_dw1000 chip;
    uwb_dw1000_io io;
    uwb_twr_config config;
    uint64_t address; /* in force; 0 until the chip was started */
    uint64_t random;
    uint64_t next_us; /* when a tag may begin again, an anchor checks the chip */
    uint64_t seek_us; /* when a tag looks for anchors again */
    uint32_t reply_us; /* grows while FINAL comes late */
    uint32_t misses;   /* consecutive missed answers, of any anchor */
    uwb_twr_counts counts;
    uwb_dw1000_status fault; /* why the last turn was UWB_TWR_FAULT */
    uint8_t running;
    uint8_t started; /* once */
    uint8_t turn;    /* place of the anchor that was polled last */
    uint8_t known;   /* anchors in the table */
    uwb_twr_anchor anchors[UWB_MAX_ANCHORS];
    uint64_t measured_us; /* of io.now_us, when the measurement's last frame was received */
    uint8_t *measurement;
    size_t measurement_bytes;
} uwb_twr;

typedef enum {
    UWB_TWR_NOTHING = 0, /* timeout, or a failed exchange */
    UWB_TWR_RANGED,      /* `measurement` is that of an exchange */
    UWB_TWR_FAULT        /* the chip does not work; the next turn tries to start it again */
} uwb_twr_event;

/* `measurement` is for UWB_TWR_MEASUREMENT_BYTES(config->window), aligned to 8 bytes: fields, then samples, as a
 * payload of RANGE_CIR. `random` should differ from start to start. */
void uwb_twr_start(uwb_twr *twr, const uwb_dw1000_io *io, const uwb_twr_config *config, uint64_t random,
                   uint8_t *measurement, size_t measurement_bytes);

/* Times that are 0 become what a tag's bus and processor usually need, and what frames that last longer than the usual
 * ones take on top of it. */
void uwb_twr_set_default_times(uwb_twr_config *config, uint32_t reply_us, uint32_t timeout_us);

/* Return the reason why a configuration is refused; NULL = it is valid. */
const char *uwb_twr_config_error(const uwb_twr *twr, const uwb_twr_config *config);

/* Use another configuration from the next turn on; returns 0 if it is refused. Counts go on, anchors are searched again. */
int uwb_twr_configure(uwb_twr *twr, const uwb_twr_config *config);

/* One exchange, which may outlast `until_us` by its own duration, or none until then. */
uwb_twr_event uwb_twr_step(uwb_twr *twr, uint64_t until_us);

/* Whether the radio works, a UWB_RADIO_STATE_*. */
uint8_t uwb_twr_state(const uwb_twr *twr);

/* Bytes of the measurement that the last turn gave. */
size_t uwb_twr_measurement_bytes(const uwb_twr *twr);

#ifdef __cplusplus
}
#endif
#endif
