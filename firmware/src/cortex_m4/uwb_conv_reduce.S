/* y = relu(conv3 stride 2(r)) + relu(conv1 stride 2(r)), for odd and even lengths, which differ in their taps only:
 * outputs centre on even positions, or windows begin on them. A block of r becomes four
 * positions of both branches, wide in r0 to r3 and narrow in r4 to r7. All 32 FPU registers hold
 * weights: for each channel pair tap 0, tap 2, tap 1, skip. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

/* Frame */
#define BIAS 0        /* wide, narrow */
#define MULTIPLIER 8  /* wide, narrow */
#define SUM 16        /* first, second, offset */
#define Y_FILTER 28   /* y, at the filter's place in a row */
#define R 32
#define R_END 36
#define Y_OFFSET 40   /* of the half row that is next */
#define WEIGHTS 44
#define REDUCE 48
#define SKIP 52
#define FILTER 56
#define Y 60
#define FRAME 64

        .macro combine wide, narrow
        mla     \narrow, \narrow, r9, r10
        mla     \wide, \wide, r8, \narrow
        usat    \wide, #8, \wide, asr #UWB_SUM_SHIFT
        .endm

        /* \taps pair, start_wide, start_narrow, ... computes one channel pair. r3 and r7 start as the biases
         * of all four, because their own first products come last. */
        .macro reduce name, taps
        function \name
        push    {r4-r11, lr}
        vpush   {s16-s31}
        sub     sp, sp, #FRAME
        add     r4, r0, r2, lsl #8
        strd    r0, r4, [sp, #R]
        mov     r11, #0
        strd    r11, r1, [sp, #FILTER]
        ldrd    r4, r5, [r3, #32]
        strd    r4, r5, [sp, #SUM]
        ldr     r6, [r3, #40]
        str     r6, [sp, #(SUM + 8)]
        ldr     r4, [r3, #20]
        ldrd    r5, r10, [r3, #24]

1:      /* filter: weights r4, channels r5 r10, place r11, y r1 */
        mov     r2, #UPPER_BYTES
        park_words 0, r4, r2, r3
        park_words 8, r4, r2, r3
        park_words 16, r4, r2, r3
        park_words 24, r4, r2, r3
        ldrd    r6, r7, [r5], #8
        ldrd    r8, r9, [r10], #8
        strd    r6, r8, [sp, #BIAS]
        strd    r7, r9, [sp, #MULTIPLIER]
        strd    r4, r5, [sp, #WEIGHTS]
        str     r10, [sp, #SKIP]
        add     r1, r1, r11
        str     r1, [sp, #Y_FILTER]
        mov     r12, #0
        ldr     lr, [sp, #R]

2:      /* block */
        str     r12, [sp, #Y_OFFSET]
        ldrd    r3, r7, [sp, #BIAS]
        \taps   0, r3, r3, r3, r7, r7, r7
        \taps   1, r0, r1, r2, r4, r5, r6
        \taps   2, r0, r1, r2, r4, r5, r6
        \taps   3, r0, r1, r2, r4, r5, r6
        \taps   4, r0, r1, r2, r4, r5, r6
        \taps   5, r0, r1, r2, r4, r5, r6
        \taps   6, r0, r1, r2, r4, r5, r6
        \taps   7, r0, r1, r2, r4, r5, r6
        ldrd    r8, r9, [sp, #MULTIPLIER]
        .irp accumulator, r0, r1, r2, r3
        requantise \accumulator, r8
        .endr
        .irp accumulator, r4, r5, r6, r7
        requantise \accumulator, r9
        .endr
        ldrd    r8, r9, [sp, #SUM]
        ldrd    r10, r11, [sp, #(SUM + 8)]
        ldr     r12, [sp, #Y_OFFSET]
        combine r0, r4
        combine r1, r5
        combine r2, r6
        combine r3, r7
        add     r11, r11, r12
        strh    r0, [r11]
        strh    r1, [r11, #4]
        strh    r2, [r11, #8]
        strh    r3, [r11, #12]
        /* Two blocks of r make one of y. */
        eor     r12, r12, #16
        tst     r12, #16
        it      eq
        addeq   r12, r12, #BLOCK_BYTES
        ldr     r8, [sp, #R_END]
        add     lr, lr, #BLOCK_BYTES
        cmp     lr, r8
        bne     2b

        ldrd    r4, r5, [sp, #WEIGHTS]
        ldr     r10, [sp, #SKIP]
        ldrd    r11, r1, [sp, #FILTER]
        next_filter r11
        str     r11, [sp, #FILTER]
        cmp     r11, #BLOCK_BYTES
        bne     1b

        add     sp, sp, #FRAME
        vpop    {s16-s31}
        pop     {r4-r11, pc}
        end_function \name
        .endm

        .macro taps_odd pair, wide0, wide1, wide2, narrow0, narrow1, narrow2
        fetch_pair r8, r9, 4 * \pair + 2        /* tap 1, skip: even positions */
        ldrd    r10, r11, [lr, #(ROW_BYTES * \pair)]
        smlad   r0, r10, r8, \wide0
        smlad   r4, r10, r9, \narrow0
        smlad   r1, r11, r8, \wide1
        smlad   r5, r11, r9, \narrow1
        ldrd    r10, r11, [lr, #(ROW_BYTES * \pair + 8)]
        smlad   r2, r10, r8, \wide2
        smlad   r6, r10, r9, \narrow2
        smlad   r3, r11, r8, r3
        smlad   r7, r11, r9, r7
        fetch_pair r8, r9, 4 * \pair            /* tap 0, tap 2: odd positions */
        ldr     r10, [lr, #(ROW_BYTES * \pair + BEFORE_BLOCK)]
        smlad   r0, r10, r8, r0
        ldrd    r10, r11, [lr, #(ROW_BYTES * \pair + 16)]
        smlad   r0, r10, r9, r0
        smlad   r1, r10, r8, r1
        smlad   r1, r11, r9, r1
        smlad   r2, r11, r8, r2
        ldrd    r10, r11, [lr, #(ROW_BYTES * \pair + 24)]
        smlad   r2, r10, r9, r2
        smlad   r3, r10, r8, r3
        smlad   r3, r11, r9, r3
        .endm

        .macro taps_even pair, wide0, wide1, wide2, narrow0, narrow1, narrow2
        fetch_pair r8, r9, 4 * \pair            /* tap 0, tap 2: even positions */
        fetch   r10, 4 * \pair + 3              /* skip: the same */
        ldrd    r11, r12, [lr, #(ROW_BYTES * \pair)]
        smlad   r0, r11, r8, \wide0
        smlad   r4, r11, r10, \narrow0
        smlad   r0, r12, r9, r0
        smlad   r1, r12, r8, \wide1
        smlad   r5, r12, r10, \narrow1
        ldrd    r11, r12, [lr, #(ROW_BYTES * \pair + 8)]
        smlad   r1, r11, r9, r1
        smlad   r2, r11, r8, \wide2
        smlad   r6, r11, r10, \narrow2
        smlad   r2, r12, r9, r2
        smlad   r3, r12, r8, r3
        smlad   r7, r12, r10, r7
        ldr     r11, [lr, #(ROW_BYTES * \pair + BLOCK_BYTES)]
        smlad   r3, r11, r9, r3
        fetch   r8, 4 * \pair + 2               /* tap 1: odd positions */
        ldrd    r11, r12, [lr, #(ROW_BYTES * \pair + 16)]
        smlad   r0, r11, r8, r0
        smlad   r1, r12, r8, r1
        ldrd    r11, r12, [lr, #(ROW_BYTES * \pair + 24)]
        smlad   r2, r11, r8, r2
        smlad   r3, r12, r8, r3
        .endm

        reduce  uwb_conv_reduce_odd, taps_odd
        reduce  uwb_conv_reduce_even, taps_even

#endif
