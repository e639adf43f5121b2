// Centre of gravity of a whole profile. Integer samples are summed exactly, moments beyond 2^32 under LONG_MOMENT.
//
// No sample is multiplied by its index. A running sum s += v, m += s gives m = sum of (steps - k) v over a block of
// steps, and one multiplication per block puts the block in its place.
#ifndef LINE_WHOLE_H
#define LINE_WHOLE_H

#include "line/line_profiles.h"

#define STEPS 20  // samples of a profile summed before they are widened: up to 22 bytes, moment included, fit 16 bits

typedef struct {
    reals position, total, lit;  // lit counts the samples over the threshold
    codes peak;
    ints lost;                   // lanes with a sample that is not finite
} Gravity;

#if CODE_BITS == 32

// Sums in two floats each: what one addition rounds off, the second number keeps.
typedef struct {
    reals total, total_rest, moment, moment_rest, lit, lost;
    codes peak;
} Sums;

inline void add_exactly(reals *sum, reals *rest, reals value) {
    const reals next = *sum + value, added = next - *sum;
    *rest += (*sum - (next - added)) + (value - added);
    *sum = next;
}

inline void add_block(Sums *sums, reals s, reals m, int first, int steps) {
    const reals begin = (real)first, at_begin = begin * s;
    add_exactly(&sums->total, &sums->total_rest, s);
    add_exactly(&sums->moment, &sums->moment_rest, at_begin);
    add_exactly(&sums->moment, &sums->moment_rest, (real)steps * s - m);
    sums->moment_rest += fma(begin, s, -at_begin);
}

inline Sums no_sums(void) {
    Sums sums;
    sums.total = sums.total_rest = sums.moment = sums.moment_rest = sums.lit = sums.lost = (reals)0;
    sums.peak = (codes)DARKEST;
    return sums;
}

inline Gravity gravity_of(const Sums *sums) {
    Gravity gravity;
    gravity.total = sums->total + sums->total_rest;
    const reals centre = rint(sums->moment / gravity.total);  // the faintest light has no finite reciprocal
    const reals offset = fma(-centre, sums->total, sums->moment) + (sums->moment_rest - centre * sums->total_rest);
    gravity.position = centre + offset / gravity.total;
    gravity.lit = sums->lit;
    gravity.peak = sums->peak;
    gravity.lost = not_finite_lanes(sums->lost) | not_finite_lanes(gravity.total);
    return gravity;
}

inline Gravity whole_gravity(const Profiles *profiles) {
    Sums sums = no_sums();
    for (int first = 0; first < profiles->length; first += STEPS) {
        const int steps = min(STEPS, profiles->length - first);
        reals s = 0, m = 0;
        for (int k = 0; k < steps; k++) {
            const codes x = sample_of(profiles, first + k);
            sums.peak = x > sums.peak ? x : sums.peak;
            sums.lost += to_reals(x) * 0;
            sums.lit += choose_reals(CODE_MASK(x > (codes)profiles->threshold), 1, 0);
            s += over_threshold(x, profiles->threshold);
            m += s;
        }
        add_block(&sums, s, m, first, steps);
    }
    return gravity_of(&sums);
}

#else

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
#define to_bigs convert_big16
#define to_signed_bigs convert_signed_big16
#else
typedef big bigs;
typedef signed_big signed_bigs;
#define to_bigs (big)
#define to_signed_bigs (signed_big)
#endif

inline Gravity gravity_of_integers(uints total, bigs moment, uints lit, codes peak) {
    Gravity gravity;
    gravity.total = to_reals(total);
    // A whole number near the position, which the moment is taken about: the rest is small and loses nothing.
    const reals per_light = 1 / choose_reals(INT_MASK(total == 0u), 1, gravity.total);
    const signed_bigs centre = to_signed_bigs(to_reals(moment) * per_light);
    const signed_bigs offset = to_signed_bigs(moment) - centre * to_signed_bigs(total);
    gravity.position = to_reals(centre) + to_reals(offset) * per_light;
    gravity.lit = to_reals(lit);
    gravity.peak = peak;
    gravity.lost = 0;
    return gravity;
}

#ifndef VECTOR_VARIANT
inline Gravity whole_gravity(const Profiles *profiles) {
    uints total = 0, lit = 0;
    bigs moment = 0;
    codes peak = 0;
    for (int k = 0; k < profiles->length; k++) {
        const codes x = sample_of(profiles, k);
        const uints v = x > profiles->threshold ? x - profiles->threshold : 0;
        total += v;
        moment += (bigs)v * k;
        lit += v > 0;
        peak = max(peak, x);
    }
    return gravity_of_integers(total, moment, lit, peak);
}
#endif

#endif

#ifdef VECTOR_VARIANT
#include "line/line_wide.h"

#if CODE_BITS == 32

typedef Sums WideSums;
inline void clear_sums(WideSums *sums) { *sums = no_sums(); }

inline void add_steps(WideSums *sums, global const CODE *at, int stride, int steps, int first, CODE threshold,
                      Ahead *ahead) {
    reals s = 0, m = 0, lit = 0, lost = sums->lost;
    codes peak = sums->peak;
    for (int k = 0; k < steps; k++, at += stride) {
        const float16 x = wide_load(at);
        if ((k & 3) == 0) fetch_lines(ahead);
        const reals v = over_threshold(x, threshold);
        peak = x > peak ? x : peak;
        lost += to_reals(x) * 0;
        s += v;
        m += s;
#ifdef WITH_LIT
        lit += choose_reals(CODE_MASK(x > (codes)threshold), 1, 0);
#endif
    }
    add_block(sums, s, m, first, steps);
    sums->peak = peak;
    sums->lost = lost;
    sums->lit += lit;
}

inline Gravity wide_gravity(const WideSums *sums, int i) { return gravity_of(sums); }

#ifdef ALONG_ROWS
inline real sum_of(real16 v) {
    const real8 a = v.lo + v.hi;
    const real4 b = a.lo + a.hi;
    return (b.x + b.y) + (b.z + b.w);
}

// Of one row, about a place near its centre of gravity, where nothing is lost by rounding.
typedef struct {
    real centre, offset, total, lit, peak, lost;
} RowSums;

inline void sum_lanes(const WideSums *wide, RowSums *sums) {
    const real total = sum_of(wide->total + wide->total_rest);
    const real centre = total > 0 ? rint(sum_of(wide->moment) / total) : 0;
    const real16 rest = wide->moment_rest - centre * wide->total_rest;
    const real16 offset = fma(-(real16)centre, wide->total, wide->moment) + rest;
    sums->centre = centre * WIDE;
    sums->offset = sum_of(WIDE * offset + to_reals(lane_numbers) * (wide->total + wide->total_rest));
    sums->total = total;
    sums->lit = sum_of(wide->lit);
    sums->peak = highest_level(wide->peak);
    sums->lost = sum_of(wide->lost);
}

inline void add_sample(RowSums *sums, CODE x, int k, CODE threshold) {
    const real v = x > threshold ? (real)x - threshold : 0;
    sums->total += v;
    sums->offset += v * (k - sums->centre);
    sums->lit += v > 0;
    sums->peak = x > sums->peak ? x : sums->peak;
    sums->lost += (real)x * 0;
}

inline Gravity row_gravity(const RowSums *rows) {
    real centre[LANES], offset[LANES], total[LANES], lit[LANES], lost[LANES];
    CODE peak[LANES];
    for (int i = 0; i < LANES; i++) {
        centre[i] = rows[i].centre;
        offset[i] = rows[i].offset;
        total[i] = rows[i].total;
        lit[i] = rows[i].lit;
        lost[i] = rows[i].lost;
        peak[i] = rows[i].peak;
    }
    Gravity gravity;
    gravity.total = *(const reals_at *)total;
    gravity.position = *(const reals_at *)centre + *(const reals_at *)offset / gravity.total;
    gravity.lit = *(const reals_at *)lit;
    gravity.peak = *(const codes_at *)peak;
    gravity.lost = not_finite_lanes(*(const reals_at *)lost) | not_finite_lanes(gravity.total);
    return gravity;
}
#endif

#else

// Sums of WIDE profiles, of the even and the odd ones apart: so numbers of double width fall out of the samples.
typedef struct {
    uint16 total[QUARTERS], lit[QUARTERS];
    big16 moment[QUARTERS];
    wides peak;
} WideSums;

inline void clear_sums(WideSums *sums) {
    for (int i = 0; i < QUARTERS; i++) {
        sums->total[i] = sums->lit[i] = 0;
        sums->moment[i] = 0;
    }
    sums->peak = 0;
}

// What remains of a sum of whole samples pairs when the odd ones are taken out.
inline halves even_part(halves both, halves odd) { return both - (odd << (halves)CODE_BITS); }

#ifdef WITH_LIT
#define COUNT_LIT                                                                                                      \
    const halves bright = __builtin_astype(x > limit ? (wides)1 : (wides)0, halves);                                   \
    lit += bright;                                                                                                     \
    lit_odd += bright >> (halves)CODE_BITS;
#else
#define COUNT_LIT
#endif

#define ADD_STEP                                                                                                       \
    {                                                                                                                  \
        const wides x = wide_load(at);                                                                                 \
        at += stride;                                                                                                  \
        peak = x > peak ? x : peak;                                                                                    \
        const halves v = __builtin_astype((x > limit ? x : limit) - limit, halves);                                    \
        s += v;                                                                                                        \
        s_odd += v >> (halves)CODE_BITS;                                                                               \
        m += s;                                                                                                        \
        m_odd += s_odd;                                                                                                \
        COUNT_LIT                                                                                                      \
    }
#define ADD_FOUR_STEPS ADD_STEP ADD_STEP ADD_STEP ADD_STEP fetch_lines(ahead);

inline void add_quarter(WideSums *sums, int i, uint16 s, uint16 m, int first, int steps) {
    sums->total[i] += s;
    sums->moment[i] += convert_big16(s) * (big)(first + steps) - convert_big16(m);
}

inline void add_steps(WideSums *sums, global const CODE *at, int stride, int steps, int first, CODE threshold,
                      Ahead *ahead) {
    halves s = 0, s_odd = 0, m = 0, m_odd = 0;
#ifdef WITH_LIT
    halves lit = 0, lit_odd = 0;
#endif
    const wides limit = threshold;
    wides peak = sums->peak;
    if (steps == STEPS) {
        ADD_FOUR_STEPS ADD_FOUR_STEPS ADD_FOUR_STEPS ADD_FOUR_STEPS ADD_FOUR_STEPS
    } else {
        for (int k = 0; k < steps; k++) ADD_STEP
    }
    sums->peak = peak;
    const halves s_even = even_part(s, s_odd), m_even = even_part(m, m_odd);
#if CODE_BITS == 8
    add_quarter(sums, 0, convert_uint16(s_even.lo), convert_uint16(m_even.lo), first, steps);
    add_quarter(sums, 1, convert_uint16(s_odd.lo), convert_uint16(m_odd.lo), first, steps);
    add_quarter(sums, 2, convert_uint16(s_even.hi), convert_uint16(m_even.hi), first, steps);
    add_quarter(sums, 3, convert_uint16(s_odd.hi), convert_uint16(m_odd.hi), first, steps);
#else
    add_quarter(sums, 0, s_even, m_even, first, steps);
    add_quarter(sums, 1, s_odd, m_odd, first, steps);
#endif
#ifdef WITH_LIT
    const halves lit_even = even_part(lit, lit_odd);
#if CODE_BITS == 8
    sums->lit[0] += convert_uint16(lit_even.lo);
    sums->lit[1] += convert_uint16(lit_odd.lo);
    sums->lit[2] += convert_uint16(lit_even.hi);
    sums->lit[3] += convert_uint16(lit_odd.hi);
#else
    sums->lit[0] += lit_even;
    sums->lit[1] += lit_odd;
#endif
#endif
}

// Even and odd profiles back in turn: the lower or the upper 16 of the 32.
#define IN_TURN(e, o)                                                                                                  \
    (e).s0, (o).s0, (e).s1, (o).s1, (e).s2, (o).s2, (e).s3, (o).s3, (e).s4, (o).s4, (e).s5, (o).s5, (e).s6, (o).s6,    \
        (e).s7, (o).s7
#define INTERLEAVED(type, values, i)                                                                                   \
    ((i)&1 ? (type)(IN_TURN((values)[(i) & ~1].hi, (values)[(i) | 1].hi))                                              \
           : (type)(IN_TURN((values)[(i) & ~1].lo, (values)[(i) | 1].lo)))

inline Gravity wide_gravity(const WideSums *sums, int i) {
    const uint16 total = INTERLEAVED(uint16, sums->total, i), lit = INTERLEAVED(uint16, sums->lit, i);
    const big16 moment = INTERLEAVED(big16, sums->moment, i);
    return gravity_of_integers(total, moment, lit, ((const codes *)&sums->peak)[i]);
}

#ifdef ALONG_ROWS
typedef struct {
    uint total, lit;
    big moment;
    CODE peak;
} RowSums;

#define SUM_LANES(sum, type, v)                                                                                        \
    {                                                                                                                  \
        const type##8 a = (v).lo + (v).hi;                                                                             \
        const type##4 b = a.lo + a.hi;                                                                                 \
        sum = (b.x + b.y) + (b.z + b.w);                                                                               \
    }

inline void sum_lanes(const WideSums *wide, RowSums *sums) {
    uint16 total = 0, lit = 0;
    big16 all = 0;
    CODE peak = 0;
    for (int i = 0; i < QUARTERS; i++) {
        // The even or the odd lanes of a half of the group.
        const uint16 lane = convert_uint16(2 * lane_numbers + (i / 2 * 32 + i % 2));
        total += wide->total[i];
        lit += wide->lit[i];
        all += wide->moment[i] * (big)WIDE + convert_big16(lane * wide->total[i]);
        peak = max(peak, highest_level(((const codes *)&wide->peak)[i]));
    }
    SUM_LANES(sums->total, uint, total)
    SUM_LANES(sums->lit, uint, lit)
    SUM_LANES(sums->moment, big, all)
    sums->peak = peak;
}

inline void add_sample(RowSums *sums, CODE x, int k, CODE threshold) {
    const uint v = x > threshold ? x - threshold : 0;
    sums->total += v;
    sums->moment += (big)v * k;
    sums->lit += v > 0;
    sums->peak = max(sums->peak, x);
}

inline Gravity row_gravity(const RowSums *rows) {
    uint total[LANES], lit[LANES];
    big moment[LANES];
    CODE peak[LANES];
    for (int i = 0; i < LANES; i++) {
        total[i] = rows[i].total;
        lit[i] = rows[i].lit;
        moment[i] = rows[i].moment;
        peak[i] = rows[i].peak;
    }
    return gravity_of_integers(vload16(0, total), vload16(0, moment), vload16(0, lit), *(const codes_at *)peak);
}
#endif

#endif
#endif
#endif
