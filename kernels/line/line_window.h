// Window of samples around a peak, flat tops, and the centroid of the light in the window.
//
// A window holds the samples [peak - reach, peak + reach] of every lane: sample k of the lanes lies at window[k *
// LANES]. Build options: RADIUS, MAX_RADIUS and WINDOW_ARGUMENT (line.cl), FIR_HALF (samples beyond the window that are
// read), COUNT_WIDTH (lengths of runs).
#ifndef LINE_WINDOW_H
#define LINE_WINDOW_H

#include "line/line_peak.h"

#define MAX_REACH (MAX_RADIUS + FIR_HALF)

static inline int window_length(const Profiles *profiles) { return 2 * radius_of(profiles) + 1; }

typedef struct {
    reals at;     // position relative to the index of the peak
    reals total;  // light in the window
    ints flags;
#ifdef NOISE
    reals variance;  // of the position [px^2]; NaN where no noise model holds
#endif
} Place;

// Copy the window of every lane, one lane after the other; beyond the border the sample at the border is repeated.
static inline void gather_lanes(const Profiles *profiles, ints peak, int reach, CODE *window) {
    int at[LANES];
    *(ints_at *)at = peak;
    for (int lane = 0; lane < LANES; lane++) {
        global const CODE *profile = profiles->first + (long)lane * profiles->lane_stride;
        const int begin = at[lane] - reach;
        if (begin >= 0 && at[lane] + reach < profiles->length) {
            global const CODE *sample = profile + (long)begin * profiles->stride;
            for (int k = 0; k <= 2 * reach; k++, sample += profiles->stride) window[k * LANES + lane] = *sample;
        } else {
            for (int k = 0; k <= 2 * reach; k++) {
                const int index = clamp(begin + k, 0, profiles->length - 1);
                window[k * LANES + lane] = profile[(long)index * profiles->stride];
            }
        }
    }
}

#if defined(VECTOR_VARIANT) && !defined(ALONG_ROWS)
// Copy the window of every lane (see gather_lanes) by whole rows of 16 lanes, where the peaks lie within SHIFTS rows.
//
// The rows from the earliest window on are copied, then each lane is moved up by the rows between the earliest window
// and its own window. This shift is done in steps of 16, 8, 4, 2 and 1 rows, one for each bit of the number of rows. A step
// selects between two rows in all lanes at once, so that 16 windows take about 2 (2 reach + 1) + SHIFTS instructions for bytes.
#define SHIFTS 32
static inline void gather(const Profiles *profiles, ints peak, int reach, CODE *window) {
    const int first = lowest_lane(peak), last = -lowest_lane(-peak), height = 2 * reach + 1;
    if (last - first >= SHIFTS) {
        gather_lanes(profiles, peak, reach, window);
        return;
    }
    CODE rows[(2 * MAX_REACH + SHIFTS) * LANES];
    const ints shift = peak - first;
    const int copied = height + last - first;
    for (int k = 0; k < copied; k++) {
        *(codes_at *)(rows + k * LANES) = sample_of(profiles, clamp(first - reach + k, 0, profiles->length - 1));
    }
    for (int bit = SHIFTS / 2; bit > 0; bit >>= 1) {
        if (bit > last - first) continue;
        const ints moved = int_mask((shift & bit) != 0);
        const int end = min(height + bit - 1, copied);
        for (int k = 0; k < end; k++) {
            const codes here = *(const codes_at *)(rows + k * LANES);
            const codes later = *(const codes_at *)(rows + (k + bit) * LANES);
            *(codes_at *)(rows + k * LANES) = choose_codes(moved, later, here);
        }
    }
    for (int k = 0; k < height; k++) *(codes_at *)(window + k * LANES) = *(const codes_at *)(rows + k * LANES);
}
#else
#define gather gather_lanes
#endif

static inline codes window_level(const CODE *window, int k) { return *(const codes_at *)(window + k * LANES); }

// Count flat tops that extend beyond the window up to their end.
static inline void follow_tops(const Profiles *profiles, Peak *peak) {
    int at[LANES], top[LANES];
    CODE level[LANES];
    *(ints_at *)at = peak->at;
    *(ints_at *)top = peak->top & peak->found;
    *(codes_at *)level = peak->level;
    for (int lane = 0; lane < LANES; lane++) {
        if (top[lane] <= radius_of(profiles)) continue;
        global const CODE *profile = profiles->first + (long)lane * profiles->lane_stride;
        int end = at[lane] + top[lane];
        while (end < profiles->length && profile[(long)end * profiles->stride] == level[lane]) end++;
        top[lane] = end - at[lane];
    }
    peak->top = *(const ints_at *)top;
}

// Move peaks from the first sample of their flat top to its middle; return whether a peak moved.
static inline int centre_top(const Profiles *profiles, Peak *peak) {
    if (any_int_lane(int_mask(peak->top > radius_of(profiles)) & peak->found)) follow_tops(profiles, peak);
    const ints shift = ((peak->top - 1) >> 1) & peak->found;
    peak->at += shift;
    return any_int_lane(int_mask(shift > 0));
}

// Move the peaks to the middle of their flat tops and copy the windows around them.
static inline void gather_centred(const Profiles *profiles, Peak *peak, int reach, CODE *window) {
    gather(profiles, peak->at, reach, window);
    ints equal = -1;
    peak->top = 0;
    for (int k = 0; k <= radius_of(profiles); k++) {
        equal &= int_mask(window_level(window, k + reach) == peak->level) & int_mask(peak->at + k < profiles->length);
        peak->top -= equal;  // a mask is -1
    }
    if (centre_top(profiles, peak)) gather(profiles, peak->at, reach, window);
}

// Lanes where the border cuts the window, or cuts a flat top wider than the window.
static inline ints cut_lanes(const Profiles *profiles, const Peak *peak) {
    const ints begin = peak->at - ((peak->top + 1) >> 1), end = peak->at + (peak->top >> 1) + 1;
    return int_mask(peak->at < radius_of(profiles)) | int_mask(peak->at + radius_of(profiles) >= profiles->length) |
           (int_mask(peak->top > window_length(profiles)) & (int_mask(begin < 0) | int_mask(end >= profiles->length)));
}

// Replace the position by the middle of the flat top, with AMBIGUOUS, where the top is wider than the window: the
// window then holds no slope to measure.
static inline Place middle_of_wide_top(const Profiles *profiles, const Peak *peak, Place place) {
    const ints wide = int_mask(peak->top > window_length(profiles)) & peak->found;
    place.at = choose_reals(wide, to_reals((peak->top - 1) & 1) / 2, place.at);
    place.flags = choose_ints(wide, STATUS_AMBIGUOUS, place.flags);
#ifdef NOISE
    place.variance = nan_where(to_masks(wide), place.variance);
#endif
    return place;
}

#ifdef NOISE
// Variance of the centroid a = m1 / m0 of the light v_k of the samples k. A sample above the threshold moves it by
// (k - a) / m0 per grey level, and has the variance lit_variance + gain v_k (LineTable), so that
//     variance = (lit_variance sum_lit (k - a)^2 + gain sum v_k (k - a)^2) / m0^2.
// The sums are taken about the middle of the window: m2 = sum v_k k^2, and n0, n1, n2 the sums of 1, k and k^2 over the
// samples above the threshold.
static inline reals centroid_variance(reals a, reals m0, reals m1, reals m2, reals n0, reals n1, reals n2,
                                      constant LineTable *table) {
    const reals constant_part = n2 - a * (2 * n1 - a * n0), shot_part = m2 - a * m1;
    return (table->lit_variance * constant_part + table->gain * shot_part) / m0 / m0;
}
#endif

// Centroid of the light in the window, relative to its middle. Samples that gather() repeated beyond the border have no
// light; peak + k as an unsigned integer is below the length only for indices inside the profile.
static inline Place window_centroid(const CODE *window, int reach, const Profiles *profiles, const Peak *peak,
                                    constant LineTable *table) {
    reals total = 0, moment = 0;
#ifdef NOISE
    reals square = 0, lit_count = 0, lit_moment = 0, lit_square = 0;
#endif
    for (int k = -radius_of(profiles); k <= radius_of(profiles); k++) {
        const ints inside = int_mask(as_uints(peak->at + k) < (uints)profiles->length);
        const reals v = choose_reals(inside, over_threshold(window_level(window, k + reach), profiles->threshold), 0);
        total += v;
        moment += v * (real)k;
#ifdef NOISE
        const reals lit = choose_reals(int_mask(v > 0), 1, 0);
        square += v * (real)(k * k);
        lit_count += lit;
        lit_moment += lit * (real)k;
        lit_square += lit * (real)(k * k);
#endif
    }
    Place place;
    place.at = moment / total;
    place.total = total;
    place.flags = 0;
#ifdef NOISE
    place.variance =
        centroid_variance(place.at, total, moment, square, lit_count, lit_moment, lit_square, table);
#endif
    return place;
}

#ifdef COUNT_WIDTH
// Number of samples in the run above the threshold that contains the peak.
static inline reals run_length(const Profiles *profiles, const Peak *peak) {
    int at[LANES], length[LANES];
    *(ints_at *)at = peak->at;
    *(ints_at *)length = peak->found;
    for (int lane = 0; lane < LANES; lane++) {
        if (!length[lane]) continue;
        global const CODE *profile = profiles->first + (long)lane * profiles->lane_stride;
        int begin = at[lane], end = at[lane];
        while (begin > 0 && profile[(long)(begin - 1) * profiles->stride] > profiles->threshold) begin--;
        while (end < profiles->length - 1 && profile[(long)(end + 1) * profiles->stride] > profiles->threshold) end++;
        length[lane] = end - begin + 1;
    }
    return to_reals(*(const ints_at *)length);
}
#endif

#endif
