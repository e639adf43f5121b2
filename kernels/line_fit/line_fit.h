// Robust straight line through points, one line per lane.
//
// The line minimises sum rho(v / (sigma scale)), v = c (y - y0) - s (x - x0) the distance of a point to the line
// through (x0, y0) along (c, s), and rho the loss of common/robust.h. The start is the best line through a pair of
// points; iteratively reweighted total least squares refines it.
//
// Options: GIVEN_SCALE: known scale of the distances in sigmas; otherwise it is estimated from their median.
//          EFFICIENCY: of the loss for normal residuals, for the covariance at a known scale.
#ifndef LINE_FIT_H
#define LINE_FIT_H

#include "common/robust.h"

#ifdef GIVEN_SCALE
#define SCALE ((real)(GIVEN_SCALE))
#endif

// Line through (x, y) along the unit vector (c, s).
typedef struct {
    reals x, y, c, s;
} laned_line;

// Points of each lane, and their certainties 1/sigma (0: missing point).
typedef struct {
    private const reals *x;
    private const reals *y;
    private const reals *certainty;
    private reals *distances; // scratch space for `count` values
    int count;
} laned_points;

// Fitted line; variances of its angle [rad2] and of its offset at (x, y).
typedef struct {
    laned_line line;
    reals scale, variance_of_angle, variance_of_offset;
    masks points, inliers; // number of points, and of points with a weight above 0
    masks coincide;        // lanes whose points coincide: no direction
} laned_fit;

// Return the signed distance of (x, y) to the line.
static inline reals line_distance(laned_line line, reals x, reals y) {
    return line.c * (y - line.y) - line.s * (x - line.x);
}

// Absolute distances in units of the points' sigma, infinite for missing points.
static inline void line_distances(laned_line line, laned_points all) {
    for (int i = 0; i < all.count; i++) {
        const reals w = all.certainty[i];
        const reals z = FABS(line_distance(line, all.x[i], all.y[i]) * w);
        all.distances[i] = w > (reals)0 ? z : (reals)INFINITY;
    }
}

// Return the score of a line, least is best: the loss where the scale is given, otherwise the distance of the given
// rank (median) to 1 %.
static inline reals line_score(laned_line line, laned_points all, masks rank) {
#ifdef SCALE
    reals sum = 0;
    for (int i = 0; i < all.count; i++)
        sum += loss_of(line_distance(line, all.x[i], all.y[i]) * all.certainty[i] * (reals)((real)1 / SCALE));
    return sum;
#else
    line_distances(line, all);
    return ranked_of(all.distances, all.count, rank, BITS_TO_ONE_PERCENT);
#endif
}

// Return the line through the weighted mean of all points, along x.
static inline laned_line line_middle(laned_points all) {
    reals sum = 0, sum_x = 0, sum_y = 0;
    for (int i = 0; i < all.count; i++) {
        const reals w = all.certainty[i] * all.certainty[i];
        sum += w, sum_x += w * all.x[i], sum_y += w * all.y[i];
    }
    const reals per = (reals)1 / (sum > (reals)0 ? sum : (reals)1);
    return (laned_line){sum_x * per, sum_y * per, 1, 0};
}

// Find the line through a pair of points with the least score. A pair of coinciding or missing points is skipped.
static inline laned_line line_start(laned_points all, constant const int *pairs, int trials, masks rank) {
    laned_line best = line_middle(all);
    reals least = INFINITY;
    for (int trial = 0; trial < trials; trial++) {
        const int i = pairs[2 * trial], j = pairs[2 * trial + 1];
        const reals along_x = all.x[j] - all.x[i], along_y = all.y[j] - all.y[i];
        const reals square = along_x * along_x + along_y * along_y;
        const masks usable =
            mask_of(square > (reals)0) & mask_of(all.certainty[i] * all.certainty[j] > (reals)0);
        const reals per = (reals)1 / sqrt(usable ? square : (reals)1);
        const laned_line candidate = {all.x[i], all.y[i], along_x * per, along_y * per};
        const reals score = line_score(candidate, all, rank);
        const masks better = usable & mask_of(score < least);
        least = better ? score : least;
        best.x = better ? candidate.x : best.x;
        best.y = better ? candidate.y : best.y;
        best.c = better ? candidate.c : best.c;
        best.s = better ? candidate.s : best.s;
    }
    return best;
}

// Do one step of reweighted total least squares (orthogonal regression).
//
// With the central moments S of the points in the frame of the current line (u along it, v across), the line of least
// sum w v^2 is turned by phi / 2, tan(phi) = 2 S_uv / (S_uu - S_vv). Half-angle formulas need no arctangent:
// cos(phi / 2) = sqrt((1 + cos(phi)) / 2), sin(phi / 2) = sin(phi) / (2 cos(phi / 2)). Both use |cos(phi)|, which
// avoids cancellation; where cos(phi) < 0, cosine and sine of the half angle are exchanged. `coincide` gets the lanes
// without a direction: S_uu = S_vv and S_uv = 0 up to rounding.
static inline laned_line line_step(laned_line line, laned_points all, reals per_scale, masks *coincide) {
    reals sum = 0, sum_u = 0, sum_v = 0, sum_uu = 0, sum_uv = 0, sum_vv = 0;
    for (int i = 0; i < all.count; i++) {
        const reals x = all.x[i] - line.x, y = all.y[i] - line.y;
        const reals u = line.c * x + line.s * y, v = line.c * y - line.s * x;
        const reals certainty = all.certainty[i];
        const reals w = certainty * certainty * loss_weight(v * certainty * per_scale);
        sum += w, sum_u += w * u, sum_v += w * v;
        sum_uu += w * u * u, sum_uv += w * u * v, sum_vv += w * v * v;
    }
    const reals per = (reals)1 / (sum > (reals)0 ? sum : (reals)1), u = sum_u * per, v = sum_v * per;
    const reals across = (reals)2 * (sum_uv - sum_u * v), along = sum_uu - sum_u * u - (sum_vv - sum_v * v);
    const reals length = sqrt(along * along + across * across);
    const masks none = mask_of(!(length > (reals)(16 * REAL_EPSILON) * (sum_uu + sum_vv))) | mask_of(!(sum > (reals)0));
    const reals over = (reals)1 / (none ? (reals)1 : length);
    // S_vv > S_uu: the turn exceeds 45 degrees.
    const masks is_steep = mask_of(along < (reals)0);
    const reals part = sqrt((reals)0.5 + (reals)0.5 * FABS(along) * over);
    const reals rest = FABS(across) * over / ((reals)2 * part);
    const reals turned_c = is_steep ? rest : part, turned = is_steep ? part : rest;
    const reals turned_s = across < (reals)0 ? -turned : turned;
    laned_line next = {line.x + line.c * u - line.s * v, line.y + line.s * u + line.c * v,
                       line.c * turned_c - line.s * turned_s, line.s * turned_c + line.c * turned_s};
    const reals size = (reals)1 / sqrt(next.c * next.c + next.s * next.s);
    next.c = none ? line.c : next.c * size;
    next.s = none ? line.s : next.s * size;
    *coincide = none;
    return next;
}

// Return the scale of the distances in sigmas: GIVEN_SCALE, or 1.4826 times the median absolute distance with the
// small-sample correction 1 + few / (n - 2). Only distances up to `reach` take part: once a first scale is known, this
// removes the outliers, which raise the median.
static inline reals line_scale(laned_line line, laned_points all, reals reach, real few, reals min_scale) {
#ifdef SCALE
    return (reals)SCALE;
#else
    line_distances(line, all);
    masks within = 0;
    for (int i = 0; i < all.count; i++)
        within -= mask_of(all.distances[i] <= reach) & mask_of(all.certainty[i] > (reals)0);
    const reals middle = ranked_of(all.distances, all.count, (within >> 1) + 1, 0);
    const reals free = LANED(convert_real)(within) - (reals)2;
    const reals scale = (reals)MAD_TO_SIGMA * ((reals)1 + (reals)few / (free > (reals)1 ? free : (reals)1)) * middle;
    return scale > min_scale ? scale : min_scale;
#endif
}

// Compute the number of inliers and the variances.
//
// Covariance of an M-estimator (Huber, 1981): f A^-1 with A = sum of h h^T / sigma^2 over the inliers. A is diagonal
// for offset and angle at the weighted mean: sum w and sum w u^2. With a given scale f = scale^2 / EFFICIENCY,
// otherwise f = scale^2 (sum psi(z)^2 / (n - 2)) / (mean psi'(z))^2, NaN for two inliers.
static inline void line_variances(laned_fit *fit, laned_points all) {
    const reals per_scale = (reals)1 / fit->scale;
    reals sum = 0, sum_uu = 0, slopes = 0, squares = 0;
    masks inliers = 0;
    for (int i = 0; i < all.count; i++) {
        const reals x = all.x[i] - fit->line.x, y = all.y[i] - fit->line.y;
        const reals u = fit->line.c * x + fit->line.s * y, v = fit->line.c * y - fit->line.s * x;
        const reals certainty = all.certainty[i], z = v * certainty * per_scale, weight = loss_weight(z);
        const masks is_in = mask_of(certainty * weight > (reals)0);
        const reals w = kept_where(is_in, certainty * certainty);
        inliers -= is_in;
        sum += w, sum_uu += w * u * u;
        slopes += kept_where(is_in, loss_slope(z));
        squares += kept_where(is_in, weight * weight * z * z);
    }
    fit->inliers = inliers;
    reals factor = fit->scale * fit->scale;
#ifdef SCALE
    factor *= (reals)(1 / (real)(EFFICIENCY));
#else
    const reals many = LANED(convert_real)(inliers), each = slopes / many;
    factor *= squares / (many - (reals)2) / (each * each);
    factor = inliers > 2 ? factor : (reals)REAL_NAN;
#endif
    fit->variance_of_offset = factor / sum;
    fit->variance_of_angle = factor / sum_uu;
}

// Fit the lines: start, then `steps` reweighted steps. `pairs` (trials, 2) holds the points of the start candidates.
static inline laned_fit line_fit(laned_points all, constant const int *pairs, int trials, int steps, reals min_scale) {
    laned_fit fit = {line_middle(all), min_scale, 0, 0, 0, 0, 0};
    for (int i = 0; i < all.count; i++) fit.points -= mask_of(all.certainty[i] > (reals)0);
#ifdef ROBUST
    fit.line = line_start(all, pairs, trials, (fit.points >> 1) + 1);
    fit.scale = line_scale(fit.line, all, (reals)INFINITY, FEW_TRIED, min_scale);
#endif
    for (int step = 0; step < steps; step++) {
        // Estimate the scale again: residuals of a line fitted to all points are more accurate than residuals of a line
        // through two points.
        if (RESCALED_AT(step))
            fit.scale = line_scale(fit.line, all, (reals)2.5f * fit.scale, FEW_FITTED, min_scale);
        fit.line = line_step(fit.line, all, (reals)1 / fit.scale, &fit.coincide);
    }
#ifndef ROBUST
    fit.scale = line_scale(fit.line, all, (reals)INFINITY, FEW_FITTED, min_scale);
#endif
    line_variances(&fit, all);
    return fit;
}

#endif
