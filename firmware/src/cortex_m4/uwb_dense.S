/* Dense layer with ReLU, four outputs a pass. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

/* r0 x, r1 weights, r2 channels, r3 scratch, r4-r7 sums, r8-r11 words, r12 lr inputs.
 * s0 x, s1 end of x, s2 y, s3 end of y. */

        .macro row sum, word
        sxtb16  r3, \word
        smlad   \sum, r12, r3, \sum
        sxtb16  r3, \word, ror #8
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

        .macro store sum, at
        ldrd    r8, r9, [r2, #(12 * \at + 4)]
        requantise \sum, r8, r9
        strh    \sum, [r12, #(2 * \at)]
        .endm

        function uwb_dense
        push    {r4-r11, lr}
        ldrh    r3, [r2, #8]
        add     r3, r0, r3, lsl #1
        vmov    s0, s1, r0, r3
        ldrh    r3, [r2, #10]
        add     r3, r1, r3, lsl #1
        vmov    s2, s3, r1, r3
        ldrd    r1, r2, [r2]

.Loutputs:
        vmov    r0, s0
        ldr     r4, [r2]
        ldr     r5, [r2, #12]
        ldr     r6, [r2, #24]
        ldr     r7, [r2, #36]
.Linputs:
        four_inputs
        four_inputs
        vmov    r3, s1
        cmp     r0, r3
        bne     .Linputs

        vmov    r12, r3, s2, s3
        store   r4, 0
        store   r5, 1
        store   r6, 2
        store   r7, 3
        add     r2, r2, #48
        add     r12, r12, #8
        vmov    s2, r12
        cmp     r12, r3
        bne     .Loutputs
        pop     {r4-r11, pc}
        end_function uwb_dense

#endif
