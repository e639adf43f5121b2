// OpenCV's camera with 14 coefficients, in displacement form. A point's ideal place is where a pinhole would show it,
// its measured place is where the lens and the tilted sensor show it:
//
//     x = (column - cx) / f                                  normalised ideal place, y likewise; q = x^2 + y^2
//     bent x - x = x e + q (a0 + a1 q)                       with e = stretch(q) + 2 (p1 y + p2 x),
//     bent y - y = y e + q (b0 + b1 q)                       a0 = p2 + s1, a1 = s2, b0 = p1 + s3, b1 = s4
//     stretch(q) = (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3) - 1
//     measured = H bent                                      the sensor's tilt, a homography that keeps the centre
//
// Only terms that are not zero are compiled: CAMERA_RADIAL and CAMERA_RATIONAL (0 to 3: how many of k1.. and k4..),
// CAMERA_DECENTRED (p and s), CAMERA_TILTED, CAMERA_MATRICES (ideal pixels other than the camera's own). The host
// computes the displacements' constants in double; a point keeps its digits, since what moves it is small beside it.
// The tables are Camera.packed in camera.py, one for either direction.
#ifndef CAMERA_H
#define CAMERA_H
#include "lanes.h"
#ifdef CAMERA

#define CAMERA_CENTRE_X 0  // of the pixels that come in
#define CAMERA_CENTRE_Y 1
#define CAMERA_PER_X 2     // their 1/f
#define CAMERA_PER_Y 3
#define CAMERA_FOCAL_X 4   // of the pixels that go out
#define CAMERA_FOCAL_Y 5
#define CAMERA_SHIFT_X 6   // from the one principal point to the other [px]
#define CAMERA_SHIFT_Y 7
#define CAMERA_GROWTH_X 8  // one f over the other, less 1
#define CAMERA_GROWTH_Y 9
#define CAMERA_TILT 10     // the homography less the identity: xx, xy, yx, yy, then wx, wy; its inverse to undistort
#define CAMERA_K 16        // k1 .. k6
#define CAMERA_P1 22
#define CAMERA_P2 23
#define CAMERA_A0 24
#define CAMERA_A1 25
#define CAMERA_B0 26
#define CAMERA_B1 27
#define CAMERA_SAFE 28     // q up to which nothing folds
#define CAMERA_LIMIT 29    // q from which all is folded; between them the sign of the determinant says

// q from which nothing is looked for. One comparison of bits finds what is larger, infinite or NaN.
#define CAMERA_REACH as_bits((real)1e12)

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

// The stretch, and its derivative by q.
#if CAMERA_RATIONAL
inline reals LANED(camera_stretch)(reals q, constant real *k, reals *slope) {
    const reals under = CAMERA_UNDER(q, k), per = 1 / (1 + under);
    const reals stretch = (CAMERA_OVER(q, k) - under) * per;
    *slope = (CAMERA_OVER_SLOPE(q, k) - (1 + stretch) * CAMERA_UNDER_SLOPE(q, k)) * per;
    return stretch;
}
#else
inline reals LANED(camera_stretch)(reals q, constant real *k, reals *slope) {
    *slope = CAMERA_OVER_SLOPE(q, k);
    return CAMERA_OVER(q, k);
}
#endif

// How far the lens moves the ideal place (x, y), and the Jacobian of the bent place (xx, xy; yx, yy); returns q.
inline reals LANED(camera_bend)(reals x, reals y, constant real *camera, reals *move_x, reals *move_y, reals *xx,
                                reals *xy, reals *yx, reals *yy) {
    const reals q = x * x + y * y;
    reals slope;
    reals e = LANED(camera_stretch)(q, camera + CAMERA_K, &slope);
    reals e_x = 2 * slope * x, e_y = 2 * slope * y;
#ifdef CAMERA_DECENTRED
    const real p1 = camera[CAMERA_P1], p2 = camera[CAMERA_P2], a1 = camera[CAMERA_A1], b1 = camera[CAMERA_B1];
    e += 2 * (p1 * y + p2 * x);
    e_x += 2 * p2;
    e_y += 2 * p1;
    const reals a = camera[CAMERA_A0] + a1 * q, b = camera[CAMERA_B0] + b1 * q;
    const reals a_slope = 2 * (a + a1 * q), b_slope = 2 * (b + b1 * q);
    *move_x = x * e + q * a;
    *move_y = y * e + q * b;
    *xx = 1 + e + x * (e_x + a_slope);
    *xy = x * e_y + y * a_slope;
    *yx = y * e_x + x * b_slope;
    *yy = 1 + e + y * (e_y + b_slope);
#else
    *move_x = x * e;
    *move_y = y * e;
    *xx = 1 + e + x * e_x;
    *xy = x * e_y;
    *yx = *xy;
    *yy = 1 + e + y * e_y;
#endif
    return q;
}

// How far the tilt (or its inverse) moves (x, y); sets what lies behind the sensor's plane.
#ifdef CAMERA_TILTED
inline void LANED(camera_tilt)(reals x, reals y, constant real *tilt, reals *move_x, reals *move_y, masks *behind) {
    const reals far = tilt[4] * x + tilt[5] * y, w = 1 + far, per = 1 / w;
    *move_x = (tilt[0] * x + tilt[1] * y - x * far) * per;
    *move_y = (tilt[2] * x + tilt[3] * y - y * far) * per;
    *behind = mask_of(w <= 0);
}
#endif

// Moves the pixels (column, row) by a normalised displacement, and to the other matrix if there is one.
inline void LANED(camera_move)(reals *column, reals *row, reals move_x, reals move_y, constant real *camera) {
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

// Moves the ideal pixel (column, row) to its measured one; returns where there is none, being past the fold.
inline masks LANED(camera_distort)(reals *column, reals *row, constant real *camera) {
    const reals x = (*column - camera[CAMERA_CENTRE_X]) * camera[CAMERA_PER_X];
    const reals y = (*row - camera[CAMERA_CENTRE_Y]) * camera[CAMERA_PER_Y];
    reals move_x, move_y, xx, xy, yx, yy;
    const reals q = LANED(camera_bend)(x, y, camera, &move_x, &move_y, &xx, &xy, &yx, &yy);
    masks folded = mask_of(q >= camera[CAMERA_SAFE]);
#ifdef CAMERA_DECENTRED
    if (any_lane(folded)) folded &= mask_of(q >= camera[CAMERA_LIMIT]) | ~mask_of(xx * yy - xy * yx > 0);
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

// A Newton step (step_x, step_y) for the place that the lens moves to (x, y): from (x, y) + (back_x, back_y), the
// distance left being `left` (squared). Returns where the place is in the lens' one-to-one part.
inline masks LANED(camera_newton)(reals x, reals y, reals back_x, reals back_y, constant real *camera, reals *step_x,
                                  reals *step_y, reals *left) {
    reals move_x, move_y, xx, xy, yx, yy;
    const reals q = LANED(camera_bend)(x + back_x, y + back_y, camera, &move_x, &move_y, &xx, &xy, &yx, &yy);
    const reals left_x = move_x + back_x, left_y = move_y + back_y;
    const reals determinant = xx * yy - xy * yx, per = 1 / determinant;
    *left = left_x * left_x + left_y * left_y;
    *step_x = (xy * left_y - yy * left_x) * per;
    *step_y = (yx * left_x - xx * left_y) * per;
    return mask_of(q < camera[CAMERA_LIMIT]) & mask_of(determinant > 0);
}

#define NEWTON_STEP LANED(camera_newton)
#include "newton.h"

// Moves the measured pixel (column, row) to its ideal one; returns where there is none, being past the fold's image, a
// million focal lengths away, or no pixel at all.
inline masks LANED(camera_undistort)(reals *column, reals *row, constant real *camera) {
    reals x = (*column - camera[CAMERA_CENTRE_X]) * camera[CAMERA_PER_X];
    reals y = (*row - camera[CAMERA_CENTRE_Y]) * camera[CAMERA_PER_Y];
    masks folded = mask_of(as_masks(x * x + y * y) >= CAMERA_REACH);
    reals tilt_x = 0, tilt_y = 0;
#ifdef CAMERA_TILTED
    masks behind;
    LANED(camera_tilt)(x, y, camera + CAMERA_TILT, &tilt_x, &tilt_y, &behind);
    folded |= behind;
    x += tilt_x;
    y += tilt_y;
#endif
    reals back_x, back_y;
    folded |= LANED(newton_back)(x, y, folded, camera, &back_x, &back_y);
    LANED(camera_move)(column, row, tilt_x + back_x, tilt_y + back_y, camera);
    return folded;
}

#endif
#endif
