// Profiles of a camera frame: one per column, or one per row under ALONG_ROWS; samples of type CODE.
//
// A work-item processes LANES neighbouring profiles side by side: 16 under VECTOR_VARIANT, else one (common/lanes.h).
// The light of a sample is the part of its value above the threshold.
#ifndef LINE_PROFILES_H
#define LINE_PROFILES_H

#include "common/lanes.h"
#include "common/status.h"

// codes: the samples of LANES profiles. DARKEST: a value that no sample is below.
#ifdef VECTOR_VARIANT
typedef CODE16 codes;
#else
typedef CODE codes;
#endif
typedef codes codes_at __attribute__((aligned(sizeof(CODE))));
typedef CODE16 code16_at __attribute__((aligned(sizeof(CODE))));

#if CODE_BITS == 32
#define DARKEST (-INFINITY)
#define higher_of fmax
#else
#define DARKEST 0
#define higher_of max
#endif

typedef struct {
    global const CODE *first;  // sample 0 of lane 0
    int stride;                // elements from one sample of a profile to the next
    int lane_stride;           // elements from one profile to the next
    int length;                // samples of a profile
    CODE threshold, saturation, minimum;
    int radius;                // see radius_of()
} Profiles;

// Number of samples on either side of the peak in its window.
static inline int radius_of(const Profiles *profiles) {
#ifdef WINDOW_ARGUMENT
    return profiles->radius;
#else
    return RADIUS;
#endif
}

// Select by a 32-bit mask.
#if defined(VECTOR_VARIANT) && CODE_BITS == 8
#define to_code_mask convert_char16
#elif defined(VECTOR_VARIANT) && CODE_BITS == 16
#define to_code_mask convert_short16
#else
#define to_code_mask
#endif
static inline codes choose_codes(ints mask, codes yes, codes no) { return to_code_mask(mask) ? yes : no; }

// Light of samples: the part above the threshold, 0 below it. A NaN has no light; the caller flags it.
static inline reals over_threshold(codes level, CODE threshold) {
#if CODE_BITS == 32
    const reals over = to_reals(level) - (reals)threshold;
    return choose_reals(int_mask(over > 0), over, 0);
#else
    return to_reals(level > (codes)threshold ? level - (codes)threshold : (codes)0);
#endif
}

// Sample k of every lane.
static inline codes sample_of(const Profiles *profiles, int k) {
    global const CODE *at = profiles->first + (long)k * profiles->stride;
#if defined(VECTOR_VARIANT) && defined(ALONG_ROWS)
    CODE lane[LANES];
    for (int i = 0; i < LANES; i++) lane[i] = at[(long)i * profiles->lane_stride];
    return *(const codes_at *)lane;
#else
    return *(global const codes_at *)at;
#endif
}

// 32-bit mask of the lanes whose sample is infinite or NaN.
static inline ints not_finite_codes(codes level) {
#if CODE_BITS == 32
    return not_finite_lanes(to_reals(level));
#else
    return 0;
#endif
}

static inline CODE highest_level(CODE16 v) {
    const CODE8 a = higher_of(v.lo, v.hi);
    const CODE4 b = higher_of(a.lo, a.hi);
    return higher_of(higher_of(b.x, b.y), higher_of(b.z, b.w));
}

// The highest of the neighbouring samples begin <= index < end.
static inline CODE highest_in(global const CODE *row, int begin, int end) {
    CODE16 highest = (CODE16)DARKEST;
    int k = begin;
    for (; k + 16 <= end; k += 16) highest = higher_of(*(global const code16_at *)(row + k), highest);
    CODE level = highest_level(highest);
    for (; k < end; k++) level = higher_of(row[k], level);
    return level;
}

// Lanes whose peak is not above the threshold, or is below the smallest allowed peak.
static inline ints dark_lanes(const Profiles *profiles, codes peak) {
    return ~int_mask(peak > (codes)profiles->threshold) | int_mask(peak < (codes)profiles->minimum);
}

#endif
