// Lens of the camera: features in the measured (distorted) image, and measured displacements in the undistorted image.
//
// The view of the board (feature_view.h) is straight: its pixels are undistorted. A feature is placed at the measured
// pixel of its undistorted one. The edge coordinate n . u (n: normal, u: undistorted pixel) has the gradient J^T n in the
// measured image, J = d(undistorted) / d(measured): a caliper (ruler) runs along this gradient, at right angles to the
// image of its edge.
//
// A displacement d in the measured image moves n . u by the integral of (J^T n) . d along d, by two points of
// Gauss-Legendre: exact for gradients that are cubic along d (k1, k2 of lens.h along a radius: quadratic, quartic). The
// integral keeps the digits of a small displacement; the difference of two undistorted pixels loses them in single
// precision.
//
// All functions take LANES features side by side. Positions are pixels of the full image.
// Options: LENS (common/lens.h) or CAMERA (common/camera.h) with CAMERA_STEPS; either defines FEATURE_LENS here.
// Tables:  distortion: undistorted -> measured; correction: measured -> undistorted. A Lens has one table for both.
#ifndef FEATURE_LENS_H
#define FEATURE_LENS_H

#include "common/camera.h"
#include "common/lens.h"
#include "feature_pose/feature_view.h"

#if defined(LENS) || defined(CAMERA)
#define FEATURE_LENS

// Load a number of LANES features, `stride` numbers apart, from feature i on; the last feature fills the lanes past it.
static inline reals gather_lanes(global const real *numbers, int stride, int i, int count) {
    real lanes[LANES];
    for (int k = 0; k < LANES; k++) lanes[k] = numbers[stride * min(i + k, count - 1)];
    return *(private const reals_at *)lanes;
}

static inline void scatter_lanes(reals value, global real *numbers, int stride, int i, int count) {
    real lanes[LANES];
    *(private reals_at *)lanes = value;
    for (int k = 0; k < LANES && i + k < count; k++) numbers[stride * (i + k)] = lanes[k];
}

// Value of the first lane.
static inline real first_lane(reals value) {
    real lanes[LANES];
    *(private reals_at *)lanes = value;
    return lanes[0];
}

static inline real sum_lanes(reals values) {
    real lanes[LANES], sum = 0;
    *(private reals_at *)lanes = values;
    for (int k = 0; k < LANES; k++) sum += lanes[k];
    return sum;
}

// Move undistorted pixels to the measured image: NaN where the lens has no image of them (past its fold).
static inline void distort_feature(reals *x, reals *y, constant real *distortion) {
#ifdef CAMERA
    const masks folded = LANED(camera_distort)(x, y, distortion);
#else
    const masks folded = LANED(lens_distort)(x, y, distortion);
#endif
    *x = nan_where(folded, *x);
    *y = nan_where(folded, *y);
}

// Change a gradient over undistorted pixels to the gradient over measured pixels, at measured pixels; NaN past the fold.
static inline void pull_back_slope(reals x, reals y, constant real *correction, reals *slope_x, reals *slope_y) {
#ifdef CAMERA
    reals back_x, back_y;
    const masks folded = LANED(camera_correction)(x, y, correction, &back_x, &back_y);
    *slope_x *= correction[CAMERA_FOCAL_X];
    *slope_y *= correction[CAMERA_FOCAL_Y];
    LANED(camera_pull_back)(x, y, back_x, back_y, correction, slope_x, slope_y);
    *slope_x *= correction[CAMERA_PER_X];
    *slope_y *= correction[CAMERA_PER_Y];
#else
    LANED(lens_pull_back)(x, y, correction, slope_x, slope_y);
    const masks folded = mask_of(LANED(lens_undistort)(&x, &y, correction));
#endif
    *slope_x = nan_where(folded, *slope_x);
    *slope_y = nan_where(folded, *slope_y);
}

// Displacement along the normal (normal_x, normal_y) in the undistorted image, for a displacement from (x, y) in the
// measured image.
static inline reals undistorted_offset(reals x, reals y, reals move_x, reals move_y, reals normal_x, reals normal_y,
                                       constant real *correction) {
    reals offset = 0;
    for (int k = 0; k < 2; k++) {
        const real part = k ? (real)0.788675135f : (real)0.211324865f; // 1/2 +- 1/sqrt(12)
        reals slope_x = normal_x, slope_y = normal_y;
        pull_back_slope(x + part * move_x, y + part * move_y, correction, &slope_x, &slope_y);
        offset += slope_x * move_x + slope_y * move_y;
    }
    return offset * (real)0.5f;
}

// Move LANES placed rulers from ruler i on to the measured image: centre, direction, limits of the spacing.
static inline void distort_rulers(global real *placed, int i, int count, real left, real top, constant real *distortion,
                                  constant real *correction) {
    reals x = gather_lanes(placed, 7, i, count) + left, y = gather_lanes(placed + 1, 7, i, count) + top;
    reals cosine = gather_lanes(placed + 2, 7, i, count), sine = gather_lanes(placed + 3, 7, i, count);
    distort_feature(&x, &y, distortion);
    pull_back_slope(x, y, correction, &cosine, &sine);
    const reals per = 1 / sqrt(cosine * cosine + sine * sine); // measured pixels of one undistorted pixel
    scatter_lanes(x - left, placed, 7, i, count);
    scatter_lanes(y - top, placed + 1, 7, i, count);
    scatter_lanes(cosine * per, placed + 2, 7, i, count);
    scatter_lanes(sine * per, placed + 3, 7, i, count);
    scatter_lanes(gather_lanes(placed + 5, 7, i, count) * per, placed + 5, 7, i, count);
    scatter_lanes(gather_lanes(placed + 6, 7, i, count) * per, placed + 6, 7, i, count);
}

// Jacobian d(undistorted) / d(measured) at a measured pixel.
typedef struct {
    real xx, xy, yx, yy;
} lens_slopes;

static inline lens_slopes slopes_at(real x, real y, constant real *correction) {
    reals xx = 1, xy = 0, yx = 0, yy = 1;
    pull_back_slope(x, y, correction, &xx, &xy);
    pull_back_slope(x, y, correction, &yx, &yy);
    return (lens_slopes){first_lane(xx), first_lane(xy), first_lane(yx), first_lane(yy)};
}

// Move a placed fiducial (x, y, radius) to the measured image.
//
// The image of a circle is no circle, and its centre is not the image of the centre: the lens m shifts it by R^2/8
// (Laplacian m + 2 grad div m), 0.05 px for R = 8 px, k1 = -0.2, f = 220 px at 60 px from the centre. The measurement fits
// a circle to the contour; so does this function, by the mean and the first harmonic of the radii of 16 points.
#define CONTOUR_POINTS 16
static inline void distort_fiducial(global real *placed, real left, real top, constant real *distortion) {
    const real x = placed[0] + left, y = placed[1] + top, per_point = (real)1 / CONTOUR_POINTS;
    reals middle_x = x, middle_y = y, radius = 0, shift_x = 0, shift_y = 0;
    distort_feature(&middle_x, &middle_y, distortion);
    for (int k = 0; k < CONTOUR_POINTS; k += LANES) {
        const reals angle = to_reals(k + LANE_NUMBERS) * (2 * (real)3.14159265f * per_point);
        const reals cosine = cos(angle), sine = sin(angle);
        reals point_x = x + placed[2] * cosine, point_y = y + placed[2] * sine;
        distort_feature(&point_x, &point_y, distortion);
        const reals reach = (point_x - middle_x) * cosine + (point_y - middle_y) * sine;
        radius += reach;
        shift_x += 2 * reach * cosine;
        shift_y += 2 * reach * sine;
    }
    placed[0] = first_lane(middle_x) - left + sum_lanes(shift_x) * per_point;
    placed[1] = first_lane(middle_y) - top + sum_lanes(shift_y) * per_point;
    placed[2] = sum_lanes(radius) * per_point;
}

#endif
#endif
