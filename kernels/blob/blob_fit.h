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

// Robust scale of the residuals within reach: their median absolute deviation.
static inline real scale_of(private const blob_edges *edges, blob_layout layout, blob_shape shape, real bent, real reach) {
    const real cosine = cos(shape.angle), sine = sin(shape.angle);
    real distances[PADDED_SPOKES];
    masks inside = 0;
    for (int i = 0; i < PADDED_SPOKES; i += LANES) {
        const reals distance = FABS(equation_of(edges, i, layout, shape, cosine, sine, bent).residual);
        const masks near = mask_of(READ(edges->there, i) > (reals)0) & mask_of(distance <= (reals)reach);
        inside -= near;
        *(private reals_at *)(distances + i) = near ? distance : (reals)INFINITY;
    }
    const int within = (int)sum_of(LANED(convert_real)(inside));
    bits found = 0;
    for (int bit = BITS_BELOW_SIGN - 1; bit >= BITS_TO_ONE_PERCENT; bit--) {
        const bits next = found | ((bits)1 << bit);
        masks below = 0;
        for (int i = 0; i < PADDED_SPOKES; i += LANES) below -= mask_of(as_masks(READ(distances, i)) < (masks)next);
        found = (int)sum_of(LANED(convert_real)(below)) > within / 2 ? found : next;
    }
    return MAD_TO_SIGMA * (1 + FEW_FITTED / fmax((real)(within - FREEDOMS), (real)1)) * as_real(found);
}

// One Gauss-Newton step of the reweighted fit; return 0 if it is singular.
static inline int fit_step(private const blob_edges *edges, blob_layout layout, real scale, private blob_shape *shape,
                    private real *blur, real across) {
    const real cosine = cos(shape->angle), sine = sin(shape->angle), per_scale = 1 / scale;
#ifdef ROUND
    const real bent = *blur + across;
#else
    const real bent = 0;
#endif
    reals matrix[TRIANGLE], right[FREEDOMS], step[FREEDOMS], weights = 0, blurs = 0;
    for (int j = 0; j < TRIANGLE; j++) matrix[j] = 0;
    for (int j = 0; j < FREEDOMS; j++) right[j] = 0;
    for (int i = 0; i < PADDED_SPOKES; i += LANES) {
        const blob_equation equation = equation_of(edges, i, layout, *shape, cosine, sine, bent);
        const reals weight = READ(edges->there, i) * loss_weight(equation.residual * (reals)per_scale);
        for (int j = 0; j < FREEDOMS; j++) {
            const reals weighted = weight * equation.row[j];
            right[j] += weighted * equation.residual;
            for (int k = 0; k <= j; k++) matrix[CELL(j, k)] += weighted * equation.row[k];
        }
        weights += weight;
        blurs += weight * READ(edges->blur, i);
    }
    for (int j = 0; j < TRIANGLE; j++) matrix[j] = (reals)sum_of(matrix[j]);
    for (int j = 0; j < FREEDOMS; j++) right[j] = (reals)sum_of(right[j]);
    if (any_lane(factored(matrix))) return 0;
    solved(matrix, right, step);
    shape->x += FIRST(step[0]);
    shape->y += FIRST(step[1]);
    shape->size += FIRST(step[2]);
#ifndef ROUND
    shape->angle += FIRST(step[3]);
#endif
    *blur = sum_of(blurs) / sum_of(weights);
    return shape->size > 0 && !not_finite(shape->x + shape->y + shape->size + shape->angle);
}

// Fit the shape to the edges by reweighted least squares, with the scale halved from step to step and then estimated from
// the residuals. Return 0 if the fit is singular.
static inline int fit_shape(private const blob_edges *edges, blob_layout layout, real reach, real noise, real across,
                     private blob_shape *shape, private real *blur, private real *scale) {
    const real predicted = fmax(sqrt(noise), LEAST_SCALE), least = fmax(LEAST_REACH / TUNING, predicted);
    *scale = fmax(reach / TUNING, least);
    for (int step = 0; step < MOST_STEPS; step++) {
        if (!fit_step(edges, layout, *scale, shape, blur, across)) return 0;
        if (*scale <= least) break;
        *scale = fmax(*scale / 2, least);
    }
    for (int step = 0; step < STEPS_AT_SCALE; step++) {
#ifdef ROUND
        const real bent = *blur + across;
#else
        const real bent = 0;
#endif
        const real measured = scale_of(edges, layout, *shape, bent, TUNING * *scale);
        *scale = fmin(fmax(measured, predicted), least);
        if (!fit_step(edges, layout, *scale, shape, blur, across)) return 0;
    }
    return 1;
}

// Quality of a fit: covariance, residual, symmetry, contrast, weights of the edges, counts.
typedef struct {
    real covariance[FREEDOMS][FREEDOMS];
    real residual, symmetry, contrast;
    real weights[PADDED_SPOKES + SPOKES / 2 + LANES];
    int inliers, saturated, regular;
} blob_quality;

static inline blob_quality quality_of(private blob_edges *edges, blob_layout layout, blob_shape shape, real scale, real bent,
                           real overlap) {
    const real cosine = cos(shape.angle), sine = sin(shape.angle), per_scale = 1 / scale;
    blob_quality quality;
    reals matrix[TRIANGLE], weights = 0, squares = 0, noises = 0, amplitudes = 0, inliers = 0;
    reals slopes = 0;
    real height[PADDED_SPOKES + SPOKES / 2 + LANES];
    private real *of = quality.weights;
    for (int j = 0; j < TRIANGLE; j++) matrix[j] = 0;
    quality.saturated = 0;
    for (int i = 0; i < PADDED_SPOKES; i += LANES) {
        const blob_equation equation = equation_of(edges, i, layout, shape, cosine, sine, bent);
        const reals z = equation.residual * (reals)per_scale, weight = READ(edges->there, i) * loss_weight(z);
        const masks is_in = mask_of(weight > (reals)0);
        for (int j = 0; j < FREEDOMS; j++)
            for (int k = 0; k <= j; k++)
                matrix[CELL(j, k)] += kept_where(is_in, equation.row[j] * equation.row[k]);
        weights += weight;
        squares += weight * weight * z * z;
        slopes += kept_where(is_in, loss_slope(z));
        noises += kept_where(is_in, READ(edges->noise, i));
        amplitudes += weight * READ(edges->amplitude, i);
        inliers += kept_where(is_in, (reals)1);
        *(private reals_at *)(of + i) = weight;
        *(private reals_at *)(height + i) = FABS(READ(edges->amplitude, i));
        for (int lane = 0; lane < LANES; lane++)
            quality.saturated |= edges->saturated[i + lane] & (LANE_BITS(is_in, lane) != 0);
    }
    const real count = sum_of(inliers), free = fmax(count - FREEDOMS, (real)1), mean = sum_of(slopes) / count;
    quality.inliers = (int)count;
    quality.residual = scale * sqrt(sum_of(squares) / sum_of(weights));
    quality.contrast = -sum_of(amplitudes) / sum_of(weights);
    // Variance of an edge: the larger one of the variance predicted from the noise and the variance of the residuals.
    const real measured = scale * scale * sum_of(squares) / (free * mean * mean);
    const real predicted = sum_of(noises) / (count * (real)EFFICIENCY);
    const real variance = fmax(measured, predicted) * fmax(overlap / shape.size, (real)1);
    for (int j = 0; j < TRIANGLE; j++) matrix[j] = (reals)sum_of(matrix[j]);
    quality.regular = !any_lane(factored(matrix)) && mean > 0;
    for (int j = 0; j < FREEDOMS; j++) {
        reals unit[FREEDOMS], column[FREEDOMS];
        for (int k = 0; k < FREEDOMS; k++) unit[k] = (reals)(real)(j == k);
        solved(matrix, unit, column);
        for (int k = 0; k < FREEDOMS; k++) quality.covariance[j][k] = variance * FIRST(column[k]);
    }
    for (int i = 0; i < SPOKES / 2 + LANES; i++) {
        of[SPOKES + i] = of[i];
        height[SPOKES + i] = height[i];
    }
    // The loop ends at SPOKES, not at PADDED_SPOKES: without lanes it would read beyond the repeated numbers, which nothing
    // wrote, and a NaN there times the weight 0 of the padding is NaN. With lanes the last vector holds the padding.
    reals agreed = 0;
    for (int i = 0; i < SPOKES; i += LANES) {
        const reals here = READ(height, i), there = READ(height, i + SPOKES / 2);
        const reals low = here < there ? here : there, high = here < there ? there : here;
        const reals product = READ(of, i) * READ(of, i + SPOKES / 2) * FROM(layout.counts, i);
        agreed += sqrt(product) * low / (high + (reals)1e-30f);
    }
    quality.symmetry = sum_of(agreed) / SPOKES;
    return quality;
}

#endif
