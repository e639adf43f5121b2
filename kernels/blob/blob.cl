// Fiducials and blobs of a known shape near given positions: calipers (rulers) across the contour, then a robust fit of the
// shape to their edges (blob_edges.h, blob_start.h, blob_fit.h), optionally refined by the grey levels (blob_match.h).
//
// Inputs:  image (rows, columns), type CODE; places (count, PLACE): x, y, size, and the angle of shapes that are not round.
// Outputs: (count,) each: x, y, size, residual, distance, blur [px], angle [rad], symmetry, contrast, centroid (gravity_x,
//          gravity_y), inliers, status; shift (count, 2); covariance (count, FREEDOMS, FREEDOMS).
// Tables:  table: parameters of ruler.h. ruler_table: six rows of PADDED_SPOKES numbers for a shape of size 1: centre of
//          the ruler (x, y); its direction (x, y), outwards from the fiducial; distance of the edge from the centre; 1,
//          or 0 for padding.
// Options: ROUND: the contour is one circle or two, FREEDOMS is 3: x, y, size; else straight edges, FREEDOMS is 4: x, y,
//          size, angle. EITHER_POLARITY: fiducials may be brighter or darker than the background. MATCH_IMAGE: refine by
//          grey levels. SPOKES: number of rulers, even; opposite rulers are SPOKES / 2 apart. PADDED_SPOKES: SPOKES
//          rounded up to whole vectors.
// Variants: vector: a work-item processes `each` fiducials, 16 rulers in a vector; work-item: a work-group of
//          RULER_GROUP items per fiducial, one ruler after the other.
#include "blob/blob_fit.h"
#include "blob/blob_grey.h"
#include "blob/blob_start.h"

// Rulers are placed again unless the shape moved by less than this [px].
#ifdef MATCH_IMAGE
#define STILL (real)2
#else
#define STILL (real)0.1f
#endif
#define BILINEAR (real)(1.0f / 6) // variance that bilinear sampling adds to the blur [px^2]
#ifdef ROUND
#define PLACE 3
#else
#define PLACE 4
#endif

kernel void find_blobs(global const CODE *restrict image, global const real *restrict places, global real *restrict x,
                       global real *restrict y, global real *restrict shift, global real *restrict size,
                       global real *restrict angle, global real *restrict covariance, global real *restrict residual,
                       global int *restrict inliers, global real *restrict symmetry, global real *restrict gravity_x,
                       global real *restrict gravity_y, global real *restrict distance, global real *restrict contrast,
                       global real *restrict blur, global uchar *restrict status, constant real *table,
                       constant real *ruler_table, const int rows, const int columns, const uint count, const uint each,
                       const real search, const int least, const real across, const real overlap, const real extent,
                       const real pixel_noise, const real spacing, const int passes) {
    const blob_layout layout = {ruler_table,
                                ruler_table + PADDED_SPOKES,
                                ruler_table + 2 * PADDED_SPOKES,
                                ruler_table + 3 * PADDED_SPOKES,
                                ruler_table + 4 * PADDED_SPOKES,
                                ruler_table + 5 * PADDED_SPOKES};
#ifdef VECTOR_VARIANT
    const uint first = get_global_id(0) * each, end = min(first + each, count);
    const int mine = 1;
#else
    local ruler_memory rulers;
    local blob_shape shared_shape;
    local int shared_done;
    local blob_edges shared;
    const uint first = get_group_id(0), end = first + 1;
    const int mine = get_local_id(0) == 0;
#endif
    blob_edges edges;
    for (uint n = first; n < end; n++) {
        global const real *place = places + (ulong)n * PLACE;
#ifdef ROUND
        const blob_shape nominal = {0, 0, place[2], 0};
#else
        const blob_shape nominal = {0, 0, place[2], place[3]};
#endif
        const int bad = not_finite(place[0]) | not_finite(place[1]) | not_finite(nominal.size) |
                        not_finite(nominal.angle) | !(nominal.size > 0);
        blob_shape shape = nominal;
        real variance = 0, noise = 0, scale = 0;
        int found = 0, agreed = 0;
        for (int pass = 0; pass < passes && !bad; pass++) {
            const blob_shape from = shape;
            int done = 1;
#ifdef VECTOR_VARIANT
            measure(image, rows, columns, place[0], place[1], from, from.angle, table, layout, &edges);
#else
            measure(image, rows, columns, place[0], place[1], from, from.angle, table, layout, &shared, &rulers);
#endif
            if (mine) {
#ifndef VECTOR_VARIANT
                edges = shared;
#endif
                const real cosine = cos(nominal.angle), sine = sin(nominal.angle);
                found = keep_edges(&edges, layout, nominal, cosine, sine, search, &noise, &variance);
                if (pass == 0 && found >= least) shape = start_of(&edges, layout, nominal, START_REACH);
                agreed = found >= least && fit_shape(&edges, layout, 2 * START_REACH, noise, across, &shape, &variance,
                                                     &scale);
                const real dx = shape.x - from.x, dy = shape.y - from.y, ds = shape.size - from.size;
                const real da = (shape.angle - from.angle) * from.size;
#ifndef VECTOR_VARIANT
                shared = edges;
#endif
                done = !agreed || dx * dx + dy * dy + ds * ds + da * da < STILL * STILL;
            }
#ifndef VECTOR_VARIANT
            barrier(CLK_LOCAL_MEM_FENCE);
            if (mine) shared_shape = shape, shared_done = done;
            barrier(CLK_LOCAL_MEM_FENCE);
            shape = shared_shape, done = shared_done;
#endif
            if (done) break;
        }
        if (!mine) continue;
#ifndef VECTOR_VARIANT
        edges = shared;
#endif
#ifdef ROUND
        const real bent = variance + across;
#else
        const real bent = 0;
#endif
        blob_quality quality;
        int what = bad ? STATUS_NOT_FINITE : 0;
        if (!bad) {
            what |= SPOKES - edges.outside < least ? STATUS_OUT_OF_RANGE : 0;
            what |= SPOKES - edges.broken < least ? STATUS_NOT_FINITE : 0;
            if (!what && found < least) what = STATUS_LOW_SIGNAL;
            if (!what && !agreed) what = STATUS_AMBIGUOUS;
        }
        if (!what) {
            quality = quality_of(&edges, layout, shape, scale, bent, overlap);
            if (quality.inliers < least || !quality.regular) what = STATUS_AMBIGUOUS;
            else if (shape.x * shape.x + shape.y * shape.y > search * search) what = STATUS_OUT_OF_RANGE;
        }
#ifdef MATCH_IMAGE
        if (!what) {
            blob_grey grey = {0, quality.contrast, sqrt(fmax(variance - BILINEAR, SHARPEST * SHARPEST))};
            grey.background = background_of(image, rows, columns, place[0], place[1], shape, &edges, quality.weights,
                                            layout, grey.blur);
            blob_hidden hidden;
            hide(shape, quality.weights, layout, spacing, grey.blur, &hidden);
            if (!match(image, rows, columns, place[0], place[1], pixel_noise, extent, &hidden, &shape, &grey,
                       quality.covariance))
                what = STATUS_AMBIGUOUS;
            else if (shape.x * shape.x + shape.y * shape.y > search * search) what = STATUS_OUT_OF_RANGE;
            quality.contrast = grey.contrast;
            variance = grey.blur * grey.blur;
        }
#endif
        const int good = !what;
        x[n] = good ? place[0] + shape.x : REAL_NAN;
        y[n] = good ? place[1] + shape.y : REAL_NAN;
        shift[2 * n] = good ? shape.x : REAL_NAN;
        shift[2 * n + 1] = good ? shape.y : REAL_NAN;
        size[n] = good ? shape.size : REAL_NAN;
#ifndef ROUND
        angle[n] = good ? shape.angle : REAL_NAN;
#endif
        for (int j = 0; j < FREEDOMS; j++)
            for (int k = 0; k < FREEDOMS; k++)
                covariance[((ulong)n * FREEDOMS + j) * FREEDOMS + k] = good ? quality.covariance[j][k] : REAL_NAN;
        residual[n] = good ? quality.residual : REAL_NAN;
        inliers[n] = good ? quality.inliers : 0;
        symmetry[n] = good ? quality.symmetry : REAL_NAN;
        distance[n] = good ? sqrt(shape.x * shape.x + shape.y * shape.y) : REAL_NAN;
        contrast[n] = good ? quality.contrast : REAL_NAN;
        blur[n] = good ? sqrt(variance) : REAL_NAN;
        real to_x = 0, to_y = 0;
        const real middle_x = place[0] + shape.x, middle_y = place[1] + shape.y;
        const int heavy = good && gravity_of(image, rows, columns, middle_x, middle_y,
                                             shape.size * extent + (real)2.5f * sqrt(variance) + 1, &to_x, &to_y);
        gravity_x[n] = heavy ? middle_x + to_x : REAL_NAN;
        gravity_y[n] = heavy ? middle_y + to_y : REAL_NAN;
        status[n] = (uchar)(what | (good && quality.saturated ? STATUS_SATURATED : 0));
    }
}
