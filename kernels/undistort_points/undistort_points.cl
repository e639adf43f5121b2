// Undistortion of points: measured points to ideal points, or ideal to measured with INVERSE.
//
// Inputs:  points (count, 2) column, row [px], type INPUT.
// Outputs: moved_points (count, 2) column, row [px]; with PLANE x, y [m]; NaN where the status is not OK. status
//          (count,): NOT_INVERTIBLE beyond the fold of the lens, OUT_OF_RANGE outside the region of PLANE, NOT_FINITE.
// Tables:  model: parameters of the model.
// Options: INPUT, INPUT2, INPUT4, INPUT16, REAL_IS_DOUBLE, INVERSE; the model: CAMERA (common/camera.h), LENS (common/lens.h) or PLANE
//          (plane.h).
// Variants: vector: a work-item processes `each` points, 16 in a vector; work-item: a work-item processes 4 points
//          that lie a work-group apart (common/item_samples.h).
#include "common/camera.h"
#include "common/item_samples.h"
#include "common/lens.h"
#include "common/load.h"
#include "common/plane.h"
#include "common/status.h"

#ifdef VECTOR_VARIANT
// Load LANES points from point i on, and separate x and y.
static inline void load_points(global const INPUT *points, ulong i, reals *x, reals *y) {
    const reals low = load_inputs(points + 2 * i), high = load_inputs(points + 2 * i + LANES);
    *x = (reals)(low.even, high.even);
    *y = (reals)(low.odd, high.odd);
}
#endif

// Store LANES points from point i on, with x and y interleaved.
static inline void store_points(reals x, reals y, global real *points, ulong i) {
#ifdef VECTOR_VARIANT
    reals low, high;
    low.even = x.lo;
    low.odd = y.lo;
    high.even = x.hi;
    high.odd = y.hi;
    store_reals(low, points + 2 * i);
    store_reals(high, points + 2 * i + LANES);
#else
    if (is_aligned(points, sizeof(real2))) {
        ((global real2 *)points)[i] = (real2)(x, y);
    } else {
        points[2 * i] = x;
        points[2 * i + 1] = y;
    }
#endif
}

// Move points (x, y) by the model; return the status flags of points without a result.
static inline __attribute__((always_inline)) masks LANED(moved)(reals *x, reals *y, constant real *model) {
#if defined(PLANE) && defined(INVERSE)
    return LANED(plane_show)(x, y, model) & STATUS_OUT_OF_RANGE;
#elif defined(PLANE)
    return LANED(plane_measure)(x, y, model) & STATUS_OUT_OF_RANGE;
#elif defined(CAMERA) && defined(INVERSE)
    return LANED(camera_distort)(x, y, model) & STATUS_NOT_INVERTIBLE;
#elif defined(CAMERA)
    return LANED(camera_undistort)(x, y, model) & STATUS_NOT_INVERTIBLE;
#elif defined(INVERSE)
    return LANED(lens_distort)(x, y, model) & STATUS_NOT_INVERTIBLE;
#else
    return mask_of(LANED(lens_undistort)(x, y, model)) & STATUS_NOT_INVERTIBLE;
#endif
}

// Move the LANES points (x, y) from point i on, and store them.
static inline __attribute__((always_inline)) void move_points(ulong i, reals x, reals y, global real *moved_points,
                                                              global uchar *status, constant real *model) {
    const reals given_x = x, given_y = y;
    masks flags = LANED(moved)(&x, &y, model);
    // Flags are rare: one test of all lanes skips the rest.
    const masks bad = mask_of(flags != 0) | mask_of(LANED(not_finite)(x)) | mask_of(LANED(not_finite)(y));
    if (any_lane(bad)) {
        const masks good = ~mask_of(LANED(not_finite)(given_x)) & ~mask_of(LANED(not_finite)(given_y));
        x = nan_where(bad, x);
        y = nan_where(bad, y);
        flags = (bad & ~(good & mask_of(flags != 0))) ? (masks)STATUS_NOT_FINITE : flags;
    }
    store_points(x, y, moved_points, i);
    store_bytes(convert_bytes(flags), status + i);
}

kernel void undistort_points(global const INPUT *restrict points, global real *restrict moved_points,
                             global uchar *restrict status, constant real *model, const ulong count,
                             const ulong each) {
#ifdef VECTOR_VARIANT
    // The last vector moves back to end with the last point, and computes some points twice. This is cheaper than a test
    // for the end in every vector.
    const ulong first = get_global_id(0) * each, end = min(first + each, count);
    for (ulong next = first; next < end; next += LANES) {
        const ulong i = min(next, count - LANES);
        reals x, y;
        load_points(points, i, &x, &y);
        move_points(i, x, y, moved_points, status, model);
    }
#else
    real4 x, y;
    load_item_pairs(points, count, &x, &y);
    // Each step moves the next point to the first lane: an index that changes would put the lanes into memory.
    const ulong first = first_item_sample();
    for (int k = 0; k < ITEM_SAMPLES && first + k * item_step() < count; k++) {
        move_points(first + k * item_step(), x.x, y.x, moved_points, status, model);
        x = x.yzww;
        y = y.yzww;
    }
#endif
}
