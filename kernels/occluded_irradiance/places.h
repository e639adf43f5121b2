// Places are subtracted in double wherever the device has it (WIDE_PLACES): 1e-6 of a segment's length away from it,
// single would have no digit left.
#ifndef PLACES_H
#define PLACES_H
#include "common/lanes.h"

#ifdef WIDE_PLACES
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

#endif
