// Load LANES neighbouring elements of an input array as reals. INPUT and INPUT16 are the array's type (build options).
#ifndef LOAD_H
#define LOAD_H

#include "common/lanes.h"

#ifdef VECTOR_VARIANT
typedef INPUT16 input_vector_at __attribute__((aligned(sizeof(INPUT))));
#else
typedef INPUT input_vector_at;
#endif

// Prefetch the cache lines (64 bytes) of a vector 2 KiB ahead: the hardware does not prefetch across the end of a page.
// Measured: a PSD readout takes 4 to 9 % less time; distances of 1 to 4 KiB are alike.
static inline void prefetch_inputs(global const INPUT *from) {
#ifdef VECTOR_VARIANT
    for (ulong at = 2048; at < 2048 + sizeof(INPUT16); at += 64) __builtin_prefetch((const void *)((ulong)from + at), 0, 3);
#endif
}

// Kernels that walk along an array: memory is prefetched.
static inline reals load_inputs(global const INPUT *from) {
    prefetch_inputs(from);
    return LANED(convert_real)(*(global const input_vector_at *)from);
}

#endif
