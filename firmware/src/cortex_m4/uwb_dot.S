/* bias + dot product of positions in words with pairs of weights, eight inputs a pass. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

/* The second position, seen as an upper halfword, is 32-fold: so is the first weight, and the sum. */
#define FOLD (UWB_POSITION_SHIFT - 16)

        function uwb_dot
        push    {r4-r11, lr}
        lsl     r3, r3, #FOLD
.Linputs:
        ldmia   r0!, {r4-r7}
        ldmia   r1!, {r8-r11}
        smlad   r3, r4, r8, r3
        smlad   r3, r5, r9, r3
        smlad   r3, r6, r10, r3
        smlad   r3, r7, r11, r3
        subs    r2, r2, #8
        bne     .Linputs
        asr     r0, r3, #FOLD
        pop     {r4-r11, pc}
        end_function uwb_dot

#endif
