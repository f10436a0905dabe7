/* Runs a model over input.bin in the emulator and writes output.bin.
 *
 * Input: uint32 kind, uint32 count, then records. Kind 0: float window[K]. Kind 1: struct cir_record.
 * Output: for each record, kind 0: uint32 status, float output. Kind 1: uint32 status,
 * uwb_corrected, float window[K] after preprocessing. Then struct report.
 *
 * Counts are ticks of SysTick around uwb_network, with interrupts off. Run with -icount shift=6, a tick is
 * 40 ns and an instruction 64 ns: the count is exact to one instruction. */
#include <string.h>

#include "semihosting.h"
#include "uwb_model.h"

enum { WINDOWS = 0, CIRS = 1, MAX_SAMPLES = 1016, MAX_WINDOW = 256, ARENA_BYTES = 12288, STACK_PROBE_BYTES = 4096 };

typedef struct {
    uint32_t count; /* int16 values */
    uint32_t encoding;
    int32_t start_index;
    float first_path_index;
    float scale;
    uint32_t preamble_count;
    float rx_power_dbm;
    float first_path_power_dbm;
    float range_m;
    float offset_m;
    int16_t samples[2 * MAX_SAMPLES];
} cir_record;

typedef struct {
    uint32_t model_id;
    uint32_t arena_bytes;
    uint32_t stack_bytes;  /* of uwb_network */
    uint32_t ticks_empty;  /* of an empty measurement */
    uint32_t ticks_lowest; /* of uwb_network */
    uint32_t ticks_highest;
    uint32_t ticks_correct; /* of uwb_correct, the highest; kind 1 */
} report;

#define SYST_CSR (*(volatile uint32_t *)0xE000E010u)
#define SYST_RVR (*(volatile uint32_t *)0xE000E014u)
#define SYST_CVR (*(volatile uint32_t *)0xE000E018u)
#define SYST_MAX 0xFFFFFFu

void board_exit(int code);

/* A guard area follows the part that the library may use. It is aligned to 4 bytes only. */
static uint64_t memory[ARENA_BYTES / sizeof(uint64_t)];
static uint32_t *const arena = (uint32_t *)memory + 1;
static const size_t available_bytes = ARENA_BYTES - sizeof(uint32_t);
static size_t arena_bytes;

__attribute__((noreturn)) void board_exit(int code) {
    semihosting_exit(code);
}

static uint8_t *guard(void) {
    return (uint8_t *)arena + arena_bytes;
}

static int guard_is_intact(void) {
    for (const uint8_t *byte = guard(); byte < (const uint8_t *)arena + available_bytes; byte++) {
        if (*byte != 0x5A) {
            return 0;
        }
    }
    return 1;
}

static uint32_t ticks_since(uint32_t start) {
    return (start - SYST_CVR) & SYST_MAX;
}

/* Fill the free stack below the frame of the caller; returns its end. */
static __attribute__((noinline)) volatile uint8_t *fill_stack(void) {
    volatile uint8_t *top;
    __asm volatile("mov %0, sp" : "=r"(top));
    for (volatile uint32_t *free = (volatile uint32_t *)(top - STACK_PROBE_BYTES); free < (volatile uint32_t *)top; free++) {
        *free = 0xA5A5A5A5u;
    }
    return top;
}

/* Measure the stack of uwb_network: fill the stack, call, and find the overwritten part. */
static __attribute__((noinline)) uint32_t stack_bytes(const float *window) {
    float output_m;
    volatile uint8_t *const top = fill_stack();
    (void)uwb_network(&uwb_model_data, window, arena, arena_bytes, &output_m);
    volatile uint8_t *reached = top - STACK_PROBE_BYTES;
    while (reached < top && *reached == 0xA5) {
        reached++;
    }
    return (uint32_t)(top - reached);
}

static __attribute__((noinline)) void run_window(const float *window, report *result, uint32_t answer[2]) {
    float output_m = 0.0f;
    const uint32_t start = SYST_CVR;
    const uwb_status status = uwb_network(&uwb_model_data, window, arena, arena_bytes, &output_m);
    const uint32_t ticks = ticks_since(start);
    result->ticks_lowest = ticks < result->ticks_lowest ? ticks : result->ticks_lowest;
    result->ticks_highest = ticks > result->ticks_highest ? ticks : result->ticks_highest;
    answer[0] = (uint32_t)status;
    memcpy(&answer[1], &output_m, sizeof output_m);
}

static int run_windows(int32_t input, int32_t output, uint32_t count, report *result) {
    static float windows[64][MAX_WINDOW];
    static uint32_t answers[64][2];
    const uint32_t samples = uwb_model_data.samples;
    for (uint32_t done = 0; done < count;) {
        const uint32_t chunk = count - done < 64u ? count - done : 64u;
        for (uint32_t i = 0; i < chunk; i++) {
            if (!semihosting_read(input, windows[i], samples * sizeof(float))) {
                return 3;
            }
        }
        for (uint32_t i = 0; i < chunk; i++) {
            (void)fill_stack(); /* the library must not depend on it */
            run_window(windows[i], result, answers[i]);
        }
        if (!semihosting_write(output, answers, chunk * sizeof answers[0])) {
            return 4;
        }
        done += chunk;
    }
    result->stack_bytes = stack_bytes(windows[0]);
    return 0;
}

static int run_cirs(int32_t input, int32_t output, uint32_t count, report *result) {
    static cir_record record;
    static float window[MAX_WINDOW];
    for (uint32_t i = 0; i < count; i++) {
        if (!semihosting_read(input, &record, sizeof record) || record.count > 2 * MAX_SAMPLES) {
            return 3;
        }
        const uwb_cir cir = {
            .samples = record.samples,
            .count = record.count,
            .encoding = (uwb_encoding)record.encoding,
            .start_index = record.start_index,
            .first_path_index = record.first_path_index,
            .scale = record.scale,
            .preamble_count = (uint16_t)record.preamble_count,
            .rx_power_dbm = record.rx_power_dbm,
            .first_path_power_dbm = record.first_path_power_dbm,
        };
        memset(window, 0, sizeof window);
        (void)uwb_preprocess(&uwb_model_data, &cir, window);
        uwb_corrected corrected;
        const uint32_t start = SYST_CVR;
        const uint32_t status =
            (uint32_t)uwb_correct(&uwb_model_data, record.range_m, record.offset_m, &cir, arena, arena_bytes,
                                  &corrected);
        const uint32_t ticks = ticks_since(start);
        result->ticks_correct = ticks > result->ticks_correct ? ticks : result->ticks_correct;
        if (!semihosting_write(output, &status, sizeof status) ||
            !semihosting_write(output, &corrected, sizeof corrected) ||
            !semihosting_write(output, window, uwb_model_data.samples * sizeof(float))) {
            return 4;
        }
    }
    return 0;
}

int main(void) {
    const int32_t input = semihosting_open("input.bin", SEMIHOSTING_READ);
    const int32_t output = semihosting_open("output.bin", SEMIHOSTING_WRITE);
    uint32_t header[2];
    if (input < 0 || output < 0 || !semihosting_read(input, header, sizeof header)) {
        return 2;
    }
    arena_bytes = uwb_arena_size(&uwb_model_data);
    if (arena_bytes == 0 || arena_bytes >= available_bytes) {
        return 5;
    }
    memset(guard(), 0x5A, available_bytes - arena_bytes);
    SYST_RVR = SYST_MAX;
    SYST_CVR = 0;
    SYST_CSR = 5; /* processor clock, no interrupt */

    report result = {
        .model_id = uwb_model_data.model_id, .arena_bytes = (uint32_t)arena_bytes, .ticks_lowest = UINT32_MAX};
    const uint32_t start = SYST_CVR;
    result.ticks_empty = ticks_since(start);
    const int code = header[0] == WINDOWS ? run_windows(input, output, header[1], &result)
                                          : run_cirs(input, output, header[1], &result);
    if (!guard_is_intact()) {
        return 6;
    }
    if (code == 0 && !semihosting_write(output, &result, sizeof result)) {
        return 4;
    }
    return code;
}
