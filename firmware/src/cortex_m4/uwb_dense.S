/* Dense layer with ReLU, four outputs a pass. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

/* r0 x, r1 weights, r2 mask, r3 scratch, r4-r7 sums, r8-r11 words, r12 lr inputs.
 * s0 y, s1 channels, s2 x, s3 end of x, s4 end of y. */

        .macro row sum, word
        and     r3, r2, \word, lsl #8
        smlad   \sum, r12, r3, \sum
        and     r3, r2, \word
        smlad   \sum, lr, r3, \sum
        .endm

        .macro four_inputs
        ldmia   r1!, {r8-r11}
        ldrd    r12, lr, [r0], #8
        row     r4, r8
        row     r5, r9
        row     r6, r10
        row     r7, r11
        .endm

        function uwb_dense
        push    {r4-r11, lr}
        ldrh    r3, [r2, #8]
        add     r3, r0, r3, lsl #1
        vmov    s2, s3, r0, r3
        ldrh    r3, [r2, #10]
        add     r3, r1, r3, lsl #1
        vmov    s4, r3
        ldrd    r4, r5, [r2]
        vmov    s0, s1, r1, r5
        mov     r1, r4
        mov     r2, #UPPER_BYTES

.Loutputs:
        vmov    r0, s2
        vmov    r3, s1
        ldr     r4, [r3]
        ldr     r5, [r3, #8]
        ldr     r6, [r3, #16]
        ldr     r7, [r3, #24]
.Linputs:
        four_inputs
        four_inputs
        vmov    r3, s3
        cmp     r0, r3
        bne     .Linputs

        vmov    r12, r3, s0, s1
        ldr     r8, [r3, #4]
        requantise r4, r8
        ldr     r8, [r3, #12]
        requantise r5, r8
        ldr     r8, [r3, #20]
        requantise r6, r8
        ldr     r8, [r3, #28]
        requantise r7, r8
        strh    r4, [r12]
        strh    r5, [r12, #2]
        strh    r6, [r12, #4]
        strh    r7, [r12, #6]
        add     r12, r12, #8
        add     r3, r3, #32
        vmov    s0, s1, r12, r3
        vmov    r3, s4
        cmp     r12, r3
        bne     .Loutputs
        pop     {r4-r11, pc}
        end_function uwb_dense

#endif
