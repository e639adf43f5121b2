// Radial lens, measured -> undistorted: x += (x - cx)(k1 r^2 + k2 r^4), y likewise (F. de Jong, eq. 3.11-3.13).
// The displacement form adds a small stretch to the point itself, which keeps single precision near its rounding.
// Compiled only under LENS; the k2 term only under LENS_K2. The table is Lens.packed in lens.py.
#ifndef LENS_H
#define LENS_H
#include "lanes.h"
#ifdef LENS

#define LENS_CENTRE_X 0
#define LENS_CENTRE_Y 1
#define LENS_K1_TERM 2
#define LENS_K2_TERM 3
#define LENS_FOLD_SQUARE 4

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

#endif
#endif
