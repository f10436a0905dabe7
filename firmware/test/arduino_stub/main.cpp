/* Runs the sketch on emulated time: main <prefix> <host> <from s> <until s> <gap us> <compute us> <end s> <upload s>.
 * Standard input are frames for pin RX: they arrive at 921,600 baud with `gap us` between two. <host>: reads, silent or
 * closed in the period (core.h). A run of the network takes `compute us`. At the end the boot loader writes the next
 * sketch for `upload s`. Exit 3: the watchdog fired; 4: the UART lost bytes; 5: no instruction cache. */
#include "core.h"

#include <stdio.h>
#include <stdlib.h>

static const uint32_t STEP_US = 1;
static const double BYTE_US = 1e7 / 921600;

static uint8_t input[1 << 22];
static size_t input_bytes, input_at;
static double byte_due_us = 100000, gap_us;
static uint64_t now_us;
static uint32_t compute_us;

void stub_pass(uint32_t us) {
    for (uint32_t passed = 0; passed < us; passed += STEP_US) {
        now_us += STEP_US;
        while (input_at < input_bytes && byte_due_us <= (double)now_us) {
            const bool ends_frame = input_at > 0 && input[input_at] == 0 && input[input_at - 1] != 0;
            stub_receive(input[input_at++]);
            byte_due_us += BYTE_US + (ends_frame ? gap_us : 0);
        }
        stub_run_events(now_us);
    }
}

extern "C" int __real_uwb_network(const void *, const float *, void *, size_t, float *);
extern "C" int __wrap_uwb_network(const void *model, const float *window, void *arena, size_t bytes, float *output) {
    stub_pass(compute_us);
    return __real_uwb_network(model, window, arena, bytes, output);
}

void pinMode(int, int) {}
void digitalWrite(int, int) {}
int digitalRead(int) {
    return LOW;
}
uint32_t micros() {
    stub_pass(STEP_US);
    return (uint32_t)now_us;
}

int main(int argc, char **argv) {
    if (argc != 9) {
        return 2;
    }
    stub_start(argv[1], stub_host_of(argv[2]), (uint64_t)(atof(argv[3]) * 1e6), (uint64_t)(atof(argv[4]) * 1e6));
    gap_us = atof(argv[5]);
    compute_us = (uint32_t)atoi(argv[6]);
    input_bytes = fread(input, 1, sizeof input, stdin);
    setup();
    while ((double)now_us < atof(argv[7]) * 1e6) {
        loop();
    }
    stub_pass((uint32_t)(atof(argv[8]) * 1e6));
    stub_finish();
    return stub_overruns() != 0 ? 4 : NRF_NVMC->ICACHECNF == 1 ? 0 : 5;
}
