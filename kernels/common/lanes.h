// One body of code for both shapes: under VECTOR_VARIANT a value is 16 samples of a CPU's strip, else it is one sample.
// Loads and stores go through element-aligned vector types: PoCL's vstore16 nearly doubles the time of a PSD
// readout, a plain assignment does not, and a caller's array need not be aligned to a vector.
#ifndef LANES_H
#define LANES_H

#include "common/real.h"

#ifdef VECTOR_VARIANT
#define LANES 16
typedef real16 reals;
typedef bits16 masks;
typedef uchar16 bytes;
typedef real16 reals_at __attribute__((aligned(sizeof(real))));
typedef uchar16 bytes_at __attribute__((aligned(1)));
#define LANED(name) name##16
#define mask_of(comparison) (comparison)
#define convert_bytes convert_uchar16
#define as_masks as_bits16
#define as_reals LANED(as_real)
#ifdef REAL_IS_DOUBLE
#define as_real16 as_double16
#else
#define as_real16 as_float16
#endif
#else
#define LANES 1
typedef real reals;
typedef bits masks;
typedef uchar bytes;
typedef real reals_at;
typedef uchar bytes_at;
#define LANED(name) name
#define mask_of(comparison) (-(bits)(comparison))
#define convert_bytes convert_uchar
#define as_masks as_bits
#define as_reals as_real
#endif

#define NAN_BITS as_bits(REAL_NAN)

// NaN where the mask is set: every bit of a quiet NaN put on top of a number makes a NaN.
inline reals nan_where(masks mask, reals value) { return as_reals(as_masks(value) | (mask & (masks)NAN_BITS)); }

// Whether the mask is set in any lane. (PoCL takes any() apart into scalars.)
#if defined(VECTOR_VARIANT) && defined(REAL_IS_DOUBLE)
inline int any_lane(masks mask) {
    const long8 half_of_it = mask.lo | mask.hi;
    const long4 quarter = half_of_it.lo | half_of_it.hi;
    return (quarter.x | quarter.y | quarter.z | quarter.w) != 0;
}
#elif defined(VECTOR_VARIANT)
inline int any_lane(masks mask) {
    const int8 half_of_it = mask.lo | mask.hi;
    const long2 quarter = as_long2(half_of_it.lo | half_of_it.hi);
    return (quarter.x | quarter.y) != 0;
}
#else
inline int any_lane(masks mask) { return mask != 0; }
#endif

// Zero where the mask is set.
inline reals zero_where(masks mask, reals value) { return as_reals(as_masks(value) & ~mask); }

#ifdef PAST_CACHES
// Outputs that the caches cannot hold go past them: a line that is written whole need not be read first. Only whole,
// aligned vectors can.
inline int aligned_to(size_t size, global const void *to) { return ((size_t)to & (size - 1)) == 0; }
inline void store_reals(reals value, global real *to) {
    if (aligned_to(sizeof(reals), to)) __builtin_nontemporal_store(value, (global reals *)to);
    else *(global reals_at *)to = value;
}
inline void store_bytes(bytes value, global uchar *to) {
    if (aligned_to(sizeof(bytes), to)) __builtin_nontemporal_store(value, (global bytes *)to);
    else *(global bytes_at *)to = value;
}
#else
inline void store_reals(reals value, global real *to) { *(global reals_at *)to = value; }
inline void store_bytes(bytes value, global uchar *to) { *(global bytes_at *)to = value; }
#endif

#endif
