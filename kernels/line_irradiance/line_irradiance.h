// Irradiance of a differential receiver from a diffuse line segment, in closed form.
//
// Coordinates: tau along the segment's line from the foot of the receiver on it; rho, the receiver's distance from the
// line.
#ifndef LINE_IRRADIANCE_H
#define LINE_IRRADIANCE_H
#include "common/lanes.h"

// Polynomial Q in atan(z) = z - z^3 Q(z^2) on [0, 1]; minimax (Remez), error 1.6e-8 in single, 8e-19 in double.
static inline __attribute__((always_inline)) reals LANED(arc_rest)(reals w) {
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

// Function R in 2 atan(t) - sin(2 atan(t)) = t^3 R(t^2) on [0, 1]; single: rational minimax, error 1e-8 and rounding.
static inline __attribute__((always_inline)) reals LANED(arc_less_sine)(reals w) {
#ifdef REAL_IS_DOUBLE
    return (real)2 * ((real)1 / ((real)1 + w) - LANED(arc_rest)(w));
#else
    const reals above = ((reals)0.376253098603f * w + 8.51360014183f) * w + 17.7905860606f;
    return above / (((w + (reals)10.0028032213f) * w + 22.3967422801f) * w + 13.3429394159f);
#endif
}

// Irradiance over exitance, times 2 pi.
//
// tau1, tau2: ends of the segment; length, length2: tau2 - tau1 and its square; height, aside: position of the receiver
// above the lit surface and across the line; by_u: component of the receiver's normal along the line; foot: distance of
// the foot in front of the receiver's plane.
//
// With theta, the angle that the part of the segment in front of the receiver's plane subtends at the receiver, and
// sigma, the sum of the angles of both ends from the foot,
//     2 int (foot + by_u tau) / (tau^2 + rho^2)^2 dtau
//         = foot / rho^3 (theta - sin theta + sin theta (1 + cos sigma)) + by_u / rho^2 sin theta sin sigma.
// Both terms of the bracket are >= 0, and each is computed without a difference: the first from tan(theta / 2), the second
// as sin^2 sigma / (1 - cos sigma) where cos sigma < 0. So one form is accurate near, far and end-on. Products and sums
// determine the cost; current CPUs execute the divisions in parallel.
static inline __attribute__((always_inline)) reals LANED(end_factor)(reals tau1, reals tau2, reals length, reals length2,
                                                             reals height, reals aside, reals by_u, reals foot) {
    const reals zero = (reals)0;
    masks lit = mask_of(height > zero);
    // Distances of the segment's ends in front of the receiver's plane.
    const reals first = foot + by_u * tau1, last = foot + by_u * tau2;
    const reals least = first < last ? first : last;
    if (any_compared(mask_of(least < zero))) {
        const reals most = first < last ? last : first;
        lit &= mask_of(most > zero);
        if (!any_compared(lit)) return zero;
        // Cut at the plane: its position from the foot, the remaining length from the far end; each without a difference.
        const reals cut = -foot / by_u, left = most / fabs(by_u);
        const masks cut_first = mask_of(first < zero), cut_last = mask_of(last < zero);
        const masks is_cut = mask_of(least < zero) & mask_of(left < length);
        length = is_cut ? left : length;
        length2 = is_cut ? left * left : length2;
        tau1 = cut_first ? cut : tau1;
        tau2 = cut_last ? cut : tau2;
    }
    // reach: product of the distances of both ends. sin theta, cos theta, sin sigma, cos sigma times reach are length rho,
    // cosine, sum rho, flat. Sines and tan(theta / 2) are computed over rho, so rho itself (a root) is not needed.
    const reals square = height * height + aside * aside, product = tau1 * tau2, sum = tau1 + tau2;
    const reals cosine = square + product, flat = square - product;
    const reals both = cosine * cosine + length2 * square, reach = sqrt(both);
    const reals tangent = length / (reach + fabs(cosine)), sine = length / both;
    const reals w = tangent * square * tangent, wide = reach + fabs(flat);
    // reach (1 + cos sigma), and the same for theta - sin theta
    const reals above = flat < zero ? sum * sum * square / wide : wide;
    reals cube = tangent * w, bracket = sine * above;
    if (any_compared(mask_of(cosine < zero))) {
        const masks obtuse = mask_of(cosine < zero);
        const reals turn = (real)3.14159265358979323846 / sqrt(square) - (real)2 * (reach * sine);
        bracket = obtuse ? bracket + turn : bracket;
        cube = obtuse ? -cube : cube;
    }
    bracket += cube * LANED(arc_less_sine)(w);
    const reals integral = by_u * sum * sine + foot / square * bracket;
    // Rounding can make the result negative at the horizon; clamp it.
    return zero_where(~lit, (integral > zero ? integral : zero) * height);
}

// The same for the receiver's position along the line from its start, and the distance from there to its end.
static inline __attribute__((always_inline)) reals LANED(line_factor)(reals along, reals height, reals aside, reals end,
                                                              reals whole, reals by_u, reals by_n, reals by_w) {
    return LANED(end_factor)(-along, end, whole, whole * whole, height, aside, by_u, -(by_n * height + by_w * aside));
}

#endif
