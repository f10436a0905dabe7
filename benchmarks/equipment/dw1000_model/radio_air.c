/* Boards with the firmware's exchange on modelled chips, behind functions that are easy to call from another language:
 * for the tests and for `python -m benchmarks radio`. Time is virtual. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "dw1000_model.h"
#include "uwb_ranger.h"

#ifdef UWB_RADIO_AIR_MODEL
#include "uwb_model.h"
#endif

enum { MAX_BOARDS = 40, MAX_RESULTS = 1 << 16, MAX_SAMPLES = 1016, SLOW_HZ = 2000000, FAST_HZ = 8000000 };

typedef struct {
    double time_s;
    int32_t board;
    uint32_t values; /* int16, two for a sample */
    double range_m;
    uint64_t tag, anchor, device_time;
    float rx_power, first_path_power, first_path_index;
    int32_t start_index;
    uint16_t preamble_count, noise_threshold;
    uint32_t at; /* of the samples in the air's store, int16 values */
} radio_result;

typedef struct radio_air radio_air;

typedef struct {
    radio_air *air;
    dw1000_chip *chip;
    uwb_ranger ranger; /* a board without a serial link uses only `twr` */
    uwb_twr_config config;
    uint64_t random;
    uint32_t spi_hz;
    double overhead_s;  /* of the processor, for each transaction */
    double baud;        /* 0 = no serial link */
    double inference_s; /* for each range in mode DEVICE */
    double sent_s;      /* time until which the serial link is busy */
    uint8_t mode;
    uint64_t measurement[UWB_TWR_MEASUREMENT_BYTES(MAX_SAMPLES) / 8 + 1];
    uint8_t queue[16384];
    uint32_t arena[12288 / 4];
    uint8_t input[8192], output[1 << 18]; /* of the serial link, at the host's end */
    size_t input_bytes, output_bytes;
    uint8_t sent[8 + 4 * MAX_SAMPLES], received[8 + 4 * MAX_SAMPLES];
} radio_board;

struct radio_air {
    dw1000_air *air;
    radio_board *boards[MAX_BOARDS];
    int count;
    uint32_t results_count, store_used;
    radio_result results[MAX_RESULTS];
    int16_t *store;
    size_t store_values;
};

static uint64_t now_us(void *context) {
    return (uint64_t)(dw1000_now(((radio_board *)context)->chip) * 1e6);
}

/* Send the bytes that a UART with DMA has sent since the last call. */
static void send_pending(radio_board *board) {
    const double now_s = dw1000_now(board->chip);
    while (board->baud > 0 && board->sent_s <= now_s) {
        const uint8_t *bytes;
        const size_t count = uwb_queue_peek(&board->ranger.board.queue, (uint64_t)(now_s * 1e6), &bytes);
        if (count == 0) {
            board->sent_s = now_s;
            break;
        }
        if (board->output_bytes + count <= sizeof board->output) {
            memcpy(board->output + board->output_bytes, bytes, count);
            board->output_bytes += count;
        }
        uwb_queue_drop(&board->ranger.board.queue, count);
        /* There is no pause between two frames. */
        board->sent_s += (double)count * 10 / board->baud;
    }
}

static int transfer(void *context, const uint8_t *header, size_t header_bytes, const uint8_t *out, uint8_t *in,
                    size_t bytes) {
    radio_board *const board = context;
    const size_t total = header_bytes + bytes;
    if (total > sizeof board->sent) {
        return -1;
    }
    memset(board->sent, 0, total);
    memcpy(board->sent, header, header_bytes);
    if (out != NULL) {
        memcpy(board->sent + header_bytes, out, bytes);
    }
    if (board->overhead_s > 0) {
        dw1000_delay(board->chip, board->overhead_s);
    }
    dw1000_spi(board->chip, board->sent, board->received, total, board->spi_hz);
    if (out == NULL) {
        memcpy(in, board->received + header_bytes, bytes);
    }
    send_pending(board);
    return 0;
}

static void speed(void *context, int fast) {
    ((radio_board *)context)->spi_hz = fast ? FAST_HZ : SLOW_HZ;
}

static void reset(void *context) {
    dw1000_reset_pin(((radio_board *)context)->chip);
}

static void wait(void *context, uint64_t until_us) {
    radio_board *const board = context;
    const double left_s = (double)until_us * 1e-6 - dw1000_now(board->chip);
    dw1000_wait(board->chip, left_s > 1e-6 ? left_s : 1e-6);
    send_pending(board);
}

static void sleep(void *context, uint32_t us) {
    radio_board *const board = context;
    dw1000_delay(board->chip, us * 1e-6);
    send_pending(board);
}

/* Store a range and its CIR. */
static void store_range(radio_board *board) {
    radio_air *const air = board->air;
    uwb_range_cir_t fields;
    memcpy(&fields, board->measurement, sizeof fields);
    if (air->results_count == MAX_RESULTS) {
        return;
    }
    radio_result *const result = &air->results[air->results_count++];
    *result = (radio_result){
        .time_s = dw1000_now(board->chip),
        .values = fields.sample_count,
        .range_m = fields.range,
        .tag = fields.tag_id,
        .anchor = fields.anchor_id,
        .device_time = fields.device_time,
        .rx_power = fields.rx_power,
        .first_path_power = fields.first_path_power,
        .first_path_index = fields.first_path_index,
        .start_index = fields.start_index,
        .preamble_count = fields.preamble_count,
        .noise_threshold = fields.noise_threshold,
        .at = air->store_used,
    };
    while (air->boards[result->board] != board) {
        result->board++;
    }
    if (air->store_used + fields.sample_count <= air->store_values) {
        memcpy(air->store + air->store_used, (const uint8_t *)board->measurement + sizeof fields,
               2u * fields.sample_count);
        air->store_used += fields.sample_count;
    }
}

static void run(dw1000_chip *chip, void *context) {
    radio_board *const board = context;
    const uwb_dw1000_io io = {
        .context = board,
        .transfer = transfer,
        .speed = speed,
        .reset = reset,
        .now_us = now_us,
        .wait = wait,
        .sleep = sleep,
    };
    uint8_t *const measurement = (uint8_t *)board->measurement;
    if (board->baud > 0) {
        uwb_board_config config;
        memset(&config, 0, sizeof config);
        config.mode = board->mode;
#ifdef UWB_RADIO_AIR_MODEL
        config.model = &uwb_model_data;
        config.arena = board->arena;
        config.arena_bytes = sizeof board->arena;
#endif
        config.queue = board->queue;
        config.queue_bytes = sizeof board->queue;
        uwb_ranger_start(&board->ranger, &config, &io, &board->config, board->random, measurement,
                         sizeof board->measurement);
    } else {
        uwb_twr_start(&board->ranger.twr, &io, &board->config, board->random, measurement, sizeof board->measurement);
    }
    for (;;) {
        uwb_twr_event event;
        if (board->baud > 0) {
            uwb_board_receive(&board->ranger.board, board->input, board->input_bytes, now_us(board));
            board->input_bytes = 0;
            event = uwb_ranger_step(&board->ranger);
            if (event == UWB_TWR_RANGED && board->mode != UWB_MODE_HOST) {
                dw1000_delay(chip, board->inference_s);
                send_pending(board);
            }
        } else {
            event = uwb_twr_step(&board->ranger.twr, now_us(board) + 100000);
        }
        if (event == UWB_TWR_RANGED) {
            store_range(board);
        }
    }
}

radio_air *radio_air_new(uint64_t seed, size_t store_values) {
    radio_air *const air = calloc(1, sizeof *air);
    if (air == NULL) {
        abort();
    }
    air->air = dw1000_air_new(seed);
    air->store = calloc(store_values + 1, sizeof *air->store);
    air->store_values = store_values;
    return air;
}

void radio_air_free(radio_air *air) {
    dw1000_air_free(air->air);
    for (int i = 0; i < air->count; i++) {
        free(air->boards[i]);
    }
    free(air->store);
    free(air);
}

int radio_air_add_board(radio_air *air, double ppm, uint64_t clock_ticks, uint16_t tx_delay, uint16_t rx_delay,
                    const uint8_t *settings, size_t bytes, uint64_t random) {
    radio_board *const board = calloc(1, sizeof *board);
    if (board == NULL || air->count == MAX_BOARDS ||
        uwb_twr_read_settings(settings, bytes, uwb_twr_defaults.reply_us, uwb_twr_defaults.timeout_us,
                              &board->config) != NULL) {
        abort();
    }
    board->air = air;
    board->random = random;
    board->chip = dw1000_chip_new(air->air, ppm, clock_ticks, tx_delay, rx_delay);
    air->boards[air->count] = board;
    dw1000_program(board->chip, run, board);
    return air->count++;
}

void radio_air_set_serial_link(radio_air *air, int board, double baud, int mode, double inference_s, double overhead_s) {
    air->boards[board]->baud = baud;
    air->boards[board]->mode = (uint8_t)mode;
    air->boards[board]->inference_s = inference_s;
    air->boards[board]->overhead_s = overhead_s;
}

void radio_air_set_pair(radio_air *air, int a, int b, double distance_m, double excess_m, const int16_t *iq,
                    size_t samples, double first_path_index, uint16_t preamble_count, uint16_t noise_threshold,
                    uint16_t std_noise, double loss, double damage) {
    const dw1000_pair_config config = {
        .distance_m = distance_m,
        .excess_m = excess_m,
        .iq = iq,
        .samples = samples,
        .first_path_index = first_path_index,
        .preamble_count = preamble_count,
        .noise_threshold = noise_threshold,
        .std_noise = std_noise,
        .loss = loss,
        .damage = damage,
    };
    dw1000_set_pair(air->air, air->boards[a]->chip, air->boards[b]->chip, &config);
}

void radio_air_remove_pair(radio_air *air, int a, int b) {
    dw1000_set_pair(air->air, air->boards[a]->chip, air->boards[b]->chip, NULL);
}

void radio_air_reset(radio_air *air, int board) {
    dw1000_reset_pin(air->boards[board]->chip);
}

double radio_air_run(radio_air *air, double seconds) {
    return dw1000_run(air->air, seconds);
}

uint32_t radio_air_results(radio_air *air, const radio_result **results, const int16_t **store) {
    *results = air->results;
    *store = air->store;
    return air->results_count;
}

void radio_air_clear_results(radio_air *air) {
    air->results_count = 0;
    air->store_used = 0;
}

/* Writes a payload of RADIO_STATUS of a board that has run; returns its bytes. */
size_t radio_air_status(const radio_air *air, int board, uint8_t *payload) {
    return uwb_twr_write_status(&air->boards[board]->ranger.twr, NAN, NAN, payload);
}

uint64_t radio_air_address(const radio_air *air, int board) {
    return air->boards[board]->ranger.twr.address;
}

uint64_t radio_air_measurements_lost(const radio_air *air, int board) {
    return air->boards[board]->ranger.board.measurements_lost;
}

/* Write bytes to a board's serial link; returns 0 if the buffer has no space for them. */
int radio_air_write(radio_air *air, int board, const uint8_t *bytes, size_t count) {
    radio_board *const to = air->boards[board];
    if (to->input_bytes + count > sizeof to->input) {
        return 0;
    }
    memcpy(to->input + to->input_bytes, bytes, count);
    to->input_bytes += count;
    return 1;
}

/* Read the bytes that a board has sent, at most 1 << 18. */
size_t radio_air_read(radio_air *air, int board, uint8_t *bytes) {
    radio_board *const from = air->boards[board];
    const size_t count = from->output_bytes;
    memcpy(bytes, from->output, count);
    from->output_bytes = 0;
    return count;
}

/* Return the size of a row of results, to check bindings. */
size_t radio_air_result_bytes(void) {
    return sizeof(radio_result);
}
