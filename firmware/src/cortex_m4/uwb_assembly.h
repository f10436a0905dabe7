/* Shared macros of the Cortex-M4 kernels. Weights of one filter are kept in s0 to s31, where a one-cycle
 * VMOV fetches them; r0 to r7 accumulate; a block of eight positions is 256 bytes, a channel pair's
 * row 32. */
#ifndef UWB_ASSEMBLY_H
#define UWB_ASSEMBLY_H

#include "../uwb_target.h"

#if UWB_CORTEX_M4

#define BLOCK_BYTES 256
#define ROW_BYTES 32
/* Position -1 is the last slot of the row in the block before. */
#define BEFORE_BLOCK (ROW_BYTES - 4 - BLOCK_BYTES)
/* The bytes that stay when int8 becomes int16 times 256: of each halfword the upper one. */
#define UPPER_BYTES 0xFF00FF00

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

        /* FPU registers by number, so that macros can compute which. */
        .macro fetch_pair r, q, number
        fetch_pair_ \r, \q, %(\number), %(\number + 1)
        .endm
        .macro fetch_pair_ r, q, m, n
        vmov    \r, \q, s\m, s\n
        .endm

        .macro fetch r, number
        fetch_ \r, %(\number)
        .endm
        .macro fetch_ r, m
        vmov    \r, s\m
        .endm

        .macro store_pair number, r, q
        store_pair_ %(\number), %(\number + 1), \r, \q
        .endm
        .macro store_pair_ m, n, r, q
        vmov    s\m, s\n, \r, \q
        .endm

        /* A word p0 q0 p1 q1 of int8 to the int16 pairs p and q, times 256, in two FPU registers. */
        .macro park number, word, mask, scratch
        and     \scratch, \mask, \word, lsl #8
        and     \word, \mask, \word
        store_pair \number, \scratch, \word
        .endm

        /* Sixteen bytes from [\from]! to s\number and the seven after it; clobbers r6-r9 and \scratch. */
        .macro park_words number, from, mask, scratch
        ldmia   \from!, {r6-r9}
        park    \number, r6, \mask, \scratch
        park    \number + 2, r7, \mask, \scratch
        park    \number + 4, r8, \mask, \scratch
        park    \number + 6, r9, \mask, \scratch
        .endm

        .macro requantise accumulator, multiplier
        smmul   \accumulator, \accumulator, \multiplier
        usat    \accumulator, #8, \accumulator, asr #UWB_REQUANTISATION_SHIFT
        .endm

        /* A filter's place in a row: two bytes a channel, a row for each pair of channels. */
        .macro next_filter offset
        eor     \offset, \offset, #2
        tst     \offset, #2
        it      eq
        addeq   \offset, \offset, #ROW_BYTES
        .endm

#endif
#endif
