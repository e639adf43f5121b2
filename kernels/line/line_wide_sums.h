// Sums of WIDE profiles of integer samples for their centroid, down the columns (WideSums) or along a row (RowSums).
//
// Two neighbouring samples of b bits, e (even lane) and o (odd lane), are read as one number of 2b bits, p = e + 2^b o.
// Sums need 2b bits, and a vector holds half the number of 2b-bit values. Two sums are kept:
//     S = sum p = sum e + 2^b sum o  (mod 2^2b)   and   O = sum (p >> b) = sum o,
// so that sum e = S - (O << b) (mod 2^2b). This is exact, because sum e and sum o of a block fit 2b bits (STEPS). It
// saves the instructions that would separate the even lanes of every sample. The moments are summed in the same way.
#ifndef LINE_WIDE_SUMS_H
#define LINE_WIDE_SUMS_H

#include "line/line_wide.h"

// Sums over the blocks. Element 2h holds the even lanes and element 2h + 1 the odd lanes of the 32 lanes of half h.
typedef struct {
    uint16 total[QUARTERS];
#ifdef COUNT_WIDTH
    uint16 width[QUARTERS];
#endif
    big16 moment[QUARTERS];
    wides peak;
} WideSums;

// Sums of one block: packed sums (both lanes) and sums of the odd lanes.
typedef struct {
    wide_pairs s, s_odd, m, m_odd;
#ifdef COUNT_WIDTH
    wide_pairs width, width_odd;
#endif
} BlockSums;

static inline void clear_sums(WideSums *sums) {
    for (int i = 0; i < QUARTERS; i++) {
        sums->total[i] = 0;
        sums->moment[i] = 0;
#ifdef COUNT_WIDTH
        sums->width[i] = 0;
#endif
    }
    sums->peak = 0;
}

static inline wide_pairs even_part(wide_pairs both, wide_pairs odd) { return both - (odd << (wide_pairs)CODE_BITS); }

static inline void add_step(BlockSums *block, wides x, wides threshold) {
    const wide_pairs v = __builtin_astype((x > threshold ? x : threshold) - threshold, wide_pairs);
    block->s += v;
    block->s_odd += v >> (wide_pairs)CODE_BITS;
    block->m += block->s;
    block->m_odd += block->s_odd;
#ifdef COUNT_WIDTH
    const wide_pairs bright = __builtin_astype(x > threshold ? (wides)1 : (wides)0, wide_pairs);
    block->width += bright;
    block->width_odd += bright >> (wide_pairs)CODE_BITS;
#endif
}

// Add the sums of 16 lanes of a block to element i: see line_centroid.h for the moment.
static inline void add_lanes(WideSums *sums, int i, uint16 s, uint16 m, int first, int steps) {
    sums->total[i] += s;
    sums->moment[i] += convert_big16(s) * (big)(first + steps) - convert_big16(m);
}

static inline void add_block(WideSums *sums, const BlockSums *block, int first, int steps) {
    const wide_pairs s = even_part(block->s, block->s_odd), m = even_part(block->m, block->m_odd);
#ifdef COUNT_WIDTH
    const wide_pairs width = even_part(block->width, block->width_odd);
#endif
#if CODE_BITS == 8
    add_lanes(sums, 0, convert_uint16(s.lo), convert_uint16(m.lo), first, steps);
    add_lanes(sums, 1, convert_uint16(block->s_odd.lo), convert_uint16(block->m_odd.lo), first, steps);
    add_lanes(sums, 2, convert_uint16(s.hi), convert_uint16(m.hi), first, steps);
    add_lanes(sums, 3, convert_uint16(block->s_odd.hi), convert_uint16(block->m_odd.hi), first, steps);
#ifdef COUNT_WIDTH
    sums->width[0] += convert_uint16(width.lo);
    sums->width[1] += convert_uint16(block->width_odd.lo);
    sums->width[2] += convert_uint16(width.hi);
    sums->width[3] += convert_uint16(block->width_odd.hi);
#endif
#else
    add_lanes(sums, 0, s, m, first, steps);
    add_lanes(sums, 1, block->s_odd, block->m_odd, first, steps);
#ifdef COUNT_WIDTH
    sums->width[0] += width;
    sums->width[1] += block->width_odd;
#endif
#endif
}

// Add the light of `steps` samples of every lane, at most STEPS: the first at `at`, the next ones `stride` elements
// further; `first` is the index of the first sample. The caller calls raise_peak(). Full blocks are unrolled, so that the
// sums stay in registers.
static inline void add_steps(WideSums *sums, global const CODE *at, int stride, int steps, int first, CODE threshold) {
    BlockSums block;
    block.s = block.s_odd = block.m = block.m_odd = 0;
#ifdef COUNT_WIDTH
    block.width = block.width_odd = 0;
#endif
    const wides limit = threshold;
    if (steps == STEPS) {
        _Pragma("unroll") for (int k = 0; k < STEPS; k++) {
            add_step(&block, wide_load(at + (long)k * stride), limit);
        }
    } else {
        for (int k = 0; k < steps; k++, at += stride) add_step(&block, wide_load(at), limit);
    }
    add_block(sums, &block, first, steps);
}

// Raise the largest samples of the lanes.
static inline void raise_peak(WideSums *sums, const Highest *highest) {
    sums->peak = highest->level > sums->peak ? highest->level : sums->peak;
}

// The 16 lanes of a quarter: even and odd lanes of a half interleaved, the first 16 or the last 16 of them.
#define INTERLEAVE(even, odd, last)                                                                             \
    ((last) ? __builtin_shufflevector(even, odd, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)  \
            : __builtin_shufflevector(even, odd, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23))
static inline uint16 uints_of_quarter(const uint16 *sums, int quarter) {
    return INTERLEAVE(sums[quarter & ~1], sums[quarter | 1], quarter & 1);
}
static inline big16 bigs_of_quarter(const big16 *sums, int quarter) {
    return INTERLEAVE(sums[quarter & ~1], sums[quarter | 1], quarter & 1);
}

// Centroids of the 16 lanes of a quarter.
static inline Centroid wide_centroid(const WideSums *sums, int quarter) {
#ifdef COUNT_WIDTH
    const uint16 width = uints_of_quarter(sums->width, quarter);
#else
    const uint16 width = 0;
#endif
    return centroid_of_integers(uints_of_quarter(sums->total, quarter), bigs_of_quarter(sums->moment, quarter), width,
                                ((const codes *)&sums->peak)[quarter]);
}

#ifdef ALONG_ROWS
typedef struct {
    uint total, width;
    big moment;
    CODE peak;
} RowSums;

static inline uint sum_uints(uint16 v) {
    const uint8 a = v.lo + v.hi;
    const uint4 b = a.lo + a.hi;
    return (b.x + b.y) + (b.z + b.w);
}
static inline big sum_bigs(big16 v) {
    const big8 a = v.lo + v.hi;
    const big4 b = a.lo + a.hi;
    return (b.x + b.y) + (b.z + b.w);
}

// Combine the lanes of a row: lane i of step k is sample k * WIDE + i.
static inline void sum_lanes(const WideSums *wide, RowSums *sums) {
    uint16 total = 0, width = 0;
    big16 moment = 0;
    CODE peak = 0;
    for (int i = 0; i < QUARTERS; i++) {
        const uint16 lane = convert_uint16(2 * LANE_NUMBERS + (i / 2 * 32 + i % 2));  // the lanes of element i
        total += wide->total[i];
#ifdef COUNT_WIDTH
        width += wide->width[i];
#endif
        moment += wide->moment[i] * (big)WIDE + convert_big16(lane * wide->total[i]);
        peak = max(peak, highest_level(((const codes *)&wide->peak)[i]));
    }
    sums->total = sum_uints(total);
    sums->width = sum_uints(width);
    sums->moment = sum_bigs(moment);
    sums->peak = peak;
}

static inline void add_sample(RowSums *sums, CODE x, int k, CODE threshold) {
    const uint v = x > threshold ? x - threshold : 0;
    sums->total += v;
    sums->moment += (big)v * k;
    sums->width += v > 0;
    sums->peak = max(sums->peak, x);
}

static inline Centroid row_centroid(const RowSums *rows) {
    uint total[LANES], width[LANES];
    big moment[LANES];
    CODE peak[LANES];
    for (int i = 0; i < LANES; i++) {
        total[i] = rows[i].total;
        width[i] = rows[i].width;
        moment[i] = rows[i].moment;
        peak[i] = rows[i].peak;
    }
    return centroid_of_integers(vload16(0, total), vload16(0, moment), vload16(0, width), *(const codes_at *)peak);
}
#endif
#endif
