// Irradiance of a receiver from a diffuse line segment, in the segment's own frame: lengths along it (tau), and the
// distance rho of the receiver from its line. All in units of rho, so it is free of scale.
#ifndef LINE_IRRADIANCE_H
#define LINE_IRRADIANCE_H
#include "lanes.h"

// Q of atan(z) = z - z^3 Q(z^2) on [0, 1], minimax: to 1.6e-8 in single, 8e-19 in double.
__attribute__((always_inline)) inline reals LANED(arc_rest)(reals w) {
#ifdef REAL_IS_DOUBLE
    reals rest = (reals)-7.76762433028991855e-6;
    rest = rest * w + 0.0000937118634505262543;
    rest = rest * w - 0.000537683929739624472;
    rest = rest * w + 0.0019612554271685326;
    rest = rest * w - 0.00514091285674693872;
    rest = rest * w + 0.0104121532603592415;
    rest = rest * w - 0.0171839817221133481;
    rest = rest * w + 0.0241913458101407186;
    rest = rest * w - 0.0303307192657905066;
    rest = rest * w + 0.0352713310668712941;
    rest = rest * w - 0.0393868754079863213;
    rest = rest * w + 0.0433065384306706625;
    rest = rest * w - 0.0475808008363782062;
    rest = rest * w + 0.0526249222902567531;
    rest = rest * w - 0.0588226441677644883;
    rest = rest * w + 0.0666665793457376784;
    rest = rest * w - 0.0769230707882702926;
    rest = rest * w + 0.0909090906193527995;
    rest = rest * w - 0.111111111102682973;
    rest = rest * w + 0.142857142857012333;
    rest = rest * w - 0.199999999999999193;
    return rest * w + 0.333333333333333333;
#else
    reals rest = (reals)0.00238699731672411321f;
    rest = rest * w - 0.0135077714270205354f;
    rest = rest * w + 0.035871538982043358f;
    rest = rest * w - 0.0625016944474956315f;
    rest = rest * w + 0.0865688043015452147f;
    rest = rest * w - 0.110337641153134553f;
    rest = rest * w + 0.142785687482106019f;
    rest = rest * w - 0.199997393298355797f;
    return rest * w + 0.333333317330635198f;
#endif
}

// Twice the integral of (offset + slope y) / (1 + y^2)^2 dy, y from y1 to y2; `step` is y2 - y1, and they are not both
// more than 1 or both less than -1: the usual form, of differences that do not cancel.
__attribute__((always_inline)) inline reals LANED(line_closed_form)(reals y1, reals y2, reals step, reals offset,
                                                                   reals slope) {
    const reals product = y1 * y2, cosine = (real)1 + product, size = fabs(cosine);
    const reals weight = step / (((real)1 + y1 * y1) * ((real)1 + y2 * y2));
    // atan(y2) - atan(y1)
    const masks steep = mask_of(step > size);
    const reals ratio = (steep ? size : step) / (steep ? step : size), square = ratio * ratio;
    const reals low = ratio - ratio * square * LANED(arc_rest)(square);
    const reals half_turn = steep ? (reals)(real)1.57079632679489661923 - low : low;
    const reals turn = cosine < (reals)(real)0 ? (reals)(real)3.14159265358979323846 - half_turn : half_turn;
    return offset * (((real)1 - product) * weight + turn) + slope * ((y1 + y2) * weight);
}

// The same where both are more than 1 in size, on one side, and that form loses its digits: in z = 1 / y its terms are
// equal but for the third order, which is what counts.
__attribute__((always_inline)) inline reals LANED(line_end_on)(reals y1, reals y2, reals step, reals offset,
                                                              reals slope) {
    const reals inverse = (real)1 / (y1 * y2), z1 = y2 * inverse, z2 = y1 * inverse;
    const reals square1 = z1 * z1, square2 = z2 * z2, sum1 = (real)1 + square1, sum2 = (real)1 + square2;
    const reals both = (real)1 / (sum1 * sum2);
    const reals level = z1 * square1 * (sum2 * both - LANED(arc_rest)(square1)) -
                        z2 * square2 * (sum1 * both - LANED(arc_rest)(square2));
    return offset * level + slope * (step * square1) * ((y1 + y2) * square2) * both;
}

// The same by Gauss and Legendre, for pieces that are short beside their distance, where the closed form cancels;
// `first` is offset + slope y1, exactly zero at a horizon.
__attribute__((always_inline)) inline reals LANED(line_quadrature)(reals start, reals step, reals first, reals slope) {
#ifdef REAL_IS_DOUBLE
#define LINE_NODES 6
    const real nodes[LINE_NODES] = {0.033765242898423986, 0.16939530676686774, 0.38069040695840155,
                                    0.61930959304159845, 0.83060469323313226, 0.96623475710157601};
    const real weights[LINE_NODES] = {0.085662246189585173, 0.18038078652406930, 0.23395696728634552,
                                      0.23395696728634552, 0.18038078652406930, 0.085662246189585173};
#else
#define LINE_NODES 4
    const real nodes[LINE_NODES] = {0.069431844202973712f, 0.33000947820757187f, 0.66999052179242813f,
                                    0.93056815579702629f};
    const real weights[LINE_NODES] = {0.17392742256872693f, 0.32607257743127307f, 0.32607257743127307f,
                                      0.17392742256872693f};
#endif
    reals sum = (reals)0;
#pragma unroll
    for (int k = 0; k < LINE_NODES; k++) {
        const reals on = step * nodes[k], y = start + on, fall = (real)1 / ((real)1 + y * y);
        sum += weights[k] * (first + slope * on) * fall * fall;
    }
    return (real)2 * step * sum;
}

// From four times its length on a piece is short beside its distance. Either form is good there: 4 nodes leave 2e-9, 6
// nodes 3e-14, and the closed form loses a factor of 12 at most.
#define LINE_FAR ((real)16)

// Irradiance over exitance, times 2 pi. `along` is where the receiver stands along the line, `height` above the lit
// surface, `aside` across it; (by_u, by_n, by_w) its normal in that frame.
__attribute__((always_inline)) inline reals LANED(line_factor)(reals along, reals height, reals aside, reals end,
                                                              reals whole, reals by_u, reals by_n, reals by_w) {
    const reals zero = (reals)0;
    const reals rho = sqrt(height * height + aside * aside), per = (real)1 / rho;
    // How far before the receiver's plane the foot of the line is, and the segment's ends.
    const reals foot = -(by_n * height + by_w * aside);
    reals tau1 = -along, tau2 = end, length = whole;
    reals first = foot + by_u * tau1;
    const reals last = foot + by_u * tau2;
    const masks cut_first = mask_of(first < zero), cut_last = mask_of(last < zero);
    const masks lit = mask_of(height > zero) & ~(cut_first & cut_last);
    if (!any_lane(lit)) return zero;
    if (any_lane(lit & (cut_first | cut_last))) {
        // The cut from the foot, where both are near; what is left from the end, where it is little.
        const reals steps = (real)1 / by_u, cut = -foot * steps;
        const reals left = min((cut_first ? last : first) * fabs(steps), length);
        length = cut_first | cut_last ? left : length;
        tau1 = cut_first ? cut : tau1;
        tau2 = cut_last ? cut : tau2;
        first = cut_first ? zero : first;
    }
    const reals y1 = tau1 * per, y2 = tau2 * per, step = length * per;
    const reals beyond = max(max(y1, -y2), zero);
    const masks far = lit & mask_of((real)1 + beyond * beyond >= LINE_FAR * step * step);
    const masks end_on = lit & ~far & mask_of(beyond > (reals)(real)1);
    reals integral = zero;
    if (any_lane(lit & ~far & ~end_on)) integral = LANED(line_closed_form)(y1, y2, step, foot * per, by_u);
    if (any_lane(end_on)) {
        const reals beside = LANED(line_end_on)(y1, y2, step, foot * per, by_u);
        integral = end_on ? beside : integral;
    }
    if (any_lane(far)) {
        const reals few = LANED(line_quadrature)(y1, step, first * per, by_u);
        integral = far ? few : integral;
    }
    // Rounding may leave less than nothing at the horizon.
    integral = max(integral, zero) * (height * per) * per;
    return zero_where(~lit, integral);
}

#endif
