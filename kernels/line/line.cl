// Light lines in camera frames: every profile (a column, or under ALONG_ROWS a row) -> position, peak, width, total,
// status, and under WITH_SHEET the point in the sheet of light. METHOD_... says how; line.py documents the defines.
#include "line/line_peak.h"
#include "line/line_centroid.h"
#include "line/line_window.h"
#include "common/sheet.h"
#ifdef VECTOR_VARIANT
#include "line/line_wide_peak.h"
#endif
#if defined(METHOD_GAUSS3) || defined(METHOD_FIR)
#include "line/line_points.h"
#endif
#ifdef METHOD_ML
#include "line/line_ml.h"
#endif

// The parameters, as LineReadout packs them.
#define MIN_WIDTH 0
#define MAX_WIDTH 1
#define AMBIGUOUS_RATIO 2
#define READ_VARIANCE 3  // of a dark sample [level^2]
#define GAIN 4           // variance per level of light

typedef struct {
    global real *position, *peak, *width, *total;
    global uchar *status;
    global real *g, *h;
    constant real *sheet;
} Outputs;

// Lanes that go to samples first, first + 1, ... of the output.
inline void store_reading(const Outputs *to, ulong first, int sample, reals position, codes peak, reals width,
                          reals total, ints flags) {
    ints lost = ~INT_MASK((flags & (STATUS_LOW_SIGNAL | STATUS_OUT_OF_RANGE | STATUS_NOT_FINITE)) == 0);
#if CODE_BITS == 32
    // Numbers whose sums are none.
    const ints overflown = not_finite_lanes(total) | (not_finite_lanes(position) & ~lost);
    flags |= flag_where(overflown, STATUS_NOT_FINITE);
    lost |= overflown;
#endif
    const ints not_finite = ~INT_MASK((flags & STATUS_NOT_FINITE) == 0);
    position = nan_where(to_masks(lost), position);
#ifdef WITH_SHEET
    reals g, h;
    const reals samples = to_reals((ints)sample + lane_numbers);
    const ints sheet_flags = to_ints(LANED(sheet_point)(position, samples, to->sheet, &g, &h));
    flags |= sheet_flags & ~lost;
#ifdef WITH_G
    store_reals(g, to->g + first);
#endif
#ifdef WITH_H
    store_reals(h, to->h + first);
#endif
#endif
#ifdef WITH_POSITION
    store_reals(position, to->position + first);
#endif
#ifdef WITH_PEAK
    store_reals(nan_where(to_masks(not_finite), to_reals(peak)), to->peak + first);
#endif
#ifdef WITH_WIDTH
    store_reals(nan_where(to_masks(not_finite), width), to->width + first);
#endif
#ifdef WITH_TOTAL
    store_reals(nan_where(to_masks(not_finite), total), to->total + first);
#endif
#ifdef WITH_STATUS
    store_bytes(convert_bytes(flags), to->status + first);
#endif
}

inline ints common_flags(const Profiles *profiles, codes peak, ints lost) {
    return flag_where(CODE_MASK(peak >= (codes)profiles->saturation), STATUS_SATURATED) |
           flag_where(lost, STATUS_NOT_FINITE);
}

#ifdef METHOD_CENTROID
// Light over the threshold of sample k.
inline reals light_at(const Profiles *profiles, int k) {
    return over_threshold(sample_of(profiles, k), profiles->threshold);
}

inline void finish_whole(const Profiles *profiles, const Gravity *gravity, constant real *p, const Outputs *to,
                         ulong first, int sample) {
    ints dark = dark_lanes(profiles, gravity->peak);
#ifdef WIDTH_LIMITS
    dark |= REAL_MASK(gravity->lit < p[MIN_WIDTH]) | REAL_MASK(gravity->lit > p[MAX_WIDTH]);
#endif
    // Light whose half maximum lies outside: its centre of gravity does not.
    const reals least = over_threshold(gravity->peak, profiles->threshold) / 2;
    const reals begin = light_at(profiles, 0), end = light_at(profiles, profiles->length - 1);
    const ints cut = REAL_MASK(begin >= least) | REAL_MASK(end >= least);
    const ints flags = flag_where(dark, STATUS_LOW_SIGNAL) | flag_where(cut & ~dark, STATUS_OUT_OF_RANGE) |
                       common_flags(profiles, gravity->peak, gravity->lost);
    store_reading(to, first, sample, gravity->position, gravity->peak, gravity->lit, gravity->total, flags);
}
#else
inline void finish_peak(const Profiles *profiles, const Peak *peak, const Place *found, constant real *p,
                        const Outputs *to, ulong first, int sample) {
    const Place place = middle_of_wide_top(peak, *found);
    const ints cut = cut_lanes(profiles, peak) & peak->found;
    ints flags = place.flags | common_flags(profiles, peak->level, peak->lost);
    flags |= flag_where(~peak->found, STATUS_LOW_SIGNAL) | flag_where(cut, STATUS_OUT_OF_RANGE);
#ifdef AMBIGUITY
    flags |= flag_where(has_second(profiles, peak, p[AMBIGUOUS_RATIO]) & peak->found, STATUS_AMBIGUOUS);
#endif
#ifdef WITH_LIT
    const reals width = run_length(profiles, peak);
#else
    const reals width = 0;
#endif
    const reals total = choose_reals(peak->found, place.total, 0);
    store_reading(to, first, sample, to_reals(peak->at) + place.at, peak->level, width, total, flags);
}

// The window of every lane by itself, by any method.
inline Place place_apart(const Profiles *profiles, Peak *peak, constant real *p) {
    CODE window[(2 * REACH + 1) * LANES];
    settle(profiles, peak, REACH, window);
#if defined(METHOD_WINDOWED)
    return window_gravity(window, REACH, profiles, peak);
#elif defined(METHOD_ML)
    return likeliest_place(window, profiles, peak, p + READ_VARIANCE);
#else
    return place_by_points(window, profiles, peak);
#endif
}
#endif

#ifdef VECTOR_VARIANT
#include "line/line_strip.h"
#endif

#define ARGUMENTS                                                                                                      \
    global const CODE *restrict frames, INPUT_PREVIOUS global real *restrict position, global real *restrict peak,     \
        global real *restrict width, global real *restrict total, global uchar *restrict status,                       \
        global real *restrict g, global real *restrict h, const int rows, const int columns, const CODE threshold,     \
        const CODE saturation, const CODE minimum, constant real *p, constant real *sheet
#ifdef SELECT_NEAREST
#define INPUT_PREVIOUS global const real *restrict previous,
#else
#define INPUT_PREVIOUS
#endif
#define OUTPUTS {position, peak, width, total, status, g, h, sheet}

#ifdef ALONG_ROWS
#define LENGTH columns
#define SAMPLES rows
#define STRIDE 1
#define LANE_STRIDE columns
#else
#define LENGTH rows
#define SAMPLES columns
#define STRIDE columns
#define LANE_STRIDE 1
#endif

// The LANES profiles from a given one on.
#define PROFILES_FROM(sample)                                                                                          \
    {frames + (ulong)frame * rows * columns + (long)(sample) * LANE_STRIDE,                                            \
     STRIDE, LANE_STRIDE, LENGTH, threshold, saturation, minimum}

#if defined(CANDIDATES) || (!defined(VECTOR_VARIANT) && !defined(METHOD_CENTROID))
// LANES profiles, by a walk along them. Items beyond the last profile fill up a work-group.
kernel void line_readout(ARGUMENTS) {
    const Outputs to = OUTPUTS;
    const int frame = get_global_id(1), sample = min((int)get_global_id(0) * LANES, SAMPLES - LANES);
    if ((int)get_global_id(0) * LANES >= SAMPLES) return;
    const Profiles profiles = PROFILES_FROM(sample);
    const ulong first = (ulong)frame * SAMPLES + sample;
#ifdef CANDIDATES
    ints nearest = -1;
#ifdef SELECT_NEAREST
    const reals before = *(global const reals_at *)(previous + first);
    nearest = choose_ints(REAL_MASK(before >= 0) & REAL_MASK(before < (real)LENGTH), to_ints(rint(before)), -1);
#endif
    Peak found = choose_peak(&profiles, nearest, (int)p[MIN_WIDTH], (int)p[MAX_WIDTH]);
#else
    Peak found = strongest_peak(&profiles);
#endif
    const Place place = place_apart(&profiles, &found, p);
    finish_peak(&profiles, &found, &place, p, &to, first, sample);
}

#elif defined(METHOD_CENTROID) && !defined(VECTOR_VARIANT)
kernel void line_readout(ARGUMENTS) {
    const Outputs to = OUTPUTS;
    const int frame = get_global_id(1), sample = get_global_id(0);
    if (sample >= SAMPLES) return;
    const Profiles profiles = PROFILES_FROM(sample);
    const Gravity gravity = whole_gravity(&profiles);
    finish_whole(&profiles, &gravity, p, &to, (ulong)frame * SAMPLES + sample, sample);
}

#elif !defined(ALONG_ROWS)
// A strip of columns, from the first row to the last: blocks of rows outside, groups of WIDE columns inside, so that
// memory is read nearly in sequence while the sums of a group stay in registers.
kernel void line_readout(ARGUMENTS) {
    const Outputs to = OUTPUTS;
    const int strips = get_global_size(0), frame = get_global_id(1);
    const int strip = ((columns + strips - 1) / strips + WIDE - 1) / WIDE * WIDE;
    const int begin = (int)get_global_id(0) * strip, end = min(begin + strip, columns);
    const Profiles profiles = PROFILES_FROM(0);
    for (int part = begin; part < end; part += MAX_STRIP) {
        read_strip(&profiles, part, min(part + MAX_STRIP, end), p, &to, (ulong)frame * columns);
    }
}
#else
// Sixteen rows.
kernel void line_readout(ARGUMENTS) {
    const Outputs to = OUTPUTS;
    const int frame = get_global_id(1), sample = min((int)get_global_id(0) * LANES, SAMPLES - LANES);
    const Profiles profiles = PROFILES_FROM(sample);
    read_rows(&profiles, p, &to, (ulong)frame * SAMPLES + sample, sample);
}
#endif
