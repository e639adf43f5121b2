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
// CAMERA_DECENTRED (p and s), CAMERA_PRISM (s2 and s4), CAMERA_TILTED, CAMERA_MATRICES (ideal pixels other than the
// camera's own). The host computes the constants in double; a point keeps its digits, since what moves it is small
// beside it.
// The tables are Camera.packed in camera.py, one for either direction; camera_undistort needs CAMERA_STEPS as well,
// how many steps serve most places (Camera.steps).
#ifndef CAMERA_H
#define CAMERA_H
#include "common/lanes.h"
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
#define CAMERA_BENT 30       // q from which no bent place is looked for: past the fold's image, or out of all bounds
#define CAMERA_PER_REACH 31  // 1 over the bent q up to which the host's guess holds
#define CAMERA_FIRST 32      // relative square of a step that goes before the first, as it were
#define CAMERA_GUESS 33
#define CAMERA_GUESS_TERMS 8

// Steps shrink evenly: one of size s after one of size t leaves about s^2 / t. Relative squares: of what may be left,
// and of a step that is rounding.
#ifdef REAL_IS_DOUBLE
#define CAMERA_LEFT 1e-31
#define CAMERA_NOISE 1e-28
#else
#define CAMERA_LEFT 1e-15f
#define CAMERA_NOISE 1e-13f
#endif
#define CAMERA_MOST_STEPS 8

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

#ifdef CAMERA_PRISM
#define CAMERA_PRISM_TERM(a, q) ((a) * (q))
#else
#define CAMERA_PRISM_TERM(a, q) 0
#endif

// How far the lens moves the ideal place (x, y); returns q.
static inline reals LANED(camera_bend)(reals x, reals y, constant real *camera, reals *move_x, reals *move_y) {
    const reals q = x * x + y * y;
    reals slope;
    reals e = LANED(camera_stretch)(q, camera + CAMERA_K, &slope);
#ifdef CAMERA_DECENTRED
    e += 2 * (camera[CAMERA_P1] * y + camera[CAMERA_P2] * x);
    *move_x = x * e + q * (camera[CAMERA_A0] + CAMERA_PRISM_TERM(camera[CAMERA_A1], q));
    *move_y = y * e + q * (camera[CAMERA_B0] + CAMERA_PRISM_TERM(camera[CAMERA_B1], q));
#else
    *move_x = x * e;
    *move_y = y * e;
#endif
    return q;
}

// Jacobian of the bent place: xx, xy; yx, yy. Returns its determinant.
static inline reals LANED(camera_slopes)(reals x, reals y, constant real *camera, reals *xx, reals *xy, reals *yx,
                                  reals *yy) {
    const reals q = x * x + y * y;
    reals slope;
    reals growth = 1 + LANED(camera_stretch)(q, camera + CAMERA_K, &slope);
    reals e_x = 2 * slope * x, e_y = 2 * slope * y;
#ifdef CAMERA_DECENTRED
    const real p1 = 2 * camera[CAMERA_P1], p2 = 2 * camera[CAMERA_P2];
    const reals a = 2 * camera[CAMERA_A0] + CAMERA_PRISM_TERM(4 * camera[CAMERA_A1], q);
    const reals b = 2 * camera[CAMERA_B0] + CAMERA_PRISM_TERM(4 * camera[CAMERA_B1], q);
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

// How far the tilt (or its inverse) moves (x, y); sets what lies behind the sensor's plane.
#ifdef CAMERA_TILTED
static inline void LANED(camera_tilt)(reals x, reals y, constant real *tilt, reals *move_x, reals *move_y, masks *behind) {
    const reals far = tilt[4] * x + tilt[5] * y, w = 1 + far, per = 1 / w;
    *move_x = (tilt[0] * x + tilt[1] * y - x * far) * per;
    *move_y = (tilt[2] * x + tilt[3] * y - y * far) * per;
    *behind = mask_of(w <= 0);
}
#endif

// Moves the pixels (column, row) by a normalised displacement, and to the other matrix if there is one.
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

// Moves the ideal pixel (column, row) to its measured one; returns where there is none, being past the fold.
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

// As newton.h asks for it.
static inline masks LANED(camera_newton)(reals x, reals y, reals back_x, reals back_y, constant real *camera, reals *step_x,
                                  reals *step_y, reals *left) {
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
// The way back for most places m = (x, y). The host fitted polynomials in z = q / reach:
//
//     back = m (z g(z) + v(z).m) + q w(z)                    v and w, which have a direction, for a decentred lens
//
// Their Jacobian is about the inverse of the lens' own: it turns what is left into a step, without a division. Returns
// the places that a few steps do not settle. (PoCL neither inlines what is so long nor unrolls, unless it is told to:
// it is half as fast then.)
static inline __attribute__((always_inline)) masks LANED(camera_approach)(reals x, reals y, constant real *camera,
                                                                   reals *back_x, reals *back_y) {
    constant real *c = camera + CAMERA_GUESS;
    const real per = camera[CAMERA_PER_REACH];
    const reals q = x * x + y * y, z = q * per;
    reals g = c[CAMERA_GUESS_TERMS - 1], slope = 0;
    _Pragma("unroll") for (int k = CAMERA_GUESS_TERMS - 2; k >= 0; k--) {
        slope = g + z * slope;
        g = c[k] + z * g;
    }
    slope = g + z * slope;
    g *= z;
#ifdef CAMERA_DECENTRED
    c += CAMERA_GUESS_TERMS;  // v0x, v0y, v1x ..., w, and the derivatives v' and 2 (z w)'
    const reals v_x = c[0] + z * (c[2] + z * c[4]), v_y = c[1] + z * (c[3] + z * c[5]);
    const reals w_x = c[6] + z * (c[8] + z * c[10]), w_y = c[7] + z * (c[9] + z * c[11]);
    const reals turn_x = c[16] + z * (c[18] + z * c[20]), turn_y = c[17] + z * (c[19] + z * c[21]);
    slope += x * (c[12] + z * c[14]) + y * (c[13] + z * c[15]);
    g += x * v_x + y * v_y;
    *back_x = x * g + q * w_x;
    *back_y = y * g + q * w_y;
#else
    *back_x = x * g;
    *back_y = y * g;
#endif
    slope *= 2 * per;
    const masks within = mask_of(z <= 1);
    masks settled = 0;
    reals before = camera[CAMERA_FIRST] * q;
    for (int k = 0; k < CAMERA_MOST_STEPS && (k < CAMERA_STEPS || any_lane(within & ~settled)); k++) {
        reals move_x, move_y;
        const reals at = LANED(camera_bend)(x + *back_x, y + *back_y, camera, &move_x, &move_y);
        const reals left_x = move_x + *back_x, left_y = move_y + *back_y, along = x * left_x + y * left_y;
#ifdef CAMERA_DECENTRED
        const reals turn = slope * along + (v_x * left_x + v_y * left_y);
        const reals step_x = left_x + (g * left_x + x * turn + turn_x * along);
        const reals step_y = left_y + (g * left_y + y * turn + turn_y * along);
#else
        const reals turn = slope * along;
        const reals step_x = left_x + (g * left_x + x * turn), step_y = left_y + (g * left_y + y * turn);
#endif
        const reals step = step_x * step_x + step_y * step_y;
        *back_x -= step_x;
        *back_y -= step_y;
        settled = mask_of(at < camera[CAMERA_SAFE]) &
                  mask_of(step * step <= (real)CAMERA_LEFT * q * (before + (real)CAMERA_NOISE * q));
        before = step;
    }
    return ~(within & settled);
}

// Moves the measured pixel (column, row) to its ideal one; returns where there is none, being past the fold's image, a
// million focal lengths away, or no pixel at all.
static inline __attribute__((always_inline)) masks LANED(camera_undistort)(reals *column, reals *row,
                                                                    constant real *camera) {
    reals x = (*column - camera[CAMERA_CENTRE_X]) * camera[CAMERA_PER_X];
    reals y = (*row - camera[CAMERA_CENTRE_Y]) * camera[CAMERA_PER_Y];
    reals back_x, back_y;
    masks folded = 0;
#ifdef CAMERA_TILTED
    reals tilt_x, tilt_y;
    LANED(camera_tilt)(x, y, camera + CAMERA_TILT, &tilt_x, &tilt_y, &folded);
    x += tilt_x;
    y += tilt_y;
#endif
    const masks open = LANED(camera_approach)(x, y, camera, &back_x, &back_y) & ~folded;
    if (any_lane(open)) {
        // One comparison of bits finds what is larger, infinite or NaN.
        const masks far = mask_of(as_masks(x * x + y * y) >= as_bits(camera[CAMERA_BENT]));
        folded |= far | LANED(newton_back)(x, y, open & ~far, camera, &back_x, &back_y);
    }
#ifdef CAMERA_TILTED
    back_x += tilt_x;
    back_y += tilt_y;
#endif
    LANED(camera_move)(column, row, back_x, back_y, camera);
    return folded;
}
#endif

#endif
#endif
