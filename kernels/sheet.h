// A light position on the sensor -> a point in the sheet of light, by a plane-plane homography in displacement form:
//
//     x = (position - x0) sx,  y = (sample - y0) sy           about -1 .. 1; then the lens, where there is one
//     w = 1 + dx x + dy y                                     the denominator, 1 in the middle of the sensor
//     G = g0 + gx p + gy q,  H = h0 + hx p + hy q             with p = x/w, q = y/w
//
// The host folds everything else into these numbers in double, with origins and scales as the device's real type
// holds them: a single-precision result is a few roundings away from the double one. The table is
// Triangulation.packed in triangulation.py. One body for a sample and for 16.
#ifndef SHEET_H
#define SHEET_H

#include "real.h"
#include "status.h"

#include "lens.h"

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

#define SHEET_X(position, sheet) (((position) - (sheet)[SHEET_POSITION_ORIGIN]) * (sheet)[SHEET_POSITION_SCALE])
#define SHEET_Y(sample, sheet) (((sample) - (sheet)[SHEET_SAMPLE_ORIGIN]) * (sheet)[SHEET_SAMPLE_SCALE])

// Undoes the lens, where there is one, and returns the squared distance from its centre or from the sensor's middle.
#ifdef LENS
#define SHEET_STRAIGHTEN(SUFFIX, x, y, sheet) lens_straighten##SUFFIX(&x, &y, sheet + SHEET_LENS)
#define SHEET_FOLDED(square, sheet) (square >= sheet[SHEET_LENS + LENS_FOLD_SQUARE])
#define SHEET_PULL_BACK(SUFFIX, x, y, sheet, slope_x, slope_y)                                                         \
    lens_pull_back##SUFFIX(x, y, sheet + SHEET_LENS, slope_x, slope_y)
#else
#define SHEET_STRAIGHTEN(SUFFIX, x, y, sheet) (x * x + y * y)
#define SHEET_FOLDED(square, sheet) 0
#define SHEET_PULL_BACK(SUFFIX, x, y, sheet, slope_x, slope_y)
#endif

// Squared distance, in half the sensor's extent, from which a coordinate counts as not finite: nothing
// below overflows, and one comparison of bits finds what is larger, infinite or NaN.
#define SHEET_REACH as_bits((real)1e12)

// sheet_point, sheet_point16: writes G and H (NaN where the status is not 0) and returns the status:
// NOT_FINITE, FOLDED (beyond the lens' fold), HORIZON (the ray does not meet the sheet in front of the sensor, or so
// far away that the place means nothing). Straight-line code in a form that PoCL vectorises across work-items: a second
// test for NaN, or an | of tests, makes LLVM pair scalars up first and then give up.
#define SHEET_POINT(SUFFIX, REAL, BITS, FLAGS, STATUS, TO_STATUS)                                                      \
    inline STATUS sheet_point##SUFFIX(REAL position, REAL sample, constant real *sheet, REAL *g, REAL *h) {            \
        REAL x = SHEET_X(position, sheet), y = SHEET_Y(sample, sheet);                                                 \
        const REAL square = SHEET_STRAIGHTEN(SUFFIX, x, y, sheet);                                                     \
        const BITS lost = as_bits##SUFFIX(square) >= SHEET_REACH;                                                      \
        const BITS folded = SHEET_FOLDED(square, sheet);                                                               \
        const REAL w = 1 + sheet[SHEET_W_TERMS] * x + sheet[SHEET_W_TERMS + 1] * y;                                    \
        const BITS hidden = w <= sheet[SHEET_HORIZON];                                                                 \
        const REAL p = x / w, q = y / w;                                                                               \
        const REAL at_g = sheet[SHEET_G_TERMS] + (sheet[SHEET_G_TERMS + 1] * p + sheet[SHEET_G_TERMS + 2] * q);        \
        const REAL at_h = sheet[SHEET_H_TERMS] + (sheet[SHEET_H_TERMS + 1] * p + sheet[SHEET_H_TERMS + 2] * q);        \
        FLAGS flags = hidden ? (FLAGS)STATUS_HORIZON : (FLAGS)STATUS_OK;                                               \
        flags = folded ? (FLAGS)STATUS_FOLDED : flags;                                                                 \
        flags = lost ? (FLAGS)STATUS_NOT_FINITE : flags;                                                               \
        *g = flags != (FLAGS)STATUS_OK ? (REAL)REAL_NAN : at_g;                                                        \
        *h = flags != (FLAGS)STATUS_OK ? (REAL)REAL_NAN : at_h;                                                        \
        return TO_STATUS(flags);                                                                                       \
    }
SHEET_POINT(, real, int, uchar, uchar, (uchar))
SHEET_POINT(16, real16, bits16, bits16, uchar16, convert_uchar16)

// The variance that the parameters' covariance brings in: |factor' d|^2, d = (1, p, q, -r p, -r q), r = value - value0.
#define SHEET_SQUARE(value) ((value) * (value))
#define SHEET_PARAMETER_VARIANCE(f, p, q, r)                                                                           \
    (SHEET_SQUARE((f)[0] + (f)[1] * (p) + (f)[2] * (q) - (r) * ((f)[3] * (p) + (f)[4] * (q))) +                        \
     SHEET_SQUARE((f)[5] * (p) + (f)[6] * (q) - (r) * ((f)[7] * (p) + (f)[8] * (q))) +                                 \
     SHEET_SQUARE((f)[9] * (q) - (r) * ((f)[10] * (p) + (f)[11] * (q))) +                                              \
     SHEET_SQUARE((r) * ((f)[12] * (p) + (f)[13] * (q))) + SHEET_SQUARE((r) * (f)[14] * (q)))

#ifdef SHEET_COVARIANCE
#define SHEET_ADD_PARAMETERS(f, p, q, r) +SHEET_PARAMETER_VARIANCE(f, p, q, r)
#else
#define SHEET_ADD_PARAMETERS(f, p, q, r)
#endif

// sheet_sigma, sheet_sigma16: standard deviations of G and H for independent ones of position and sample, by the
// gradients at the point; the parameters' own covariance is added under SHEET_COVARIANCE. Means nothing where
// sheet_point flags the point.
#define SHEET_SIGMA(SUFFIX, REAL)                                                                                      \
    inline REAL sheet_slope_sigma##SUFFIX(REAL x, REAL y, REAL slope_x, REAL slope_y, REAL sigma_x, REAL sigma_y,      \
                                          REAL variance, constant real *sheet) {                                       \
        SHEET_PULL_BACK(SUFFIX, x, y, sheet, &slope_x, &slope_y);                                                      \
        return sqrt(SHEET_SQUARE(slope_x * sigma_x) + SHEET_SQUARE(slope_y * sigma_y) + variance);                     \
    }                                                                                                                  \
    inline void sheet_sigma##SUFFIX(REAL position, REAL sample, REAL sigma_position, REAL sigma_sample,                \
                                    constant real *sheet, REAL *sigma_g, REAL *sigma_h) {                              \
        const REAL measured_x = SHEET_X(position, sheet), measured_y = SHEET_Y(sample, sheet);                         \
        REAL x = measured_x, y = measured_y;                                                                           \
        (void)SHEET_STRAIGHTEN(SUFFIX, x, y, sheet);                                                                   \
        constant real *in_w = sheet + SHEET_W_TERMS, *in_g = sheet + SHEET_G_TERMS, *in_h = sheet + SHEET_H_TERMS;     \
        const REAL w = 1 + in_w[0] * x + in_w[1] * y;                                                                  \
        const REAL p = x / w, q = y / w;                                                                               \
        const REAL from_g = in_g[1] * p + in_g[2] * q, from_h = in_h[1] * p + in_h[2] * q;                             \
        const REAL sigma_x = sigma_position * sheet[SHEET_POSITION_SCALE];                                             \
        const REAL sigma_y = sigma_sample * sheet[SHEET_SAMPLE_SCALE];                                                 \
        const REAL of_g = 0 SHEET_ADD_PARAMETERS(sheet + SHEET_FACTOR_G, p, q, from_g);                                \
        const REAL of_h = 0 SHEET_ADD_PARAMETERS(sheet + SHEET_FACTOR_H, p, q, from_h);                                \
        *sigma_g = sheet_slope_sigma##SUFFIX(measured_x, measured_y, (in_g[1] - from_g * in_w[0]) / w,                 \
                                             (in_g[2] - from_g * in_w[1]) / w, sigma_x, sigma_y, of_g, sheet);         \
        *sigma_h = sheet_slope_sigma##SUFFIX(measured_x, measured_y, (in_h[1] - from_h * in_w[0]) / w,                 \
                                             (in_h[2] - from_h * in_w[1]) / w, sigma_x, sigma_y, of_h, sheet);         \
    }
SHEET_SIGMA(, real)
SHEET_SIGMA(16, real16)

#endif
