// Radial lens, measured -> undistorted: x += (x - cx)(k1 r^2 + k2 r^4), y likewise (F. de Jong, eq. 3.11-3.13).
// The displacement form adds a small stretch to the point itself, which keeps single precision near its rounding.
// Compiled only under LENS; the k2 term only under LENS_K2. The table is Lens.packed in lens.py.
#ifndef LENS_H
#define LENS_H
#include "real.h"
#ifdef LENS

#define LENS_CENTRE_X 0
#define LENS_CENTRE_Y 1
#define LENS_K1_TERM 2
#define LENS_K2_TERM 3
#define LENS_FOLD_SQUARE 4
#define LENS_SIZE 5

#ifdef LENS_K2
#define LENS_STRETCH(square, lens) ((square) * ((lens)[LENS_K1_TERM] + (lens)[LENS_K2_TERM] * (square)))
#define LENS_STRETCH_SLOPE(square, lens) ((lens)[LENS_K1_TERM] + 2 * (lens)[LENS_K2_TERM] * (square))
#else
#define LENS_STRETCH(square, lens) ((square) * (lens)[LENS_K1_TERM])
#define LENS_STRETCH_SLOPE(square, lens) ((lens)[LENS_K1_TERM])
#endif

// lens_straighten moves (x, y) to its undistorted place and returns the squared distance of the measured point from the
// centre. lens_undistort tells instead whether the measured point lies at or beyond the fold of the polynomial, where no
// scene point can be. One body for a sample and for 16.
#define LENS_UNDISTORT(SUFFIX, REAL, BITS)                                                                             \
    inline REAL lens_straighten##SUFFIX(REAL *x, REAL *y, constant real *lens) {                                       \
        const REAL along = *x - lens[LENS_CENTRE_X], across = *y - lens[LENS_CENTRE_Y];                                \
        const REAL square = along * along + across * across;                                                           \
        const REAL stretch = LENS_STRETCH(square, lens);                                                               \
        *x += along * stretch;                                                                                         \
        *y += across * stretch;                                                                                        \
        return square;                                                                                                 \
    }                                                                                                                  \
    inline BITS lens_undistort##SUFFIX(REAL *x, REAL *y, constant real *lens) {                                        \
        return lens_straighten##SUFFIX(x, y, lens) >= lens[LENS_FOLD_SQUARE];                                          \
    }
LENS_UNDISTORT(, real, int)
LENS_UNDISTORT(16, real16, bits16)

// Takes a gradient over undistorted (x, y) back to one over the measured (x, y) given.
#define LENS_PULL_BACK(NAME, REAL)                                                                                     \
    inline void NAME(REAL x, REAL y, constant real *lens, REAL *slope_x, REAL *slope_y) {                              \
        const REAL along = x - lens[LENS_CENTRE_X], across = y - lens[LENS_CENTRE_Y];                                  \
        const REAL square = along * along + across * across;                                                           \
        const REAL growth = 1 + LENS_STRETCH(square, lens);                                                            \
        const REAL turn = 2 * LENS_STRETCH_SLOPE(square, lens) * (along * *slope_x + across * *slope_y);               \
        *slope_x = *slope_x * growth + along * turn;                                                                   \
        *slope_y = *slope_y * growth + across * turn;                                                                  \
    }
LENS_PULL_BACK(lens_pull_back, real)
LENS_PULL_BACK(lens_pull_back16, real16)

#endif
#endif
