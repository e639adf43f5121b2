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
// Variants: vector: a work-item processes `each` fiducials, 16 rulers or pixels in a vector; work-item: a work-group of
//          RULER_GROUP items per fiducial. The items share the samples of RULERS_PER_GROUP rulers at a time
//          (ruler_group.h), the start shapes, the edges and the pixels, and add up their sums in local memory (group.h).
#ifndef VECTOR_VARIANT
#define GROUP_PER_PROBLEM
#endif
#include "blob/blob_fit.h"
#include "blob/blob_grey.h"
#include "blob/blob_start.h"
#include "common/team.h"

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

// Whether a shape is further than `search` from the nominal position.
static inline int is_beyond(blob_shape shape, real search) {
    return shape.x * shape.x + shape.y * shape.y > search * search;
}

kernel void find_blobs(global const CODE *restrict image, global const real *restrict places, global real *restrict x,
                       global real *restrict y, global real *restrict shift, global real *restrict size,
                       global real *restrict angle, global real *restrict covariance, global real *restrict residual,
                       global int *restrict inliers, global real *restrict symmetry, global real *restrict gravity_x,
                       global real *restrict gravity_y, global real *restrict distance, global real *restrict contrast,
                       global real *restrict blur, global uchar *restrict status, constant real *table,
                       constant real *ruler_table, const int rows, const int columns, const uint count, const uint each,
                       const real search, const int least, const real across, const real overlap, const real extent,
                       const real pixel_noise, const real spacing, const int passes TEAM_ARGUMENTS) {
    const blob_layout layout = {ruler_table,
                                ruler_table + PADDED_SPOKES,
                                ruler_table + 2 * PADDED_SPOKES,
                                ruler_table + 3 * PADDED_SPOKES,
                                ruler_table + 4 * PADDED_SPOKES,
                                ruler_table + 5 * PADDED_SPOKES};
    GROUP_SPACE blob_edges edges;
    GROUP_SPACE blob_fit fit;
    GROUP_SPACE blob_quality quality;
    GROUP_SPACE real distances[PADDED_SPOKES]; // of the edges from the shape
    GROUP_SPACE blob_room room;
#ifdef MATCH_IMAGE
    GROUP_SPACE blob_hidden hidden;
    GROUP_SPACE blob_match match;
#endif
#ifdef VECTOR_VARIANT
    FOR_EACH_ITEM(item) {
        const uint first = item.x * each, end = min(first + each, count);
#else
    {
        const uint first = get_group_id(0), end = first + 1;
#endif
        uint n = first;
        do {
            global const real *place = places + (ulong)n * PLACE;
#ifdef ROUND
            const blob_shape nominal = {0, 0, place[2], 0};
#else
            const blob_shape nominal = {0, 0, place[2], place[3]};
#endif
            const int bad = not_finite(place[0]) | not_finite(place[1]) | not_finite(nominal.size) |
                            not_finite(nominal.angle) | !(nominal.size > 0);
            if (GROUP_ITEM == 0) fit.shape = nominal, fit.is_done = 0;
            group_barrier();
            blob_count counted = {0, 0, 0, 0, 0};
            real scale = 0;
            int pass = 0;
            do {
                const blob_shape from = fit.shape;
                measure(image, rows, columns, place[0], place[1], from, table, layout, &edges, &room);
                counted = keep_edges(&edges, layout, nominal, search, &room);
                const int is_enough = !bad && counted.found >= least;
                if (GROUP_ITEM == 0) {
                    fit.blur = counted.blur;
                    fit.is_regular = is_enough;
                }
                group_barrier();
                start_of(&fit.shape, &edges, layout, is_enough && pass == 0, START_REACH, &room);
                scale = fit_shape(&fit, &edges, layout, 2 * START_REACH, counted.noise, across, distances, &room);
                if (GROUP_ITEM == 0) {
                    const real dx = fit.shape.x - from.x, dy = fit.shape.y - from.y, ds = fit.shape.size - from.size;
                    const real da = (fit.shape.angle - from.angle) * from.size;
                    fit.is_done = !fit.is_regular || dx * dx + dy * dy + ds * ds + da * da < STILL * STILL;
                }
                group_barrier();
            } while (++pass < passes && !fit.is_done);
            quality_of(&quality, &edges, layout, fit.shape, scale, bent_by(fit.blur, across), overlap, &room);
            if (GROUP_ITEM == 0) {
                int what = bad ? STATUS_NOT_FINITE : 0;
                if (!bad) {
                    what |= SPOKES - counted.outside < least ? STATUS_OUT_OF_RANGE : 0;
                    what |= SPOKES - counted.broken < least ? STATUS_NOT_FINITE : 0;
                    if (!what && counted.found < least) what = STATUS_LOW_SIGNAL;
                    if (!what && (!fit.is_regular || quality.inliers < least || !quality.regular))
                        what = STATUS_AMBIGUOUS;
                    if (!what && is_beyond(fit.shape, search)) what = STATUS_OUT_OF_RANGE;
                }
                fit.status = what;
            }
            group_barrier();
#ifdef MATCH_IMAGE
            const real blur_of_edges = sqrt(fmax(fit.blur - BILINEAR, SHARPEST * SHARPEST));
            const real background = background_of(image, rows, columns, place[0], place[1], fit.shape, &edges,
                                                  quality.weights, layout, blur_of_edges, &room);
            if (GROUP_ITEM == 0) {
                match.first = match.shape = fit.shape;
                match.grey = (blob_grey){background, quality.contrast, blur_of_edges};
                match.slope_x = match.slope_y = 0;
                match.state = fit.status ? MATCH_FAILS : MATCH_RUNS;
                hide(fit.shape, quality.weights, layout, spacing, blur_of_edges, &hidden);
            }
            group_barrier();
            match_image(&match, image, rows, columns, place[0], place[1], pixel_noise, extent, &hidden, &room);
            if (GROUP_ITEM == 0 && !fit.status) {
                fit.shape = match.shape;
                fit.blur = match.grey.blur * match.grey.blur;
                quality.contrast = match.grey.contrast;
                for (int j = 0; j < FREEDOMS; j++)
                    for (int k = 0; k < FREEDOMS; k++) quality.covariance[j][k] = match.covariance[j][k];
                if (match.state == MATCH_FAILS) fit.status = STATUS_AMBIGUOUS;
                else if (is_beyond(fit.shape, search)) fit.status = STATUS_OUT_OF_RANGE;
            }
            group_barrier();
#endif
            const blob_shape shape = fit.shape;
            const int good = !fit.status;
            real to_x, to_y;
            const real middle_x = place[0] + shape.x, middle_y = place[1] + shape.y, width = sqrt(fit.blur);
            const int heavy = gravity_of(image, rows, columns, middle_x, middle_y,
                                         shape.size * extent + (real)2.5f * width + 1, good, &room, &to_x, &to_y);
            if (GROUP_ITEM == 0) {
                x[n] = good ? middle_x : REAL_NAN;
                y[n] = good ? middle_y : REAL_NAN;
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
                blur[n] = good ? width : REAL_NAN;
                gravity_x[n] = heavy ? middle_x + to_x : REAL_NAN;
                gravity_y[n] = heavy ? middle_y + to_y : REAL_NAN;
                status[n] = (uchar)(fit.status | (good && quality.saturated ? STATUS_SATURATED : 0));
            }
        } while (++n < end);
    }
}
