// Radial lens, measured -> undistorted: x += (x - cx)(k1 r^2 + k2 r^4), y likewise (F. de Jong, eq. 3.11-3.13), and
// its inverse. The displacement form adds a small stretch to the point itself, which keeps single precision near its
// rounding. Compiled only under LENS; the k2 term only under LENS_K2. The table is Lens.packed in lens.py.
#ifndef LENS_H
#define LENS_H
#include "common/lanes.h"
#ifdef LENS

#define LENS_CENTRE_X 0
#define LENS_CENTRE_Y 1
#define LENS_K1_TERM 2
#define LENS_K2_TERM 3
#define LENS_FOLD_SQUARE 4
#define LENS_REACH_SQUARE 5  // undistorted; only in the table of the inverse

// k1 r^2 + k2 r^4, and its derivative by r^2.
#ifdef LENS_K2
#define LENS_STRETCH(square, lens) ((square) * ((lens)[LENS_K1_TERM] + (lens)[LENS_K2_TERM] * (square)))
#define LENS_STRETCH_SLOPE(square, lens) ((lens)[LENS_K1_TERM] + 2 * (lens)[LENS_K2_TERM] * (square))
#else
#define LENS_STRETCH(square, lens) ((square) * (lens)[LENS_K1_TERM])
#define LENS_STRETCH_SLOPE(square, lens) ((lens)[LENS_K1_TERM])
#endif

// Moves (x, y) to its undistorted place and returns the squared distance of the measured point from the centre.
inline reals LANED(lens_straighten)(reals *x, reals *y, constant real *lens) {
    const reals along = *x - lens[LENS_CENTRE_X], across = *y - lens[LENS_CENTRE_Y];
    const reals square = along * along + across * across;
    const reals stretch = LENS_STRETCH(square, lens);
    *x += along * stretch;
    *y += across * stretch;
    return square;
}

// The same; tells whether the measured point lies at or beyond the fold of the polynomial, where no scene point can be
// (as a comparison does: for mask_of).
inline masks LANED(lens_undistort)(reals *x, reals *y, constant real *lens) {
    return LANED(lens_straighten)(x, y, lens) >= lens[LENS_FOLD_SQUARE];
}

// Takes a gradient over undistorted (x, y) back to one over the measured (x, y) given.
inline void LANED(lens_pull_back)(reals x, reals y, constant real *lens, reals *slope_x, reals *slope_y) {
    const reals along = x - lens[LENS_CENTRE_X], across = y - lens[LENS_CENTRE_Y];
    const reals square = along * along + across * across;
    const reals growth = 1 + LENS_STRETCH(square, lens);
    const reals turn = 2 * LENS_STRETCH_SLOPE(square, lens) * (along * *slope_x + across * *slope_y);
    *slope_x = *slope_x * growth + along * turn;
    *slope_y = *slope_y * growth + across * turn;
}

// Newton steps that suffice for most lenses; who needs more goes on with care.
#define LENS_STEPS 3
#define LENS_CAREFUL_STEPS 100
#ifdef REAL_IS_DOUBLE
#define LENS_SETTLED 3e-8
#else
#define LENS_SETTLED 3e-5f
#endif

// A Newton step for e in (1 + e)(1 + k1 r^2 (1 + e)^2 + k2 r^4 (1 + e)^4) = 1, which takes an undistorted radius r to
// the measured one, (1 + e) r; `left` is what is not yet equal. Returns where the polynomial still rises.
inline masks LANED(lens_newton)(reals square, reals e, constant real *lens, reals *step, reals *left) {
    const reals part = 1 + e, measured = square * part * part;
    const reals stretch = LENS_STRETCH(measured, lens);
    *left = e + part * stretch;
    *step = *left / -(1 + stretch + 2 * measured * LENS_STRETCH_SLOPE(measured, lens));
    return mask_of(measured < lens[LENS_FOLD_SQUARE]);
}

// The same e from the centre on, where no step leaves the rising part or gains nothing: it is halved instead.
inline reals LANED(lens_find)(reals square, masks wanted, constant real *lens, reals found) {
    const reals own = zero_where(~wanted, square);
    reals e = -1, step = 1, left = 1;
    masks open = wanted;
    for (int k = 0; k < LENS_CAREFUL_STEPS && any_lane(open); k++) {
        reals next_step, next_left;
        const masks inside = LANED(lens_newton)(own, e + step, lens, &next_step, &next_left);
        const masks better = inside & mask_of(fabs(next_left) < left);
        e = better ? e + step : e;
        left = better ? fabs(next_left) : left;
        step = better ? next_step : step / 2;
        open = mask_of(left > (real)REAL_EPSILON) & mask_of(fabs(step) > (real)REAL_EPSILON / 4);
    }
    // The last step is still to come, or next to nothing.
    return wanted ? e + step : found;
}

// Moves the undistorted (x, y) to its measured place; returns where there is none, past the fold's image.
inline masks LANED(lens_distort)(reals *x, reals *y, constant real *lens) {
    const reals along = *x - lens[LENS_CENTRE_X], across = *y - lens[LENS_CENTRE_Y];
    const reals square = along * along + across * across;
    const masks reached = mask_of(square < lens[LENS_REACH_SQUARE]);
    reals e = 0, step, left;
    masks settled = 0;
    for (int k = 0; k < LENS_STEPS; k++) {
        settled = LANED(lens_newton)(square, e, lens, &step, &left);
        e += step;
    }
    settled &= mask_of(fabs(step) <= (real)LENS_SETTLED);
    const masks open = reached & ~settled;
    if (any_lane(open)) e = LANED(lens_find)(square, open, lens, e);
    *x += along * e;
    *y += across * e;
    return ~reached;
}

#endif
#endif
