// Centroid (centre of gravity) of the light of a whole profile (METHOD_CENTROID).
//
// Integer samples are summed exactly: in 32 bits, moments beyond 2^32 in 64 bits under LONG_MOMENT. Float samples are
// summed with compensation. No sample is multiplied by its index. For the light v_0 .. v_(n-1) of a block of n steps
// that begins at index `first`, the running sums s += v, m += s end as
//     s = sum v_k,   m = sum (n - k) v_k,   so that   sum (first + k) v_k = (first + n) s - m:
// one multiplication per block.
// Build options: COUNT_WIDTH (number of samples above the threshold), LONG_MOMENT.
#ifndef LINE_CENTROID_H
#define LINE_CENTROID_H

#include "line/line_profiles.h"

// Samples of a profile in a block, summed in lanes of twice the sample's width. Bytes: s <= 20 * 255, and
// m <= 255 * (20 * 21 / 2) = 53550 < 2^16 (22 steps would also fit, 23 would not). Measured: bytes in a cache are fastest
// with 16; bytes from memory (PREFETCH) and wider samples with 20.
#if CODE_BITS == 8 && !defined(PREFETCH)
#define STEPS 16
#else
#define STEPS 20
#endif

typedef struct {
    reals position, total, width;  // width: number of samples above the threshold
    codes peak;                    // largest sample
    ints not_finite;               // lanes with a sample that is not finite
#ifdef NOISE
    reals variance;  // of the position [px^2]
#if CODE_BITS < 32
    reals per_light;  // 1 / total, 1 for no light
#endif
#endif
} Centroid;

#if CODE_BITS == 32

// Sums of float samples, each in two numbers: the second one collects the rounding errors of the first.
typedef struct {
    reals total, total_error, moment, moment_error, width;
    reals poison;  // 0, or NaN after a sample that is not finite
    codes peak;
} Sums;

// Add a value to a sum and its exact rounding error to `error` (two-sum, D. E. Knuth, The Art of Computer Programming,
// volume 2, section 4.2.2).
static inline void add_exactly(reals *sum, reals *error, reals value) {
    const reals next = *sum + value, added = next - *sum;
    *error += (*sum - (next - added)) + (value - added);
    *sum = next;
}

// Add the block sums s and m (see above) of `steps` samples from index `first` on. Its moment is first * s + (steps * s
// - m); the rounding error of the product is fma(first, s, -first * s). The product itself is an fma with `poison`, which
// is 0 for finite samples: a compiler could contract a plain product into the sum that the two-sum takes apart.
static inline void add_block(Sums *sums, reals s, reals m, int first, int steps) {
    const reals begin = (real)first, at_begin = fma(begin, s, sums->poison);
    add_exactly(&sums->total, &sums->total_error, s);
    add_exactly(&sums->moment, &sums->moment_error, at_begin);
    add_exactly(&sums->moment, &sums->moment_error, (real)steps * s - m);
    sums->moment_error += fma(begin, s, -at_begin);
}

static inline Sums zero_sums(void) {
    Sums sums;
    sums.total = sums.total_error = sums.moment = sums.moment_error = sums.width = sums.poison = (reals)0;
    sums.peak = (codes)DARKEST;
    return sums;
}

// The moment is taken about `centre`, an integer near the position: the remaining moment is small, so its rounding
// error is negligible.
static inline Centroid centroid_of(const Sums *sums) {
    Centroid centroid;
    centroid.total = sums->total + sums->total_error;
    const reals centre = rint(sums->moment / centroid.total);  // a denormal total has no finite reciprocal: divide
    const reals offset = fma(-centre, sums->total, sums->moment) + (sums->moment_error - centre * sums->total_error);
    centroid.position = centre + offset / centroid.total;
    centroid.width = sums->width;
    centroid.peak = sums->peak;
    centroid.not_finite = not_finite_lanes(sums->poison) | not_finite_lanes(centroid.total);
    return centroid;
}

#else

// big: type of a moment.
#ifdef LONG_MOMENT
typedef ulong big;
typedef ulong4 big4;
typedef ulong8 big8;
typedef long signed_big;
typedef ulong16 big16;
typedef long16 signed_big16;
#define convert_big16 convert_ulong16
#define convert_signed_big16 convert_long16
#else
typedef uint big;
typedef uint4 big4;
typedef uint8 big8;
typedef int signed_big;
typedef uint16 big16;
typedef int16 signed_big16;
#define convert_big16
#define convert_signed_big16 convert_int16
#endif
#ifdef VECTOR_VARIANT
typedef big16 bigs;
typedef signed_big16 signed_bigs;
#define to_signed_bigs convert_signed_big16
#else
typedef big bigs;
typedef signed_big signed_bigs;
#define to_signed_bigs (signed_big)
#endif

// The moment is taken about `centre`, a whole number near the position: the remaining offset is a small integer, exact
// in the real type.
static inline Centroid centroid_of_integers(uints total, bigs moment, uints width, codes peak) {
    Centroid centroid;
    centroid.total = to_reals(total);
    const reals per_light = 1 / choose_reals(int_mask(total == 0u), 1, centroid.total);
    const signed_bigs centre = to_signed_bigs(to_reals(moment) * per_light);
    const signed_bigs offset = to_signed_bigs(moment) - centre * to_signed_bigs(total);
    centroid.position = to_reals(centre) + to_reals(offset) * per_light;
    centroid.width = to_reals(width);
    centroid.peak = peak;
    centroid.not_finite = 0;
#ifdef NOISE
    centroid.per_light = per_light;
#endif
    return centroid;
}

#endif

#ifdef VECTOR_VARIANT
#if CODE_BITS == 32
#include "line/line_wide_sums_float.h"
#else
#include "line/line_wide_sums.h"
#endif
#endif
#endif
