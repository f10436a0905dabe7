/* Runs the golden vectors of uwb_model.h in an arena of exactly the size asked for, so that a sanitizer sees
 * what reaches past it. Exit 0: every output has the expected bits. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define UWB_GOLDEN_VECTORS
#include "uwb_model.h"

int main(void) {
    const size_t bytes = uwb_arena_size(&uwb_model_data);
    void *const arena = malloc(bytes);
    if (arena == NULL) {
        return 2;
    }
    int wrong = 0;
    for (int i = 0; i < UWB_GOLDEN_COUNT; i++) {
        float output_m;
        const uwb_status status = uwb_network(&uwb_model_data, uwb_golden_windows[i], arena, bytes, &output_m);
        if (status != UWB_OK || memcmp(&output_m, &uwb_golden_outputs_m[i], sizeof output_m) != 0) {
            wrong++;
        }
    }
    printf("model %08lx: %d of %d golden vectors wrong, arena of %lu bytes\n",
           (unsigned long)uwb_model_data.model_id, wrong, (int)UWB_GOLDEN_COUNT, (unsigned long)bytes);
    free(arena);
    return wrong == 0 ? 0 : 1;
}
