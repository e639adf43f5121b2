// Peak of a profile: its largest sample, or under CANDIDATES the peak of one of its runs of samples above the
// threshold.
//
// Of equally large samples the first one is the peak; centre_top() in line_window.h moves it to the middle of a flat
// top. Build options: CANDIDATES with SELECT_STRONGEST, _FIRST, _LAST or _NEAREST; AMBIGUITY compares a second peak.
#ifndef LINE_PEAK_H
#define LINE_PEAK_H

#include "line/line_profiles.h"

typedef struct {
    ints at;          // index of the peak; arbitrary in lanes without a peak
    codes level;      // sample at the peak; the largest sample in lanes without a peak
    ints found;       // lanes with a peak
    ints not_finite;  // lanes with a sample that is not finite
    ints top;         // samples of the flat top (neighbours equal to the peak); set when the window is read
} Peak;

#ifdef CANDIDATES

// Search over the runs of a profile. A run is a sequence of samples above the threshold.
typedef struct {
    ints at, start, inside;  // current run: index of its peak, its first sample, mask of the lanes inside a run
    codes level;             // sample at the peak of the current run
    ints selected, found;    // index of the selected peak, and the lanes that have one
    codes selected_level;
} RunSearch;

// End the run in the lanes of `closing`: select its peak if it is allowed and better than the peak selected so far.
static inline void close_run(RunSearch *search, const Profiles *profiles, ints closing, int end, ints nearest,
                             int min_width, int max_width) {
    const ints width = end - search->start;
    const ints allowed = int_mask(width >= min_width) & int_mask(width <= max_width);
    const ints fits = allowed & ~dark_lanes(profiles, search->level);
#if defined(SELECT_FIRST)
    const ints better = ~search->found;
#elif defined(SELECT_LAST)
    const ints better = -1;
#elif defined(SELECT_NEAREST)
    const ints stronger = int_mask(search->level > search->selected_level);
    const ints nearer = int_mask(abs(search->at - nearest) < abs(search->selected - nearest));
    const ints better = ~search->found | choose_ints(int_mask(nearest < 0), stronger, nearer);
#else
    const ints better = ~search->found | int_mask(search->level > search->selected_level);
#endif
    const ints take = closing & fits & better;
    search->selected = choose_ints(take, search->at, search->selected);
    search->selected_level = choose_codes(take, search->level, search->selected_level);
    search->found |= take;
}

#ifdef ALONG_ROWS
// Whether one of 16 samples is above the threshold or not finite.
static inline int any_light(CODE16 samples, CODE threshold) {
#if CODE_BITS == 32
    return any(!(samples <= (CODE16)threshold)) || any(samples == (CODE16)DARKEST);
#else
    return any(samples > (CODE16)threshold);
#endif
}

// Skip samples without light, in vectors of 16; return the index of the next sample to examine. Keep the highest of
// them.
static inline int skip_dark(const Profiles *profiles, int k, CODE16 *highest) {
    for (; k + 16 <= profiles->length; k += 16) {
        const CODE16 samples = *(global const code16_at *)(profiles->first + k);
        if (any_light(samples, profiles->threshold)) break;
        *highest = higher_of(samples, *highest);
    }
    return k;
}
#endif

// Walk along the profiles of all lanes and select a peak. Samples that are dark in every lane are skipped.
static inline Peak select_peak(const Profiles *profiles, ints nearest, int min_width, int max_width) {
    RunSearch search;
    search.at = search.start = search.inside = search.selected = search.found = (ints)0;
    search.level = search.selected_level = (codes)DARKEST;
    codes strongest = (codes)DARKEST;
    ints not_finite = 0;
#ifdef ALONG_ROWS
    CODE16 highest = (CODE16)DARKEST;
#endif
    for (int k = 0; k < profiles->length; k++) {
#ifdef ALONG_ROWS
        if (!search.inside) k = min(skip_dark(profiles, k, &highest), profiles->length - 1);
#endif
        const codes x = sample_of(profiles, k);
        not_finite |= not_finite_codes(x);
        strongest = x > strongest ? x : strongest;
        const ints bright = int_mask(x > (codes)profiles->threshold);
        if (!any_int_lane(bright | search.inside)) continue;
        const ints closing = search.inside & ~bright, opening = bright & ~search.inside;
        if (any_int_lane(closing)) close_run(&search, profiles, closing, k, nearest, min_width, max_width);
        search.start = choose_ints(opening, k, search.start);
        const ints higher = opening | (bright & int_mask(x > search.level));
        search.at = choose_ints(higher, k, search.at);
        search.level = choose_codes(higher, x, search.level);
        search.inside = bright;
    }
#ifdef ALONG_ROWS
    strongest = higher_of(strongest, highest_level(highest));
#endif
    close_run(&search, profiles, search.inside, profiles->length, nearest, min_width, max_width);
    Peak peak;
    peak.at = search.selected;
    peak.found = search.found;
    peak.level = choose_codes(search.found, search.selected_level, strongest);
    peak.not_finite = not_finite;
    return peak;
}

#endif

#ifdef AMBIGUITY
// The highest sample outside the window, in every lane.
static inline codes highest_outside(const Profiles *profiles, ints peak) {
#ifdef ALONG_ROWS
    int at[LANES];
    CODE level[LANES];
    *(ints_at *)at = peak;
    for (int lane = 0; lane < LANES; lane++) {
        global const CODE *row = profiles->first + (long)lane * profiles->lane_stride;
        const CODE before = highest_in(row, 0, min(at[lane] - radius_of(profiles), profiles->length));
        level[lane] = higher_of(before, highest_in(row, max(at[lane] + radius_of(profiles) + 1, 0), profiles->length));
    }
    return *(const codes_at *)level;
#else
    codes highest = (codes)DARKEST;
    for (int k = 0; k < profiles->length; k++) {
        const codes x = sample_of(profiles, k);
        const ints outside = int_mask(abs(k - peak) > (uint)radius_of(profiles));
        highest = choose_codes(outside & int_mask(x > highest), x, highest);
    }
    return highest;
#endif
}

// Lanes where the highest sample outside the window has at least `ratio` of the peak's light.
static inline ints is_second(const Profiles *profiles, const Peak *peak, codes highest, real ratio) {
    const reals second = over_threshold(highest, profiles->threshold);
    return int_mask(second > 0) & int_mask(second >= ratio * over_threshold(peak->level, profiles->threshold));
}
#else
static inline codes highest_outside(const Profiles *profiles, ints peak) { return (codes)DARKEST; }
#endif

#endif
