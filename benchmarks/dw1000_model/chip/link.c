/* Links between chips: the registers' values that follow from a link's accumulator. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define SPEED_OF_LIGHT 299792458.0
#define DEFAULT_PLACE 745.25
#define DEFAULT_HEIGHT 8000.0
#define DEFAULT_NOISE 12.0
#define PULSE_SAMPLES 2.4 /* full width at half amplitude of a lone path */
/* Noise is measured well before a first path can arrive, as uwb_mitigation/sources/simulation/radio.py does. */
#define NOISE_FROM 64
#define NOISE_TO 576

void dw1000_drop_link(link *path) {
    if (path != NULL && --path->users == 0) {
        free(path);
    }
}

static double magnitude(const link *path, size_t sample) {
    return hypot(path->iq[2 * sample], path->iq[2 * sample + 1]);
}

/* 0 to 65535, rounded. */
static uint16_t word(double value) {
    return (uint16_t)fmax(0.0, fmin(65535.0, rint(value)));
}

static void synthesise(link *path, double place) {
    for (size_t i = 0; i < ACCUMULATOR_SAMPLES; i++) {
        const double x = ((double)i - place) / PULSE_SAMPLES;
        const double height = DEFAULT_HEIGHT * exp(-4 * log(2) * x * x);
        for (size_t part = 0; part < 2; part++) {
            /* The sum of three uniform numbers approximates a normal distribution. */
            double noise = -1.5;
            for (uint64_t k = 0; k < 3; k++) {
                noise += dw1000_chance(dw1000_dice(path->key + k, 2 * i + part));
            }
            path->iq[2 * i + part] = (int16_t)rint(height * (part == 0 ? 0.8 : 0.6) + noise * 2 * DEFAULT_NOISE);
        }
    }
}

/* Where the magnitude, after a threshold of 12 deviations of the noise, first reaches half of the next peak. */
static double find_first_path(const link *path) {
    double peak = 0;
    for (size_t i = 0; i < ACCUMULATOR_SAMPLES; i++) {
        peak = fmax(peak, magnitude(path, i));
    }
    const double threshold = fmin(fmax(12.0 * path->std_noise, 1), peak / 2);
    size_t first = 0;
    while (first + 1 < ACCUMULATOR_SAMPLES && magnitude(path, first) < threshold) {
        first++;
    }
    size_t top = first;
    while (top + 1 < ACCUMULATOR_SAMPLES && magnitude(path, top + 1) >= magnitude(path, top)) {
        top++;
    }
    const double half = magnitude(path, top) / 2;
    size_t after = top;
    while (after > 0 && magnitude(path, after - 1) > half) {
        after--;
    }
    if (after == 0) {
        return 0;
    }
    const double low = magnitude(path, after - 1), high = magnitude(path, after);
    return (double)after - (high > low ? (high - half) / (high - low) : 0);
}

/* The same sums as uwb_mitigation/sources/simulation/radio.py: so that both give the same register values. */
static void measure(link *path, const dw1000_link_config *config) {
    double energy = 0, noise = 0, sum = 0;
    for (size_t i = 0; i < ACCUMULATOR_SAMPLES; i++) {
        const double re = path->iq[2 * i], im = path->iq[2 * i + 1], squared = re * re + im * im;
        energy += squared;
        if (i >= NOISE_FROM && i < NOISE_TO) {
            noise += squared;
            sum += sqrt(squared);
        }
    }
    const double taps = NOISE_TO - NOISE_FROM, mean = sum / taps;
    const double all = config->iq != NULL && config->samples != 0 && config->samples < ACCUMULATOR_SAMPLES
                           ? (double)config->samples
                           : ACCUMULATOR_SAMPLES;
    const double power = fmax(rint((energy - noise / taps * all) / 0x1p17), 1.0);
    path->std_noise = config->std_noise ? config->std_noise : word(fmax(1.0, sqrt(fmax(0, noise / taps - mean * mean))));
    path->threshold = config->noise_threshold;
    path->cir_pwr = word(power);
    const double found = config->first_path_index > 0 ? config->first_path_index : find_first_path(path);
    path->fp_index = word(found * 64);
    for (size_t k = 0; k < 3; k++) {
        const size_t at = (size_t)path->fp_index / 64 + 1 + k;
        path->fp_ampl[k] = at < ACCUMULATOR_SAMPLES ? word(magnitude(path, at)) : 0;
    }
    path->preamble_count = config->preamble_count;
    const double count = path->preamble_count ? path->preamble_count : 128;
    path->level = power / (count * count);
}

static double within(double value, double low, double high) {
    return value >= low ? fmin(value, high) : low; /* NaN is the least */
}

static link *new_link(const dw1000_link_config *config, uint64_t key) {
    link *const path = dw1000_memory(sizeof *path);
    const double per_metre = (double)UNITS_PER_SECOND / SPEED_OF_LIGHT;
    path->key = key;
    path->flight = llround(within(config->distance_m, 0, LONGEST_LINK_M) * per_metre);
    path->excess = llround(within(config->excess_m, -LONGEST_LINK_M, LONGEST_LINK_M) * per_metre);
    path->loss = within(config->loss, 0, 1);
    path->damage = within(config->damage, 0, 1);
    if (config->iq != NULL) {
        const size_t most = config->samples < ACCUMULATOR_SAMPLES ? config->samples : ACCUMULATOR_SAMPLES;
        memcpy(path->iq, config->iq, most * 2 * sizeof *config->iq);
    } else {
        synthesise(path, config->first_path_index > 0 ? config->first_path_index + 1 : DEFAULT_PLACE);
    }
    measure(path, config);
    return path;
}

void dw1000_link(dw1000_air *air, dw1000_chip *a, dw1000_chip *b, const dw1000_link_config *config) {
    if (a == b) {
        return;
    }
    link **const there = &b->links[a->index], **const back = &a->links[b->index];
    dw1000_drop_link(*there);
    dw1000_drop_link(*back);
    *there = *back = NULL;
    if (config != NULL) {
        const uint64_t low = a->index < b->index ? a->index : b->index, high = a->index + b->index - low;
        *there = *back = new_link(config, dw1000_dice(air->seed, low << 32 | high));
        (*there)->users = 2;
    }
}
