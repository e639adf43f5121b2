// Robust fit of a shape to the edges of a fiducial, and its quality.
//
// Options: as in blob.cl.
#ifndef BLOB_FIT_H
#define BLOB_FIT_H
#include "blob/blob_edges.h"

#define LEAST_REACH (real)0.6f    // residual up to which an edge is an inlier before the scale is known [px]
#define LEAST_SCALE (real)0.01f   // smallest scale of the residuals [px]
#define MOST_STEPS 12             // iterations with shrinking scale
#define STEPS_AT_SCALE 2          // iterations at the estimated scale

#ifdef ROUND
#define START_REACH LEAST_REACH // residual up to which an edge supports a start shape [px]
#else
#define START_REACH (3 * LEAST_REACH) // larger: start shapes have the nominal angle
#endif

// State of the fit to the edges; in a group item 0 changes it.
typedef struct {
    blob_shape shape;
    real blur;      // mean variance of the blur of the edges [px^2]
    int is_regular; // whether the last step was possible
    int is_done;    // whether the rulers are well placed, or no fit was possible
    int status;
} blob_fit;

// Variance that moves a round edge (equation_of).
static inline real bent_by(real blur, real across) {
#ifdef ROUND
    return blur + across;
#else
    return 0;
#endif
}

// Return the robust scale of the residuals within reach: their median absolute deviation.
INLINE real scale_of(GROUP_SPACE const blob_edges *edges, blob_layout layout, blob_shape shape, real bent, real reach,
                     GROUP_SPACE real *distances, GROUP_SPACE blob_room *room) {
    const real cosine = cosine_of(shape), sine = sine_of(shape);
    reals inside;
    EACH_PART(part) {
        masks counted = 0;
        for (int i = part * LANES; i < PADDED_SPOKES; i += PARTS * LANES) {
            const reals distance = FABS(equation_of(edges, i, layout, shape, cosine, sine, bent).residual);
            const masks near = mask_of(AT(edges->there, i) > (reals)0) & mask_of(distance <= (reals)reach);
            counted -= near;
            AT(distances, i) = near ? distance : (reals)INFINITY;
        }
        inside = LANED(convert_real)(counted);
        group_put(&inside, 1, part, room->sums);
    }
    const int within = (int)sum_of(*group_total(&inside, 1, room->sums));
    const real middle = group_ranked(distances, PADDED_SPOKES, within / 2 + 1, BITS_TO_ONE_PERCENT, room->sums);
    return MAD_TO_SIGMA * (1 + FEW_FITTED / fmax((real)(within - FREEDOMS), (real)1)) * middle;
}

// Sums over the edges: weighted normal equations (lower triangle, right side), weights, weighted variances of the blur.
#define FIT_RIGHT TRIANGLE
#define FIT_WEIGHT (FIT_RIGHT + FREEDOMS)
#define FIT_BLUR (FIT_WEIGHT + 1)
#define FIT_SUMS (FIT_BLUR + 1)

// Do the Gauss-Newton step of the normal equations.
BETWEEN_BARRIERS void fit_stepped(private blob_fit *fit, private reals *sums) {
    reals step[FREEDOMS];
    fit->is_regular &= !any_lane(factored(sums));
    if (!fit->is_regular) return;
    solved(sums, sums + FIT_RIGHT, step);
    fit->shape.x += FIRST(step[0]);
    fit->shape.y += FIRST(step[1]);
    fit->shape.size += FIRST(step[2]);
#ifndef ROUND
    fit->shape.angle += FIRST(step[3]);
#endif
    fit->blur = FIRST(sums[FIT_BLUR]) / FIRST(sums[FIT_WEIGHT]);
    fit->is_regular = fit->shape.size > 0 &&
                      !not_finite(fit->shape.x + fit->shape.y + fit->shape.size + fit->shape.angle);
}

// One Gauss-Newton step of the reweighted fit.
INLINE void fit_step(GROUP_SPACE blob_fit *fit, GROUP_SPACE const blob_edges *edges, blob_layout layout, real scale,
                     real across, GROUP_SPACE blob_room *room) {
    const blob_shape shape = fit->shape;
    const real cosine = cosine_of(shape), sine = sine_of(shape), per_scale = 1 / scale;
    const real bent = bent_by(fit->blur, across);
    reals sums[FIT_SUMS];
    EACH_PART(part) {
        for (int k = 0; k < FIT_SUMS; k++) sums[k] = 0;
        for (int i = part * LANES; i < PADDED_SPOKES; i += PARTS * LANES) {
            const blob_equation equation = equation_of(edges, i, layout, shape, cosine, sine, bent);
            const reals weight = AT(edges->there, i) * loss_weight(equation.residual * (reals)per_scale);
            for (int j = 0; j < FREEDOMS; j++) {
                const reals weighted = weight * equation.row[j];
                sums[FIT_RIGHT + j] += weighted * equation.residual;
                for (int k = 0; k <= j; k++) sums[CELL(j, k)] += weighted * equation.row[k];
            }
            sums[FIT_WEIGHT] += weight;
            sums[FIT_BLUR] += weight * AT(edges->blur, i);
        }
        for (int k = 0; k < FIT_SUMS; k++) sums[k] = (reals)sum_of(sums[k]);
        group_put(sums, FIT_SUMS, part, room->sums);
    }
    GROUP_SPACE const reals *totals = group_total(sums, FIT_SUMS, room->sums);
    if (GROUP_ITEM == 0) {
        for (int k = 0; k < FIT_SUMS; k++) sums[k] = totals[k];
        blob_fit stepped = *fit;
        fit_stepped(&stepped, sums);
        *fit = stepped;
    }
    group_barrier();
}

// Fit the shape to the edges by reweighted least squares, with the scale halved from step to step and then estimated from
// the residuals. Return the last scale. A fit that is not regular stays as it is.
INLINE real fit_shape(GROUP_SPACE blob_fit *fit, GROUP_SPACE const blob_edges *edges, blob_layout layout, real reach,
                      real noise, real across, GROUP_SPACE real *distances, GROUP_SPACE blob_room *room) {
    const real predicted = fmax(sqrt(noise), LEAST_SCALE), least = fmax(LEAST_REACH / TUNING, predicted);
    real scale = fmax(reach / TUNING, least);
    int step = 0, is_last;
    do {
        fit_step(fit, edges, layout, scale, across, room);
        is_last = scale <= least;
        scale = is_last ? scale : fmax(scale / 2, least);
    } while (++step < MOST_STEPS && !is_last && fit->is_regular);
    for (int again = 0; again < STEPS_AT_SCALE; again++) {
        const real bent = bent_by(fit->blur, across);
        const real measured = scale_of(edges, layout, fit->shape, bent, TUNING * scale, distances, room);
        scale = fmin(fmax(measured, predicted), least);
        fit_step(fit, edges, layout, scale, across, room);
    }
    return scale;
}

// Quality of a fit: covariance, residual, symmetry, contrast, counts; weights and heights of the edges, repeated after
// the last one.
typedef struct {
    real covariance[FREEDOMS][FREEDOMS];
    real residual, symmetry, contrast;
    real weights[PADDED_SPOKES + SPOKES / 2 + LANES], height[PADDED_SPOKES + SPOKES / 2 + LANES];
    int inliers, saturated, regular;
} blob_quality;

// Sums over the edges of a fit: normal equations of the inliers without weights; weights, squares of the weighted
// residuals, slopes of the loss, variances, weighted amplitudes, number of inliers and of saturated inliers.
#define QUALITY_WEIGHT TRIANGLE
#define QUALITY_SQUARE (TRIANGLE + 1)
#define QUALITY_SLOPE (TRIANGLE + 2)
#define QUALITY_NOISE (TRIANGLE + 3)
#define QUALITY_AMPLITUDE (TRIANGLE + 4)
#define QUALITY_INLIERS (TRIANGLE + 5)
#define QUALITY_SATURATED (TRIANGLE + 6)
#define QUALITY_SUMS (TRIANGLE + 7)

// Compute everything but the symmetry from the sums.
INLINE void quality_from(GROUP_SPACE blob_quality *quality, private reals *sums, real scale, real overlap,
                         real size) {
    const real count = FIRST(sums[QUALITY_INLIERS]), free = fmax(count - FREEDOMS, (real)1), mean = FIRST(sums[QUALITY_SLOPE]) / count;
    const real squares = FIRST(sums[QUALITY_SQUARE]), weights = FIRST(sums[QUALITY_WEIGHT]);
    quality->inliers = (int)count;
    quality->saturated = FIRST(sums[QUALITY_SATURATED]) > 0;
    quality->residual = scale * sqrt(squares / weights);
    quality->contrast = -FIRST(sums[QUALITY_AMPLITUDE]) / weights;
    // Variance of an edge: the larger one of the variance predicted from the noise and the variance of the residuals.
    const real measured = scale * scale * squares / (free * mean * mean);
    const real predicted = FIRST(sums[QUALITY_NOISE]) / (count * (real)EFFICIENCY);
    const real variance = fmax(measured, predicted) * fmax(overlap / size, (real)1);
    quality->regular = !any_lane(factored(sums)) && mean > 0;
    for (int j = 0; j < FREEDOMS; j++) {
        reals unit[FREEDOMS], column[FREEDOMS];
        for (int k = 0; k < FREEDOMS; k++) unit[k] = (reals)(real)(j == k);
        solved(sums, unit, column);
        for (int k = 0; k < FREEDOMS; k++) quality->covariance[j][k] = variance * FIRST(column[k]);
    }
}

INLINE void quality_of(GROUP_SPACE blob_quality *quality, GROUP_SPACE const blob_edges *edges, blob_layout layout,
                       blob_shape shape, real scale, real bent, real overlap, GROUP_SPACE blob_room *room) {
    const real cosine = cosine_of(shape), sine = sine_of(shape), per_scale = 1 / scale;
    reals sums[QUALITY_SUMS];
    EACH_PART(part) {
        for (int k = 0; k < QUALITY_SUMS; k++) sums[k] = 0;
        for (int i = part * LANES; i < PADDED_SPOKES; i += PARTS * LANES) {
            const blob_equation equation = equation_of(edges, i, layout, shape, cosine, sine, bent);
            const reals z = equation.residual * (reals)per_scale, weight = AT(edges->there, i) * loss_weight(z);
            const masks is_in = mask_of(weight > (reals)0);
            for (int j = 0; j < FREEDOMS; j++)
                for (int k = 0; k <= j; k++)
                    sums[CELL(j, k)] += kept_where(is_in, equation.row[j] * equation.row[k]);
            sums[QUALITY_WEIGHT] += weight;
            sums[QUALITY_SQUARE] += weight * weight * z * z;
            sums[QUALITY_SLOPE] += kept_where(is_in, loss_slope(z));
            sums[QUALITY_NOISE] += kept_where(is_in, AT(edges->noise, i));
            sums[QUALITY_AMPLITUDE] += weight * AT(edges->amplitude, i);
            sums[QUALITY_INLIERS] += kept_where(is_in, (reals)1);
            const masks saturated = is_in & mask_of((FLAGS_AT(edges, i) & (masks)STATUS_SATURATED) != 0);
            sums[QUALITY_SATURATED] += kept_where(saturated, (reals)1);
            AT(quality->weights, i) = weight;
            AT(quality->height, i) = FABS(AT(edges->amplitude, i));
        }
        for (int k = 0; k < QUALITY_SUMS; k++) sums[k] = (reals)sum_of(sums[k]);
        group_put(sums, QUALITY_SUMS, part, room->sums);
    }
    GROUP_SPACE const reals *totals = group_total(sums, QUALITY_SUMS, room->sums);
    if (GROUP_ITEM == 0) {
        for (int k = 0; k < QUALITY_SUMS; k++) sums[k] = totals[k];
        quality_from(quality, sums, scale, overlap, shape.size);
    }
    for (int i = GROUP_ITEM; i < SPOKES / 2 + LANES; i += GROUP_ITEMS) {
        quality->weights[SPOKES + i] = quality->weights[i];
        quality->height[SPOKES + i] = quality->height[i];
    }
    group_barrier();
    // The loop ends at SPOKES, not at PADDED_SPOKES: without lanes it would read beyond the repeated numbers, which nothing
    // wrote, and a NaN there times the weight 0 of the padding is NaN. With lanes the last vector holds the padding.
    reals agreed;
    EACH_PART(part) {
        agreed = 0;
        for (int i = part * LANES; i < SPOKES; i += PARTS * LANES) {
            const reals here = AT(quality->height, i), there = AT(quality->height, i + SPOKES / 2);
            const reals low = here < there ? here : there, high = here < there ? there : here;
            const reals product =
                AT(quality->weights, i) * AT(quality->weights, i + SPOKES / 2) * FROM(layout.counts, i);
            agreed += sqrt(product) * low / (high + (reals)1e-30f);
        }
        group_put(&agreed, 1, part, room->sums);
    }
    const real symmetry = sum_of(*group_total(&agreed, 1, room->sums)) / SPOKES;
    if (GROUP_ITEM == 0) quality->symmetry = symmetry;
}

#endif
