// Triangulation of a batch of points: sensor coordinates (u, v) -> points (G, H) in the sheet of light
// (common/sheet.h).
//
// Inputs:  u, v        (points,) INPUT [sensor unit]
//          sheet       SheetTable
//          sigma_u, sigma_v  standard deviations of u and v, under SHEET_SIGMAS
// Outputs: g, h        (points,) real [m]; NaN where the status is not 0
//          status      (points,) uchar
//          sigma_g, sigma_h  (points,) real [m], under SHEET_SIGMAS
// Build options: INPUT, INPUT2, INPUT4, INPUT16 (float or double), REAL_IS_DOUBLE, LENS, LENS_K2, LENS_K3, LENS_K4,
//          SHEET_SIGMAS, SHEET_COVARIANCE, PAST_CACHES, VECTOR_VARIANT.
// Work:    vector variant: a work-item processes `each` consecutive points in vectors of 16. Otherwise: a
//          work-item processes 4 points that lie a work-group apart (common/item_samples.h).
#include "common/item_samples.h"
#include "common/load.h"
#include "common/sheet.h"

// Triangulate the LANES points from point i on, of these sensor coordinates.
static inline void triangulate_at(ulong i, reals position, reals sample, global real *g, global real *h,
                                  global uchar *status, global real *sigma_g, global real *sigma_h,
                                  constant SheetTable *sheet, real sigma_u, real sigma_v) {
    reals at_g, at_h;
    store_bytes(sheet_point(position, sample, sheet, &at_g, &at_h), status + i);
    store_reals(at_g, g + i);
    store_reals(at_h, h + i);
#ifdef SHEET_SIGMAS
    reals of_g, of_h;
    sheet_sigma(position, sample, (reals)sigma_u, (reals)sigma_v, sheet, &of_g, &of_h);
    const masks missing = mask_of(LANED(not_finite)(at_g));
    store_reals(nan_where(missing, of_g), sigma_g + i);
    store_reals(nan_where(missing, of_h), sigma_h + i);
#endif
}

kernel void triangulate(global const INPUT *restrict u, global const INPUT *restrict v, global real *restrict g,
                        global real *restrict h, global uchar *restrict status, global real *restrict sigma_g,
                        global real *restrict sigma_h, const ulong points, const ulong each, constant SheetTable *sheet,
                        const real sigma_u, const real sigma_v) {
#ifdef VECTOR_VARIANT
    // The last vector is moved back to end with the last point, and some points are computed twice with the same result.
    // This costs less than a test for the end in every vector.
    const ulong first = get_global_id(0) * each, end = min(first + each, points);
    for (ulong next = first; next < end; next += LANES) {
        const ulong i = min(next, points - LANES);
        triangulate_at(i, load_inputs(u + i), load_inputs(v + i), g, h, status, sigma_g, sigma_h, sheet, sigma_u,
                       sigma_v);
    }
#else
    real4 position = load_item_samples(u, points), sample = load_item_samples(v, points);
    // Each step moves the next point to the first lane: an index that changes would put the lanes into memory.
    const ulong first = first_item_sample();
    for (int k = 0; k < ITEM_SAMPLES && first + k * item_step() < points; k++) {
        triangulate_at(first + k * item_step(), position.x, sample.x, g, h, status, sigma_g, sigma_h, sheet, sigma_u,
                       sigma_v);
        position = position.yzww;
        sample = sample.yzww;
    }
#endif
}
