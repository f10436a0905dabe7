/* r = relu(conv3(x)) + x: one filter over all blocks, then the next. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

/* Frame */
#define X 0
#define X_END 4
#define R_MINUS_X 8
#define WEIGHTS 12 /* and channels after it */
#define FRAME 24

/* FPU registers after the 24 weights: s24 bias, s25 multiplier, s26 s27 s28 the sum's first, second and
 * offset, s29 the filter's place in x's blocks, s30 the same in r's, relative to x; s31 the block. */

        /* Eight positions of one channel pair: ten loads' worth of inputs in six instructions. r7 starts as
         * the bias of all eight, because its own first product comes last. */
        .macro taps pair, start0, start1, start2, start3, start4, start5, start6
        fetch_pair r8, r9, 3 * \pair
        fetch   r10, 3 * \pair + 2
        ldr     r11, [lr, #(ROW_BYTES * \pair + BEFORE_BLOCK)]
        smlad   r0, r11, r8, \start0
        ldrd    r11, r12, [lr, #(ROW_BYTES * \pair)]
        smlad   r0, r11, r9, r0
        smlad   r1, r11, r8, \start1
        smlad   r0, r12, r10, r0
        smlad   r1, r12, r9, r1
        smlad   r2, r12, r8, \start2
        ldrd    r11, r12, [lr, #(ROW_BYTES * \pair + 8)]
        smlad   r1, r11, r10, r1
        smlad   r2, r11, r9, r2
        smlad   r3, r11, r8, \start3
        smlad   r2, r12, r10, r2
        smlad   r3, r12, r9, r3
        smlad   r4, r12, r8, \start4
        ldrd    r11, r12, [lr, #(ROW_BYTES * \pair + 16)]
        smlad   r3, r11, r10, r3
        smlad   r4, r11, r9, r4
        smlad   r5, r11, r8, \start5
        smlad   r4, r12, r10, r4
        smlad   r5, r12, r9, r5
        smlad   r6, r12, r8, \start6
        ldrd    r11, r12, [lr, #(ROW_BYTES * \pair + 24)]
        smlad   r5, r11, r10, r5
        smlad   r6, r11, r9, r6
        smlad   r7, r11, r8, r7
        smlad   r6, r12, r10, r6
        smlad   r7, r12, r9, r7
        ldr     r11, [lr, #(ROW_BYTES * \pair + BLOCK_BYTES)]
        smlad   r7, r11, r10, r7
        .endm

        .macro more_taps pair
        taps    \pair, r0, r1, r2, r3, r4, r5, r6
        .endm

        /* Even positions go to the first half of a row of r, odd ones to the second. */
        .macro add_input accumulator, position, slot
        ldrh    r11, [lr, #(4 * \position)]
        mla     r11, r11, r9, r10
        mla     \accumulator, \accumulator, r8, r11
        usat    \accumulator, #8, \accumulator, asr #UWB_SUM_SHIFT
        strh    \accumulator, [r12, #(4 * \slot)]
        .endm

        function uwb_conv_residual
        push    {r4-r11, lr}
        vpush   {s16-s31}
        sub     sp, sp, #FRAME
        add     r4, r0, r2, lsl #8
        sub     r5, r1, r0
        strd    r0, r4, [sp, #X]
        str     r5, [sp, #R_MINUS_X]
        ldrd    r6, r7, [r3, #8]
        vmov    s26, s27, r6, r7
        ldr     r6, [r3, #16]
        vmov    s28, r6
        ldrd    r4, r5, [r3]
        mov     r11, #0

.Lfilter:
        mov     r2, #UPPER_BYTES
        park_words 0, r4, r2, r3
        park_words 8, r4, r2, r3
        park_words 16, r4, r2, r3
        ldrd    r6, r7, [r5], #8
        vmov    s24, s25, r6, r7
        strd    r4, r5, [sp, #WEIGHTS]
        ldr     r10, [sp, #R_MINUS_X]
        add     r10, r10, r11
        vmov    s29, s30, r11, r10
        ldr     lr, [sp, #X]

.Lblock:
        vmov    s31, lr
        vmov    r7, s24
        taps    0, r7, r7, r7, r7, r7, r7, r7
        more_taps 1
        more_taps 2
        more_taps 3
        more_taps 4
        more_taps 5
        more_taps 6
        more_taps 7
        vmov    r8, s25
        .irp accumulator, r0, r1, r2, r3, r4, r5, r6, r7
        requantise \accumulator, r8
        .endr
        vmov    r8, r9, s26, s27
        vmov    r10, s28
        vmov    r11, r12, s29, s30
        add     r12, r12, lr
        add     lr, lr, r11
        add_input r0, 0, 0
        add_input r1, 1, 4
        add_input r2, 2, 1
        add_input r3, 3, 5
        add_input r4, 4, 2
        add_input r5, 5, 6
        add_input r6, 6, 3
        add_input r7, 7, 7
        vmov    lr, s31
        ldr     r8, [sp, #X_END]
        add     lr, lr, #BLOCK_BYTES
        cmp     lr, r8
        bne     .Lblock

        ldrd    r4, r5, [sp, #WEIGHTS]
        vmov    r11, s29
        next_filter r11
        cmp     r11, #BLOCK_BYTES
        bne     .Lfilter

        add     sp, sp, #FRAME
        vpop    {s16-s31}
        pop     {r4-r11, pc}
        end_function uwb_conv_residual

#endif
