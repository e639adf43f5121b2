// Radial lens distortion: measured -> undistorted position, its inverse, and gradients through it.
//
//     x' = x + (x - cx)(k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8),  y' likewise,  r^2 = (x - cx)^2 + (y - cy)^2
//
// F. de Jong, eq. 3.11-3.13, has k1 and k2; wide-angle lenses need k3 and k4.
//
// The formula adds a small displacement to the point itself, which keeps single precision within a few roundings.
// Positions, the centre and r are in one unit, chosen by the host (Lens.packed in gpuvision/camera/lens.py).
// Build options: LENS compiles this file; LENS_K2, LENS_K3, LENS_K4 the terms up to k2, k3 or k4 (one of the three).
#ifndef LENS_H
#define LENS_H
#include "common/lanes.h"
#ifdef LENS

// Offsets in the table that Lens.packed writes.
#define LENS_CENTRE_X 0
#define LENS_CENTRE_Y 1
#define LENS_K1_TERM 2
#define LENS_K2_TERM 3
#define LENS_K3_TERM 4
#define LENS_K4_TERM 5
#define LENS_FOLD_SQUARE 6   // squared radius at which the polynomial stops rising; the last of the 7 entries that
                             // lens_undistort and lens_pull_back need (Lens.TABLE_SIZE)
#define LENS_REACH_SQUARE 7  // squared undistorted radius of the fold; only in the table for lens_distort

// k1 r^2 + k2 r^4 + ... at r^2 = square, and its derivative by r^2, in Horner's form. Macros instead of functions: a
// compiler contracts a*b + c to one rounding only within an expression, and the expressions around these are kept as
// accurate as they are.
#if defined(LENS_K4)
#define LENS_STRETCH(square, lens)                       \
    ((square) * ((lens)[LENS_K1_TERM] +                  \
                 (square) * ((lens)[LENS_K2_TERM] +      \
                             (square) * ((lens)[LENS_K3_TERM] + (lens)[LENS_K4_TERM] * (square)))))
#define LENS_STRETCH_SLOPE(square, lens)                 \
    ((lens)[LENS_K1_TERM] +                              \
     (square) * (2 * (lens)[LENS_K2_TERM] +              \
                 (square) * (3 * (lens)[LENS_K3_TERM] + 4 * (lens)[LENS_K4_TERM] * (square))))
#elif defined(LENS_K3)
#define LENS_STRETCH(square, lens) \
    ((square) * ((lens)[LENS_K1_TERM] + (square) * ((lens)[LENS_K2_TERM] + (lens)[LENS_K3_TERM] * (square))))
#define LENS_STRETCH_SLOPE(square, lens) \
    ((lens)[LENS_K1_TERM] + (square) * (2 * (lens)[LENS_K2_TERM] + 3 * (lens)[LENS_K3_TERM] * (square)))
#elif defined(LENS_K2)
#define LENS_STRETCH(square, lens) ((square) * ((lens)[LENS_K1_TERM] + (lens)[LENS_K2_TERM] * (square)))
#define LENS_STRETCH_SLOPE(square, lens) ((lens)[LENS_K1_TERM] + 2 * (lens)[LENS_K2_TERM] * (square))
#else
#define LENS_STRETCH(square, lens) ((square) * (lens)[LENS_K1_TERM])
#define LENS_STRETCH_SLOPE(square, lens) ((lens)[LENS_K1_TERM])
#endif

// Move the measured (x, y) to its undistorted position; return the squared distance of the measured point from the
// centre.
static inline reals LANED(lens_straighten)(reals *x, reals *y, constant real *lens) {
    const reals from_centre_x = *x - lens[LENS_CENTRE_X], from_centre_y = *y - lens[LENS_CENTRE_Y];
    const reals square = from_centre_x * from_centre_x + from_centre_y * from_centre_y;
    const reals stretch = LENS_STRETCH(square, lens);
    *x += from_centre_x * stretch;
    *y += from_centre_y * stretch;
    return square;
}

// The same. Return the comparison (for mask_of) that is true where the measured point lies at or beyond the fold of the
// polynomial: no scene point is imaged there.
static inline masks LANED(lens_undistort)(reals *x, reals *y, constant real *lens) {
    return LANED(lens_straighten)(x, y, lens) >= lens[LENS_FOLD_SQUARE];
}

// Convert a gradient over undistorted (x', y') to the gradient over the measured (x, y): multiply by the transposed
// Jacobian of the distortion.
static inline void LANED(lens_pull_back)(reals x, reals y, constant real *lens, reals *slope_x, reals *slope_y) {
    const reals from_centre_x = x - lens[LENS_CENTRE_X], from_centre_y = y - lens[LENS_CENTRE_Y];
    const reals square = from_centre_x * from_centre_x + from_centre_y * from_centre_y;
    const reals scale = 1 + LENS_STRETCH(square, lens);
    const reals radial = 2 * LENS_STRETCH_SLOPE(square, lens) * (from_centre_x * *slope_x + from_centre_y * *slope_y);
    *slope_x = *slope_x * scale + from_centre_x * radial;
    *slope_y = *slope_y * scale + from_centre_y * radial;
}

// Newton steps of the inverse that every lane takes; they suffice for most lenses. Lanes that have not converged
// continue with lens_find, which takes at most LENS_CAREFUL_STEPS steps and halves steps that do not improve.
#define LENS_STEPS 3
#define LENS_CAREFUL_STEPS 100
// Size of the last step, relative to the radius, at which a lane has converged: about the square root of the rounding,
// since the error after a Newton step is of the order of its square.
#ifdef REAL_IS_DOUBLE
#define LENS_SETTLED 3e-8
#else
#define LENS_SETTLED 3e-5f
#endif

// Compute a Newton step for e in (1 + e)(1 + k1 r^2 (1 + e)^2 + k2 r^4 (1 + e)^4 + ...) = 1. The measured radius is (1 + e) r
// for the undistorted radius r. `residual` is the left side minus 1. Return where the polynomial still rises.
static inline masks LANED(lens_newton)(reals square, reals e, constant real *lens, reals *step, reals *residual) {
    const reals part = 1 + e, measured = square * part * part;
    const reals stretch = LENS_STRETCH(measured, lens);
    *residual = e + part * stretch;
    *step = *residual / -(1 + stretch + 2 * measured * LENS_STRETCH_SLOPE(measured, lens));
    return mask_of(measured < lens[LENS_FOLD_SQUARE]);
}

// Find e, starting at the centre (e = -1), for the lanes that are `wanted`; the other lanes keep `found`. A step that
// leaves the rising part of the polynomial, or does not reduce the residual, is halved.
static inline reals LANED(lens_find)(reals square, masks wanted, constant real *lens, reals found) {
    const reals searched = zero_where(~wanted, square);
    reals e = -1, step = 1, residual = 1;
    masks open = wanted;
    for (int k = 0; k < LENS_CAREFUL_STEPS && any_lane(open); k++) {
        reals next_step, next_residual;
        const masks inside = LANED(lens_newton)(searched, e + step, lens, &next_step, &next_residual);
        const masks better = inside & mask_of(fabs(next_residual) < residual);
        e = better ? e + step : e;
        residual = better ? fabs(next_residual) : residual;
        step = better ? next_step : step / 2;
        open = mask_of(residual > (real)REAL_EPSILON) & mask_of(fabs(step) > (real)REAL_EPSILON / 4);
    }
    // The last step was computed and not taken yet.
    return wanted ? e + step : found;
}

// Move the undistorted (x, y) to its measured position. Return the lanes without one: beyond the image of the fold.
static inline masks LANED(lens_distort)(reals *x, reals *y, constant real *lens) {
    const reals from_centre_x = *x - lens[LENS_CENTRE_X], from_centre_y = *y - lens[LENS_CENTRE_Y];
    const reals square = from_centre_x * from_centre_x + from_centre_y * from_centre_y;
    const masks reached = mask_of(square < lens[LENS_REACH_SQUARE]);
    reals e = 0, step, residual;
    masks settled = 0;
    for (int k = 0; k < LENS_STEPS; k++) {
        settled = LANED(lens_newton)(square, e, lens, &step, &residual);
        e += step;
    }
    settled &= mask_of(fabs(step) <= (real)LENS_SETTLED);
    const masks open = reached & ~settled;
    if (any_lane(open)) e = LANED(lens_find)(square, open, lens, e);
    *x += from_centre_x * e;
    *y += from_centre_y * e;
    return ~reached;
}

#endif
#endif
