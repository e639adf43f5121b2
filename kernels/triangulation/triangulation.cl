// Triangulation of a batch of points: sensor coordinates (u, v) -> points (G, H) in the sheet of light
// (common/sheet.h).
//
// Inputs:  u, v        (points,) INPUT [sensor unit]
//          sheet       SheetTable
//          sigma_u, sigma_v  standard deviations of u and v, under SHEET_SIGMAS
// Outputs: g, h        (points,) real [m]; NaN where the status is not 0
//          status      (points,) uchar
//          sigma_g, sigma_h  (points,) real [m], under SHEET_SIGMAS
// Build options: INPUT, INPUT16 (float or double), REAL_IS_DOUBLE, LENS, LENS_K2, LENS_K3, LENS_K4,
//          SHEET_SIGMAS, SHEET_COVARIANCE, PAST_CACHES, VECTOR_VARIANT.
// Work:    vector variant: a work-item processes `each` consecutive points in vectors of 16. Otherwise: one work-item
//          per point, in work-groups of at most `points` work-items.
#include "common/load.h"
#include "common/sheet.h"

// Triangulate the LANES points from point i on.
static inline void triangulate_at(ulong i, global const INPUT *u, global const INPUT *v, global real *g, global real *h,
                                  global uchar *status, global real *sigma_g, global real *sigma_h,
                                  constant SheetTable *sheet, real sigma_u, real sigma_v) {
    const reals position = load_inputs(u + i), sample = load_inputs(v + i);
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
    // The last vector, or work-group, is moved back to end with the last point, and some points are computed twice with
    // the same result. This costs less than a test for the end in every work-item.
#ifdef VECTOR_VARIANT
    const ulong first = get_global_id(0) * each, end = min(first + each, points);
    for (ulong next = first; next < end; next += LANES) {
        triangulate_at(min(next, points - LANES), u, v, g, h, status, sigma_g, sigma_h, sheet, sigma_u, sigma_v);
    }
#else
    const ulong group = get_local_size(0), i = min(get_group_id(0) * group, points - group) + get_local_id(0);
    triangulate_at(i, u, v, g, h, status, sigma_g, sigma_h, sheet, sigma_u, sigma_v);
#endif
}
