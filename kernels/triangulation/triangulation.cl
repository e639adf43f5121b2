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
#include "common/team.h"

typedef struct {
    global const INPUT *u, *v;
    global real *g, *h;
    global uchar *status;
    global real *sigma_g, *sigma_h;
    ulong points;
    constant SheetTable *sheet;
    real sigma_u, sigma_v;
} Points;

// Triangulate the LANES points from point i on, of these sensor coordinates; return their status.
static inline bytes triangulate_at(ulong i, reals position, reals sample, const Points *io) {
    reals at_g, at_h;
    const bytes status = sheet_point(position, sample, io->sheet, &at_g, &at_h);
    store_reals(at_g, io->g + i);
    store_reals(at_h, io->h + i);
    store_bytes(status, io->status + i);
#ifdef SHEET_SIGMAS
    reals of_g, of_h;
    sheet_sigma(position, sample, (reals)io->sigma_u, (reals)io->sigma_v, io->sheet, &of_g, &of_h);
    const masks missing = mask_of(LANED(not_finite)(at_g));
    store_reals(nan_where(missing, of_g), io->sigma_g + i);
    store_reals(nan_where(missing, of_h), io->sigma_h + i);
#endif
    return status;
}

#ifdef VECTOR_VARIANT
#define BLOCK (16 * LANES)  // points that share a test

#if defined(SHEET_SIGMAS) || defined(CAMERA)
// The tests take a small part of the time.
static inline int triangulate_block(ulong first, const Points *io) { return 0; }
#else
// Mask of the places that may have a flag: all places with a flag, and without a distortion also far places.
static inline masks suspects(const SheetPlace *at, reals w, constant SheetTable *sheet) {
#if defined(LENS) || defined(PLANE)
    const masks near = mask_of(at->square < SHEET_REACH);
#else
    // Below the square root of SHEET_REACH, with a margin for the rounding of the sum. It takes fewer instructions than
    // the square, which is not computed.
    const masks near = mask_of(fabs(at->x) + fabs(at->y) < (real)5e5);
#endif
    return ~near | mask_of(w <= sheet->horizon) | at->folded;
}

// Triangulate the points of a block as if none had a flag; return whether this is so. Flags are rare, and one test of a
// block takes less time than a test of each vector.
static inline int triangulate_block(ulong first, const Points *io) {
    masks suspected = 0;
    for (int k = 0; k < BLOCK; k += LANES) {
        const ulong i = first + k;
        const SheetPlace at = sheet_place(load_inputs(io->u + i), load_inputs(io->v + i), io->sheet);
        reals at_g, at_h;
        suspected |= suspects(&at, sheet_project(&at, io->sheet, &at_g, &at_h), io->sheet);
        store_reals(at_g, io->g + i);
        store_reals(at_h, io->h + i);
        store_bytes((bytes)STATUS_OK, io->status + i);
    }
    return !any_lane(suspected);
}
#endif

// Triangulate the points begin <= i < end. Points with a flag often lie together: after a block with a flag, blocks are
// computed point by point until one has none. The last vector is moved back to end with the last point, and some points
// are computed twice with the same result: this costs less than a test for the end in every vector.
static inline void triangulate_range(ulong begin, ulong end, const Points *io) {
    int is_clean = 1;
    for (ulong first = begin; first < end; first += BLOCK) {
        const ulong stop = min(first + BLOCK, end);
        if (is_clean && stop == first + BLOCK && triangulate_block(first, io)) continue;
        bytes found = 0;
        for (ulong next = first; next < stop; next += LANES) {
            const ulong i = min(next, io->points - LANES);
            found |= triangulate_at(i, load_inputs(io->u + i), load_inputs(io->v + i), io);
        }
        const ulong2 words = as_ulong2(found);
        is_clean = (words.x | words.y) == 0;
    }
}
#endif

kernel void triangulate(global const INPUT *restrict u, global const INPUT *restrict v, global real *restrict g,
                        global real *restrict h, global uchar *restrict status, global real *restrict sigma_g,
                        global real *restrict sigma_h, const ulong points, const ulong each, constant SheetTable *sheet,
                        const real sigma_u, const real sigma_v TEAM_ARGUMENTS) {
    const Points io = {u, v, g, h, status, sigma_g, sigma_h, points, sheet, sigma_u, sigma_v};
#ifdef VECTOR_VARIANT
    FOR_EACH_ITEM(item) {
        const ulong first = item.x * each;
        triangulate_range(first, min(first + each, points), &io);
    }
#else
    real4 position = load_item_samples(u, points), sample = load_item_samples(v, points);
    // Each step moves the next point to the first lane: an index that changes would put the lanes into memory.
    const ulong first = first_item_sample();
    for (int k = 0; k < ITEM_SAMPLES && first + k * item_step() < points; k++) {
        triangulate_at(first + k * item_step(), position.x, sample.x, &io);
        position = position.yzww;
        sample = sample.yzww;
    }
#endif
}
