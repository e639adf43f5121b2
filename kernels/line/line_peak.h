// The peak of a profile: the strongest sample, or under CANDIDATES one of the runs of samples over the threshold.
//
// Of samples that tie, the first one is the peak; centre_top() in line_window.h moves it to the middle of a flat top.
#ifndef LINE_PEAK_H
#define LINE_PEAK_H

#include "line/line_profiles.h"

typedef struct {
    ints at;      // its index; any in lanes without one
    codes level;  // the sample there; the strongest sample in lanes without one
    ints found;
    ints lost;    // lanes with a sample that is not finite
    ints top;     // samples of the flat top, neighbours that equal the peak; counted where the window is read
} Peak;

#if CODE_BITS == 32
#define lost_lanes(level) not_finite_lanes(to_reals(level))
#else
#define lost_lanes(level) (ints)0
#endif

#ifdef CANDIDATES

typedef struct {
    ints at, start, run;  // of the run the walk is in: its peak, its first sample, mask of lanes in a run
    codes level;
    ints chosen, found;
    codes chosen_level;
} Choice;

// At the end of a run: is it a candidate, and better than the one chosen so far?
inline void close_run(Choice *choice, const Profiles *profiles, ints closing, int end, ints nearest, int min_width,
                      int max_width) {
    const ints width = end - choice->start;
    const ints allowed = INT_MASK(width >= min_width) & INT_MASK(width <= max_width);
    const ints fits = allowed & ~dark_lanes(profiles, choice->level);
#if defined(SELECT_FIRST)
    const ints better = ~choice->found;
#elif defined(SELECT_LAST)
    const ints better = -1;
#elif defined(SELECT_NEAREST)
    const ints stronger = CODE_MASK(choice->level > choice->chosen_level);
    const ints nearer = INT_MASK(abs(choice->at - nearest) < abs(choice->chosen - nearest));
    const ints better = ~choice->found | choose_ints(INT_MASK(nearest < 0), stronger, nearer);
#else
    const ints better = ~choice->found | CODE_MASK(choice->level > choice->chosen_level);
#endif
    const ints take = closing & fits & better;
    choice->chosen = choose_ints(take, choice->at, choice->chosen);
    choice->chosen_level = choose_codes(take, choice->level, choice->chosen_level);
    choice->found |= take;
}

#ifdef ALONG_ROWS
#if CODE_BITS == 32
#define any_light(x, threshold) (any(!((x) <= (threshold))) || any((x) == (CODE16)DARKEST))
#else
#define any_light(x, threshold) any((x) > (threshold))
#endif

// Passes by 16 samples at a time without light, and keeps the highest of them. A sample that is not finite lights.
inline int pass_dark(const Profiles *profiles, int k, CODE16 *highest) {
    for (; k + 16 <= profiles->length; k += 16) {
        const CODE16 x = *(global const code16_at *)(profiles->first + k);
        if (any_light(x, (CODE16)profiles->threshold)) break;
        *highest = higher_of(x, *highest);
    }
    return k;
}
#endif

// Walks all lanes along their profiles; samples which no lane has over the threshold are passed by quickly.
inline Peak choose_peak(const Profiles *profiles, ints nearest, int min_width, int max_width) {
    Choice choice;
    choice.at = choice.start = choice.run = choice.chosen = choice.found = (ints)0;
    choice.level = choice.chosen_level = (codes)DARKEST;
    codes strongest = (codes)DARKEST;
    ints lost = 0;
#ifdef ALONG_ROWS
    CODE16 highest = (CODE16)DARKEST;
#endif
    for (int k = 0; k < profiles->length; k++) {
#ifdef ALONG_ROWS
        if (!choice.run) k = min(pass_dark(profiles, k, &highest), profiles->length - 1);
#endif
        const codes x = sample_of(profiles, k);
        lost |= lost_lanes(x);
        strongest = x > strongest ? x : strongest;
        const ints bright = CODE_MASK(x > (codes)profiles->threshold);
        if (!any_lane(bright | choice.run)) continue;
        const ints closing = choice.run & ~bright, opening = bright & ~choice.run;
        if (any_lane(closing)) close_run(&choice, profiles, closing, k, nearest, min_width, max_width);
        choice.start = choose_ints(opening, k, choice.start);
        const ints higher = opening | (bright & CODE_MASK(x > choice.level));
        choice.at = choose_ints(higher, k, choice.at);
        choice.level = choose_codes(higher, x, choice.level);
        choice.run = bright;
    }
#ifdef ALONG_ROWS
    strongest = higher_of(strongest, highest_level(highest));
#endif
    close_run(&choice, profiles, choice.run, profiles->length, nearest, min_width, max_width);
    Peak peak;
    peak.at = choice.chosen;
    peak.found = choice.found;
    peak.level = choose_codes(choice.found, choice.chosen_level, strongest);
    peak.lost = lost;
    return peak;
}

#else

// Walks all lanes along their profiles for the strongest sample.
inline Peak strongest_peak(const Profiles *profiles) {
    Peak peak;
    peak.at = peak.lost = (ints)0;
    peak.level = (codes)DARKEST;
    for (int k = 0; k < profiles->length; k++) {
        const codes x = sample_of(profiles, k);
        peak.at = choose_ints(CODE_MASK(x > peak.level), k, peak.at);
        peak.level = x > peak.level ? x : peak.level;
        peak.lost |= lost_lanes(x);
    }
    peak.found = ~dark_lanes(profiles, peak.level);
    return peak;
}

#endif

#ifdef AMBIGUITY
// The highest sample of every lane outside the window.
inline codes highest_outside(const Profiles *profiles, ints peak) {
#ifdef ALONG_ROWS
    int at[LANES];
    CODE level[LANES];
    *(ints_at *)at = peak;
    for (int lane = 0; lane < LANES; lane++) {
        global const CODE *row = profiles->first + (long)lane * profiles->lane_stride;
        const CODE before = highest_in(row, 0, min(at[lane] - RADIUS, profiles->length));
        level[lane] = higher_of(before, highest_in(row, max(at[lane] + RADIUS + 1, 0), profiles->length));
    }
    return *(const codes_at *)level;
#else
    codes highest = (codes)DARKEST;
    for (int k = 0; k < profiles->length; k++) {
        const codes x = sample_of(profiles, k);
        const ints outside = INT_MASK(abs(k - peak) > RADIUS);
        highest = choose_codes(outside & CODE_MASK(x > highest), x, highest);
    }
    return highest;
#endif
}

// Lanes where a sample outside the window is comparable to the peak.
inline ints has_second(const Profiles *profiles, const Peak *peak, real ratio) {
    const reals second = over_threshold(highest_outside(profiles, peak->at), profiles->threshold);
    return REAL_MASK(second > 0) & REAL_MASK(second >= ratio * over_threshold(peak->level, profiles->threshold));
}
#endif

#endif
