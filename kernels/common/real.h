// The real type of a build (float, or double under REAL_IS_DOUBLE), its bits, and tests on them.
#ifndef REAL_H
#define REAL_H

#ifdef REAL_IS_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double real;
typedef double4 real4;
typedef double8 real8;
typedef double16 real16;
typedef long bits;
typedef long16 bits16;
#define as_bits as_long
#define as_bits16 as_long16
#define as_real as_double
#define convert_real convert_double
#define convert_real16 convert_double16
#define convert_bits convert_long
#define convert_bits16 convert_long16
#define EXPONENT_BITS 0x7ff0000000000000L
#define REAL_NAN as_double(0x7ff8000000000000L)
#define REAL_EPSILON 2.220446049250313e-16
#else
typedef float real;
typedef float4 real4;
typedef float8 real8;
typedef float16 real16;
typedef int bits;
typedef int16 bits16;
#define as_bits as_int
#define as_bits16 as_int16
#define as_real as_float
#define convert_real convert_float
#define convert_real16 convert_float16
#define convert_bits convert_int
#define convert_bits16 convert_int16
#define EXPONENT_BITS 0x7f800000
#define REAL_NAN as_float(0x7fc00000)
#define REAL_EPSILON 1.1920929e-7f
#endif

// Attribute of a kernel that uses vectors of 16 explicitly: the compiler need not search for more vectors across
// work-items (Intel's does so, for seconds).
#ifdef VECTOR_VARIANT
#define AS_IT_IS __attribute__((vec_type_hint(real16)))
#else
#define AS_IT_IS
#endif

// Infinity and NaN have all exponent bits set. This integer test means the same under every compiler option; isnan()
// and x != x are removed under finite-math options.
static inline int not_finite(real x) { return (as_bits(x) & EXPONENT_BITS) == EXPONENT_BITS; }
static inline bits16 not_finite16(real16 x) { return (as_bits16(x) & (bits16)EXPONENT_BITS) == (bits16)EXPONENT_BITS; }

#endif
