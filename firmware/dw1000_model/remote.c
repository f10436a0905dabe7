/* Programs in languages that cannot be coroutines. */
#include "model.h"

static void run(dw1000_chip *chip, void *context) {
    dw1000_request request = {DW1000_DELAY, 0, 0, 0, NULL, NULL, 0, 0};
    for (;;) {
        request.line = chip->line;
        request.now_s = dw1000_seconds_now(chip->air);
        if (!chip->next(context, &request)) {
            return;
        }
        switch (request.kind) {
        case DW1000_SPI: dw1000_spi(chip, request.out, request.in, request.n, request.hz); break;
        case DW1000_WAIT: dw1000_wait(chip, request.seconds); break;
        case DW1000_RESET_PIN: dw1000_reset_pin(chip); break;
        default: dw1000_delay(chip, request.seconds); break;
        }
    }
}

void dw1000_program_remote(dw1000_chip *chip, int (*next)(void *context, dw1000_request *request), void *context) {
    chip->next = next;
    dw1000_program(chip, run, context);
}
