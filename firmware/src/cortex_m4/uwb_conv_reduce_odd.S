/* y = relu(conv3 stride 2(r)) + relu(conv1 stride 2(r)) for odd lengths: outputs centre on even positions. */
#include "uwb_reduce.h"

#if UWB_CORTEX_M4

        .macro taps pair, wide0, wide1, wide2, narrow0, narrow1, narrow2
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

        reduce  uwb_conv_reduce_odd

#endif
