/* Samples of the input: uint8 in uint16. */
#include "uwb_assembly.h"

#if UWB_CORTEX_M4

        function uwb_quantise
        vldr    s0, [r3]
.Lvalues:
        vldmia  r0!, {s1}
        vdiv.f32 s1, s1, s0
        vcvtr.s32.f32 s1, s1                    /* half to even; NaN becomes 0 */
        subs    r2, r2, #1
        vmov    r3, s1
        usat    r3, #8, r3
        strh    r3, [r1], #2
        bne     .Lvalues
        bx      lr
        end_function uwb_quantise

#endif
