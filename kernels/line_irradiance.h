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

// One end of the segment at tau.
typedef struct {
    masks steep;  // |tau| > rho
    reals ratio;  // tau / rho, or where steep rho / tau: in [-1, 1]
    reals fall;   // 1 / (1 + ratio^2)
    reals part;   // integral of dy / (1 + y^2)^2 from 0 to tau / rho, or where steep from there to infinity
} LANED(LineEnd);

__attribute__((always_inline)) inline LANED(LineEnd) LANED(line_end)(reals tau, reals rho) {
    LANED(LineEnd) end;
    end.steep = mask_of(fabs(tau) > rho);
    end.ratio = (end.steep ? rho : tau) / (end.steep ? tau : rho);
    const reals w = end.ratio * end.ratio, rest = LANED(arc_rest)(w);
    end.fall = (real)1 / ((real)1 + w);
    // Where steep both terms of the usual form are ratio / 2 but for the third order, which is what counts there.
    const reals cube = end.ratio * w;
    end.part = (real)0.5 * (end.steep ? cube * (end.fall - rest) : end.ratio - cube * rest + end.ratio * end.fall);
    return end;
}

// Integral of (offset + slope y) / (1 + y^2)^2 dy, y from tau1 / rho to tau2 / rho; `length` is tau2 - tau1.
__attribute__((always_inline)) inline reals LANED(line_closed_form)(reals tau1, reals tau2, reals length, reals rho,
                                                                   reals offset, reals slope) {
    const LANED(LineEnd) one = LANED(line_end)(tau1, rho), two = LANED(line_end)(tau2, rho);
    const real quarter_turn = (real)0.78539816339744830962;
    const reals zero = (reals)0;
    const reals to_one = one.steep ? (tau1 < zero ? (reals)-quarter_turn : (reals)quarter_turn) : zero;
    const reals to_two = two.steep ? (tau2 < zero ? (reals)-quarter_turn : (reals)quarter_turn) : zero;
    // The quarters cancel exactly where both ends are steep on one side.
    const reals level = (to_two - to_one) + ((two.steep ? -two.part : two.part) - (one.steep ? -one.part : one.part));
    const reals fall_one = one.steep ? one.ratio * one.ratio * one.fall : one.fall;
    const reals fall_two = two.steep ? two.ratio * two.ratio * two.fall : two.fall;
    const reals tilt = (real)0.5 * ((length / rho) * fall_one) * (((tau1 + tau2) / rho) * fall_two);
    return offset * level + slope * tilt;
}

// The same by Gauss and Legendre, for pieces that are short beside their distance, where the closed form cancels;
// `first` is offset + slope tau1 / rho, exactly zero at a horizon.
__attribute__((always_inline)) inline reals LANED(line_quadrature)(reals tau1, reals length, reals rho, reals first,
                                                                  reals slope) {
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
    const reals start = tau1 / rho, step = length / rho;
    reals sum = (reals)0;
#pragma unroll
    for (int k = 0; k < LINE_NODES; k++) {
        const reals on = step * nodes[k], y = start + on, fall = (real)1 / ((real)1 + y * y);
        sum += weights[k] * (first + slope * on) * fall * fall;
    }
    return step * sum;
}

// From how many times its length on a piece is short beside its distance; squared. Either form is good to a few
// roundings there: 4 nodes leave 4e-7 at 2 lengths, 6 nodes 3e-14 at 4, and the closed form loses a factor of 3 or 6.
#ifdef REAL_IS_DOUBLE
#define LINE_FAR ((real)16)
#else
#define LINE_FAR ((real)4)
#endif

// Irradiance over exitance, times pi. `along` is where the receiver stands along the line, `height` above the lit
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
        const reals cut = -foot / by_u, left = min((cut_first ? last : first) / fabs(by_u), length);
        length = cut_first | cut_last ? left : length;
        tau1 = cut_first ? cut : tau1;
        tau2 = cut_last ? cut : tau2;
        first = cut_first ? zero : first;
    }
    const reals beyond = max(max(tau1, -tau2), zero);
    const masks far = mask_of(rho * rho + beyond * beyond >= LINE_FAR * length * length);
    reals integral = zero;
    if (any_lane(lit & ~far)) integral = LANED(line_closed_form)(tau1, tau2, length, rho, foot * per, by_u);
    if (any_lane(lit & far)) {
        const reals few = LANED(line_quadrature)(tau1, length, rho, first * per, by_u);
        integral = far ? few : integral;
    }
    // Rounding may leave less than nothing at the horizon.
    integral = max(integral, zero) * (height * per) * per;
    return zero_where(~lit, integral);
}

#endif
