/* The chips' clocks, and chance. */
#include "model.h"

__extension__ typedef __int128 wide;

#define RATE_BITS 44

uint64_t dw1000_local_units(const dw1000_chip *chip, instant at) {
    return chip->clock_offset + (uint64_t)(((wide)at * chip->clock_rate) >> RATE_BITS);
}

instant dw1000_air_time(const dw1000_chip *chip, uint64_t units) {
    const wide scaled = (wide)(units - chip->clock_offset) << RATE_BITS;
    return (instant)((scaled + chip->clock_rate - 1) / chip->clock_rate);
}

uint64_t dw1000_counter_now(const dw1000_chip *chip) {
    return (dw1000_local_units(chip, chip->air->now) / UNITS_PER_TICK) & COUNTER_MASK;
}

/* The finaliser of splitmix64 (Steele, Lea, Flood 2014), twice. */
static uint64_t mix(uint64_t x) {
    x = (x ^ (x >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    x = (x ^ (x >> 27)) * UINT64_C(0x94D049BB133111EB);
    return x ^ (x >> 31);
}

uint64_t dw1000_dice(uint64_t a, uint64_t b) {
    return mix(mix(a + UINT64_C(0x9E3779B97F4A7C15)) + b + UINT64_C(0x9E3779B97F4A7C15));
}

double dw1000_chance(uint64_t bits) {
    return (double)(bits >> 11) * 0x1p-53;
}
