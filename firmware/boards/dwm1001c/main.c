/* Self-test of a model on a DWM1001-DEV board: runs the golden vectors of uwb_model.h and shows the result,
 * green LED for all bits equal, red LED otherwise. */
#include <string.h>

#define UWB_GOLDEN_VECTORS
#include "uwb_model.h"

/* nRF52832 product specification, section 20: GPIO. The LEDs light when low. */
#define GPIO_OUTSET (*(volatile uint32_t *)0x50000508u)
#define GPIO_OUTCLR (*(volatile uint32_t *)0x5000050Cu)
#define GPIO_DIRSET (*(volatile uint32_t *)0x50000518u)
enum { GREEN_LED = 30, RED_LED = 14, ARENA_BYTES = 11008 };

__attribute__((noreturn)) void board_exit(int code);

__attribute__((noreturn)) void board_exit(int code) {
    const uint32_t lit = 1u << (code == 0 ? GREEN_LED : RED_LED);
    GPIO_OUTSET = 1u << GREEN_LED | 1u << RED_LED;
    GPIO_DIRSET = 1u << GREEN_LED | 1u << RED_LED;
    GPIO_OUTCLR = lit;
    for (;;) {
        __asm volatile("wfi");
    }
}

int main(void) {
    static uint32_t arena[ARENA_BYTES / sizeof(uint32_t)];
    for (int i = 0; i < UWB_GOLDEN_COUNT; i++) {
        float output_m;
        if (uwb_network(&uwb_model_data, uwb_golden_windows[i], arena, sizeof arena, &output_m) != UWB_OK ||
            memcmp(&output_m, &uwb_golden_outputs_m[i], sizeof output_m) != 0) {
            return 1;
        }
    }
    return 0;
}
