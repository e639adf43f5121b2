// Vector vocabulary of the kernels: one source serves both kernel variants.
//
// Under VECTOR_VARIANT (CPU runtimes) a work-item processes LANES = 16 neighbouring samples side by side, and the types
// below are 16-wide vectors. Otherwise (GPUs) a work-item processes one sample, and the same types are scalars.
//
//     reals        values of the real type (real.h)
//     masks        signed integers as wide as a real: all bits set where a condition holds, else 0
//     ints, uints  32-bit indices and counts; also masks of conditions on integers (int_mask)
//     bytes        status flags
//
// A comparison of vectors gives -1 in the lanes where it holds, a comparison of scalars gives 1. mask_of() and
// int_mask() turn a comparison into a mask in both variants. The build options are REAL_IS_DOUBLE, VECTOR_VARIANT and
// PAST_CACHES (inputs and outputs together larger than the last cache).
#ifndef LANES_H
#define LANES_H

#include "common/real.h"

#define INLINE static inline __attribute__((always_inline))

// A function with much unrolled code: CPUs call it. LLVM splits vectors of 512 bits into halves in a function without
// vectors as arguments where it prefers vectors of 256 bits, as PoCL does, unless the attribute forbids it.
#ifndef VECTOR_VARIANT
#define CALLED static inline
#elif __has_attribute(min_vector_width)
#define CALLED static __attribute__((noinline, min_vector_width(512)))
#else
#define CALLED static __attribute__((noinline))
#endif

#ifdef VECTOR_VARIANT
#define LANES 16
typedef real16 reals;
typedef bits16 masks;
typedef int16 ints;
typedef uint16 uints;
typedef uchar16 bytes;
// LANED(name): the 16-wide version of a function or conversion that exists for scalars and for vectors of 16.
#define LANED(name) name##16
// mask_of: mask (as wide as a real) of a comparison of reals. int_mask: 32-bit mask of any comparison.
#define mask_of(comparison) (comparison)
#define int_mask(comparison) convert_int16(comparison)
#define to_reals convert_real16
#define to_ints convert_int16
#define to_masks convert_bits16
#define as_uints as_uint16
#define as_ints as_int16
#define convert_bytes convert_uchar16
#define as_masks as_bits16
#ifdef REAL_IS_DOUBLE
#define as_reals as_double16
#else
#define as_reals as_float16
#endif
// 0, 1, ...: number of each lane.
#define LANE_NUMBERS ((int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#else
#define LANES 1
typedef real reals;
typedef bits masks;
typedef int ints;
typedef uint uints;
typedef uchar bytes;
#define LANED(name) name
#define mask_of(comparison) (-(bits)(comparison))
#define int_mask(comparison) (-(int)(comparison))
#define to_reals (real)
#define to_ints (int)
#define to_masks (bits)
#define as_uints as_uint
#define as_ints as_int
#define convert_bytes convert_uchar
#define as_masks as_bits
#define as_reals as_real
#define LANE_NUMBERS 0
#endif

// Types for loads and stores at addresses that are aligned to an element only: a caller's array need not be aligned to
// a vector. PoCL's vload16 and vstore16 take apart such an access (a PSD readout takes nearly twice the time).
typedef reals reals_at __attribute__((aligned(sizeof(real))));
typedef ints ints_at __attribute__((aligned(sizeof(int))));
typedef bytes bytes_at __attribute__((aligned(1)));

#define NAN_BITS as_bits(REAL_NAN)

// NaN where the mask is set: a number with all bits of a quiet NaN set is a NaN.
static inline reals nan_where(masks mask, reals value) {
    return as_reals(as_masks(value) | (mask & (masks)NAN_BITS));
}

// Zero where the mask is set.
static inline reals zero_where(masks mask, reals value) { return as_reals(as_masks(value) & ~mask); }

// Select by a 32-bit mask, bit by bit.
static inline ints choose_ints(ints mask, ints yes, ints no) { return (yes & mask) | (no & ~mask); }
static inline reals choose_reals(ints mask, reals yes, reals no) {
    const masks wide = to_masks(mask);
    return as_reals((as_masks(yes) & wide) | (as_masks(no) & ~wide));
}

// A status flag in the lanes of a 32-bit mask.
static inline ints flag_where(ints mask, int flag) { return mask & (ints)flag; }

// 32-bit mask of the lanes that are infinite or NaN.
static inline ints not_finite_lanes(reals value) { return int_mask(LANED(not_finite)(value)); }

// Whether the mask is set in any lane. The lanes are combined by OR in halves, because PoCL compiles any() to a test of
// every lane by itself.
#if defined(VECTOR_VARIANT) && defined(REAL_IS_DOUBLE)
static inline int any_lane(masks mask) {
    const long8 half_of_it = mask.lo | mask.hi;
    const long4 quarter = half_of_it.lo | half_of_it.hi;
    return (quarter.x | quarter.y | quarter.z | quarter.w) != 0;
}
#elif defined(VECTOR_VARIANT)
static inline int any_lane(masks mask) {
    const int8 half_of_it = mask.lo | mask.hi;
    const long2 quarter = as_long2(half_of_it.lo | half_of_it.hi);
    return (quarter.x | quarter.y) != 0;
}
#else
static inline int any_lane(masks mask) { return mask != 0; }
#endif

// The same for a 32-bit mask.
#ifdef VECTOR_VARIANT
static inline int any_int_lane(ints mask) {
    const int8 half_of_it = mask.lo | mask.hi;
    const long2 quarter = as_long2(half_of_it.lo | half_of_it.hi);
    return (quarter.x | quarter.y) != 0;
}
#else
static inline int any_int_lane(ints mask) { return mask != 0; }
#endif

// Smallest value of the lanes.
static inline int lowest_lane(ints v) {
#ifdef VECTOR_VARIANT
    const int8 a = min(v.lo, v.hi);
    const int4 b = min(a.lo, a.hi);
    const int2 c = min(b.lo, b.hi);
    return min(c.x, c.y);
#else
    return v;
#endif
}

#ifdef PAST_CACHES
// Stores that bypass the caches: a cache line that is written as a whole need not be read first. Only vectors at an
// aligned address can bypass them. The other addresses take two stores of halves: Intel's compiler would merge two
// stores of one vector to one common store behind the branches, which does not bypass the caches.
typedef real8 half_reals_at __attribute__((aligned(sizeof(real))));
typedef uchar8 half_bytes_at __attribute__((aligned(1)));
static inline int aligned_to(size_t size, global const void *to) { return ((size_t)to & (size - 1)) == 0; }
static inline void store_reals(reals value, global real *to) {
    if (aligned_to(sizeof(reals), to)) {
        __builtin_nontemporal_store(value, (global reals *)to);
    } else {
        *(global half_reals_at *)to = value.lo;
        *(global half_reals_at *)(to + LANES / 2) = value.hi;
    }
}
static inline void store_bytes(bytes value, global uchar *to) {
    if (aligned_to(sizeof(bytes), to)) {
        __builtin_nontemporal_store(value, (global bytes *)to);
    } else {
        *(global half_bytes_at *)to = value.lo;
        *(global half_bytes_at *)(to + LANES / 2) = value.hi;
    }
}
#else
static inline void store_reals(reals value, global real *to) { *(global reals_at *)to = value; }
static inline void store_bytes(bytes value, global uchar *to) { *(global bytes_at *)to = value; }
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
#elif __has_builtin(__builtin_reduce_add)
// Each lane keeps a bit in one byte. The sum of eight different bits is their "or", and compilers add eight bytes by one
// instruction (vpsadbw). Intel's compiler, which has no names of x86 instructions, takes this path: any-hit queries take
// 7 % less time than with the tree below.
INLINE uint lane_bits(masks mask) {
    const uchar16 weights = {1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128};
    const uchar16 set = as_uchar16(convert_char16(mask)) & weights;
    return (uint)__builtin_reduce_add(set.lo) | (uint)__builtin_reduce_add(set.hi) << 8;
}
#else
// Each lane keeps the bit of its lane number; a tree of "or" operations joins the bits.
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

// Samples [begin, end) of a work-item, LANES in a vector. Vector variant: `each` consecutive samples. Work-item
// variant: one sample; the last group moves back to end with the last sample. `count` is at least LANES, or the group's
// size.
typedef struct {
    ulong begin, end;
} sample_range;

static inline sample_range samples_of_item(ulong each, ulong count) {
    sample_range range;
#ifdef VECTOR_VARIANT
    range.begin = get_global_id(0) * each;
    range.end = min(range.begin + each, count);
#else
    const ulong group = get_local_size(0); // the host halves the groups where a device lacks registers
    range.begin = min(get_group_id(0) * group, count - group) + get_local_id(0);
    range.end = range.begin + 1;
#endif
    return range;
}

// First sample of the vector at `next`: the last vector moves back to end with the last sample.
static inline ulong whole_vector(ulong next, ulong count) { return min(next, count - LANES); }

#endif
