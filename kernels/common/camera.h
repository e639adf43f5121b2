// OpenCV's camera model with 14 coefficients, in displacement form.
//
// The ideal position of a point is its image by a pinhole camera; its measured position includes lens distortion and
// the tilt of the sensor:
//
//     x = (column - cx) / f                                  normalised ideal place, y likewise; q = x^2 + y^2
//     bent x - x = x e + q (a0 + a1 q)                       with e = stretch(q) + 2 (p1 y + p2 x),
//     bent y - y = y e + q (b0 + b1 q)                       a0 = p2 + s1, a1 = s2, b0 = p1 + s3, b1 = s4
//     stretch(q) = (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3) - 1
//     measured = H bent                                      tilt of the sensor, a homography that keeps the centre
//
// Only the displacement is computed, and added to the pixel: in single precision its relative error is 1e-6, and the
// pixel keeps its digits. The host computes all constants in double precision.
//
// Options: only terms that are not zero are compiled. CAMERA; CAMERA_RADIAL and CAMERA_RATIONAL: number of coefficients
//          (0 to 3) of k1.. and k4..; CAMERA_DECENTRED: p and s; CAMERA_PRISM: s2 and s4; CAMERA_TILTED;
//          CAMERA_MATRICES: the ideal pixels have another camera matrix; CAMERA_STEPS: Newton steps after which most
//          points have converged (Camera.undistort_defines); it compiles camera_undistort. CAMERA_SURE: the host has
//          verified that these steps, possibly 0, are enough on a grid of points within the reach of the start
//          polynomials (Camera.undistort_defines and correction_defines); the steps are not tested then.
// Tables:  Camera.packed in camera.py, one per direction, with the entries CAMERA_...
#ifndef CAMERA_H
#define CAMERA_H
#include "common/lanes.h"
#ifdef CAMERA

#define CAMERA_CENTRE_X 0  // principal point of the input pixels [px]
#define CAMERA_CENTRE_Y 1
#define CAMERA_PER_X 2     // 1 / focal length of the input pixels [1/px]
#define CAMERA_PER_Y 3
#define CAMERA_FOCAL_X 4   // focal length of the output pixels [px]
#define CAMERA_FOCAL_Y 5
#define CAMERA_SHIFT_X 6   // rounded difference of the principal points, output minus input [px]
#define CAMERA_SHIFT_Y 7
#define CAMERA_GROWTH_X 8  // ratio of the focal lengths, output over input, minus 1
#define CAMERA_GROWTH_Y 9
#define CAMERA_TILT 10     // H less the identity: xx, xy, yx, yy, then wx, wy; undistortion: the inverse of H
#define CAMERA_K 16        // k1 .. k6
#define CAMERA_TWICE_P1 22
#define CAMERA_TWICE_P2 23
#define CAMERA_A0 24
#define CAMERA_A1 25
#define CAMERA_B0 26
#define CAMERA_B1 27
#define CAMERA_SAFE 28     // q below which every point is invertible
#define CAMERA_LIMIT 29    // q from which no point is invertible; below, invertible where the Jacobian determinant is > 0
#define CAMERA_BENT 30       // q of bent points from which no inverse is searched: beyond the fold's image, or 1e6 f
#define CAMERA_PER_REACH 31  // 1 / (q of bent points up to which the start polynomials hold)
#define CAMERA_FIRST 32      // squared length of a virtual step before the first one, relative to q
#define CAMERA_GUESS 33      // start polynomials of camera_approach, 34 entries
#define CAMERA_GUESS_TERMS 8
#define CAMERA_SLOPE_TERMS 6
#define CAMERA_PROFILE_MIDDLE 31  // under CAMERA_PROFILES (sheet.h): position of t = 0, and t of one position; there are no
#define CAMERA_PROFILE_SCALE 32   // start polynomials then
#if CAMERA_RADIAL || CAMERA_RATIONAL || defined(CAMERA_DECENTRED)
#define CAMERA_BENDS         // the lens has distortion terms; otherwise only the sensor is tilted
#endif

// Convergence of camera_approach. Its steps shrink linearly: a step of length s after one of length t leaves an error
// of about s (s / t) = s^2 / t. CAMERA_LEFT is the accepted error and CAMERA_NOISE a step that is rounding, both
// squared and relative to q.
#ifdef REAL_IS_DOUBLE
#define CAMERA_LEFT 1e-31
#define CAMERA_NOISE 1e-28
#else
#define CAMERA_LEFT 1e-15f
#define CAMERA_NOISE 1e-13f
#endif
#define CAMERA_MOST_STEPS 8
#ifdef CAMERA_SURE
#define CAMERA_TESTED 0
#else
#define CAMERA_TESTED 1
#endif

#if CAMERA_RADIAL == 3
#define CAMERA_OVER(q, k) ((q) * ((k)[0] + (q) * ((k)[1] + (q) * (k)[2])))
#define CAMERA_OVER_SLOPE(q, k) ((k)[0] + (q) * (2 * (k)[1] + (q) * (3 * (k)[2])))
#elif CAMERA_RADIAL == 2
#define CAMERA_OVER(q, k) ((q) * ((k)[0] + (q) * (k)[1]))
#define CAMERA_OVER_SLOPE(q, k) ((k)[0] + (q) * (2 * (k)[1]))
#elif CAMERA_RADIAL == 1
#define CAMERA_OVER(q, k) ((q) * (k)[0])
#define CAMERA_OVER_SLOPE(q, k) ((reals)((k)[0]))
#else
#define CAMERA_OVER(q, k) ((reals)0)
#define CAMERA_OVER_SLOPE(q, k) ((reals)0)
#endif

#if CAMERA_RATIONAL == 3
#define CAMERA_UNDER(q, k) ((q) * ((k)[3] + (q) * ((k)[4] + (q) * (k)[5])))
#define CAMERA_UNDER_SLOPE(q, k) ((k)[3] + (q) * (2 * (k)[4] + (q) * (3 * (k)[5])))
#elif CAMERA_RATIONAL == 2
#define CAMERA_UNDER(q, k) ((q) * ((k)[3] + (q) * (k)[4]))
#define CAMERA_UNDER_SLOPE(q, k) ((k)[3] + (q) * (2 * (k)[4]))
#elif CAMERA_RATIONAL == 1
#define CAMERA_UNDER(q, k) ((q) * (k)[3])
#define CAMERA_UNDER_SLOPE(q, k) ((reals)((k)[3]))
#endif

// Compute stretch(q) and its derivative by q. For over / under - 1 the difference (over - under) / (1 + under) of the
// polynomials without their leading 1 avoids cancellation.
#if CAMERA_RATIONAL
static inline reals LANED(camera_stretch)(reals q, constant real *k, reals *slope) {
    const reals under = CAMERA_UNDER(q, k), per = 1 / (1 + under);
    const reals stretch = (CAMERA_OVER(q, k) - under) * per;
    *slope = (CAMERA_OVER_SLOPE(q, k) - (1 + stretch) * CAMERA_UNDER_SLOPE(q, k)) * per;
    return stretch;
}
#else
static inline reals LANED(camera_stretch)(reals q, constant real *k, reals *slope) {
    *slope = CAMERA_OVER_SLOPE(q, k);
    return CAMERA_OVER(q, k);
}
#endif

// a0 + a1 q for two neighbouring entries of the table.
#ifdef CAMERA_PRISM
static inline reals LANED(camera_prism)(reals q, constant real *a) { return a[0] + a[1] * q; }
#else
static inline reals LANED(camera_prism)(reals q, constant real *a) { return a[0]; }
#endif

// Compute the displacement of the ideal point (x, y) by the lens (normalised coordinates); return q.
static inline reals LANED(camera_bend)(reals x, reals y, constant real *camera, reals *move_x, reals *move_y) {
    const reals q = x * x + y * y;
    reals slope;
    reals e = LANED(camera_stretch)(q, camera + CAMERA_K, &slope);
#ifdef CAMERA_DECENTRED
    e += camera[CAMERA_TWICE_P1] * y + camera[CAMERA_TWICE_P2] * x;
    *move_x = x * e + q * LANED(camera_prism)(q, camera + CAMERA_A0);
    *move_y = y * e + q * LANED(camera_prism)(q, camera + CAMERA_B0);
#else
    *move_x = x * e;
    *move_y = y * e;
#endif
    return q;
}

// Compute the Jacobian of the bent point by the ideal point, (xx, xy; yx, yy); return its determinant.
static inline reals LANED(camera_slopes)(reals x, reals y, constant real *camera, reals *xx, reals *xy, reals *yx,
                                         reals *yy) {
    const reals q = x * x + y * y;
    reals slope;
    reals growth = 1 + LANED(camera_stretch)(q, camera + CAMERA_K, &slope);
    reals e_x = 2 * slope * x, e_y = 2 * slope * y;
#ifdef CAMERA_DECENTRED
    const real p1 = camera[CAMERA_TWICE_P1], p2 = camera[CAMERA_TWICE_P2];
    const reals a = 2 * LANED(camera_prism)(2 * q, camera + CAMERA_A0);
    const reals b = 2 * LANED(camera_prism)(2 * q, camera + CAMERA_B0);
    growth += p1 * y + p2 * x;
    e_x += p2;
    e_y += p1;
    *xx = growth + x * (e_x + a);
    *xy = x * e_y + y * a;
    *yx = y * e_x + x * b;
    *yy = growth + y * (e_y + b);
#else
    *xx = growth + x * e_x;
    *xy = x * e_y;
    *yx = *xy;
    *yy = growth + y * e_y;
#endif
    return *xx * *yy - *xy * *yx;
}

// Compute the displacement of (x, y) by the tilt or its inverse, H(x, y) - (x, y); set the mask of points behind the
// sensor plane (denominator w <= 0).
#ifdef CAMERA_TILTED
static inline void LANED(camera_tilt)(reals x, reals y, constant real *tilt, reals *move_x, reals *move_y,
                                      masks *behind) {
    const reals far = tilt[4] * x + tilt[5] * y, w = 1 + far, per = 1 / w;
    *move_x = (tilt[0] * x + tilt[1] * y - x * far) * per;
    *move_y = (tilt[2] * x + tilt[3] * y - y * far) * per;
    *behind = mask_of(w <= 0);
}
#endif

// Move pixels by a normalised displacement: column + f move_x. With CAMERA_MATRICES also from the input matrix to the
// output matrix: f' / f (column - cx) + cx' = column + growth (column - cx) + shift.
static inline void LANED(camera_move)(reals *column, reals *row, reals move_x, reals move_y, constant real *camera) {
#ifdef CAMERA_MATRICES
    move_x = camera[CAMERA_GROWTH_X] * (*column - camera[CAMERA_CENTRE_X]) + camera[CAMERA_FOCAL_X] * move_x;
    move_y = camera[CAMERA_GROWTH_Y] * (*row - camera[CAMERA_CENTRE_Y]) + camera[CAMERA_FOCAL_Y] * move_y;
    *column += camera[CAMERA_SHIFT_X] + move_x;
    *row += camera[CAMERA_SHIFT_Y] + move_y;
#else
    *column += camera[CAMERA_FOCAL_X] * move_x;
    *row += camera[CAMERA_FOCAL_Y] * move_y;
#endif
}

// Move ideal pixels to their measured positions; return the mask of pixels without one: beyond the fold of the lens, or
// behind the sensor plane.
static inline masks LANED(camera_distort)(reals *column, reals *row, constant real *camera) {
    const reals x = (*column - camera[CAMERA_CENTRE_X]) * camera[CAMERA_PER_X];
    const reals y = (*row - camera[CAMERA_CENTRE_Y]) * camera[CAMERA_PER_Y];
    reals move_x, move_y;
    const reals q = LANED(camera_bend)(x, y, camera, &move_x, &move_y);
    masks folded = mask_of(q >= camera[CAMERA_SAFE]);
#ifdef CAMERA_DECENTRED
    if (any_lane(folded)) {
        reals xx, xy, yx, yy;
        const reals determinant = LANED(camera_slopes)(x, y, camera, &xx, &xy, &yx, &yy);
        folded &= mask_of(q >= camera[CAMERA_LIMIT]) | ~mask_of(determinant > 0);
    }
#endif
#ifdef CAMERA_TILTED
    reals tilt_x, tilt_y;
    masks behind;
    LANED(camera_tilt)(x + move_x, y + move_y, camera + CAMERA_TILT, &tilt_x, &tilt_y, &behind);
    folded |= behind;
    move_x += tilt_x;
    move_y += tilt_y;
#endif
    LANED(camera_move)(column, row, move_x, move_y, camera);
    return folded;
}

// Newton step for newton.h: solve bend(x + back) + back = 0, bend: displacement by the lens.
static inline masks LANED(camera_newton)(reals x, reals y, reals back_x, reals back_y, constant real *camera,
                                         reals *step_x, reals *step_y, reals *left) {
    const reals at_x = x + back_x, at_y = y + back_y;
    reals move_x, move_y, xx, xy, yx, yy;
    const reals q = LANED(camera_bend)(at_x, at_y, camera, &move_x, &move_y);
    const reals determinant = LANED(camera_slopes)(at_x, at_y, camera, &xx, &xy, &yx, &yy);
    const reals left_x = move_x + back_x, left_y = move_y + back_y, per = 1 / determinant;
    *left = left_x * left_x + left_y * left_y;
    *step_x = (xy * left_y - yy * left_x) * per;
    *step_y = (yx * left_x - xx * left_y) * per;
    return mask_of(q < camera[CAMERA_LIMIT]) & mask_of(determinant > 0);
}

#define NEWTON_STEP LANED(camera_newton)
#include "common/newton.h"

#ifdef CAMERA_STEPS
// Evaluate a polynomial with an even number of terms: its even and its odd terms apart, so that a CPU need not wait for
// the product of one term before it begins with the next.
static inline reals LANED(camera_series)(reals z, constant real *c, const int terms) {
    const reals square = z * z;
    reals even = c[terms - 2], odd = c[terms - 1];
    _Pragma("unroll") for (int k = terms - 4; k >= 0; k -= 2) {
        even = c[k] + square * even;
        odd = c[k + 1] + square * odd;
    }
    return even + z * odd;
}

// Compute the inverse displacement `back` of measured points m = (x, y); return the mask of points without convergence.
//
// Start: polynomials in z = q / reach, which the host fits to the inverse (inverse_start.py):
//
//     back = m G + q w(z),  G = z g(z) + v(z) . m            vectors v and w only for a decentred lens
//
// Iteration: the residual is r = bend(m + back) + back. A Newton step needs the inverse Jacobian of the lens, times r.
// The Jacobian of the inverse mapping m -> m + back is this inverse up to the error of the fit, so that the step is r +
// T r with the matrix T = d back / dm: no division, and T is computed once:
//
//     T = G I + m (slope m + v)^T + across m^T,   slope = 2 ((z g)' + v' . m) / reach,   across = 2 (z w)'
//
// The host shortens `slope` and `across`: T need not be as exact as `back`. The next `back` is back - (r + T r) =
// -(bend(m + back) + T r).
//
// PoCL does not inline a function of this length, or unroll the loop, without the attribute and the pragma: it would be
// half as fast.
static inline __attribute__((always_inline)) masks LANED(camera_approach)(reals x, reals y, constant real *camera,
                                                                          reals *back_x, reals *back_y) {
    constant real *c = camera + CAMERA_GUESS;  // coefficients of g, and of slope without v
    const reals q = x * x + y * y, z = q * camera[CAMERA_PER_REACH];
    reals g = z * LANED(camera_series)(z, c, CAMERA_GUESS_TERMS);
    reals slope = LANED(camera_series)(z, c + CAMERA_GUESS_TERMS, CAMERA_SLOPE_TERMS);
#ifdef CAMERA_DECENTRED
    // Coefficients v0x, v0y, v1x, ... of v, then of w, of 2 v' / reach, and of `across`.
    c += CAMERA_GUESS_TERMS + CAMERA_SLOPE_TERMS;
    const reals v_x = c[0] + z * (c[2] + z * c[4]), v_y = c[1] + z * (c[3] + z * c[5]);
    const reals w_x = c[6] + z * (c[8] + z * c[10]), w_y = c[7] + z * (c[9] + z * c[11]);
    g += x * v_x + y * v_y;
    *back_x = x * g + q * w_x;
    *back_y = y * g + q * w_y;
    slope += x * (c[12] + z * c[14]) + y * (c[13] + z * c[15]);
    const reals along_x = slope * x + v_x, along_y = slope * y + v_y;
    const reals across_x = c[16] + z * c[18], across_y = c[17] + z * c[19];
    const reals xx = g + x * along_x + across_x * x, xy = x * along_y + across_x * y;
    const reals yx = y * along_x + across_y * x, yy = g + y * along_y + across_y * y;
#else
    *back_x = x * g;
    *back_y = y * g;
    const reals along_x = slope * x, along_y = slope * y;
    const reals xx = g + x * along_x, xy = x * along_y, yx = xy, yy = g + y * along_y;
#endif
    const masks within = mask_of(z <= 1);
    masks settled = -1;
    reals before = camera[CAMERA_FIRST] * q;
    for (int k = 0; k < CAMERA_STEPS || (CAMERA_TESTED && k < CAMERA_MOST_STEPS && any_lane(within & ~settled)); k++) {
        reals move_x, move_y;
        const reals at = LANED(camera_bend)(x + *back_x, y + *back_y, camera, &move_x, &move_y);
        const reals left_x = move_x + *back_x, left_y = move_y + *back_y;
        *back_x = -xx * left_x - (move_x + xy * left_y);
        *back_y = -yy * left_y - (move_y + yx * left_x);
#if CAMERA_TESTED
        const reals step_x = left_x + (xx * left_x + xy * left_y), step_y = left_y + (yx * left_x + yy * left_y);
        const reals step = step_x * step_x + step_y * step_y;
        settled = mask_of(at < camera[CAMERA_SAFE]) &
                  mask_of(step * step <= (real)CAMERA_LEFT * q * (before + (real)CAMERA_NOISE * q));
        before = step;
#endif
    }
    return ~(within & settled);
}

// Compute the normalised displacement that moves measured pixels to their ideal positions; return the mask of pixels
// without one: beyond the image of the fold, a million focal lengths away, or not finite. Points that camera_approach
// does not solve take Newton's method (newton.h). *certain: under CAMERA_SURE the start polynomials hold for all lanes,
// so that no lane is masked and all results are finite.
static inline __attribute__((always_inline)) masks LANED(camera_solve)(reals column, reals row, constant real *camera,
                                                                       reals *back_x, reals *back_y, int *certain) {
    reals x = (column - camera[CAMERA_CENTRE_X]) * camera[CAMERA_PER_X];
    reals y = (row - camera[CAMERA_CENTRE_Y]) * camera[CAMERA_PER_Y];
    masks folded = 0;
#ifdef CAMERA_TILTED
    reals tilt_x, tilt_y;
    LANED(camera_tilt)(x, y, camera + CAMERA_TILT, &tilt_x, &tilt_y, &folded);
    x += tilt_x;
    y += tilt_y;
#endif
#ifdef CAMERA_BENDS
    const masks open = LANED(camera_approach)(x, y, camera, back_x, back_y) & ~folded;
#else
    *back_x = *back_y = 0;
    const masks open = ~folded;
#endif
    *certain = !CAMERA_TESTED;
    if (any_compared(CAMERA_TESTED ? open : open | folded)) {
        *certain = 0;
        // One comparison finds points that are too far or not finite: it is false for NaN of either sign.
        const masks far = ~mask_of(x * x + y * y < camera[CAMERA_BENT]);
#ifdef CAMERA_BENDS
        folded |= far | LANED(newton_back)(x, y, open & ~far, camera, back_x, back_y);
#else
        folded |= far;
#endif
    }
#ifdef CAMERA_TILTED
    *back_x += tilt_x;
    *back_y += tilt_y;
#endif
    return folded;
}

// The same for callers that test each result themselves.
static inline __attribute__((always_inline)) masks LANED(camera_correction)(reals column, reals row,
                                                                            constant real *camera, reals *back_x,
                                                                            reals *back_y) {
    int certain;
    return LANED(camera_solve)(column, row, camera, back_x, back_y, &certain);
}

// Move measured pixels to their ideal positions; return the mask of pixels without one, and *certain, as camera_solve.
static inline __attribute__((always_inline)) masks LANED(camera_undistort)(reals *column, reals *row,
                                                                           constant real *camera, int *certain) {
    reals back_x, back_y;
    const masks folded = LANED(camera_solve)(*column, *row, camera, &back_x, &back_y, certain);
    LANED(camera_move)(column, row, back_x, back_y, camera);
    return folded;
}
#endif

// Convert a gradient over ideal normalised coordinates to the gradient over the measured ones: multiply by the
// transposed Jacobian of the correction, (lens Jacobian)^-1 times the Jacobian of the inverse tilt. (back_x, back_y) is
// the displacement of camera_correction at the measured pixel.
static inline void LANED(camera_pull_back)(reals column, reals row, reals back_x, reals back_y, constant real *camera,
                                           reals *slope_x, reals *slope_y) {
    const reals x = (column - camera[CAMERA_CENTRE_X]) * camera[CAMERA_PER_X];
    const reals y = (row - camera[CAMERA_CENTRE_Y]) * camera[CAMERA_PER_Y];
#ifdef CAMERA_BENDS
    reals xx, xy, yx, yy;
    const reals per = 1 / LANED(camera_slopes)(x + back_x, y + back_y, camera, &xx, &xy, &yx, &yy);
    const reals along_x = (*slope_x * yy - *slope_y * yx) * per;
    const reals along_y = (*slope_y * xx - *slope_x * xy) * per;
    *slope_x = along_x;
    *slope_y = along_y;
#endif
#ifdef CAMERA_TILTED
    constant real *tilt = camera + CAMERA_TILT;
    reals tilt_x, tilt_y;
    masks behind;
    LANED(camera_tilt)(x, y, tilt, &tilt_x, &tilt_y, &behind);
    const reals per_w = 1 / (1 + (tilt[4] * x + tilt[5] * y));
    const reals far = *slope_x * (x + tilt_x) + *slope_y * (y + tilt_y);
    const reals across_x = *slope_x + (*slope_x * tilt[0] + *slope_y * tilt[2]) - far * tilt[4];
    const reals across_y = *slope_y + (*slope_x * tilt[1] + *slope_y * tilt[3]) - far * tilt[5];
    *slope_x = across_x * per_w;
    *slope_y = across_y * per_w;
#endif
}

#endif
#endif
