/* bias + 256 * dot product, eight inputs a pass. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

        .macro four_inputs
        ldr     r4, [r1], #4
        ldrd    r5, r6, [r0], #8
        and     r7, r12, r4, lsl #8
        smlad   r3, r5, r7, r3
        and     r4, r12, r4
        smlad   r3, r6, r4, r3
        .endm

        function uwb_dot
        push    {r4-r7}
        mov     r12, #UPPER_BYTES
.Linputs:
        four_inputs
        four_inputs
        subs    r2, r2, #8
        bne     .Linputs
        mov     r0, r3
        pop     {r4-r7}
        bx      lr
        end_function uwb_dot

#endif
