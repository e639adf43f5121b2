// Peak positions from a few samples: parabola through three logarithms (METHOD_GAUSS3), or zero crossing of a
// derivative filter (METHOD_FIR, FIR_HALF samples on either side).
#ifndef LINE_POINTS_H
#define LINE_POINTS_H

#include "line/line_window.h"

// Light of the sample at distance k from the peak.
static inline reals over_at(const CODE *window, int k, CODE threshold) {
    return over_threshold(window_level(window, k + REACH), threshold);
}

#ifdef METHOD_GAUSS3
// The logarithm of a Gaussian is a parabola: fit it to the peak and its two neighbours, which must have light. With
// logarithms a, b, c the vertex is at (a - c) / (2 (a - 2 b + c)). If the parabola does not open downwards (a flat
// top), or its vertex lies beyond the three samples, the position is the middle of the flat top, with AMBIGUOUS.
static inline Place place_by_points(const CODE *window, const Profiles *profiles, const Peak *peak) {
    const reals a = over_at(window, -1, profiles->threshold), b = over_at(window, 0, profiles->threshold);
    const reals c = over_at(window, 1, profiles->threshold);
    const ints lit = int_mask(a > 0) & int_mask(c > 0);
    const reals log_a = log(a), log_c = log(c), curvature = log_a - 2 * log(b) + log_c;
    const reals vertex = (log_a - log_c) / (2 * curvature);
    const ints good = int_mask(curvature < 0) & int_mask(fabs(vertex) <= 1);
    Place place = window_centroid(window, REACH, profiles, peak);
    place.at = choose_reals(good, vertex, to_reals((peak->top - 1) & 1) / 2);
    place.flags = flag_where(~lit & peak->found, STATUS_LOW_SIGNAL) | flag_where(lit & ~good, STATUS_AMBIGUOUS);
    return place;
}
#endif

#ifdef METHOD_FIR
// Derivative filter at sample k: the sum of the FIR_HALF samples before k minus the sum of the FIR_HALF samples after
// k. It rises through zero at the peak.
static inline reals derivative(const CODE *window, int k) {
    reals sum = 0;
    for (int i = 1; i <= FIR_HALF; i++) {
        sum += to_reals(window_level(window, k - i + REACH)) - to_reals(window_level(window, k + i + REACH));
    }
    return sum;
}

// Zero crossing of the filter nearest to the peak, linear between samples (F. Blais and M. Rioux, Real-time numerical
// peak detector, Signal Processing 11, 1986). On a flat top the filter stays at zero: take the middle between the place
// where it reaches zero and the place where it leaves zero.
static inline Place place_by_points(const CODE *window, const Profiles *profiles, const Peak *peak) {
    reals reached = 2 * RADIUS, left = 2 * RADIUS, before = derivative(window, -RADIUS);
    for (int k = -RADIUS; k < RADIUS; k++) {
        const reals after = derivative(window, k + 1);
        const reals here = k + before / (before - after);
        const ints reaches = int_mask(before < 0) & int_mask(after >= 0) & int_mask(fabs(here) < fabs(reached));
        const ints leaves = int_mask(before <= 0) & int_mask(after > 0) & int_mask(fabs(here) < fabs(left));
        reached = choose_reals(reaches, here, reached);
        left = choose_reals(leaves, here, left);
        before = after;
    }
    Place place = window_centroid(window, REACH, profiles, peak);
    place.at = (reached + left) / 2;
    place.flags = flag_where((int_mask(reached > RADIUS) | int_mask(left > RADIUS)) & peak->found, STATUS_LOW_SIGNAL);
    return place;
}
#endif

#endif
