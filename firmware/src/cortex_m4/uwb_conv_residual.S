/* r = relu(conv3(x)) + x: one filter over all blocks, then the next.
 *
 * SMLAL multiplies two packed positions of one channel by packed taps and adds up to four products of 15 bits at once. With
 * the positions e0 e1 (even) and o0 o1 (odd) of one channel in words X = e0 + e1 B, B = 2^21, and taps t0, t1, t2:
 *
 *                               field 0       field 1          field 2
 *     even += E * t1            e0 t1         e1 t1
 *     even += O * (t2 + t0 B)   o0 t2         o0 t0 + o1 t2    o1 t0, of the next even position
 *     odd  += E * (t2 + t0 B)   e0 t2, of     e0 t0 + e1 t2    e1 t0
 *     odd  += O * t1 B          the odd one   o0 t1            o1 t1
 *                               before it
 *
 * The sums over 16 channels are below 2^20 in each field, because weights have 7 bits. Fields 0 and 1 must not be negative
 * in the end, because they would borrow from the next one: they start at 2^19, and at the bias, which is at least 3 * 2^18;
 * field 2 starts with the rest of the bias. So sum 1 is field 1, and sum 0 is field 0 + field 2 of the word before: a sum at
 * the end of a block is completed in the next one, and the last odd one of all after the last block. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

/* Frame */
#define CARRY_EVEN 0  /* upper halves of the last even and odd accumulators of the block before */
#define START 4       /* of the accumulators, upper and lower half */
#define CARRY_ODD 12
#define MULTIPLIER 16 /* and offset */
#define SUM 24        /* first, second, offset */
#define X_OFFSET 36   /* of the filter's channel, from the end of a block of x; and of its place in the block of r */
#define R_OFFSET 40
#define X_NEXT 44
#define X_END 48
#define X 52          /* and r - x */
#define WEIGHTS 60    /* and channels */
#define FRAME 72

#define FIELD 21

        /* r0:r1, r2:r3 even and r4:r5, r6:r7 odd accumulators. */
        .macro eight_positions number
        ldmia   lr!, {r8-r11}                   /* even 0, even 1, odd 0, odd 1 */
        fetch   r12, 2 * \number                /* t1 */
        smlal   r0, r1, r8, r12
        smlal   r2, r3, r9, r12
        lsl     r12, r12, #FIELD
        smlal   r4, r5, r10, r12
        smlal   r6, r7, r11, r12
        fetch   r12, 2 * \number + 1            /* t2, t0 */
        smlal   r0, r1, r10, r12
        smlal   r2, r3, r11, r12
        smlal   r4, r5, r8, r12
        smlal   r6, r7, r9, r12
        .endm

        /* The first four positions. */
        .macro four_positions number
        ldr     r8, [lr, #(16 * \number)]
        ldr     r10, [lr, #(16 * \number + 8)]
        fetch   r12, 2 * \number
        smlal   r0, r1, r8, r12
        lsl     r12, r12, #FIELD
        smlal   r4, r5, r10, r12
        fetch   r12, 2 * \number + 1
        smlal   r0, r1, r10, r12
        smlal   r4, r5, r8, r12
        .endm

        /* Field 0 begins with field 2 of the word before. */
        .macro start_accumulators
        ldmia   sp, {r0-r2, r4}
        add     r0, r2, r0, asr #(2 * FIELD - 32)
        mov     r3, r1
        add     r4, r2, r4, asr #(2 * FIELD - 32)
        mov     r5, r1
        mov     r6, r2
        mov     r7, r1
        .endm

        .macro each_channel positions
        .irp number, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15
        \positions \number
        .endr
        .endm

        /* \before, the upper half of the word before, becomes the sum that began there. */
        .macro joint_sum before, low, scratch
        ubfx    \scratch, \low, #0, #FIELD
        add     \before, \scratch, \before, asr #(2 * FIELD - 32)
        .endm

        .macro second_sum low, high
        lsr     \low, \low, #FIELD
        bfi     \low, \high, #(32 - FIELD), #(2 * FIELD - 32)
        .endm

        .macro unpack word, second
        lsr     \second, \word, #FIELD
        uxtb    \word, \word
        .endm

        function uwb_conv_residual
        push    {r4-r11, lr}
        vpush   {s16-s31}
        sub     sp, sp, #FRAME
        add     r2, r0, r2, lsl #8
        str     r2, [sp, #X_END]
        sub     r1, r1, r0
        strd    r0, r1, [sp, #X]
        ldrd    r6, r7, [r3, #8]
        strd    r6, r7, [sp, #SUM]
        ldr     r6, [r3, #16]
        str     r6, [sp, #(SUM + 8)]
        mov     r6, #0
        str     r6, [sp, #CARRY_ODD]            /* for position -1, which is not used; small, or field 0 overflows */
        ldrd    r4, r5, [r3]
        mvn     r11, #(BLOCK_BYTES - 1)

.Lfilter:
        vldmia  r4!, {s0-s31}
        ldmia   r5!, {r8-r10}                   /* bias, multiplier, offset */
        str     r4, [sp, #WEIGHTS]
        str     r5, [sp, #(WEIGHTS + 4)]
        str     r9, [sp, #MULTIPLIER]
        str     r10, [sp, #(MULTIPLIER + 4)]
        ldrd    lr, r4, [sp, #X]
        add     r4, r4, r11
        tst     r11, #16                        /* x: 16 bytes a channel. r: 32 bytes two, 2 between them. */
        it      ne
        subne   r4, r4, #14
        str     r11, [sp, #X_OFFSET]
        str     r4, [sp, #R_OFFSET]
        mov     r6, #(1 << 19)
        orr     r0, r6, r8, lsl #FIELD
        sub     r6, r8, r6
        lsr     r1, r8, #(32 - FIELD)
        add     r1, r1, r6, lsl #(2 * FIELD - 32)
        str     r1, [sp, #CARRY_EVEN]
        str     r1, [sp, #START]
        str     r0, [sp, #(START + 4)]
        ldr     r7, [sp, #X_END]
        cmp     lr, r7
        beq     .Lfour

.Lblock:
        start_accumulators
        each_channel eight_positions
.Lsums:
        /* Sums of positions -1 (r9), 0 (r8), 1 (r4), 2 (r0), 3 (r5), 4 (r1), 5 (r6) and 6 (r2) */
        ldrd    r10, r11, [sp, #MULTIPLIER]
        ubfx    r8, r0, #0, #FIELD
        second_sum r0, r1
        joint_sum r1, r2, r12
        second_sum r2, r3
        str     r3, [sp, #CARRY_EVEN]
        ubfx    r9, r4, #0, #FIELD
        second_sum r4, r5
        joint_sum r5, r6, r12
        second_sum r6, r7
        str     r7, [sp, #CARRY_ODD]
        .irp sum, r8, r0, r1, r2, r9, r4, r5, r6
        requantise \sum, r10, r11
        .endr
        ldrd    r10, r11, [sp, #SUM]
        ldrd    r12, r3, [sp, #(SUM + 8)]       /* offset, X_OFFSET */
        add     r3, r3, lr
        str     lr, [sp, #X_NEXT]
        ldr     lr, [r3]
        unpack  lr, r7
        add_scaled r8, r10, lr, r11, r12
        add_scaled r0, r10, r7, r11, r12
        ldr     lr, [r3, #4]
        unpack  lr, r7
        add_scaled r1, r10, lr, r11, r12
        add_scaled r2, r10, r7, r11, r12
        ldr     lr, [r3, #8]
        unpack  lr, r7
        add_scaled r4, r10, lr, r11, r12
        add_scaled r5, r10, r7, r11, r12
        ldr     lr, [r3, #12]
        ldrh    r7, [r3, #(14 - BLOCK_BYTES)]
        uxtb    lr, lr
        add_scaled r6, r10, lr, r11, r12
        lsr     r7, r7, #(FIELD - 16)
        add_scaled r9, r10, r7, r11, r12
        ldr     r3, [sp, #R_OFFSET]
        ldrd    lr, r7, [sp, #X_NEXT]           /* and X_END */
        add     r3, r3, lr
        cmp     lr, r7
        strh    r8, [r3]
        strh    r0, [r3, #4]
        strh    r1, [r3, #8]
        strh    r2, [r3, #12]
        strh    r9, [r3, #(28 - BLOCK_BYTES)]
        strh    r4, [r3, #16]
        strh    r5, [r3, #20]
        strh    r6, [r3, #24]
        blo     .Lblock

        ldr     r4, [sp, #X_OFFSET]
        bhi     .Lnext_filter
        /* The last odd position of the last block, after which there are zeros */
        ldrd    r0, r1, [sp, #CARRY_ODD]        /* and the multiplier */
        ldr     r2, [sp, #(MULTIPLIER + 4)]
        mov     r5, #(1 << 19)
        add     r6, r4, lr
        add     r0, r5, r0, asr #(2 * FIELD - 32)
        ldrh    r6, [r6, #14]
        requantise r0, r1, r2
        lsr     r6, r6, #(FIELD - 16)
        add_scaled r0, r10, r6, r11, r12
        strh    r0, [r3, #28]

.Lnext_filter:
        adds    r11, r4, #16
        ldrd    r4, r5, [sp, #WEIGHTS]
        bne     .Lfilter

        add     sp, sp, #FRAME
        vpop    {s16-s31}
        pop     {r4-r11, pc}

.Lfour:
        start_accumulators
        each_channel four_positions
        add     lr, lr, #BLOCK_BYTES
        b       .Lsums
        end_function uwb_conv_residual

#endif
