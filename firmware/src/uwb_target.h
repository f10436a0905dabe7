/* Whether the Cortex-M4 assembly is built; for C and for the assembler. */
#ifndef UWB_TARGET_H
#define UWB_TARGET_H

/* It holds weights in FPU registers and multiplies with the DSP extension of ARMv7E-M. */
#if defined(__ARM_ARCH_7EM__) && defined(__ARM_FEATURE_DSP) && defined(__ARM_FP) && !defined(UWB_PORTABLE)
#define UWB_CORTEX_M4 1
#else
#define UWB_CORTEX_M4 0
#endif

#define UWB_REQUANTISATION_SHIFT 11
#define UWB_SUM_SHIFT 22

#endif
