/* Programs in languages that cannot be coroutines: each asks for one request after another. */
#ifndef DW1000_REMOTE_H
#define DW1000_REMOTE_H

#include "dw1000_model.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum { DW1000_SPI, DW1000_DELAY, DW1000_WAIT, DW1000_RESET_PIN } dw1000_request_kind;

typedef struct {
    int32_t kind; /* dw1000_request_kind */
    int32_t line; /* the IRQ line after the last request */
    double now_s; /* and the time */
    double seconds;
    const uint8_t *out;
    uint8_t *in;
    size_t n;
    uint32_t hz;
} dw1000_request;

/* `next` writes the next request, and returns 0 when there is none any more. It is called on the program's stack, and
 * has to return before anything else happens on the air. */
void dw1000_program_remote(dw1000_chip *chip, int (*next)(void *context, dw1000_request *request), void *context);

#ifdef __cplusplus
}
#endif
#endif
