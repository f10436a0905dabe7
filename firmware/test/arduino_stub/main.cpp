/* Runs the sketch on memory: standard input is Serial1's, what the sketch writes to Serial goes to standard output.
 * Exit 2: a write was longer than a USB packet's safe length, or than the room there was. */
#include "Arduino.h"

#include <stdio.h>

StubPort Serial, Serial1;
static StubWatchdog watchdog;
static StubFactory factory = {{0x386, 1}};
static StubRandom randomness;
StubWatchdog *NRF_WDT = &watchdog;
StubFactory *NRF_FICR = &factory;
StubRandom *NRF_RNG = &randomness;
static uint32_t now_us;

size_t StubPort::write(const uint8_t *bytes, size_t count) {
    longest_write = count > longest_write ? count : longest_write;
    if ((int)count > room || count > sizeof output - output_count) {
        return 0;
    }
    memcpy(output + output_count, bytes, count);
    output_count += count;
    return count;
}

void pinMode(int, int) {}
void digitalWrite(int, int) {}
int digitalRead(int) {
    return LOW;
}
uint32_t micros() {
    return now_us += 10;
}

int main() {
    static uint8_t input[1 << 16];
    Serial1.input = input;
    Serial1.input_left = fread(input, 1, sizeof input, stdin);
    setup();
    for (int turn = 0; turn < 20000; turn++) {
        /* Now and then the host reads slowly. */
        Serial.room = turn % 3 == 0 ? 0 : 64;
        loop();
    }
    fwrite(Serial.output, 1, Serial.output_count, stdout);
    return Serial.longest_write < 64 && watchdog.RR[0] == 0x6E524635u ? 0 : 2;
}
