/* Detection of the target, Cortex-M4 or portable C, and its floating-point arithmetic. For C and assembler. */
#ifndef UWB_TARGET_H
#define UWB_TARGET_H

#ifndef __ASSEMBLER__
#include <float.h>

/* Every float operation must be rounded to float once, or the results differ from those of the host. */
#if defined(FLT_EVAL_METHOD) && (FLT_EVAL_METHOD == 1 || FLT_EVAL_METHOD == 2)
#error "float operations are computed in a wider type: on x86 compile with -msse2 -mfpmath=sse"
#endif
#ifdef __FAST_MATH__
#error "-ffast-math (or -Ofast) changes results: compile without it"
#endif
#endif

/* The assembler kernels hold weights in FPU registers and multiply with the DSP extension of ARMv7E-M. Only C decides
 * whether they are used, because only C gets every flag: the Arduino core assembles without -mfloat-abi, and then
 * __ARM_FP is undefined as in a build without FPU. The assembler files always contain their kernels on this
 * architecture, with names of their own: C that does not use them has the portable kernels, and the linker drops these. */
#if defined(__ARM_ARCH_7EM__) && \
    (defined(__ASSEMBLER__) || (defined(__ARM_FEATURE_DSP) && defined(__ARM_FP) && !defined(UWB_PORTABLE)))
#define UWB_CORTEX_M4 1
#define uwb_quantise uwb_quantise_cortex_m4
#define uwb_conv_first uwb_conv_first_cortex_m4
#define uwb_conv_residual uwb_conv_residual_cortex_m4
#define uwb_conv_reduce_odd uwb_conv_reduce_odd_cortex_m4
#define uwb_conv_reduce_even uwb_conv_reduce_even_cortex_m4
#define uwb_dense uwb_dense_cortex_m4
#define uwb_dot uwb_dot_cortex_m4
#else
#define UWB_CORTEX_M4 0
#endif

#define UWB_REQUANTISATION_SHIFT 3
#define UWB_SUM_SHIFT 22
#define UWB_POSITION_SHIFT 21 /* of the second position in a word of a layer's input */

#endif
