// Peak positions from a few samples: parabola through three logarithms (METHOD_GAUSS3), or zero crossing of a
// derivative filter (METHOD_FIR, FIR_HALF samples on either side).
#ifndef LINE_POINTS_H
#define LINE_POINTS_H

#include "line/line_window.h"

#define REACH (RADIUS + FIR_HALF)

// Light of the sample at distance k from the peak.
static inline reals over_at(const CODE *window, int k, CODE threshold) {
    return over_threshold(window_level(window, k + REACH), threshold);
}

#ifdef NOISE
// Variance of a sample: read noise, quantisation and shot noise.
static inline reals sample_variance(codes level, constant LineTable *table) {
    const reals light = to_reals(level);
    return table->noise_variance + table->gain * choose_reals(int_mask(light > 0), light, 0);
}
#endif

#ifdef METHOD_GAUSS3
// The logarithm of a Gaussian is a parabola: fit it to the peak and its two neighbours, which must have light. With
// logarithms a, b, c the vertex is at (a - c) / (2 (a - 2 b + c)). If the parabola does not open downwards (a flat
// top), or its vertex lies beyond the three samples, the position is the middle of the flat top, with AMBIGUOUS.
//
// Noise: with the curvature q = a - 2 b + c and the vertex p, the derivatives of p with respect to a, b and c are
// (1 - 2p) / 2q, 4p / 2q and (-1 - 2p) / 2q; a logarithm has the derivative 1 / light.
static inline Place place_by_points(const CODE *window, const Profiles *profiles, const Peak *peak,
                                    constant LineTable *table) {
    const reals a = over_at(window, -1, profiles->threshold), b = over_at(window, 0, profiles->threshold);
    const reals c = over_at(window, 1, profiles->threshold);
    const ints lit = int_mask(a > 0) & int_mask(c > 0);
    const reals log_a = log(a), log_c = log(c), curvature = log_a - 2 * log(b) + log_c;
    const reals vertex = (log_a - log_c) / (2 * curvature);
    const ints good = int_mask(curvature < 0) & int_mask(fabs(vertex) <= 1);
    Place place = window_centroid(window, REACH, profiles, peak, table);
    place.at = choose_reals(good, vertex, to_reals((peak->top - 1) & 1) / 2);
    place.flags = flag_where(~lit & peak->found, STATUS_LOW_SIGNAL) | flag_where(lit & ~good, STATUS_AMBIGUOUS);
#ifdef NOISE
    const reals by_a = (1 - 2 * vertex) / a, by_b = 4 * vertex / b, by_c = (1 + 2 * vertex) / c;
    const reals noise = by_a * by_a * sample_variance(window_level(window, REACH - 1), table) +
                        by_b * by_b * sample_variance(window_level(window, REACH), table) +
                        by_c * by_c * sample_variance(window_level(window, REACH + 1), table);
    place.variance = nan_where(to_masks(~good), noise / (4 * curvature * curvature));
#endif
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

#ifdef NOISE
// Variance of a zero crossing k + t between samples k and k + 1 of the window. It is sum w_j^2 variance_j / slope^2,
// where w_j = (1 - t) c(j - k) + t c(j - k - 1) with the coefficients c of the filter: 1 before its middle, -1 after it.
static inline reals crossing_variance(const CODE *window, int k, reals t, reals slope, constant LineTable *table) {
    reals noise = 0;
    for (int j = -FIR_HALF; j <= FIR_HALF + 1; j++) {
        const real here = j < 0 ? 1 : j == 0 || j > FIR_HALF ? 0 : -1;
        const real next = j == -FIR_HALF || j == 1 ? 0 : j < 1 ? 1 : -1;
        const reals weight = here + t * (next - here);
        noise += weight * weight * sample_variance(window_level(window, k + j + REACH), table);
    }
    return noise / (slope * slope);
}
#endif

// Zero crossing of the filter nearest to the peak, linear between samples (F. Blais and M. Rioux, Real-time numerical
// peak detector, Signal Processing 11, 1986). On a flat top the filter stays at zero: take the middle between the place
// where it reaches zero and the place where it leaves zero.
static inline Place place_by_points(const CODE *window, const Profiles *profiles, const Peak *peak,
                                    constant LineTable *table) {
    reals reached = 2 * RADIUS, left = 2 * RADIUS, before = derivative(window, -RADIUS);
#ifdef NOISE
    reals variance = 0;
#endif
    for (int k = -RADIUS; k < RADIUS; k++) {
        const reals after = derivative(window, k + 1);
        const reals here = k + before / (before - after);
        const ints reaches = int_mask(before < 0) & int_mask(after >= 0) & int_mask(fabs(here) < fabs(reached));
        const ints leaves = int_mask(before <= 0) & int_mask(after > 0) & int_mask(fabs(here) < fabs(left));
        reached = choose_reals(reaches, here, reached);
        left = choose_reals(leaves, here, left);
#ifdef NOISE
        if (any_lane(to_masks(reaches))) {
            const reals here_variance = crossing_variance(window, k, here - (real)k, after - before, table);
            variance = choose_reals(reaches, here_variance, variance);
        }
#endif
        before = after;
    }
    Place place = window_centroid(window, REACH, profiles, peak, table);
    place.at = (reached + left) / 2;
#ifdef NOISE
    // On a flat top the reached and the left place differ: no single crossing.
    place.variance = nan_where(to_masks(int_mask(reached != left)), variance);
#endif
    place.flags = flag_where((int_mask(reached > RADIUS) | int_mask(left > RADIUS)) & peak->found, STATUS_LOW_SIGNAL);
    return place;
}
#endif

#endif
