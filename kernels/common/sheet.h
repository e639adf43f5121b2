// Triangulation: light position on the sensor -> point (G, H) in the sheet of light [m].
//
// A plane-to-plane homography in displacement form (F. de Jong, sections 2.3.3 and 3.3.2; Triangulation in
// gpuvision/ranging/triangulation.py):
//
//     x = (position - x0) sx,  y = (sample - y0) sy           about -1 .. 1; then the distortion is undone
//     w = 1 + dx x + dy y                                     denominator, 1 in the middle of the sensor
//     G = g0 + gx p + gy q,  H = h0 + hx p + hy q             with p = x/w, q = y/w
//
// The host folds all other constants into these numbers in double precision. Origins and scales are rounded to the
// kernel's real type before that, so a single-precision result is within a few roundings of the double-precision one.
// Build options: the distortion: LENS, LENS_K2, LENS_K3, LENS_K4 (lens.h); or CAMERA and its options (camera.h) with
// SHEET_ROWS where the samples run along the rows axis of the image (positions are columns); or PLANE (the higher terms of
// plane.h). SHEET_COVARIANCE adds the covariance of the parameters to the sigmas. CAMERA_PROFILES: number of terms of the
// table of sheet_place_in_profile.
#ifndef SHEET_H
#define SHEET_H

#include "common/camera.h"
#include "common/lanes.h"
#include "common/lens.h"
#include "common/plane.h"
#include "common/status.h"

// Parameters, in the order of SheetTable in triangulation.py (tests/ranging/test_tables.py compares them).
typedef struct {
    real position_origin, position_scale;  // x0, sx: position in the unit of the sensor -> about -1 .. 1
    real sample_origin, sample_scale;      // y0, sy
    real horizon;                          // smallest denominator w that counts
    real w_terms[2];                       // dx, dy
    real g_terms[3], h_terms[3];           // g0, gx, gy and h0, hx, hy [m]
    real lens[7];                          // table of lens.h, for x and y
    real factor_g[15], factor_h[15];       // triangular factors of the covariance of (g0, gx, gy, dx, dy) and of
                                           // (h0, hx, hy, dx, dy), column by column
#ifdef CAMERA
    real camera[63];                       // table of camera.h: pixels are positions and samples, the output is x and y
#endif
#ifdef PLANE
    real plane_origin[2], plane_scale[2];  // c = (sample - origin[0]) scale[0], r = (position - origin[1]) scale[1]:
                                           // -1 .. 1 in the region of the polynomials
    real plane_unit[2];                    // units of c and r in y and x
    real plane_terms[14];                  // a0 .. a6 and b0 .. b6 of plane.h
#endif
} SheetTable;

// Squared distance, in half extents of the sensor region, from which a coordinate counts as not finite. Smaller values do
// not overflow. A comparison with NaN is false for either sign of the NaN.
#define SHEET_REACH ((real)1e12)

#ifdef CAMERA
// Entry of the camera's table for the axis of the positions, and for the axis of the samples.
#ifdef SHEET_ROWS
#define SHEET_OF_POSITION(entry) entry##_X
#define SHEET_OF_SAMPLE(entry) entry##_Y
#else
#define SHEET_OF_POSITION(entry) entry##_Y
#define SHEET_OF_SAMPLE(entry) entry##_X
#endif

#ifndef CAMERA_PROFILES
// Compute the normalised correction of the camera along position and sample; return the mask of positions without one.
static inline __attribute__((always_inline)) masks sheet_correction(reals position, reals sample,
                                                                    constant SheetTable *sheet, reals *back_position,
                                                                    reals *back_sample) {
#ifdef SHEET_ROWS
    return LANED(camera_correction)(position, sample, sheet->camera, back_position, back_sample);
#else
    return LANED(camera_correction)(sample, position, sheet->camera, back_sample, back_position);
#endif
}
#endif
#endif

#ifdef PLANE
#define SHEET_FOLDED STATUS_OUT_OF_RANGE  // outside of the region of the polynomials
// Compute the coordinates (c, r) of the polynomials.
static inline void sheet_plane(reals position, reals sample, constant SheetTable *sheet, reals *c, reals *r) {
    *c = (sample - sheet->plane_origin[0]) * sheet->plane_scale[0];
    *r = (position - sheet->plane_origin[1]) * sheet->plane_scale[1];
}
#else
#define SHEET_FOLDED STATUS_NOT_INVERTIBLE
#endif

// Light position on the sensor and its undistorted place.
typedef struct {
    reals position, sample;  // measured
    reals x, y;              // undistorted and scaled
    reals square;            // squared distance of the measured place from the centre of the lens, or without a lens from
                             // the middle of the sensor region
    masks folded;            // no undistorted place: beyond the fold of the lens, behind the tilted sensor, or outside of
                             // the region of the polynomials
#ifdef CAMERA
    reals back_position, back_sample;  // normalised correction of the camera
#endif
} SheetPlace;

#ifdef CAMERA_PROFILES
// Compute the undistorted place of light positions by the table of a readout whose samples are whole numbers
// (gpuvision/camera/profile_correction.py). Along a profile, at a fixed sample, the correction of the camera is a
// polynomial of the position: t = (position - middle) scale, correction = c0 + t (c1 + t (c2 + ...)), in the units of x
// and y. The host makes the table only if all 24 x 24 nodes of a Chebyshev series over the frame have undistorted
// places, and the dropped terms of the series are below a quarter of a rounding. There are no division, no iteration
// and no test, and a third of the arithmetic.
//
// `sample` is the number of the first lane's profile, a multiple of 16 or samples - 16 k: the last vectors of a frame are
// moved back. The table `terms` has a block of (CAMERA_PROFILES, 2, 16) numbers for each 16 profiles, which are read in
// sequence: powers of t from the highest one, position and sample, profile. Blocks from profile samples % 16 on follow
// for the moved vectors.
static inline SheetPlace sheet_place_in_profile(reals position, int sample, int samples, global const real *terms,
                                                constant SheetTable *sheet) {
#ifdef VECTOR_VARIANT
    const int moved = sample % 16, block = sample / 16 + (moved ? (samples + 15) / 16 : 0), lane = 0;
#else
    const int block = sample / 16, lane = sample % 16;
#endif
    SheetPlace at;
    at.position = position;
    at.sample = to_reals((ints)sample + LANE_NUMBERS);
    at.x = (position - sheet->position_origin) * sheet->position_scale;
    at.y = (at.sample - sheet->sample_origin) * sheet->sample_scale;
    at.square = at.x * at.x + at.y * at.y;
    at.folded = 0;
    const reals t = (position - sheet->camera[CAMERA_PROFILE_MIDDLE]) * sheet->camera[CAMERA_PROFILE_SCALE];
    global const real *next = terms + (long)block * (32 * CAMERA_PROFILES) + lane;
    reals move_x = load_reals(next), move_y = load_reals(next + 16);
    _Pragma("unroll") for (int k = 1; k < CAMERA_PROFILES; k++) {
        move_x = load_reals(next + 32 * k) + t * move_x;
        move_y = load_reals(next + 32 * k + 16) + t * move_y;
    }
    at.x += move_x;
    at.y += move_y;
    at.back_position = move_x / sheet->camera[SHEET_OF_POSITION(CAMERA_FOCAL)];
    at.back_sample = move_y / sheet->camera[SHEET_OF_SAMPLE(CAMERA_FOCAL)];
    return at;
}
#else
// Compute the undistorted place of a light position.
static inline SheetPlace sheet_place(reals position, reals sample, constant SheetTable *sheet) {
    SheetPlace at;
    at.position = position;
    at.sample = sample;
    at.x = (position - sheet->position_origin) * sheet->position_scale;
    at.y = (sample - sheet->sample_origin) * sheet->sample_scale;
#if defined(LENS)
    at.square = LANED(lens_straighten)(&at.x, &at.y, sheet->lens);
    at.folded = mask_of(at.square >= sheet->lens[LENS_FOLD_SQUARE]);
#elif defined(CAMERA)
    at.square = at.x * at.x + at.y * at.y;
    at.folded = sheet_correction(position, sample, sheet, &at.back_position, &at.back_sample);
    at.x += at.back_position * sheet->camera[SHEET_OF_POSITION(CAMERA_FOCAL)];
    at.y += at.back_sample * sheet->camera[SHEET_OF_SAMPLE(CAMERA_FOCAL)];
#elif defined(PLANE)
    at.square = at.x * at.x + at.y * at.y;
    reals c, r;
    sheet_plane(position, sample, sheet, &c, &r);
    at.folded = ~LANED(plane_within)(c, r, PLANE_EDGE);
    at.x += sheet->plane_unit[1] * LANED(plane_bend)(c, r, sheet->plane_terms + 7);
    at.y += sheet->plane_unit[0] * LANED(plane_bend)(c, r, sheet->plane_terms);
#else
    at.square = at.x * at.x + at.y * at.y;
    at.folded = 0;
#endif
    return at;
}
#endif

// Compute G and H of an undistorted place, whatever its flags; return the denominator w.
static inline reals sheet_project(const SheetPlace *at, constant SheetTable *sheet, reals *g, reals *h) {
    constant real *in_w = sheet->w_terms, *in_g = sheet->g_terms, *in_h = sheet->h_terms;
    const reals w = 1 + in_w[0] * at->x + in_w[1] * at->y;
#ifdef VECTOR_VARIANT
    // One division for both coordinates, at the cost of one more rounding each: a CPU divides 16 lanes in the time of
    // about ten multiplications.
    const reals per = 1 / w, p = at->x * per, q = at->y * per;
#else
    const reals p = at->x / w, q = at->y / w;
#endif
    *g = in_g[0] + (in_g[1] * p + in_g[2] * q);
    *h = in_h[0] + (in_h[1] * p + in_h[2] * q);
    return w;
}

// Compute G and H (NaN where the status is not 0) and return the status: NOT_FINITE; NOT_INVERTIBLE: beyond the fold of
// the lens or behind the tilted sensor; OUT_OF_RANGE: outside of the region of the polynomials; HORIZON: the ray does not
// meet the sheet in front of the sensor, or meets it too far away.
static inline bytes sheet_point_at(const SheetPlace *at, constant SheetTable *sheet, reals *g, reals *h) {
    const reals w = sheet_project(at, sheet, g, h);
    const masks lost = ~mask_of(at->square < SHEET_REACH);
    const masks hidden = mask_of(w <= sheet->horizon);
    const masks flagged = lost | hidden | at->folded;
    bytes status = STATUS_OK;
    // Flags are rare, and computing them takes half as long as the geometry: skip it where no lane has a flag.
    if (any_lane(flagged)) {
        *g = nan_where(flagged, *g);
        *h = nan_where(flagged, *h);
        const masks which = (at->folded & SHEET_FOLDED) | (~at->folded & hidden & STATUS_HORIZON);
        status = convert_bytes((lost & STATUS_NOT_FINITE) | (~lost & which));
    }
    return status;
}

#ifndef CAMERA_PROFILES
// The same for a light position.
static inline bytes sheet_point(reals position, reals sample, constant SheetTable *sheet, reals *g, reals *h) {
    const SheetPlace at = sheet_place(position, sample, sheet);
    return sheet_point_at(&at, sheet, g, h);
}
#endif

// Variance of G or H from the covariance C = F F' of its parameters (a0, ax, ay, dx, dy): |F' d|^2 with the gradient
// d = (1, p, q, -r p, -r q) and r = value - a0. F is lower triangular, column by column in `factor`.
static inline reals sheet_parameter_variance(constant real *factor, reals p, reals q, reals r) {
    const reals first = factor[0] + factor[1] * p + factor[2] * q - r * (factor[3] * p + factor[4] * q);
    const reals second = factor[5] * p + factor[6] * q - r * (factor[7] * p + factor[8] * q);
    const reals third = factor[9] * q - r * (factor[10] * p + factor[11] * q);
    const reals fourth = r * (factor[12] * p + factor[13] * q), fifth = r * factor[14] * q;
    return first * first + second * second + third * third + fourth * fourth + fifth * fifth;
}

// Convert a gradient over the undistorted (x, y) to the gradient over the measured (x, y).
static inline void sheet_pull_back(const SheetPlace *at, constant SheetTable *sheet, reals *slope_x, reals *slope_y) {
#if defined(LENS)
    const reals measured_x = (at->position - sheet->position_origin) * sheet->position_scale;
    const reals measured_y = (at->sample - sheet->sample_origin) * sheet->sample_scale;
    LANED(lens_pull_back)(measured_x, measured_y, sheet->lens, slope_x, slope_y);
#elif defined(CAMERA)
    // The gradient over normalised coordinates is the gradient over (x, y) times the focal lengths.
    const real focal_x = sheet->camera[SHEET_OF_POSITION(CAMERA_FOCAL)];
    const real focal_y = sheet->camera[SHEET_OF_SAMPLE(CAMERA_FOCAL)];
    const reals back_x = at->back_position, back_y = at->back_sample;
    *slope_x *= focal_x;
    *slope_y *= focal_y;
#ifdef SHEET_ROWS
    LANED(camera_pull_back)(at->position, at->sample, back_x, back_y, sheet->camera, slope_x, slope_y);
#else
    LANED(camera_pull_back)(at->sample, at->position, back_y, back_x, sheet->camera, slope_y, slope_x);
#endif
    *slope_x /= focal_x;
    *slope_y /= focal_y;
#elif defined(PLANE)
    // The displaced place is (x + unit_r b(c, r), y + unit_c a(c, r)) with c = y / unit_c and r = x / unit_r.
    const real ratio = sheet->plane_unit[0] / sheet->plane_unit[1];
    reals c, r, a_c, a_r, b_c, b_r;
    sheet_plane(at->position, at->sample, sheet, &c, &r);
    LANED(plane_slopes)(c, r, sheet->plane_terms, &a_c, &a_r);
    LANED(plane_slopes)(c, r, sheet->plane_terms + 7, &b_c, &b_r);
    const reals by_x = *slope_x + *slope_x * b_r + *slope_y * ratio * a_r;
    const reals by_y = *slope_y + *slope_y * a_c + *slope_x / ratio * b_c;
    *slope_x = by_x;
    *slope_y = by_y;
#endif
}

typedef struct {
    reals g, h;  // variances of G and H [m^2]
} SheetVariances;

// Compute the variance of G or H, given its terms, at (p, q) with denominator w, for the standard deviations sigma_x and
// sigma_y of the measured x and y.
static inline reals sheet_noise_of(constant real *terms, const SheetPlace *at, reals p, reals q, reals w, reals sigma_x,
                                   reals sigma_y, constant SheetTable *sheet) {
    const reals offset = terms[1] * p + terms[2] * q;
    reals slope_x = (terms[1] - offset * sheet->w_terms[0]) / w;
    reals slope_y = (terms[2] - offset * sheet->w_terms[1]) / w;
    sheet_pull_back(at, sheet, &slope_x, &slope_y);
    slope_x *= sigma_x;
    slope_y *= sigma_y;
    return slope_x * slope_x + slope_y * slope_y;
}

// Compute the random variances of G and H, to first order, from independent errors of position and sample. The result
// is meaningless where sheet_point sets a flag.
static inline SheetVariances sheet_noise_at(const SheetPlace *at, reals sigma_position, reals sigma_sample,
                                            constant SheetTable *sheet) {
    const reals w = 1 + sheet->w_terms[0] * at->x + sheet->w_terms[1] * at->y;
    const reals p = at->x / w, q = at->y / w;
    const reals sigma_x = sigma_position * sheet->position_scale;
    const reals sigma_y = sigma_sample * sheet->sample_scale;
    const SheetVariances noise = {sheet_noise_of(sheet->g_terms, at, p, q, w, sigma_x, sigma_y, sheet),
                                  sheet_noise_of(sheet->h_terms, at, p, q, w, sigma_x, sigma_y, sheet)};
    return noise;
}

// Compute the systematic variances of G and H, to first order, from the covariance of the parameters.
static inline SheetVariances sheet_systematic_at(const SheetPlace *at, constant SheetTable *sheet) {
    constant real *in_g = sheet->g_terms, *in_h = sheet->h_terms;
    const reals w = 1 + sheet->w_terms[0] * at->x + sheet->w_terms[1] * at->y;
    const reals p = at->x / w, q = at->y / w;
    const SheetVariances systematic = {
        sheet_parameter_variance(sheet->factor_g, p, q, in_g[1] * p + in_g[2] * q),
        sheet_parameter_variance(sheet->factor_h, p, q, in_h[1] * p + in_h[2] * q)};
    return systematic;
}

#ifndef CAMERA_PROFILES
// Compute the standard deviations of G and H for independent errors of position and sample. Under SHEET_COVARIANCE the
// systematic variances are added.
static inline void sheet_sigma(reals position, reals sample, reals sigma_position, reals sigma_sample,
                               constant SheetTable *sheet, reals *sigma_g, reals *sigma_h) {
    const SheetPlace at = sheet_place(position, sample, sheet);
    SheetVariances sum = sheet_noise_at(&at, sigma_position, sigma_sample, sheet);
#ifdef SHEET_COVARIANCE
    const SheetVariances systematic = sheet_systematic_at(&at, sheet);
    sum.g += systematic.g;
    sum.h += systematic.h;
#endif
    *sigma_g = sqrt(sum.g);
    *sigma_h = sqrt(sum.h);
}
#endif

#endif
