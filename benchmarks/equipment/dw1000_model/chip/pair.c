/* Pairs of chips: the register values that follow from the accumulator of a pair. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define SPEED_OF_LIGHT 299792458.0
#define DEFAULT_FIRST_PATH 745.25
#define DEFAULT_AMPLITUDE 8000.0
#define DEFAULT_NOISE 12.0
#define PULSE_SAMPLES 2.4 /* full width at half amplitude of a lone path */
/* Noise is measured well before a first path can arrive, as uwb_mitigation/simulation/radio.py does. */
#define NOISE_FROM 64
#define NOISE_TO 576

void dw1000_release_pair(radio_pair *pair) {
    if (pair != NULL && --pair->users == 0) {
        free(pair);
    }
}

static double magnitude(const radio_pair *pair, size_t sample) {
    return hypot(pair->iq[2 * sample], pair->iq[2 * sample + 1]);
}

/* Round and clamp to 0 to 65535. */
static uint16_t to_uint16(double value) {
    return (uint16_t)fmax(0.0, fmin(65535.0, rint(value)));
}

static void synthesise(radio_pair *pair, double position) {
    for (size_t i = 0; i < ACCUMULATOR_SAMPLES; i++) {
        const double x = ((double)i - position) / PULSE_SAMPLES;
        const double height = DEFAULT_AMPLITUDE * exp(-4 * log(2) * x * x);
        for (size_t part = 0; part < 2; part++) {
            /* The sum of three uniform numbers approximates a normal distribution. */
            double noise = -1.5;
            for (uint64_t k = 0; k < 3; k++) {
                noise += dw1000_uniform(dw1000_random_bits(pair->key + k, 2 * i + part));
            }
            pair->iq[2 * i + part] = (int16_t)rint(height * (part == 0 ? 0.8 : 0.6) + noise * 2 * DEFAULT_NOISE);
        }
    }
}

/* Where the magnitude, beyond 12 standard deviations of the noise, first reaches half of the next peak. */
static double find_first_path(const radio_pair *pair) {
    double peak = 0;
    for (size_t i = 0; i < ACCUMULATOR_SAMPLES; i++) {
        peak = fmax(peak, magnitude(pair, i));
    }
    const double threshold = fmin(fmax(12.0 * pair->std_noise, 1), peak / 2);
    size_t first = 0;
    while (first + 1 < ACCUMULATOR_SAMPLES && magnitude(pair, first) < threshold) {
        first++;
    }
    size_t top = first;
    while (top + 1 < ACCUMULATOR_SAMPLES && magnitude(pair, top + 1) >= magnitude(pair, top)) {
        top++;
    }
    const double half = magnitude(pair, top) / 2;
    size_t after = top;
    while (after > 0 && magnitude(pair, after - 1) > half) {
        after--;
    }
    if (after == 0) {
        return 0;
    }
    const double low = magnitude(pair, after - 1), high = magnitude(pair, after);
    return (double)after - (high > low ? (high - half) / (high - low) : 0);
}

/* The same sums as in uwb_mitigation/simulation/radio.py, so that the register values are equal. */
static void measure(radio_pair *pair, const dw1000_pair_config *config) {
    double energy = 0, noise = 0, sum = 0;
    for (size_t i = 0; i < ACCUMULATOR_SAMPLES; i++) {
        const double re = pair->iq[2 * i], im = pair->iq[2 * i + 1], squared = re * re + im * im;
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
    pair->std_noise = config->std_noise ? config->std_noise : to_uint16(fmax(1.0, sqrt(fmax(0, noise / taps - mean * mean))));
    pair->threshold = config->noise_threshold;
    pair->cir_pwr = to_uint16(power);
    const double found = config->first_path_index > 0 ? config->first_path_index : find_first_path(pair);
    pair->fp_index = to_uint16(found * 64);
    for (size_t k = 0; k < 3; k++) {
        const size_t at = (size_t)pair->fp_index / 64 + 1 + k;
        pair->fp_ampl[k] = at < ACCUMULATOR_SAMPLES ? to_uint16(magnitude(pair, at)) : 0;
    }
    pair->preamble_count = config->preamble_count;
    const double count = pair->preamble_count ? pair->preamble_count : 128;
    pair->level = power / (count * count);
}

static double clamp(double value, double low, double high) {
    return value >= low ? fmin(value, high) : low; /* the lower limit for NaN */
}

static radio_pair *new_pair(const dw1000_pair_config *config, uint64_t key) {
    radio_pair *const pair = dw1000_allocate(sizeof *pair);
    const double per_metre = (double)UNITS_PER_SECOND / SPEED_OF_LIGHT;
    pair->key = key;
    pair->flight = llround(clamp(config->distance_m, 0, MAX_DISTANCE_M) * per_metre);
    pair->excess = llround(clamp(config->excess_m, -MAX_DISTANCE_M, MAX_DISTANCE_M) * per_metre);
    pair->loss = clamp(config->loss, 0, 1);
    pair->damage = clamp(config->damage, 0, 1);
    if (config->iq != NULL) {
        const size_t most = config->samples < ACCUMULATOR_SAMPLES ? config->samples : ACCUMULATOR_SAMPLES;
        memcpy(pair->iq, config->iq, most * 2 * sizeof *config->iq);
    } else {
        synthesise(pair, config->first_path_index > 0 ? config->first_path_index + 1 : DEFAULT_FIRST_PATH);
    }
    measure(pair, config);
    return pair;
}

void dw1000_set_pair(dw1000_air *air, dw1000_chip *a, dw1000_chip *b, const dw1000_pair_config *config) {
    if (a == b) {
        return;
    }
    radio_pair **const there = &b->pairs[a->index], **const back = &a->pairs[b->index];
    dw1000_release_pair(*there);
    dw1000_release_pair(*back);
    *there = *back = NULL;
    if (config != NULL) {
        const uint64_t low = a->index < b->index ? a->index : b->index, high = a->index + b->index - low;
        *there = *back = new_pair(config, dw1000_random_bits(air->seed, low << 32 | high));
        (*there)->users = 2;
    }
}
