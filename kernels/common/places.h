// Positions [m]: double wherever the device has it (build option DOUBLE_POSITIONS), independent of the real type.
//
// At 1e-6 of a segment's length from the segment a difference of two single-precision positions has no digit left.
// Differences are taken in `place`, the rest is computed in `real`.
#ifndef PLACES_H
#define PLACES_H
#include "common/lanes.h"

#ifdef DOUBLE_POSITIONS
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double place;
typedef double16 place16;
#define convert_place convert_double
#define convert_place16 convert_double16
#else
typedef float place;
typedef float16 place16;
#define convert_place convert_float
#define convert_place16 convert_float16
#endif

#ifdef VECTOR_VARIANT
typedef place16 places;
#else
typedef place places;
#endif
typedef places places_at __attribute__((aligned(sizeof(place))));

INLINE places convert_places(reals value) { return LANED(convert_place)(value); }
INLINE reals convert_to_reals(places value) { return LANED(convert_real)(value); }
INLINE places load_places(const place *from) { return *(const places_at *)from; }
INLINE void store_places(places value, place *to) { *(places_at *)to = value; }

// The mask of a comparison of places, with the number of bits per lane of a real.
#ifdef VECTOR_VARIANT
#define mask_of_places(comparison) convert_bits16(comparison)
#else
#define mask_of_places(comparison) (-(bits)(comparison))
#endif

#endif
