// Places from a few samples about the peak: three logarithms, or the zero crossing of a derivative filter.
#ifndef LINE_POINTS_H
#define LINE_POINTS_H

#include "line/line_window.h"

inline reals over_at(const CODE *window, int k, CODE threshold) {
    return over_threshold(window_level(window, k + REACH), threshold);
}

#ifdef METHOD_GAUSS3
// The logarithm of a Gaussian is a parabola, here through the peak and its neighbours. Both must have light. Where the
// three do not bend down (a flat top) or put the summit beyond them, the middle of the top stands in.
inline Place place_by_points(const CODE *window, const Profiles *profiles, const Peak *peak) {
    const reals a = over_at(window, -1, profiles->threshold), b = over_at(window, 0, profiles->threshold);
    const reals c = over_at(window, 1, profiles->threshold);
    const ints lit = REAL_MASK(a > 0) & REAL_MASK(c > 0);
    const reals log_a = log(a), log_c = log(c), bend = log_a - 2 * log(b) + log_c;
    const reals summit = (log_a - log_c) / (2 * bend);
    const ints good = REAL_MASK(bend < 0) & REAL_MASK(fabs(summit) <= 1);
    Place place = window_gravity(window, REACH, profiles, peak);
    place.at = choose_reals(good, summit, to_reals((peak->top - 1) & 1) / 2);
    place.flags = flag_where(~lit & peak->found, STATUS_LOW_SIGNAL) | flag_where(lit & ~good, STATUS_AMBIGUOUS);
    return place;
}
#endif

#ifdef METHOD_FIR
// Sum of the FIR_HALF samples before k less those after it: it rises through zero where the light balances.
inline reals balance(const CODE *window, int k) {
    reals sum = 0;
    for (int i = 1; i <= FIR_HALF; i++) {
        sum += to_reals(window_level(window, k - i + REACH)) - to_reals(window_level(window, k + i + REACH));
    }
    return sum;
}

// The zero crossing nearest to the peak, linear between samples (F. Blais and M. Rioux, 1986). On a flat top the
// balance stays at zero: the middle between where it gets there and where it leaves.
inline Place place_by_points(const CODE *window, const Profiles *profiles, const Peak *peak) {
    reals reached = 2 * RADIUS, left = 2 * RADIUS, before = balance(window, -RADIUS);
    for (int k = -RADIUS; k < RADIUS; k++) {
        const reals after = balance(window, k + 1);
        const reals here = k + before / (before - after);
        const ints reaches = REAL_MASK(before < 0) & REAL_MASK(after >= 0) & REAL_MASK(fabs(here) < fabs(reached));
        const ints leaves = REAL_MASK(before <= 0) & REAL_MASK(after > 0) & REAL_MASK(fabs(here) < fabs(left));
        reached = choose_reals(reaches, here, reached);
        left = choose_reals(leaves, here, left);
        before = after;
    }
    Place place = window_gravity(window, REACH, profiles, peak);
    place.at = (reached + left) / 2;
    place.flags = flag_where((REAL_MASK(reached > RADIUS) | REAL_MASK(left > RADIUS)) & peak->found, STATUS_LOW_SIGNAL);
    return place;
}
#endif

#endif
