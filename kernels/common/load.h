// Load LANES neighbouring elements of an input array as reals. INPUT and INPUT16 are the array's type (build options).
#ifndef LOAD_H
#define LOAD_H

#include "common/lanes.h"

#ifdef VECTOR_VARIANT
typedef INPUT16 input_vector_at __attribute__((aligned(sizeof(INPUT))));
#else
typedef INPUT input_vector_at;
#endif

static inline reals load_inputs(global const INPUT *from) {
    return LANED(convert_real)(*(global const input_vector_at *)from);
}

#endif
