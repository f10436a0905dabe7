/* y = relu(conv3 stride 2(r)) + relu(conv1 stride 2(r)), for odd and even lengths, which differ in their taps only:
 * outputs centre on even positions, or windows begin on them. A block of r becomes four positions of both branches, wide
 * in r0 to r3 and narrow in r4 to r7. The FPU registers contain for each channel pair tap 0, tap 2, tap 1, skip. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

/* Frame */
#define MULTIPLIER 0 /* and offset: wide, narrow */
#define SUM 16       /* first, second, offset */
#define Y_WORD 28    /* next even positions of the filter; the word of the odd ones is two after it */
#define R_END 32
#define STEP 36      /* to the next word: two blocks of r make one of y */
#define BIAS 40      /* wide, narrow */
#define WEIGHTS 48
#define R 52
#define CHANNELS 56  /* wide, narrow */
#define Y 64         /* of the filter, and of the one after the last */
#define FRAME 72

#define ROW_BYTES 32

        /* Products of a tap in r8 with the four positions in r9 to r12, added to \from0 ... */
        .macro four_sums sum0, from0, sum1, from1, sum2, from2, sum3, from3
        smlad   \sum0, r9, r8, \from0
        smlad   \sum1, r10, r8, \from1
        smlad   \sum2, r11, r8, \from2
        smlad   \sum3, r12, r8, \from3
        .endm

        /* One channel pair. r3 and r7 begin as the biases of all four. */
        .macro taps_odd pair, wide0, wide1, wide2, narrow0, narrow1, narrow2
        ldmia   lr!, {r9-r12}                   /* even positions */
        fetch   r8, 4 * \pair + 2
        four_sums r0, \wide0, r1, \wide1, r2, \wide2, r3, r3
        fetch   r8, 4 * \pair + 3
        four_sums r4, \narrow0, r5, \narrow1, r6, \narrow2, r7, r7
        ldr     r9, [lr, #(12 - BLOCK_BYTES)]   /* the odd position before the block */
        fetch   r8, 4 * \pair
        smlad   r0, r9, r8, r0
        ldmia   lr!, {r9-r12}                   /* odd positions */
        smlad   r1, r9, r8, r1
        smlad   r2, r10, r8, r2
        smlad   r3, r11, r8, r3
        fetch   r8, 4 * \pair + 1
        four_sums r0, r0, r1, r1, r2, r2, r3, r3
        .endm

        .macro taps_even pair, wide0, wide1, wide2, narrow0, narrow1, narrow2
        ldmia   lr!, {r9-r12}                   /* even positions */
        fetch   r8, 4 * \pair
        four_sums r0, \wide0, r1, \wide1, r2, \wide2, r3, r3
        fetch   r8, 4 * \pair + 3
        four_sums r4, \narrow0, r5, \narrow1, r6, \narrow2, r7, r7
        fetch   r8, 4 * \pair + 1
        smlad   r0, r10, r8, r0
        smlad   r1, r11, r8, r1
        smlad   r2, r12, r8, r2
        ldr     r9, [lr, #(BLOCK_BYTES - 16)]   /* the even position after the block */
        smlad   r3, r9, r8, r3
        ldmia   lr!, {r9-r12}                   /* odd positions */
        fetch   r8, 4 * \pair + 2
        four_sums r0, r0, r1, r1, r2, r2, r3, r3
        .endm

        .macro reduce name, taps
        function \name
        push    {r4-r11, lr}
        vpush   {s16-s31}
        sub     sp, sp, #FRAME
        add     r2, r0, r2, lsl #8
        str     r0, [sp, #R]
        str     r2, [sp, #R_END]
        add     r2, r1, #BLOCK_BYTES
        strd    r1, r2, [sp, #Y]
        ldrd    r4, r5, [r3, #32]
        strd    r4, r5, [sp, #SUM]
        ldr     r4, [r3, #40]
        str     r4, [sp, #(SUM + 8)]
        ldr     r4, [r3, #20]
        ldrd    r10, r11, [r3, #24]

1:      /* filter: weights r4, channels r10 r11, y r1 */
        vldmia  r4!, {s0-s31}
        ldmia   r10!, {r3, r5, r6}
        ldmia   r11!, {r7, r8, r9}
        str     r4, [sp, #WEIGHTS]
        str     r10, [sp, #CHANNELS]
        str     r11, [sp, #(CHANNELS + 4)]
        str     r3, [sp, #BIAS]
        str     r7, [sp, #(BIAS + 4)]
        str     r5, [sp, #MULTIPLIER]
        str     r6, [sp, #(MULTIPLIER + 4)]
        str     r8, [sp, #(MULTIPLIER + 8)]
        str     r9, [sp, #(MULTIPLIER + 12)]
        str     r1, [sp, #Y_WORD]
        mov     r1, #4
        str     r1, [sp, #STEP]
        ldr     lr, [sp, #R]

2:      /* block */
        \taps   0, r3, r3, r3, r7, r7, r7
        .irp pair, 1, 2, 3, 4, 5, 6, 7
        \taps   \pair, r0, r1, r2, r4, r5, r6
        .endr
        ldmia   sp, {r8-r11}
        .irp accumulator, r0, r1, r2, r3
        requantise \accumulator, r8, r9
        .endr
        .irp accumulator, r4, r5, r6, r7
        requantise \accumulator, r10, r11
        .endr
        ldrd    r8, r9, [sp, #SUM]
        ldrd    r10, r11, [sp, #(SUM + 8)]      /* offset, Y_WORD */
        add_scaled r0, r8, r4, r9, r10
        add_scaled r1, r8, r5, r9, r10
        add_scaled r2, r8, r6, r9, r10
        add_scaled r3, r8, r7, r9, r10
        orr     r0, r0, r2, lsl #UWB_POSITION_SHIFT
        str     r0, [r11]
        orr     r1, r1, r3, lsl #UWB_POSITION_SHIFT
        str     r1, [r11, #8]
        ldrd    r8, r9, [sp, #R_END]            /* and STEP */
        ldrd    r3, r7, [sp, #BIAS]
        add     r11, r11, r9
        str     r11, [sp, #Y_WORD]
        rsb     r9, r9, #BLOCK_BYTES
        str     r9, [sp, #STEP]
        cmp     lr, r8
        bne     2b

        ldr     r4, [sp, #WEIGHTS]
        ldrd    r10, r11, [sp, #CHANNELS]
        ldrd    r1, r2, [sp, #Y]
        add     r1, r1, #16
        str     r1, [sp, #Y]
        cmp     r1, r2
        bne     1b

        add     sp, sp, #FRAME
        vpop    {s16-s31}
        pop     {r4-r11, pc}
        end_function \name
        .endm

        reduce  uwb_conv_reduce_odd, taps_odd
        reduce  uwb_conv_reduce_even, taps_even

#endif
