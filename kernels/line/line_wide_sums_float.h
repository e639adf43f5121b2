// Sums of WIDE profiles of float samples for their centroid, down the columns (WideSums) or along a row (RowSums).
#ifndef LINE_WIDE_SUMS_FLOAT_H
#define LINE_WIDE_SUMS_FLOAT_H

#include "line/line_wide.h"

typedef Sums WideSums;
static inline void clear_sums(WideSums *sums) { *sums = zero_sums(); }

// Add the light of `steps` samples of every lane: the first at `at`, the next ones `stride` elements further; `first` is
// the index of the first sample. The caller calls raise_peak() first.
static inline void add_steps(WideSums *sums, global const CODE *at, int stride, int steps, int first, CODE threshold) {
    reals s = 0, m = 0, width = 0;
    for (int k = 0; k < steps; k++, at += stride) {
        const float16 x = wide_load(at);
        const reals v = over_threshold(x, threshold);
        s += v;
        m += s;
#ifdef COUNT_WIDTH
        width += choose_reals(int_mask(x > (codes)threshold), 1, 0);
#endif
    }
    add_block(sums, s, m, first, steps);
    sums->width += width;
}

// Raise the largest samples of the lanes, and keep whether a sample is not finite.
static inline void raise_peak(WideSums *sums, const Highest *highest) {
    sums->peak = highest->level > sums->peak ? highest->level : sums->peak;
    sums->poison += to_reals(highest->poison);
}

// Centroids of the 16 lanes of a quarter (a wide vector of floats has one).
static inline Centroid wide_centroid(const WideSums *sums, int quarter) { return centroid_of(sums); }

#ifdef ALONG_ROWS
// Sums of one row. The moment is kept as total * centre + offset with a centre near the centroid, so that rounding does
// not matter.
typedef struct {
    real centre, offset, total, width, peak, poison;
} RowSums;

// Combine the lanes of a row: lane i of step k is sample k * WIDE + i.
static inline void sum_lanes(const WideSums *wide, RowSums *sums) {
    const real total = sum_of(wide->total + wide->total_error);
    const real centre = total > 0 ? rint(sum_of(wide->moment) / total) : 0;
    const real16 rest = wide->moment_error - centre * wide->total_error;
    const real16 offset = fma(-(real16)centre, wide->total, wide->moment) + rest;
    sums->centre = centre * WIDE;
    sums->offset = sum_of(WIDE * offset + to_reals(LANE_NUMBERS) * (wide->total + wide->total_error));
    sums->total = total;
    sums->width = sum_of(wide->width);
    sums->peak = highest_level(wide->peak);
    sums->poison = sum_of(wide->poison);
}

static inline void add_sample(RowSums *sums, CODE x, int k, CODE threshold) {
    const real v = x > threshold ? (real)x - threshold : 0;
    sums->total += v;
    sums->offset += v * (k - sums->centre);
    sums->width += v > 0;
    sums->peak = x > sums->peak ? x : sums->peak;
    sums->poison += (real)x * 0;
}

static inline Centroid row_centroid(const RowSums *rows) {
    real centre[LANES], offset[LANES], total[LANES], width[LANES], poison[LANES];
    CODE peak[LANES];
    for (int i = 0; i < LANES; i++) {
        centre[i] = rows[i].centre;
        offset[i] = rows[i].offset;
        total[i] = rows[i].total;
        width[i] = rows[i].width;
        poison[i] = rows[i].poison;
        peak[i] = rows[i].peak;
    }
    Centroid centroid;
    centroid.total = *(const reals_at *)total;
    centroid.position = *(const reals_at *)centre + *(const reals_at *)offset / centroid.total;
    centroid.width = *(const reals_at *)width;
    centroid.peak = *(const codes_at *)peak;
    centroid.not_finite = not_finite_lanes(*(const reals_at *)poison) | not_finite_lanes(centroid.total);
    return centroid;
}
#endif
#endif
