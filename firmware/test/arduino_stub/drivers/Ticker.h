/* The periodic interrupt of Mbed OS. */
#ifndef TICKER_H
#define TICKER_H

#include <stdint.h>

#if __has_include(<chrono>)
#include <chrono>
#else /* arm-none-eabi-g++ without its C++ library */
namespace std {
namespace chrono {
struct microseconds {
    explicit constexpr microseconds(int64_t us) : us(us) {}
    constexpr int64_t count() const { return us; }
    int64_t us;
};
} // namespace chrono
} // namespace std
#endif

namespace mbed {
struct Ticker {
    void attach(void (*function)(), std::chrono::microseconds interval);
};
} // namespace mbed

#endif
