// Laser line readout: every profile of a camera frame -> sub-pixel position of the line, peak, width, total light,
// status, and under WITH_SHEET the point in the sheet of light (triangulation in the same pass).
//
// A profile is a column of the frame, or a row under ALONG_ROWS. `length` is the number of its samples, `samples` the
// number of profiles of a frame. METHOD_... selects the peak estimator:
//     CENTROID  sum v k / sum v over the whole profile, v the light (line_centroid.h)
//     WINDOWED  the same in a window of `radius` samples on either side of the peak (line_window.h)
//     GAUSS3    parabola through three logarithms, FIR zero crossing of a derivative filter (line_points.h)
//     ML        maximum-likelihood fit of a Gaussian (line_ml.h, line_point_fit.h)
//
// Inputs:  frames     (frames, rows, columns) CODE [grey levels]
//          previous   (frames, samples) real [px], under SELECT_NEAREST: earlier positions, NaN: unknown
//          threshold, saturation, minimum  CODE [grey levels]: level of no light, of saturation, smallest peak
//          radius     int [px]: samples on either side of the peak in its window
//          table      LineTable;  sheet  SheetTable (common/sheet.h), under WITH_SHEET
//          correction (blocks, CAMERA_PROFILES, 2, 16) real, under CAMERA_PROFILES (sheet_place_in_profile)
// Outputs: (frames, samples), each one compiled only under its WITH_... option:
//          position real [px], peak real [grey levels], width real [px], total real [grey levels], status uchar,
//          g, h real [m] (under WITH_SHEET), sigma real [px] (standard deviation of the position by the noise of the
//          samples), and under WITH_SHEET sigma_g, sigma_h real [m] (the same of g and h) and systematic_g,
//          systematic_h real [m] (standard deviation by the covariance of the triangulation)
// Build options: CODE, CODE4, CODE8, CODE16, CODE_BITS (type of the samples), REAL_IS_DOUBLE, ALONG_ROWS, MAX_RADIUS
//          (largest radius that the build takes), WINDOW_ARGUMENT (the radius is the argument) or RADIUS (it is this
//          constant), FIR_HALF (samples read beyond the window on either side), CANDIDATES with SELECT_...
//          (line_peak.h), AMBIGUITY, WIDTH_LIMITS, COUNT_WIDTH, LONG_MOMENT, PREFETCH, NOISE (compute variances: any of
//          the sigmas is an output), ITEM_PER_PROFILE (line_group.h),
//          WITH_POSITION/PEAK/WIDTH/TOTAL/STATUS/SHEET/G/H/SIGMA/SIGMA_G/SIGMA_H/SYSTEMATIC_G/SYSTEMATIC_H, LENS,
//          LENS_K2, LENS_K3, LENS_K4, CAMERA, CAMERA_PROFILES (terms of the table of corrections), PAST_CACHES,
//          VECTOR_VARIANT.
// Work:    global size (work-items of a frame, frames). Vector variant: a work-item reads a strip of columns, or 16
//          rows; under CANDIDATES 16 profiles. Otherwise: a work-group reads 32 or 64 columns, or 32 or 64 rows, together
//          (line_group.h); under CANDIDATES one work-item per profile, padded to whole work-groups.
#include "line/line_profiles.h"
#include "common/sheet.h"
#include "common/team.h"

// Parameters, in the order of LineTable in gpuvision/ranging/line_launch.py.
typedef struct {
    real min_width, max_width;  // limits on the number of samples above the threshold
    real ambiguous_ratio;       // fraction of the peak's light from which on a second peak counts
    real read_variance;         // METHOD_ML: variance of a dark sample [grey level^2]
    real gain;                  // variance per grey level of light
    real noise_variance;        // NOISE: variance of a dark sample with quantisation [grey level^2]
    real lit_variance;          // NOISE: the same of a sample at the threshold
    real speckle_variance;      // NOISE: variance of the position by speckle [px^2]
    real minimum_total;         // METHOD_CENTROID, float samples: smallest total light whose position is exact
} LineTable;

#include "line/line_peak.h"
#include "line/line_centroid.h"
#include "line/line_window.h"
#ifdef METHOD_CENTROID
#include "line/line_noise.h"
#endif
#ifdef VECTOR_VARIANT
#include "line/line_wide_peak.h"
#endif
#if defined(METHOD_GAUSS3) || defined(METHOD_FIR)
#include "line/line_points.h"
#endif
#ifdef METHOD_ML
#include "line/line_ml.h"
#endif

typedef struct {
    global real *position, *peak, *width, *total;
    global uchar *status;
    global real *g, *h, *sigma, *sigma_g, *sigma_h, *systematic_g, *systematic_h;
    constant SheetTable *sheet;
    constant LineTable *table;
    global const real *correction;
    int samples;  // profiles of a frame
} Outputs;

// Write the readings of LANES profiles, the first of them element `first` of the outputs and profile `sample` of its
// frame.
static inline void store_reading(const Outputs *to, ulong first, int sample, reals position, codes peak, reals width,
                                 reals total, ints flags, reals variance) {
    ints lost = ~int_mask((flags & (STATUS_LOW_SIGNAL | STATUS_OUT_OF_RANGE | STATUS_NOT_FINITE)) == 0);
#if CODE_BITS == 32
    // Sums that overflow to infinity or NaN.
    const ints overflown = not_finite_lanes(total) | (not_finite_lanes(position) & ~lost);
    flags |= flag_where(overflown, STATUS_NOT_FINITE);
    lost |= overflown;
    // Other flags of such a profile would depend on the order in which its samples are read.
    flags = choose_ints(~int_mask((flags & STATUS_NOT_FINITE) == 0), STATUS_NOT_FINITE, flags);
#endif
    const ints not_finite = ~int_mask((flags & STATUS_NOT_FINITE) == 0);
    position = nan_where(to_masks(lost), position);
#ifdef NOISE
    const reals sigma = nan_where(to_masks(lost), sqrt(variance + to->table->speckle_variance));
#endif
#ifdef WITH_SIGMA
    store_reals(sigma, to->sigma + first);
#endif
#ifdef WITH_SHEET
    reals g, h;
#ifdef CAMERA_PROFILES
    const SheetPlace place = sheet_place_in_profile(position, sample, to->samples, to->correction, to->sheet);
#else
    const SheetPlace place = sheet_place(position, to_reals((ints)sample + LANE_NUMBERS), to->sheet);
#endif
    const ints sheet_flags = to_ints(sheet_point_at(&place, to->sheet, &g, &h));
    flags |= sheet_flags & ~lost;
#ifdef WITH_G
    store_reals(g, to->g + first);
#endif
#ifdef WITH_H
    store_reals(h, to->h + first);
#endif
#if defined(WITH_SIGMA_G) || defined(WITH_SIGMA_H)
    const SheetVariances noise = sheet_noise_at(&place, sigma, (reals)0, to->sheet);
#endif
#ifdef WITH_SIGMA_G
    store_reals(nan_where(to_masks(not_finite_lanes(g)), sqrt(noise.g)), to->sigma_g + first);
#endif
#ifdef WITH_SIGMA_H
    store_reals(nan_where(to_masks(not_finite_lanes(h)), sqrt(noise.h)), to->sigma_h + first);
#endif
#if defined(WITH_SYSTEMATIC_G) || defined(WITH_SYSTEMATIC_H)
    const SheetVariances systematic = sheet_systematic_at(&place, to->sheet);
#endif
#ifdef WITH_SYSTEMATIC_G
    store_reals(nan_where(to_masks(not_finite_lanes(g)), sqrt(systematic.g)), to->systematic_g + first);
#endif
#ifdef WITH_SYSTEMATIC_H
    store_reals(nan_where(to_masks(not_finite_lanes(h)), sqrt(systematic.h)), to->systematic_h + first);
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

static inline ints common_flags(const Profiles *profiles, codes peak, ints not_finite) {
    return flag_where(int_mask(peak >= (codes)profiles->saturation), STATUS_SATURATED) |
           flag_where(not_finite, STATUS_NOT_FINITE);
}

#ifdef METHOD_CENTROID
// Mask of the lanes whose sample has at least half of the light of the peak.
static inline ints reaches_half(codes level, codes peak, CODE threshold) {
#if CODE_BITS == 32
    return int_mask(over_threshold(level, threshold) >= over_threshold(peak, threshold) / 2);
#else
    const codes limit = threshold, light = max(level, limit) - limit;
    return int_mask(light >= max(peak, limit) - limit - light);
#endif
}

static inline void finish_centroid(const Profiles *profiles, const Centroid *centroid, constant LineTable *table,
                                   const Outputs *to, ulong first, int sample) {
    ints dark = dark_lanes(profiles, centroid->peak);
#if CODE_BITS == 32
    dark |= int_mask(centroid->total < table->minimum_total);
#endif
#ifdef WIDTH_LIMITS
    dark |= int_mask(centroid->width < table->min_width) | int_mask(centroid->width > table->max_width);
#endif
    // A line whose half maximum lies beyond the border is cut: its centroid is wrong.
    const codes border = higher_of(sample_of(profiles, 0), sample_of(profiles, profiles->length - 1));
    const ints cut = reaches_half(border, centroid->peak, profiles->threshold);
    const ints flags = flag_where(dark, STATUS_LOW_SIGNAL) | flag_where(cut & ~dark, STATUS_OUT_OF_RANGE) |
                       common_flags(profiles, centroid->peak, centroid->not_finite);
#ifdef NOISE
    const reals variance = centroid->variance;
#else
    const reals variance = 0;
#endif
    store_reading(to, first, sample, centroid->position, centroid->peak, centroid->width, centroid->total, flags,
                  variance);
}
#else
// `second`: under AMBIGUITY the highest sample outside the window.
static inline void finish_peak(const Profiles *profiles, const Peak *peak, const Place *found, codes second,
                               constant LineTable *table, const Outputs *to, ulong first, int sample) {
    const Place place = middle_of_wide_top(profiles, peak, *found);
    const ints cut = cut_lanes(profiles, peak) & peak->found;
    ints flags = place.flags | common_flags(profiles, peak->level, peak->not_finite);
    flags |= flag_where(~peak->found, STATUS_LOW_SIGNAL) | flag_where(cut, STATUS_OUT_OF_RANGE);
#ifdef AMBIGUITY
    flags |= flag_where(is_second(profiles, peak, second, table->ambiguous_ratio) & peak->found, STATUS_AMBIGUOUS);
#endif
#ifdef COUNT_WIDTH
    const reals width = run_length(profiles, peak);
#else
    const reals width = 0;
#endif
    const reals total = choose_reals(peak->found, place.total, 0);
#ifdef NOISE
    const reals variance = place.variance;
#else
    const reals variance = 0;
#endif
    store_reading(to, first, sample, to_reals(peak->at) + place.at, peak->level, width, total, flags, variance);
}

// Copy the window of every lane and estimate the position in it, by any of the methods.
static inline Place place_in_window(const Profiles *profiles, Peak *peak, constant LineTable *table) {
    const int reach = radius_of(profiles) + FIR_HALF;
    CODE window[(2 * MAX_REACH + 1) * LANES];
    gather_centred(profiles, peak, reach, window);
#if defined(METHOD_WINDOWED)
    return window_centroid(window, reach, profiles, peak, table);
#elif defined(METHOD_ML)
    return fit_gaussian(window, profiles, peak, table);
#else
    return place_by_points(window, profiles, peak, table);
#endif
}
#endif

#ifdef VECTOR_VARIANT
#include "line/line_strip.h"
#elif !defined(CANDIDATES)
#define TOGETHER
#endif

// The LANES profiles of a frame from profile `sample` on.
static inline Profiles profiles_from(const Profiles *frame, int sample) {
    Profiles profiles = *frame;
    profiles.first += (long)sample * frame->lane_stride;
    return profiles;
}

#ifdef TOGETHER
#include "line/line_group.h"
#endif

// read_frame: read the part of a frame that a work-item processes, one of `items` of the frame. `first` is the element of
// the frame's first profile in the outputs.
#if defined(CANDIDATES)
// LANES profiles, by a walk along them. Work-items beyond the last profile only fill up a work-group.
static inline void read_frame(const Profiles *frame, int item, int items, int samples, constant LineTable *table,
                              const Outputs *to, ulong first, global const real *previous) {
    const int sample = min(item * LANES, samples - LANES);
    if (item * LANES >= samples) return;
    const Profiles profiles = profiles_from(frame, sample);
    ints nearest = -1;
#ifdef SELECT_NEAREST
    const reals before = *(global const reals_at *)(previous + first + sample);
    const ints known = int_mask(before >= 0) & int_mask(before < (real)frame->length);
    nearest = choose_ints(known, to_ints(rint(before)), -1);
#endif
    Peak found = select_peak(&profiles, nearest, (int)table->min_width, (int)table->max_width);
    const Place place = place_in_window(&profiles, &found, table);
    finish_peak(&profiles, &found, &place, highest_outside(&profiles, found.at), table, to, first + sample, sample);
}

#elif defined(TOGETHER)
// All work-items of a group go on together: read_group in line_group.h.

#elif !defined(ALONG_ROWS)
// A strip of columns, in parts of at most MAX_STRIP columns. Memory is read nearly in sequence, while the sums of a
// group of columns stay in registers.
static inline void read_frame(const Profiles *frame, int item, int items, int samples, constant LineTable *table,
                              const Outputs *to, ulong first, global const real *previous) {
    const int strip = ((samples + items - 1) / items + WIDE - 1) / WIDE * WIDE;
    const int begin = item * strip, end = min(begin + strip, samples);
    for (int part = begin; part < end; part += MAX_STRIP) {
        read_strip(frame, part, min(part + MAX_STRIP, end), table, to, first);
    }
}

#else
// 16 rows; the last work-item moves back to end with the last row.
static inline void read_frame(const Profiles *frame, int item, int items, int samples, constant LineTable *table,
                              const Outputs *to, ulong first, global const real *previous) {
    const int sample = min(item * LANES, samples - LANES);
    const Profiles profiles = profiles_from(frame, sample);
    read_rows(&profiles, table, to, first + sample, sample);
}
#endif

kernel void line_readout(global const CODE *restrict frames,
#ifdef SELECT_NEAREST
                         global const real *restrict previous,
#endif
                         global real *restrict position, global real *restrict peak, global real *restrict width,
                         global real *restrict total, global uchar *restrict status, global real *restrict g,
                         global real *restrict h, global real *restrict sigma, global real *restrict sigma_g,
                         global real *restrict sigma_h, global real *restrict systematic_g,
                         global real *restrict systematic_h, const int rows, const int columns, const CODE threshold,
                         const CODE saturation, const CODE minimum, const int radius, constant LineTable *table,
                         constant SheetTable *sheet, global const real *restrict correction TEAM_ARGUMENTS) {
#ifndef SELECT_NEAREST
    global const real *previous = 0;
#endif
#ifdef ALONG_ROWS
    const int samples = rows, length = columns, stride = 1, lane_stride = columns;
#else
    const int samples = columns, length = rows, stride = columns, lane_stride = 1;
#endif
#ifdef TOGETHER
    local Shared shared;
#endif
    FOR_EACH_ITEM(item) {
        const ulong number = item.y, first = number * samples;
        const Profiles frame = {frames + number * rows * columns, stride,  lane_stride, length, threshold,
                                saturation,                       minimum, radius};
        const Outputs to = {position, peak,    width,   total,        status,       g,     h,
                            sigma,    sigma_g, sigma_h, systematic_g, systematic_h, sheet, table,
                            correction, samples};
#ifdef TOGETHER
        read_group(&frame, samples, table, &to, first, &shared);
#else
        read_frame(&frame, item.x, ITEM_COLUMNS, samples, table, &to, first, previous);
#endif
    }
}
