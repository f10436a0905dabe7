/* The board's side of the wire protocol, used by sketches and bare-metal programs. benchmarks/equipment/board.py is the
 * same in Python.
 *
 * No allocation, no globals, no blocking: if the host does not read in time, complete frames are dropped and
 * counted. `now_us` is the board's uptime, of 64 bits. */
#ifndef UWB_BOARD_H
#define UWB_BOARD_H

#include "uwb_link.h"

#ifdef __cplusplus
extern "C" {
#endif

#define UWB_STATUS_INTERVAL_US 1000000u
#define UWB_ANSWER_RESERVE_BYTES 512u /* of the queue, reserved for answers and STATUS */

/* Configuration of a board. The caller owns the memory and must keep it while the board is in use. */
typedef struct {
    uint64_t board_id;
    uint32_t boot_id; /* differs between two boots */
    uint8_t firmware_version[3];
    uint8_t mode; /* UWB_MODE_* to start in; HOST if there is no model */
    char firmware_name[16];
    const uwb_model *model; /* NULL = no model */
    void *arena;            /* as for uwb_correct */
    size_t arena_bytes;
    uint8_t *queue; /* for frames to the host; sufficient size: two of the longest frames and the reserve */
    size_t queue_bytes;
    uint32_t (*clock_us)(void); /* for compute_us; NULL = it is sent as 0 */
    /* Handle a frame of another type, such as SET_RADIO; returns whether it was handled. May be NULL. */
    int (*handle_other_frame)(void *context, const uwb_header_t *header, const uint8_t *payload, size_t payload_bytes,
                 uint64_t now_us);
    void *context;
} uwb_board_config;

typedef struct {
    uwb_board_config config;
    uwb_decoder host;
    uwb_decoder radio;
    uwb_queue queue;
    uint64_t status_due_us;
    uint64_t radio_frame_start_us; /* start of the frame that is being received from the radio */
    uint32_t dropped;
    uint32_t measurements;
    uint32_t measurements_lost;
    uint32_t radio_faults; /* frames from the radio that were damaged or no measurements */
    uint32_t radio_faults_logged;
    float temperature; /* degrees Celsius, for STATUS; the caller may set it */
    uint8_t mode;
    float default_offset_m;
    uint16_t offset_count;
    uwb_offset_t offsets[UWB_MAX_OFFSETS]; /* set by the host; empty after boot */
} uwb_board;

/* Start, and send HELLO. */
void uwb_board_start(uwb_board *board, const uwb_board_config *config, uint64_t now_us);

/* Process bytes from the host, and answer. */
void uwb_board_receive(uwb_board *board, const uint8_t *bytes, size_t count, uint64_t now_us);

/* Process bytes with RANGE_CIR frames from the radio. Forward the ranges raw or corrected, according to the mode. */
void uwb_board_receive_from_radio(uwb_board *board, const uint8_t *bytes, size_t count, uint64_t now_us);

/* Forward a measurement of the board's own radio: a payload of RANGE_CIR, aligned to 2 bytes, measured at `time_us`.
 * Returns whether it is well formed. */
int uwb_board_process_measurement(uwb_board *board, const uint8_t *payload, size_t payload_bytes, uint64_t time_us);

/* Send STATUS if it is due, once a second. */
void uwb_board_tick(uwb_board *board, uint64_t now_us);

/* Queue one frame if it fits and leaves `reserve` bytes of the queue free; returns whether it was queued. */
int uwb_board_send(uwb_board *board, uint8_t type, uint16_t flags, uint64_t time_us, const void *payload,
                   size_t payload_bytes, size_t reserve);

#ifdef __cplusplus
}
#endif
#endif
