#include "uwb_twr.h"

static const double METRES_PER_TICK = 299792458.0 / (128 * 499.2e6);

/* Beyond these no exchange of ours goes: a second for each reply, and what clocks 60 ppm apart gain in it or a wave
 * travels in 2000 m. They keep all products below within 63 bits. */
static const uint64_t LONGEST = (uint64_t)1 << 36;
static const int64_t MOST_FLIGHT = (int64_t)1 << 23;

static uint64_t since(uint64_t later, uint64_t earlier) {
    return (later - earlier) & UWB_DW1000_TICK_MASK;
}

/* Time of flight = (R1 R2 - P1 P2) / (R1 + R2 + P1 + P2), with rounds R and replies P. A round is its reply and
 * something small, R = P + f, so that the numerator is f1 P2 + f2 P1 + f1 f2: exact in integers of 64 bits. */
int uwb_twr_range_m(const uint64_t tag[UWB_TWR_STAMPS], const uint64_t anchor[UWB_TWR_STAMPS], double *range_m) {
    const uint64_t round_1 = since(tag[1], tag[0]), reply_1 = since(anchor[1], anchor[0]);
    const uint64_t round_2 = since(anchor[2], anchor[1]), reply_2 = since(tag[2], tag[1]);
    if (round_1 > LONGEST || round_2 > LONGEST || reply_1 > LONGEST || reply_2 > LONGEST || reply_1 == 0 ||
        reply_2 == 0) {
        return 0;
    }
    const int64_t flight_1 = (int64_t)round_1 - (int64_t)reply_1, flight_2 = (int64_t)round_2 - (int64_t)reply_2;
    if (flight_1 > MOST_FLIGHT || flight_1 < -MOST_FLIGHT || flight_2 > MOST_FLIGHT || flight_2 < -MOST_FLIGHT) {
        return 0;
    }
    const int64_t product =
        flight_1 * (int64_t)reply_2 + flight_2 * (int64_t)reply_1 + flight_1 * flight_2;
    const int64_t sum = (int64_t)(round_1 + round_2 + reply_1 + reply_2);
    *range_m = (double)product / (double)sum * METRES_PER_TICK;
    return *range_m > -10 && *range_m < 2000;
}
