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
#include "common/team.h"

#ifdef VECTOR_VARIANT
// Load LANES points from point i on, and separate x and y.
static inline void load_points(global const INPUT *points, ulong i, reals *x, reals *y) {
    const reals low = load_inputs(points + 2 * i), high = load_inputs(points + 2 * i + LANES);
    *x = (reals)(low.even, high.even);
    *y = (reals)(low.odd, high.odd);
}
#endif

// Store LANES points from point i on, with x and y interleaved: one shuffle of x and y for each stored vector.
static inline void store_points(reals x, reals y, global real *points, ulong i) {
#ifdef VECTOR_VARIANT
    const reals low = __builtin_shufflevector(x, y, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
    const reals high = __builtin_shufflevector(x, y, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
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

// Move points (x, y) by the model; return the status flags of points without a result. *certain: no lane has a flag, and
// all results are finite.
static inline __attribute__((always_inline)) masks LANED(moved)(reals *x, reals *y, constant real *model,
                                                                int *certain) {
    *certain = 0;
#if defined(PLANE) && defined(INVERSE)
    return LANED(plane_show)(x, y, model) & STATUS_OUT_OF_RANGE;
#elif defined(PLANE)
    return LANED(plane_measure)(x, y, model) & STATUS_OUT_OF_RANGE;
#elif defined(CAMERA) && defined(INVERSE)
    return LANED(camera_distort)(x, y, model) & STATUS_NOT_INVERTIBLE;
#elif defined(CAMERA)
    return LANED(camera_undistort)(x, y, model, certain) & STATUS_NOT_INVERTIBLE;
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
    int certain;
    masks flags = LANED(moved)(&x, &y, model, &certain);
    // Flags are rare: one test of all lanes skips the rest.
    const masks bad = mask_of(flags != 0) | mask_of(LANED(not_finite)(x)) | mask_of(LANED(not_finite)(y));
    if (!certain && any_lane(bad)) {
        const masks good = ~mask_of(LANED(not_finite)(given_x)) & ~mask_of(LANED(not_finite)(given_y));
        x = nan_where(bad, x);
        y = nan_where(bad, y);
        flags = (bad & ~(good & mask_of(flags != 0))) ? (masks)STATUS_NOT_FINITE : flags;
    }
    store_points(x, y, moved_points, i);
    store_bytes(convert_bytes(flags), status + i);
}

// The arrays are not `restrict`: the compilers would load the numbers of the model once, before the loop. They are more
// than the registers, and PoCL's compiler spills them to a stack that is not aligned to vectors, so that each use crosses a
// cache line. Numbers that the instructions of each vector read from the table take 25 % less time.
kernel void undistort_points(global const INPUT *points, global real *moved_points, global uchar *status,
                             constant real *model, const ulong count, const ulong each TEAM_ARGUMENTS) {
#ifdef VECTOR_VARIANT
    // The last vector moves back to end with the last point, and computes some points twice. This is cheaper than a test
    // for the end in every vector.
    FOR_EACH_ITEM(item) {
        const ulong first = item.x * each, end = min(first + each, count);
        for (ulong next = first; next < end; next += LANES) {
            const ulong i = min(next, count - LANES);
            reals x, y;
            load_points(points, i, &x, &y);
            move_points(i, x, y, moved_points, status, model);
        }
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
