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

/* It holds weights in FPU registers and multiplies with the DSP extension of ARMv7E-M. */
#if defined(__ARM_ARCH_7EM__) && defined(__ARM_FEATURE_DSP) && defined(__ARM_FP) && !defined(UWB_PORTABLE)
#define UWB_CORTEX_M4 1
#else
#define UWB_CORTEX_M4 0
#endif

#define UWB_REQUANTISATION_SHIFT 11
#define UWB_SUM_SHIFT 22

#endif
