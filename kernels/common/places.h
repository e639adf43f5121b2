// Positions [m] with more digits than a float, independent of the real type.
//
// At 1e-6 of a segment's length from the segment a difference of two single-precision positions has no digit left.
// Differences are taken in `place`, the rest is computed in `real`.
//
// Options: DOUBLE_POSITIONS: doubles; TWO_FLOAT_POSITIONS: two floats (two_float.h); neither: floats. Kernels take doubles
// on devices with fast doubles and two floats on other devices. The vector variants of occluded irradiance and of ray
// queries take doubles where the device has them, else floats. INPUT: type of the numbers in memory. With two floats it
// may be double in the work-item variant: a few operations in double split each number, the rest runs in single.
#ifndef PLACES_H
#define PLACES_H
#include "common/lanes.h"

#ifdef TWO_FLOAT_POSITIONS
#include "common/two_float.h"

typedef float2 place; // in memory: high part, low part
typedef two_floats places;

INLINE reals convert_to_reals(places value) { return value.high; }
INLINE places convert_places(reals value) { return (places){value, (reals)0}; }
INLINE places place_minus(reals a, place b) { return two_plus_real(two_sum(a, (reals)-b.x), (reals)-b.y); }
INLINE places place_plus(places a, place b) { return two_plus(a, two_floats_of(b)); }
INLINE places place_plus_real(places a, reals b) { return two_plus_real(a, b); }
// a + b, of which only the nearest real is used.
INLINE reals real_of_sum(places a, place b) {
    const two_floats high = two_sum(a.high, (reals)b.x);
    return high.high + (high.low + (a.low + (reals)b.y));
}
// x row[0] + y row[1] + z row[2] + row[3]
INLINE places place_dot(places x, places y, places z, global const place *row) {
    return two_dot_plus(x, two_floats_of(row[0]), y, two_floats_of(row[1]), z, two_floats_of(row[2]), two_floats_of(row[3]));
}

// Numbers of the input. sizeof is a constant: builds for float input have no double.
#ifdef VECTOR_VARIANT
typedef reals input_numbers; // INPUT is float
INLINE reals input_reals(input_numbers number) { return number; }
INLINE places input_minus(input_numbers a, place b) { return place_minus(a, b); }
#else
typedef INPUT input_numbers;
#define INPUT_IS_WIDE (sizeof(INPUT) > sizeof(real))
INLINE real input_reals(INPUT number) { return (real)number; }
INLINE places input_places(INPUT number) {
    const real high = (real)number;
    return (places){high, INPUT_IS_WIDE ? (real)(number - (INPUT)high) : 0};
}
INLINE places input_minus(INPUT a, place b) {
    return INPUT_IS_WIDE ? two_plus(input_places(a), two_floats_of(-b)) : place_minus((real)a, b);
}
INLINE places input_difference(INPUT a, INPUT b) {
    return INPUT_IS_WIDE ? input_places(a - b) : two_plus(input_places(a), input_places(-b));
}
// Direction of any length, times a power of two: a double may lie outside the range of a float.
INLINE void load_direction(global const INPUT *from, private places *to) {
    const INPUT longest = fmax(fmax(fabs(from[0]), fabs(from[1])), fabs(from[2]));
    const int power = INPUT_IS_WIDE && longest > 0 && longest < INFINITY ? ilogb(longest) : 0;
    for (int k = 0; k < 3; k++) to[k] = input_places(INPUT_IS_WIDE ? ldexp(from[k], -power) : from[k]);
}
#endif

INLINE places load_place(place value) { return two_floats_of(value); }
#ifndef VECTOR_VARIANT
INLINE place as_place(places value) { return (place)(value.high, value.low); }
#endif
INLINE places places_plus(places a, places b) { return two_plus(a, b); }
INLINE places places_minus(places a, places b) { return two_plus(a, (places){-b.high, -b.low}); }
INLINE places places_times(places a, places b) { return two_times(a, b); }
INLINE places places_dot(places x, places a, places y, places b, places z, places c) {
    return two_dot_plus(x, a, y, b, z, c, convert_places((reals)0));
}
// 1 / sqrt(v), relative error 2^-40: one Newton step from single precision. OpenCL allows 3 ulp for the square root and 2.5
// ulp for the division: y is wrong by e < 5.5 * 2^-23, and a step leaves 3/2 e^2 and a rounding of e, below 2^-40 together.
INLINE places place_per_root(places v) {
    const reals y = (reals)1 / sqrt(v.high);
    const two_floats product = two_times(v, two_product(y, y));
    const reals rest = two_plus_real((places){-product.high, -product.low}, (reals)1).high;
    return quick_two_sum(y, (reals)0.5 * y * rest);
}

#else
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
typedef places input_numbers;
INLINE reals input_reals(places number) { return convert_to_reals(number); }
INLINE places input_minus(places a, place b) { return a - b; }
#ifndef VECTOR_VARIANT
INLINE places input_places(INPUT number) { return (places)number; }
INLINE places input_difference(INPUT a, INPUT b) { return (places)a - (places)b; }
INLINE void load_direction(global const INPUT *from, private places *to) {
    for (int k = 0; k < 3; k++) to[k] = from[k];
}
#endif
INLINE places load_places(const place *from) { return *(const places_at *)from; }
INLINE void store_places(places value, place *to) { *(places_at *)to = value; }

INLINE places place_minus(places a, place b) { return a - b; }
INLINE places place_plus(places a, place b) { return a + b; }
INLINE places place_plus_real(places a, reals b) { return a + convert_places(b); }
INLINE reals real_of_sum(places a, place b) { return convert_to_reals(a + b); }
INLINE places place_dot(places x, places y, places z, global const place *row) {
    return x * row[0] + (y * row[1] + (z * row[2] + row[3]));
}

INLINE places load_place(place value) { return (places)value; }
#ifndef VECTOR_VARIANT
INLINE place as_place(places value) { return value; }
#endif
INLINE places places_plus(places a, places b) { return a + b; }
INLINE places places_minus(places a, places b) { return a - b; }
INLINE places places_times(places a, places b) { return a * b; }
INLINE places places_dot(places x, places a, places y, places b, places z, places c) { return x * a + y * b + z * c; }
INLINE places place_per_root(places v) { return (places)1 / sqrt(v); }

// The mask of a comparison of places, with the number of bits per lane of a real.
#ifdef VECTOR_VARIANT
#define mask_of_places(comparison) convert_bits16(comparison)
#else
#define mask_of_places(comparison) (-(bits)(comparison))
#endif
#endif

#endif
