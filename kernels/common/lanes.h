// One body of code for both shapes: under VECTOR_VARIANT a value is 16 samples of a CPU's strip, else it is one sample.
// Loads and stores go through element-aligned vector types: PoCL's vstore16 nearly doubles the time of a PSD
// readout, a plain assignment does not, and a caller's array need not be aligned to a vector.
#ifndef LANES_H
#define LANES_H

#include "common/real.h"

#define INLINE static inline __attribute__((always_inline))

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

// ---- loads, stores and lane-wise operations of the tree and light kernels ---------------------------------------------

// LANES consecutive numbers of global memory, or of private arrays; the address need not be aligned to a vector.
INLINE reals load_reals(global const real *from) {
    return *(global const reals_at *)from;
}
INLINE reals load_private(const real *from) { return *(const reals_at *)from; }
INLINE void store_private(reals value, real *to) { *(reals_at *)to = value; }

// Lane-wise by comparison: fmin() and fmax() may become function calls. If b is NaN, the result is b.
INLINE reals lane_max(reals a, reals b) { return a > b ? a : b; }
INLINE reals lane_min(reals a, reals b) { return a < b ? a : b; }

// Fused multiply-add. PoCL expands the built-in fma() of vectors into scalars; clang's element-wise one stays a vector.
#if defined(VECTOR_VARIANT) && __has_builtin(__builtin_elementwise_fma)
#define lane_fma __builtin_elementwise_fma
#else
#define lane_fma fma
#endif

// The mask as an integer: bit n is lane n.
#if !defined(VECTOR_VARIANT)
INLINE uint lane_bits(masks mask) { return mask ? 1u : 0u; }
#elif defined(__AVX512DQ__) && __has_builtin(__builtin_ia32_cvtd2mask512) && !defined(REAL_IS_DOUBLE)
// One instruction (vpmovd2m) that compilers do not find by themselves.
INLINE uint lane_bits(masks mask) {
    return (ushort)__builtin_ia32_cvtd2mask512(mask);
}
#else
// Each lane keeps the bit of its own number; a tree of "or" joins them.
INLINE uint lane_bits(masks mask) {
    const masks weights = {1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768};
    const masks set = mask & weights;
#ifdef REAL_IS_DOUBLE
    const long8 half_of_it = set.lo | set.hi;
    const long4 quarter = half_of_it.lo | half_of_it.hi;
    return (uint)(quarter.x | quarter.y | quarter.z | quarter.w);
#else
    const int8 half_of_it = set.lo | set.hi;
    const long2 quarter = as_long2(half_of_it.lo | half_of_it.hi);
    const long both = quarter.x | quarter.y;
    return (uint)both | (uint)(both >> 32);
#endif
}
#endif

// Position of the lowest set bit.
INLINE int lowest_bit(uint set) { return (int)popcount((set & -set) - 1); }

// Whether the mask of a comparison is set in any lane: a reduction, which is one instruction where the compiler knows
// that the mask came from a comparison. (any_lane is faster for masks that were computed.)
#if !defined(VECTOR_VARIANT)
INLINE int any_compared(masks mask) { return mask != 0; }
#elif __has_builtin(__builtin_reduce_or)
INLINE int any_compared(masks mask) { return __builtin_reduce_or(mask) != 0; }
#else
INLINE int any_compared(masks mask) { return lane_bits(mask) != 0; }
#endif

// ---- samples of a work-item --------------------------------------------------------------------------------------------

// Samples [begin, end) of a work-item, LANES at a time. Vector variant: `each` consecutive samples. Work-item variant:
// one sample; the last group moves back to end with the last sample. `count` is at least LANES, or the group's size.
typedef struct {
    ulong begin, end;
} sample_range;

static inline sample_range samples_of_item(ulong each, ulong count) {
    sample_range range;
#ifdef VECTOR_VARIANT
    range.begin = get_global_id(0) * each;
    range.end = min(range.begin + each, count);
#else
    range.begin = min(get_group_id(0) * each, count - each) + get_local_id(0);
    range.end = range.begin + 1;
#endif
    return range;
}

// First sample of the vector at `next`: the last vector moves back to end with the last sample.
static inline ulong whole_vector(ulong next, ulong count) { return min(next, count - LANES); }

#endif
