/* Feeds arbitrary CIRs to uwb_correct, and aborts on violated assertions.
 *
 *     clang -fsanitize=fuzzer,address,undefined -DUWB_LIBFUZZER -Isrc -I<export> test/fuzz_correct.c src/uwb_*.c
 *
 * Without a fuzzer it makes its own inputs: fuzz_correct <inputs> <seed>. */
#include <math.h>

#include "fuzz.h"
#include "uwb_model.h"

/* Fields, then samples. Field values come from a few bits where arbitrary ones would seldom get past a check. */
enum { FIELD_BYTES = 28 };

static float float_at(const uint8_t *data) {
    float value;
    memcpy(&value, data, sizeof value);
    return value;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    if (size < FIELD_BYTES) {
        return 0;
    }
    /* Copies of exactly the right size: a sanitizer sees one sample too many. */
    const size_t count = (size - FIELD_BYTES) / sizeof(int16_t);
    int16_t *const samples = malloc(count * sizeof *samples + 1);
    const size_t arena_bytes = uwb_arena_size(&uwb_model_data);
    void *const arena = malloc(arena_bytes);
    check(samples != NULL && arena != NULL, "memory");
    memcpy(samples, data + FIELD_BYTES, count * sizeof *samples);

    const uint8_t choice = data[0];
    int32_t start_index = 0;
    if (choice & 1) {
        memcpy(&start_index, data + 4, sizeof start_index);
    }
    const uwb_cir cir = {
        .samples = samples,
        .count = count,
        .encoding = (choice & 2) ? UWB_MAGNITUDE : UWB_COMPLEX_INT16,
        .start_index = start_index,
        .first_path_index = (choice & 4) ? float_at(data + 8) : (float)start_index + (float)(data[8] % 32),
        .scale = (choice & 8) ? float_at(data + 12) : 1.0f,
        .preamble_count = data[2],
        .rx_power_dbm = (choice & 16) ? float_at(data + 16) : -80.0f,
        .first_path_power_dbm = (choice & 32) ? float_at(data + 20) : -85.0f,
    };
    const float range_m = (choice & 64) ? float_at(data + 24) : 3.0f;
    const float offset_m = (choice & 128) ? 0.25f : 0.0f;
    const float offset_range_m = offset_m != 0.0f ? range_m - offset_m : range_m;
    uwb_corrected corrected;
    const uwb_status status = uwb_correct(&uwb_model_data, range_m, offset_m, &cir, arena, arena_bytes, &corrected);
    if (status == UWB_OK) {
        check(corrected.status == UWB_RANGE_OK, "status of a corrected range");
        check(corrected.correction_m >= offset_m + uwb_model_data.correction_low_m, "lower limit");
        check(corrected.correction_m <= offset_m + uwb_model_data.correction_high_m, "upper limit");
        check(isfinite(corrected.range_m) && offset_range_m >= 0.0f, "range");
    } else {
        check(corrected.status != UWB_RANGE_OK, "status of a range passed through");
        check(memcmp(&corrected.range_m, &offset_range_m, sizeof offset_range_m) == 0, "a range passes through, less the offset");
        check(corrected.correction_m == offset_m, "no correction but the offset");
    }
    check(corrected.variance_m2 > 0.0f, "variance");
    free(arena);
    free(samples);
#ifdef UWB_LIBFUZZER
    return 0; /* other values are reserved */
#else
    return (int)status;
#endif
}

#ifndef UWB_LIBFUZZER
int main(int argc, char **argv) {
    static uint8_t data[FIELD_BYTES + 600];
    unsigned long seen[32] = {0};
    const unsigned long inputs = fuzz_inputs(argc, argv);
    for (unsigned long i = 0; i < inputs; i++) {
        fuzz_fill(data, sizeof data);
        /* Every second input has few invalid fields and small samples: most of these reach the network. */
        if (i % 2 == 0) {
            data[0] &= (uint8_t)(data[1] & data[3]);
            for (size_t byte = FIELD_BYTES + 1; byte < sizeof data; byte += 2) {
                data[byte] = 0;
            }
        }
        const size_t bytes = FIELD_BYTES + (size_t)(fuzz_state >> 40) % (sizeof data - FIELD_BYTES + 1);
        seen[LLVMFuzzerTestOneInput(data, bytes) & 31]++;
    }
    for (int status = 0; status < 32; status++) {
        if (seen[status] > 0) {
            printf("status %d: %lu\n", status, seen[status]);
        }
    }
    return 0;
}
#endif
