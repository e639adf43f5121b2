// Irradiance of a receiver from a diffuse line segment, in the segment's own frame: lengths along it (tau), and the
// distance rho of the receiver from its line.
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

// R of 2 atan(t) - sin(2 atan(t)) = t^3 R(t^2) on [0, 1]: to 1e-7 of t in single.
__attribute__((always_inline)) inline reals LANED(arc_less_sine)(reals w) {
#ifdef REAL_IS_DOUBLE
    return (real)2 * ((real)1 / ((real)1 + w) - LANED(arc_rest)(w));
#else
    reals rest = (reals)0.05120302772f;
    rest = rest * w - 0.2948785707f;
    rest = rest * w + 0.7820229038f;
    rest = rest * w - 1.310448332f;
    rest = rest * w + 1.640203795f;
    rest = rest * w - 1.740863266f;
    rest = rest * w + 1.71000008f;
    rest = rest * w - 1.5997734f;
    return rest * w + 1.333330179f;
#endif
}

// Irradiance over exitance, times 2 pi. `along` is where the receiver stands along the line from its start, `end` what
// is left from there to its end, `height` above the lit surface, `aside` across it; (by_u, by_n, by_w) the receiver's
// normal in that frame.
//
// With theta the angle under which the receiver sees what lies before its plane, sigma the sum of the angles of both
// ends from the foot, and tau1, tau2 these ends, 2 int (foot + by_u tau) / (tau^2 + rho^2)^2 dtau is
//     foot / rho^3 (theta - sin theta + sin theta (1 + cos sigma)) + by_u / rho^2 sin theta sin sigma.
// Neither term of the bracket is negative, and both are had without a difference: the first from tan(theta / 2), the
// second beyond an end as sin^2 sigma / (1 - cos sigma). So one form holds near, far, and end-on.
__attribute__((always_inline)) inline reals LANED(line_factor)(reals along, reals height, reals aside, reals end,
                                                              reals whole, reals by_u, reals by_n, reals by_w) {
    const reals zero = (reals)0, one = (reals)1;
    masks lit = mask_of(height > zero);
    // How far before the receiver's plane the foot of the line is, and the segment's ends.
    const reals foot = -(by_n * height + by_w * aside);
    reals tau1 = -along, tau2 = end, length = whole;
    const reals first = foot + by_u * tau1, last = foot + by_u * tau2;
    const reals least = first < last ? first : last, most = first < last ? last : first;
    if (any_lane(lit & mask_of(least < zero))) {
        lit &= mask_of(most > zero);
        if (!any_lane(lit)) return zero;
        // The cut from the foot, where both are near; what is left from the end, where it is little.
        const reals steps = one / by_u, cut = -foot * steps, left = most * fabs(steps);
        const masks cut_first = mask_of(first < zero), cut_last = mask_of(last < zero);
        length = (mask_of(least < zero) & mask_of(left < length)) ? left : length;
        tau1 = cut_first ? cut : tau1;
        tau2 = cut_last ? cut : tau2;
    }
    // reach: the distances of both ends multiplied. Times it, sin theta, cos theta, sin sigma and cos sigma are span,
    // cosine, (tau1 + tau2) rho and square - product.
    const reals square = height * height + aside * aside, rho = sqrt(square), product = tau1 * tau2;
    const reals span = length * rho, cosine = square + product;
    const reals reach = sqrt(span * span + cosine * cosine), per_reach = one / reach, per_rho = one / rho;
    const reals sine = span * per_reach, sum = tau1 + tau2, flatter = reach + fabs(cosine);
    const reals tangent = span / flatter, w = tangent * tangent, rest = tangent * w * LANED(arc_less_sine)(w);
    // theta - sin theta, and reach (1 + cos sigma)
    reals less_sine = rest, above = reach + square - product;
    const masks odd = mask_of(fabs(product) > square);
    if (any_lane(lit & odd)) {
        const reals across = sum * rho, away = across * across / (reach + (product - square));
        less_sine = cosine < zero ? (real)3.14159265358979323846 - (sine + sine) - rest : rest;
        above = product > square ? away : above;
    }
    const reals both = sine * per_reach;
    const reals level = (foot * per_rho * per_rho) * (less_sine + both * above), slope = by_u * (sum * both);
    // Rounding may leave less than nothing at the horizon.
    const reals integral = level + slope;
    return zero_where(~lit, (integral > zero ? integral : zero) * (height * per_rho));
}

#endif
