/* y = relu(conv3 or conv5(x)) of one channel: pairs of samples against pairs of weights. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

/* Frame */
#define X 0
#define X_END 4
#define WEIGHTS 8 /* and channels after it */
#define Y 16
#define FILTER 20
#define FRAME 24
#define SAVED 36 /* bytes that push stores below the arguments on the stack */

/* r0 to r3 samples, r4 to r7 weights, r8 bias, r9 multiplier, r10 sum, r11 x, r12 y, lr end of x. */

        .macro store position
        requantise r10, r9
        strh    r10, [r12, #(4 * \position)]
        .endm

        /* Positions \at and the next, which begin on the first and the second sample of the pair \a. */
        .macro two3 at, a, b
        smlad   r10, \a, r4, r8
        smlabt  r10, \b, r5, r10
        store   \at
        smlatb  r10, \a, r4, r8
        smlad   r10, \b, r5, r10
        store   (\at + 1)
        .endm

        .macro two5 at, a, b, c
        smlad   r10, \a, r4, r8
        smlad   r10, \b, r5, r10
        smlabt  r10, \c, r7, r10
        store   \at
        smlatb  r10, \a, r4, r8
        smlad   r10, \b, r6, r10
        smlad   r10, \c, r7, r10
        store   (\at + 1)
        .endm

        .macro begin_filter
        ldrd    r11, lr, [sp, #X]
        ldrd    r0, r1, [sp, #WEIGHTS]
        ldrd    r8, r9, [r1], #8
        ldrd    r12, r2, [sp, #Y]
        add     r12, r12, r2
        .endm

        .macro end_filter bytes, again
        ldrd    r0, r1, [sp, #WEIGHTS]
        add     r0, r0, #\bytes
        add     r1, r1, #8
        strd    r0, r1, [sp, #WEIGHTS]
        ldr     r2, [sp, #FILTER]
        next_filter r2
        str     r2, [sp, #FILTER]
        cmp     r2, #BLOCK_BYTES
        bne     \again
        .endm

        function uwb_conv_first
        push    {r4-r11, lr}
        sub     sp, sp, #FRAME
        ldrd    r4, r5, [sp, #(FRAME + SAVED)]  /* channels, kernel */
        mov     r7, #0
        strd    r1, r7, [sp, #Y]
        strd    r3, r4, [sp, #WEIGHTS]
        /* What is loaded ahead moves the end of x. */
        subs    r6, r5, #1
        add     r6, r0, r6, lsl #1
        add     r6, r6, r2, lsl #4
        strd    r0, r6, [sp, #X]
        cmp     r5, #5
        beq     .Lfilter5

.Lfilter3:
        begin_filter
        ldr     r4, [r0]                /* taps 0 1 */
        ldr     r5, [r0, #2]            /* taps 1 2 */
        ldr     r0, [r11], #4
.Lblock3:
        ldrd    r1, r2, [r11], #8
        two3    0, r0, r1
        two3    2, r1, r2
        ldrd    r3, r0, [r11], #8
        two3    4, r2, r3
        two3    6, r3, r0
        add     r12, r12, #BLOCK_BYTES
        cmp     r11, lr
        bne     .Lblock3
        end_filter 8, .Lfilter3
        b       .Lend

.Lfilter5:
        begin_filter
        ldr     r4, [r0]                /* taps 0 1 */
        ldr     r5, [r0, #4]            /* taps 2 3 */
        ldr     r6, [r0, #2]            /* taps 1 2 */
        ldr     r7, [r0, #6]            /* taps 3 4 */
        ldrd    r0, r1, [r11], #8
.Lblock5:
        ldrd    r2, r3, [r11], #8
        two5    0, r0, r1, r2
        two5    2, r1, r2, r3
        ldrd    r0, r1, [r11], #8
        two5    4, r2, r3, r0
        two5    6, r3, r0, r1
        add     r12, r12, #BLOCK_BYTES
        cmp     r11, lr
        bne     .Lblock5
        end_filter 12, .Lfilter5

.Lend:
        add     sp, sp, #FRAME
        pop     {r4-r11, pc}
        end_function uwb_conv_first

#endif
