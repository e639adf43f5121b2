// Mapping from the sensor to the measurement plane by two cubic polynomials, and its inverse (F. de Jong, Range Imaging
// and Visual Servoing for industrial applications, TU Delft 2008, eq. 3.6 and 3.7).
//
// The polynomials are split into a small displacement on the sensor and an affine map, so that the large terms are not
// subtracted from each other:
//
//     x = (u - u0) su, y = (v - v0) sv                      -1 to 1 in the calibrated region
//     bent x - x = a0 x^2 + a1 x y + a2 y^2 + a3 x^3 + a4 x^2 y + a5 x y^2 + a6 y^3,  y likewise with b0 .. b6
//     (G, H) = (g0, h0) + M (bent x, bent y)
//
// The table is PlanePolynomial.packed in polynomial.py. Option: PLANE.
#ifndef PLANE_H
#define PLANE_H
#include "common/lanes.h"
#ifdef PLANE

#define PLANE_ORIGIN 0   // u0, v0
#define PLANE_SCALE 2    // su, sv
#define PLANE_PER_SCALE 4
#define PLANE_OFFSET 6   // g0, h0
#define PLANE_MATRIX 8   // M: gx, gy, hx, hy
#define PLANE_BACK 12    // its inverse
#define PLANE_A 16
#define PLANE_B 23
// Edge of the region, with a tolerance for rounding: of input positions, and of positions from the inverse.
#define PLANE_EDGE ((real)(1 + 4 * REAL_EPSILON))
#define PLANE_FOUND_EDGE ((real)(1 + 64 * REAL_EPSILON))
// Newton iterations may go this far beyond the region (normalised coordinates).
#define PLANE_OUTSKIRTS ((real)1.25)
// Positions beyond this (normalised coordinates) are not the image of any position in the region.
#define PLANE_FARTHEST ((real)1e3)

static inline masks LANED(plane_within)(reals x, reals y, real edge) {
    return mask_of(fabs(x) <= edge) & mask_of(fabs(y) <= edge);
}

// Return the displacement bent x - x (or y) for its seven coefficients c.
static inline reals LANED(plane_bend)(reals x, reals y, constant real *c) {
    return x * x * (c[0] + c[3] * x + c[4] * y) + y * (x * c[1] + y * (c[2] + c[5] * x + c[6] * y));
}

// Compute the derivatives of the displacement by x and y.
static inline void LANED(plane_slopes)(reals x, reals y, constant real *c, reals *by_x, reals *by_y) {
    *by_x = x * (2 * c[0] + 3 * c[3] * x + 2 * c[4] * y) + y * (c[1] + c[5] * y);
    *by_y = x * (c[1] + c[4] * x) + y * (2 * c[2] + 2 * c[5] * x + 3 * c[6] * y);
}

// Map sensor coordinates to the plane [m]; return the mask of points outside the region.
static inline masks LANED(plane_measure)(reals *u, reals *v, constant real *plane) {
    constant real *matrix = plane + PLANE_MATRIX;
    const reals x = (*u - plane[PLANE_ORIGIN]) * plane[PLANE_SCALE];
    const reals y = (*v - plane[PLANE_ORIGIN + 1]) * plane[PLANE_SCALE + 1];
    const reals bent_x = x + LANED(plane_bend)(x, y, plane + PLANE_A);
    const reals bent_y = y + LANED(plane_bend)(x, y, plane + PLANE_B);
    *u = plane[PLANE_OFFSET] + (matrix[0] * bent_x + matrix[1] * bent_y);
    *v = plane[PLANE_OFFSET + 1] + (matrix[2] * bent_x + matrix[3] * bent_y);
    return ~LANED(plane_within)(x, y, PLANE_EDGE);
}

// Newton step for newton.h: solve bend(x + back) + back = 0 with the Jacobian I + d bend.
static inline masks LANED(plane_newton)(reals x, reals y, reals back_x, reals back_y, constant real *plane,
                                        reals *step_x, reals *step_y, reals *left) {
    const reals at_x = x + back_x, at_y = y + back_y;
    reals xx, xy, yx, yy;
    LANED(plane_slopes)(at_x, at_y, plane + PLANE_A, &xx, &xy);
    LANED(plane_slopes)(at_x, at_y, plane + PLANE_B, &yx, &yy);
    xx += 1;
    yy += 1;
    const reals left_x = back_x + LANED(plane_bend)(at_x, at_y, plane + PLANE_A);
    const reals left_y = back_y + LANED(plane_bend)(at_x, at_y, plane + PLANE_B);
    const reals determinant = xx * yy - xy * yx, per = 1 / determinant;
    *left = left_x * left_x + left_y * left_y;
    *step_x = (xy * left_y - yy * left_x) * per;
    *step_y = (yx * left_x - xx * left_y) * per;
    return LANED(plane_within)(at_x, at_y, PLANE_OUTSKIRTS) & mask_of(determinant > 0);
}

#define NEWTON_STEP LANED(plane_newton)
#include "common/newton.h"

// Map plane coordinates [m] to the sensor; return the mask of points outside the region.
static inline masks LANED(plane_show)(reals *g, reals *h, constant real *plane) {
    constant real *back = plane + PLANE_BACK;
    const reals along = *g - plane[PLANE_OFFSET], up = *h - plane[PLANE_OFFSET + 1];
    const reals x = back[0] * along + back[1] * up, y = back[2] * along + back[3] * up;
    reals back_x = 0, back_y = 0;
    masks unseen = ~LANED(plane_within)(x, y, PLANE_FARTHEST);
    unseen |= LANED(newton_back)(x, y, ~unseen, plane, &back_x, &back_y);
    unseen |= ~LANED(plane_within)(x + back_x, y + back_y, PLANE_FOUND_EDGE);
    *g = plane[PLANE_ORIGIN] + plane[PLANE_PER_SCALE] * (x + back_x);
    *h = plane[PLANE_ORIGIN + 1] + plane[PLANE_PER_SCALE + 1] * (y + back_y);
    return unseen;
}

#endif
#endif
