// The window of samples around the peak, and the centre of gravity in it.
#ifndef LINE_WINDOW_H
#define LINE_WINDOW_H

#include "line/line_peak.h"

#define WINDOW (2 * RADIUS + 1)

typedef struct {
    reals at;     // position relative to the peak
    reals total;  // light over the threshold in the window
    ints flags;
} Place;

// Copies [peak - reach, peak + reach] of every lane side by side; beyond the border its last sample is repeated.
inline void gather(const Profiles *profiles, ints peak, int reach, CODE *window) {
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

inline codes window_level(const CODE *window, int k) { return *(const codes_at *)(window + k * LANES); }

// Counts flat tops that reach beyond the window to their ends.
inline void follow_tops(const Profiles *profiles, Peak *peak) {
    int at[LANES], top[LANES];
    CODE level[LANES];
    *(ints_at *)at = peak->at;
    *(ints_at *)top = peak->top & peak->found;
    *(codes_at *)level = peak->level;
    for (int lane = 0; lane < LANES; lane++) {
        if (top[lane] <= RADIUS) continue;
        global const CODE *profile = profiles->first + (long)lane * profiles->lane_stride;
        int end = at[lane] + top[lane];
        while (end < profiles->length && profile[(long)end * profiles->stride] == level[lane]) end++;
        top[lane] = end - at[lane];
    }
    peak->top = *(const ints_at *)top;
}

// Moves peaks from the first sample of their flat top to its middle; returns whether any moved.
inline int centre_top(const Profiles *profiles, Peak *peak) {
    if (any_lane(INT_MASK(peak->top > RADIUS) & peak->found)) follow_tops(profiles, peak);
    const ints shift = ((peak->top - 1) >> 1) & peak->found;
    peak->at += shift;
    return any_lane(INT_MASK(shift > 0));
}

// Gathers the window about the middle of the peak's flat top, to which the peak moves.
inline void settle(const Profiles *profiles, Peak *peak, int reach, CODE *window) {
    gather(profiles, peak->at, reach, window);
    ints run = -1;
    peak->top = 0;
    for (int k = 0; k <= RADIUS; k++) {
        run &= CODE_MASK(window_level(window, k + reach) == peak->level) & INT_MASK(peak->at + k < profiles->length);
        peak->top -= run;
    }
    if (centre_top(profiles, peak)) gather(profiles, peak->at, reach, window);
}

// Lanes where the border cuts the window, or a flat top wider than it.
inline ints cut_lanes(const Profiles *profiles, const Peak *peak) {
    const ints begin = peak->at - ((peak->top + 1) >> 1), end = peak->at + (peak->top >> 1) + 1;
    return INT_MASK(peak->at < RADIUS) | INT_MASK(peak->at + RADIUS >= profiles->length) |
           (INT_MASK(peak->top > WINDOW) & (INT_MASK(begin < 0) | INT_MASK(end >= profiles->length)));
}

// A flat top wider than the window hides all that the methods go by: its middle, flagged as AMBIGUOUS.
inline Place middle_of_wide_top(const Peak *peak, Place place) {
    const ints wide = INT_MASK(peak->top > WINDOW) & peak->found;
    place.at = choose_reals(wide, to_reals((peak->top - 1) & 1) / 2, place.at);
    place.flags = choose_ints(wide, STATUS_AMBIGUOUS, place.flags);
    return place;
}

// Centre of gravity about the middle of the window; what gather() repeated beyond the border is no light.
inline Place window_gravity(const CODE *window, int reach, const Profiles *profiles, const Peak *peak) {
    reals total = 0, moment = 0;
    for (int k = -RADIUS; k <= RADIUS; k++) {
        const ints inside = INT_MASK(as_uints(peak->at + k) < (uints)profiles->length);
        const reals v = choose_reals(inside, over_threshold(window_level(window, k + reach), profiles->threshold), 0);
        total += v;
        moment += v * (real)k;
    }
    Place place;
    place.at = moment / total;
    place.total = total;
    place.flags = 0;
    return place;
}

#ifdef WITH_LIT
// Samples in the run over the threshold that holds the peak.
inline reals run_length(const Profiles *profiles, const Peak *peak) {
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
