/* Airs and chips. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

dw1000_air *dw1000_air_new(uint64_t seed) {
    dw1000_air *const air = calloc(1, sizeof *air);
    dw1000_init_register_map();
    if (air != NULL) {
        air->seed = seed;
        if (!dw1000_create_caller(air)) {
            free(air);
            return NULL;
        }
    }
    return air;
}

void dw1000_air_free(dw1000_air *air) {
    if (air == NULL) {
        return;
    }
    for (size_t i = 0; i < air->chip_count; i++) {
        dw1000_chip *const chip = air->chips[i];
        dw1000_stop_transmitter(chip);
        dw1000_stop_receiver(chip);
        for (size_t j = 0; j < air->chip_count; j++) {
            dw1000_release_pair(chip->pairs[j]);
        }
        free(chip->pairs);
        free(chip);
    }
    while (air->frames_on_air != NULL) {
        transmission *const frame = air->frames_on_air;
        air->frames_on_air = frame->next;
        free(frame);
    }
    dw1000_free_programs(air);
    free(air->chips);
    free(air);
}

dw1000_chip *dw1000_chip_new(dw1000_air *air, double ppm, uint64_t clock_ticks, uint16_t tx_delay_ticks,
                             uint16_t rx_delay_ticks) {
    const size_t count = air->chip_count + 1;
    dw1000_chip *const chip = calloc(1, sizeof *chip);
    dw1000_chip **const chips = calloc(count, sizeof(dw1000_chip *));
    if (chip == NULL || chips == NULL) {
        free(chip);
        free(chips);
        return NULL;
    }
    for (size_t i = 0; i < count; i++) {
        radio_pair **const pairs = dw1000_allocate(count * sizeof(radio_pair *));
        dw1000_chip *const other = i + 1 < count ? air->chips[i] : chip;
        if (other->pairs != NULL) {
            memcpy(pairs, other->pairs, (count - 1) * sizeof(radio_pair *));
        }
        free(other->pairs);
        other->pairs = pairs;
        chips[i] = other;
    }
    free(air->chips);
    air->chips = chips;
    air->chip_count = count;
    chip->air = air;
    chip->index = count - 1;
    chip->ppm = ppm;
    chip->celsius = 25.0;
    chip->volts = 3.3;
    chip->clock_offset = (clock_ticks & COUNTER_MASK) * UNITS_PER_TICK;
    chip->clock_rate = llround((1 + ppm * 1e-6) * 0x1p44);
    chip->tx_delay = tx_delay_ticks;
    chip->rx_delay = rx_delay_ticks;
    dw1000_fill_otp(chip);
    dw1000_reset_registers(chip);
    chip->power = POWER_IDLE;
    chip->status = ST_CPLOCK | ST_SLP2INIT;
    return chip;
}

void dw1000_set_edge_loss(dw1000_chip *chip, double probability) {
    chip->edge_loss = probability;
}
