/* Shared by the fuzz targets: abort on a violated assertion, and generated inputs if there is no fuzzer. */
#ifndef UWB_FUZZ_H
#define UWB_FUZZ_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void check(int condition, const char *what) {
    if (!condition) {
        fprintf(stderr, "broken: %s\n", what);
        abort();
    }
}

#ifndef UWB_LIBFUZZER
static uint64_t fuzz_state;

/* The requested number of inputs: PROGRAM <inputs> <seed>. */
static unsigned long fuzz_inputs(int argc, char **argv) {
    if (argc != 3) {
        exit(2);
    }
    fuzz_state = strtoull(argv[2], NULL, 10) * 2u + 1u;
    return strtoul(argv[1], NULL, 10);
}

static void fuzz_fill(uint8_t *data, size_t size) {
    for (size_t byte = 0; byte < size; byte++) {
        /* Knuth's MMIX generator; its high bits are the random ones. */
        fuzz_state = fuzz_state * 6364136223846793005u + 1442695040888963407u;
        data[byte] = (uint8_t)(fuzz_state >> 56);
    }
}

/* Give the target all inputs that are asked for, `size` bytes each. */
static inline void fuzz_run(int argc, char **argv, size_t size) {
    const unsigned long inputs = fuzz_inputs(argc, argv);
    uint8_t *data = malloc(size);
    check(data != NULL, "memory");
    for (unsigned long i = 0; i < inputs; i++) {
        fuzz_fill(data, size);
        (void)LLVMFuzzerTestOneInput(data, size);
    }
    free(data);
}
#endif
#endif
