// A light position on the sensor -> a point in the sheet of light, by a plane-plane homography in displacement form:
//
//     x = (position - x0) sx,  y = (sample - y0) sy           about -1 .. 1; then the lens, where there is one
//     w = 1 + dx x + dy y                                     the denominator, 1 in the middle of the sensor
//     G = g0 + gx p + gy q,  H = h0 + hx p + hy q             with p = x/w, q = y/w
//
// The host folds everything else into these numbers in double, with origins and scales as the device's real type
// holds them: a single-precision result is a few roundings away from the double one. The table is
// Triangulation.packed in triangulation.py.
#ifndef SHEET_H
#define SHEET_H

#include "common/lanes.h"
#include "common/lens.h"
#include "common/status.h"

#define SHEET_POSITION_ORIGIN 0
#define SHEET_POSITION_SCALE 1
#define SHEET_SAMPLE_ORIGIN 2
#define SHEET_SAMPLE_SCALE 3
#define SHEET_HORIZON 4
#define SHEET_W_TERMS 5
#define SHEET_G_TERMS 7
#define SHEET_H_TERMS 10
#define SHEET_LENS 13
#define SHEET_FACTOR_G 18
#define SHEET_FACTOR_H 33

// Squared distance, in half the sensor's extent, from which a coordinate counts as not finite: nothing below
// overflows, and one comparison of bits finds what is larger, infinite or NaN.
#define SHEET_REACH as_bits((real)1e12)

// Where a light position lies, undistorted and conditioned; returns its squared distance from the lens' centre, or from
// the middle of the sensor.
inline reals LANED(sheet_place)(reals position, reals sample, constant real *sheet, reals *x, reals *y) {
    *x = (position - sheet[SHEET_POSITION_ORIGIN]) * sheet[SHEET_POSITION_SCALE];
    *y = (sample - sheet[SHEET_SAMPLE_ORIGIN]) * sheet[SHEET_SAMPLE_SCALE];
#ifdef LENS
    return LANED(lens_straighten)(x, y, sheet + SHEET_LENS);
#else
    return *x * *x + *y * *y;
#endif
}

// Writes G and H (NaN where the status is not 0) and returns the status: NOT_FINITE; NOT_INVERTIBLE, beyond the lens' fold;
// HORIZON, the ray does not meet the sheet in front of the sensor, or so far away that the place means nothing.
inline bytes LANED(sheet_point)(reals position, reals sample, constant real *sheet, reals *g, reals *h) {
    constant real *in_w = sheet + SHEET_W_TERMS, *in_g = sheet + SHEET_G_TERMS, *in_h = sheet + SHEET_H_TERMS;
    reals x, y;
    const reals square = LANED(sheet_place)(position, sample, sheet, &x, &y);
    const reals w = 1 + in_w[0] * x + in_w[1] * y;
    const reals p = x / w, q = y / w;
    *g = in_g[0] + (in_g[1] * p + in_g[2] * q);
    *h = in_h[0] + (in_h[1] * p + in_h[2] * q);
    const masks lost = mask_of(as_masks(square) >= SHEET_REACH);
    const masks hidden = mask_of(w <= sheet[SHEET_HORIZON]);
#ifdef LENS
    const masks folded = mask_of(square >= sheet[SHEET_LENS + LENS_FOLD_SQUARE]);
#else
    const masks folded = 0;
#endif
    const masks flagged = lost | hidden | folded;
    bytes status = STATUS_OK;
    // Flags are rare, and telling which costs half as much as the geometry.
    if (any_lane(flagged)) {
        *g = nan_where(flagged, *g);
        *h = nan_where(flagged, *h);
        const masks which = (folded & STATUS_NOT_INVERTIBLE) | (~folded & hidden & STATUS_HORIZON);
        status = convert_bytes((lost & STATUS_NOT_FINITE) | (~lost & which));
    }
    return status;
}

// The variance that the parameters' covariance brings in: |factor' d|^2, d = (1, p, q, -r p, -r q), r = value - value0.
inline reals LANED(sheet_parameter_variance)(constant real *factor, reals p, reals q, reals r) {
    const reals first = factor[0] + factor[1] * p + factor[2] * q - r * (factor[3] * p + factor[4] * q);
    const reals second = factor[5] * p + factor[6] * q - r * (factor[7] * p + factor[8] * q);
    const reals third = factor[9] * q - r * (factor[10] * p + factor[11] * q);
    const reals fourth = r * (factor[12] * p + factor[13] * q), fifth = r * factor[14] * q;
    return first * first + second * second + third * third + fourth * fourth + fifth * fifth;
}

// Standard deviation of G or H (its terms and factor) at (p, q) with denominator w, for conditioned sigma_x, sigma_y.
inline reals LANED(sheet_sigma_of)(constant real *terms, constant real *factor, reals measured_x, reals measured_y,
                                   reals p, reals q, reals w, reals sigma_x, reals sigma_y, constant real *sheet) {
    const reals offset = terms[1] * p + terms[2] * q;
    reals slope_x = (terms[1] - offset * sheet[SHEET_W_TERMS]) / w;
    reals slope_y = (terms[2] - offset * sheet[SHEET_W_TERMS + 1]) / w;
#ifdef LENS
    LANED(lens_pull_back)(measured_x, measured_y, sheet + SHEET_LENS, &slope_x, &slope_y);
#endif
    slope_x *= sigma_x;
    slope_y *= sigma_y;
    reals variance = slope_x * slope_x + slope_y * slope_y;
#ifdef SHEET_COVARIANCE
    variance += LANED(sheet_parameter_variance)(factor, p, q, offset);
#endif
    return sqrt(variance);
}

// Standard deviations of G and H for independent ones of position and sample, by the gradients at the point; the
// parameters' own covariance is added under SHEET_COVARIANCE. Means nothing where sheet_point flags the point.
inline void LANED(sheet_sigma)(reals position, reals sample, reals sigma_position, reals sigma_sample,
                               constant real *sheet, reals *sigma_g, reals *sigma_h) {
    reals x, y;
    LANED(sheet_place)(position, sample, sheet, &x, &y);
    const reals w = 1 + sheet[SHEET_W_TERMS] * x + sheet[SHEET_W_TERMS + 1] * y;
    const reals p = x / w, q = y / w;
    const reals measured_x = (position - sheet[SHEET_POSITION_ORIGIN]) * sheet[SHEET_POSITION_SCALE];
    const reals measured_y = (sample - sheet[SHEET_SAMPLE_ORIGIN]) * sheet[SHEET_SAMPLE_SCALE];
    const reals sigma_x = sigma_position * sheet[SHEET_POSITION_SCALE];
    const reals sigma_y = sigma_sample * sheet[SHEET_SAMPLE_SCALE];
    *sigma_g = LANED(sheet_sigma_of)(sheet + SHEET_G_TERMS, sheet + SHEET_FACTOR_G, measured_x, measured_y, p, q, w,
                                     sigma_x, sigma_y, sheet);
    *sigma_h = LANED(sheet_sigma_of)(sheet + SHEET_H_TERMS, sheet + SHEET_FACTOR_H, measured_x, measured_y, p, q, w,
                                     sigma_x, sigma_y, sheet);
}

#endif
