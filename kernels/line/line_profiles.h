// Profiles of a camera frame: one per column (ALONG_ROWS not set) or one per row, samples of type CODE.
//
// A work-item holds LANES neighbouring profiles side by side: 16 under VECTOR_VARIANT, one otherwise, under the same code.
// Masks are ints, all bits set where true. A sample counts by how far it lies above the threshold.
#ifndef LINE_PROFILES_H
#define LINE_PROFILES_H

#include "common/lanes.h"
#include "common/status.h"

#ifdef VECTOR_VARIANT
typedef int16 ints;
typedef uint16 uints;
typedef CODE16 codes;
#define INT_MASK(comparison) (comparison)
#define CODE_MASK(comparison) convert_int16(comparison)
#define REAL_MASK(comparison) convert_int16(comparison)
#define any_lane(mask) any(mask)
#define to_ints convert_int16
#define as_uints as_uint16
#define to_reals convert_real16
#define to_masks convert_bits16
#define lane_numbers ((int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#define not_finite_lanes(value) convert_int16(not_finite16(value))
#else
typedef int ints;
typedef uint uints;
typedef CODE codes;
#define INT_MASK(comparison) (-(comparison))
#define CODE_MASK(comparison) (-(comparison))
#define REAL_MASK(comparison) (-(comparison))
#define any_lane(mask) (mask)
#define to_ints (int)
#define as_uints as_uint
#define to_reals (real)
#define to_masks (bits)
#define lane_numbers 0
#define not_finite_lanes(value) (-not_finite(value))
#endif
typedef codes codes_at __attribute__((aligned(sizeof(CODE))));
typedef ints ints_at __attribute__((aligned(sizeof(int))));

#if CODE_BITS == 32
#define DARKEST (-INFINITY)
#else
#define DARKEST 0
#endif

typedef struct {
    global const CODE *first;  // sample 0 of lane 0
    int stride;                // from a sample to the next one
    int lane_stride;           // from a profile to the next one
    int length;                // samples in a profile
    CODE threshold, saturation, minimum;
} Profiles;

// Reals by the mask, which has the width of an int.
inline reals choose_reals(ints mask, reals yes, reals no) {
    const masks wide = to_masks(mask);
    return as_reals((as_masks(yes) & wide) | (as_masks(no) & ~wide));
}
#ifdef VECTOR_VARIANT
#if CODE_BITS == 8
#define to_code_mask convert_char16
#elif CODE_BITS == 16
#define to_code_mask convert_short16
#else
#define to_code_mask
#endif
#else
#define to_code_mask
#endif
inline codes choose_codes(ints mask, codes yes, codes no) { return to_code_mask(mask) ? yes : no; }
inline ints choose_ints(ints mask, ints yes, ints no) { return (yes & mask) | (no & ~mask); }

// How far samples lie above the threshold: 0 below it. NaN is found elsewhere and counts as no light.
inline reals over_threshold(codes level, CODE threshold) {
#if CODE_BITS == 32
    const reals over = to_reals(level) - (reals)threshold;
    return choose_reals(REAL_MASK(over > 0), over, 0);
#else
    return to_reals(level > (codes)threshold ? level - (codes)threshold : (codes)0);
#endif
}

// Sample k of every lane.
inline codes sample_of(const Profiles *profiles, int k) {
    global const CODE *at = profiles->first + (long)k * profiles->stride;
#if defined(VECTOR_VARIANT) && defined(ALONG_ROWS)
    CODE lane[LANES];
    for (int i = 0; i < LANES; i++) lane[i] = at[(long)i * profiles->lane_stride];
    return *(const codes_at *)lane;
#else
    return *(global const codes_at *)at;
#endif
}

#if CODE_BITS == 32
#define higher_of fmax
#else
#define higher_of max
#endif

inline CODE highest_level(CODE16 v) {
    const CODE8 a = higher_of(v.lo, v.hi);
    const CODE4 b = higher_of(a.lo, a.hi);
    return higher_of(higher_of(b.x, b.y), higher_of(b.z, b.w));
}

typedef CODE16 code16_at __attribute__((aligned(sizeof(CODE))));

// The highest of neighbouring samples: begin <= index < end.
inline CODE highest_in(global const CODE *row, int begin, int end) {
    CODE16 highest = (CODE16)DARKEST;
    int k = begin;
    for (; k + 16 <= end; k += 16) highest = higher_of(*(global const code16_at *)(row + k), highest);
    CODE level = highest_level(highest);
    for (; k < end; k++) level = higher_of(row[k], level);
    return level;
}

inline ints dark_lanes(const Profiles *profiles, codes peak) {
    return ~CODE_MASK(peak > (codes)profiles->threshold) | CODE_MASK(peak < (codes)profiles->minimum);
}

inline ints flag_where(ints mask, int flag) { return mask & (ints)flag; }

#endif
