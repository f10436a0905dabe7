/* Shared macros of the Cortex-M4 kernels. s0 to s31 hold the weights of one filter, from where VMOV fetches them in one
 * cycle; r0 to r7 accumulate. A block of eight positions is 256 bytes, a row of a channel 16, one of two channels 32. */
#ifndef UWB_ASSEMBLY_H
#define UWB_ASSEMBLY_H

#include "../uwb_target.h"

#if UWB_CORTEX_M4

#define BLOCK_BYTES 256

        .syntax unified
        .thumb
        .fpu fpv4-sp-d16
        .altmacro

        .macro function name
        .section .text.\name, "ax", %progbits
        .balign 4
        .global \name
        .type \name, %function
        .thumb_func
\name:
        .endm

        .macro end_function name
        .size \name, . - \name
        .endm

        /* An FPU register by number, so that macros can compute which. */
        .macro fetch r, number
        fetch_  \r, %(\number)
        .endm
        .macro fetch_ r, number
        vmov    \r, s\number
        .endm

        .macro requantise accumulator, multiplier, offset
        smmla   \accumulator, \accumulator, \multiplier, \offset
        usat    \accumulator, #8, \accumulator, asr #UWB_REQUANTISATION_SHIFT
        .endm

        /* clip(\a * \first + \b * \second + \offset >> UWB_SUM_SHIFT) */
        .macro add_scaled a, first, b, second, offset
        mla     \b, \b, \second, \offset
        mla     \a, \a, \first, \b
        usat    \a, #8, \a, asr #UWB_SUM_SHIFT
        .endm

#endif
#endif
