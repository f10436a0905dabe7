/* y = relu(conv3 or conv5(x)) of one channel: pairs of samples against pairs of weights. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

/* Frame */
#define WEIGHTS 0
#define CHANNELS 4
#define X_END 8
#define X 12
#define Y 16      /* of the filter, and of the one after the last */
#define FRAME 24
#define SAVED 36  /* bytes that push stores below the arguments on the stack */

/* r0 to r3 samples, r9 multiplier, r10 offset, r11 x, r12 y, lr sum. Three taps: r4 r5 weights, r6 sum, r7 end of x, r8 bias.
 * Five: r4 to r7 weights, r8 sum, s0 bias. */

        /* A position: products of pairs of samples, or of one of a pair, with pairs of weights. */
        .macro position3 sum, first, a, second, b
        \first \sum, \a, r4, r8
        \second \sum, \b, r5, \sum
        requantise \sum, r9, r10
        .endm
        .macro position5 sum, first, a, weights, b, last, c
        vmov    \sum, s0
        \first \sum, \a, r4, \sum
        smlad   \sum, \b, \weights, \sum
        \last  \sum, \c, r7, \sum
        requantise \sum, r9, r10
        .endm

        .macro store second, at
        orr     lr, lr, \second, lsl #UWB_POSITION_SHIFT
        str     lr, [r12, #\at]
        .endm

        /* Four positions: words of the even ones, which begin on the first sample of a pair, and of the odd ones. */
        .macro four3 at, a, b, c
        position3 lr, smlad, \a, smlabt, \b
        position3 r6, smlad, \b, smlabt, \c
        store   r6, \at
        position3 lr, smlatb, \a, smlad, \b
        position3 r6, smlatb, \b, smlad, \c
        store   r6, (\at + 8)
        .endm
        .macro four5 at, a, b, c, d
        position5 lr, smlad, \a, r5, \b, smlabt, \c
        position5 r8, smlad, \b, r5, \c, smlabt, \d
        store   r8, \at
        position5 lr, smlatb, \a, r6, \b, smlad, \c
        position5 r8, smlatb, \b, r6, \c, smlad, \d
        store   r8, (\at + 8)
        .endm

        .macro begin_filter
        ldmia   sp, {r0, r1, r7, r11, r12}
        ldmia   r1!, {r8-r10}
        str     r1, [sp, #CHANNELS]
        .endm

        .macro end_filter bytes, again
        ldr     r0, [sp, #WEIGHTS]
        ldrd    r1, r2, [sp, #Y]
        add     r0, r0, #\bytes
        str     r0, [sp, #WEIGHTS]
        add     r1, r1, #16
        str     r1, [sp, #Y]
        cmp     r1, r2
        bne     \again
        .endm

        function uwb_conv_first
        push    {r4-r11, lr}
        sub     sp, sp, #FRAME
        ldrd    r4, r5, [sp, #(FRAME + SAVED)]  /* channels, kernel */
        add     r7, r1, #BLOCK_BYTES
        strd    r1, r7, [sp, #Y]
        strd    r3, r4, [sp, #WEIGHTS]
        /* What is loaded ahead moves the end of x. */
        subs    r6, r5, #1
        add     r6, r0, r6, lsl #1
        add     r6, r6, r2, lsl #4
        strd    r6, r0, [sp, #X_END]
        cmp     r5, #5
        beq     .Lfilter5

.Lfilter3:
        begin_filter
        ldr     r4, [r0]                /* taps 0 1 */
        ldr     r5, [r0, #2]            /* taps 1 2 */
        ldr     r0, [r11], #4
.Lblock3:
        ldrd    r1, r2, [r11], #8
        four3   0, r0, r1, r2
        ldrd    r3, r0, [r11], #8
        four3   4, r2, r3, r0
        add     r12, r12, #BLOCK_BYTES
        cmp     r11, r7
        bne     .Lblock3
        end_filter 8, .Lfilter3
        b       .Lend

.Lfilter5:
        begin_filter
        vmov    s0, r8
        ldr     r4, [r0]                /* taps 0 1 */
        ldr     r5, [r0, #4]            /* taps 2 3 */
        ldr     r6, [r0, #2]            /* taps 1 2 */
        ldr     r7, [r0, #6]            /* taps 3 4 */
        ldrd    r0, r1, [r11], #8
.Lblock5:
        ldrd    r2, r3, [r11], #8
        four5   0, r0, r1, r2, r3
        ldrd    r0, r1, [r11], #8
        four5   4, r2, r3, r0, r1
        add     r12, r12, #BLOCK_BYTES
        ldr     lr, [sp, #X_END]
        cmp     r11, lr
        bne     .Lblock5
        end_filter 12, .Lfilter5

.Lend:
        add     sp, sp, #FRAME
        pop     {r4-r11, pc}
        end_function uwb_conv_first

#endif
