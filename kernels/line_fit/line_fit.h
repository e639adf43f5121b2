// Robust straight line through points: one line per lane, or one line per work-group (IN_GROUP, common/group.h).
//
// The line minimises sum rho(v / (sigma scale)), v = c (y - y0) - s (x - x0) the distance of a point to the line
// through (x0, y0) along (c, s), and rho the loss of common/robust.h. The start is the best line through a pair of
// points; iteratively reweighted total least squares refines it.
//
// Options: GIVEN_SCALE: known scale of the distances in sigmas; otherwise it is estimated from their median.
//          EFFICIENCY: of the loss for normal residuals, for the covariance at a known scale.
#ifndef LINE_FIT_H
#define LINE_FIT_H

#include "common/group.h"
#include "common/status.h"
#include "line_fit/line_fit_points.h"

#ifdef GIVEN_SCALE
#define SCALE ((real)(GIVEN_SCALE))
#endif

// Line through (x, y) along the unit vector (c, s).
typedef struct {
    reals x, y, c, s;
} laned_line;

// Fitted line; variances of its angle [rad2] and of its offset at (x, y).
typedef struct {
    laned_line line;
    reals scale, variance_of_angle, variance_of_offset;
    masks points, inliers; // number of points, and of points with a weight above 0
    masks coincide;        // lanes whose points coincide: no direction
    masks is_open;         // lanes that have not converged (CONVERGED_SQUARE of common/status.h)
} laned_fit;

// Return the signed distance of (x, y) to the line.
static inline reals line_distance(laned_line line, reals x, reals y) {
    return line.c * (y - line.y) - line.s * (x - line.x);
}

// Absolute distance in units of the point's sigma, infinite for missing points.
static inline reals line_sigmas(laned_line line, laned_point at) {
    const reals z = FABS(line_distance(line, at.x, at.y) * at.certainty);
    return at.certainty > (reals)0 ? z : (reals)INFINITY;
}

// Return the score of a line, least is best: the loss where the scale is given, otherwise the distance of the given
// rank (median) to 1 %.
//
// Local memory has no room for the distances of every candidate: a work-group computes them again for every three bits
// of the order statistic.
BETWEEN_BARRIERS reals line_score(laned_line line, laned_points all, masks rank) {
#ifdef SCALE
    reals sum = 0;
    for (int i = 0; i < all.count; i++) {
        const laned_point at = point_at(all, i);
        sum += loss_of(line_distance(line, at.x, at.y) * at.certainty * (reals)((real)1 / SCALE));
    }
    return sum;
#elif defined(IN_GROUP)
    bits found = 0;
    for (int shift = BITS_BELOW_SIGN - 3; shift >= BITS_TO_ONE_PERCENT; shift -= 3) {
        int below[DIGITS];
        for (int k = 0; k < DIGITS; k++) below[k] = 0;
        for (int i = 0; i < all.count; i++)
            count_below(as_bits(line_sigmas(line, point_at(all, i))), found, shift, below);
        found |= (bits)digit_of(below, rank) << shift;
    }
    return as_real(found);
#else
    for (int i = 0; i < all.count; i++) all.distances[i] = line_sigmas(line, point_at(all, i));
    return ranked_of(all.distances, all.count, rank, BITS_TO_ONE_PERCENT);
#endif
}

// Return the line through the weighted mean of all points, along x.
INLINE laned_line line_middle(laned_points all) {
    reals sums[3];
    EACH_PART(part) {
        reals sum = 0, sum_x = 0, sum_y = 0;
        for (int i = part; i < all.count; i += PARTS) {
            const laned_point at = point_at(all, i);
            const reals w = at.certainty * at.certainty;
            sum += w, sum_x += w * at.x, sum_y += w * at.y;
        }
        sums[0] = sum, sums[1] = sum_x, sums[2] = sum_y;
        group_put(sums, 3, part, all.sums);
    }
    GROUP_SPACE const reals *totals = group_total(sums, 3, all.sums);
    const reals per = (reals)1 / (totals[0] > (reals)0 ? totals[0] : (reals)1);
    return (laned_line){totals[1] * per, totals[2] * per, 1, 0};
}

// Find the line through a pair of points with the least score. A pair of coinciding or missing points is skipped. The
// items of a group take different pairs.
INLINE laned_line line_start(laned_points all, constant const int *pairs, int trials, masks rank) {
    laned_line best = line_middle(all);
    reals least = INFINITY;
#ifdef IN_GROUP
    int chosen = INT_MAX;
#endif
    for (int trial = GROUP_ITEM; trial < trials; trial += GROUP_ITEMS) {
        const laned_point from = point_at(all, pairs[2 * trial]), to = point_at(all, pairs[2 * trial + 1]);
        const reals along_x = to.x - from.x, along_y = to.y - from.y;
        const reals square = along_x * along_x + along_y * along_y;
        const masks usable =
            mask_of(square > (reals)0) & mask_of(from.certainty * to.certainty > (reals)0);
        const reals per = (reals)1 / sqrt(usable ? square : (reals)1);
        const laned_line candidate = {from.x, from.y, along_x * per, along_y * per};
        const reals score = line_score(candidate, all, rank);
        const masks better = usable & mask_of(score < least);
        least = better ? score : least;
        best.x = better ? candidate.x : best.x;
        best.y = better ? candidate.y : best.y;
        best.c = better ? candidate.c : best.c;
        best.s = better ? candidate.s : best.s;
#ifdef IN_GROUP
        chosen = better ? trial : chosen;
#endif
    }
#ifdef IN_GROUP
    // The item of the best pair shares it in the room for totals.
    if (group_best(least, chosen, all.sums) == GROUP_ITEM) {
        all.sums[0] = best.x, all.sums[1] = best.y, all.sums[2] = best.c, all.sums[3] = best.s;
    }
    group_barrier();
    best = (laned_line){all.sums[0], all.sums[1], all.sums[2], all.sums[3]};
#endif
    return best;
}

// Sums of w, w u, w v, w u u, w u v and w v v in the frame of a line.
#define MOMENTS 6

// Turn and move a line by its moments: one step of total least squares (orthogonal regression).
//
// With the central moments S of the points in the frame of the current line (u along it, v across), the line of least
// sum w v^2 is turned by phi / 2, tan(phi) = 2 S_uv / (S_uu - S_vv). Half-angle formulas need no arctangent:
// cos(phi / 2) = sqrt((1 + cos(phi)) / 2), sin(phi / 2) = sin(phi) / (2 cos(phi / 2)). Both use |cos(phi)|, which
// avoids cancellation; where cos(phi) < 0, cosine and sine of the half angle are exchanged. `coincide` gets the lanes
// without a direction: S_uu = S_vv and S_uv = 0 up to rounding.
static inline laned_line line_turned(laned_line line, GROUP_SPACE const reals *moments, private masks *coincide) {
    const reals sum = moments[0], sum_u = moments[1], sum_v = moments[2];
    const reals sum_uu = moments[3], sum_uv = moments[4], sum_vv = moments[5];
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

// Do one step of reweighted total least squares.
INLINE laned_line line_step(laned_line line, laned_points all, reals per_scale, masks *coincide) {
    reals moments[MOMENTS];
    EACH_PART(part) {
        reals sum = 0, sum_u = 0, sum_v = 0, sum_uu = 0, sum_uv = 0, sum_vv = 0;
        for (int i = part; i < all.count; i += PARTS) {
            const laned_point at = point_at(all, i);
            const reals x = at.x - line.x, y = at.y - line.y;
            const reals u = line.c * x + line.s * y, v = line.c * y - line.s * x;
            const reals w = at.certainty * at.certainty * loss_weight(v * at.certainty * per_scale);
            sum += w, sum_u += w * u, sum_v += w * v;
            sum_uu += w * u * u, sum_uv += w * u * v, sum_vv += w * v * v;
        }
        moments[0] = sum, moments[1] = sum_u, moments[2] = sum_v;
        moments[3] = sum_uu, moments[4] = sum_uv, moments[5] = sum_vv;
        group_put(moments, MOMENTS, part, all.sums);
    }
    return line_turned(line, group_total(moments, MOMENTS, all.sums), coincide);
}

// Return the scale of the distances in sigmas: GIVEN_SCALE, or 1.4826 times the median absolute distance with the
// small-sample correction 1 + few / (n - 2). Only distances up to `reach` take part: once a first scale is known, this
// removes the outliers, which raise the median.
INLINE reals line_scale(laned_line line, laned_points all, reals reach, real few, reals min_scale) {
#ifdef SCALE
    return (reals)SCALE;
#else
    reals counted;
    EACH_PART(part) {
        masks within = 0;
        for (int i = part; i < all.count; i += PARTS) {
            const laned_point at = point_at(all, i);
            const reals z = line_sigmas(line, at);
            within -= mask_of(z <= reach) & mask_of(at.certainty > (reals)0);
            all.distances[i] = z;
        }
        counted = LANED(convert_real)(within);
        group_put(&counted, 1, part, all.sums);
    }
    const reals many = *group_total(&counted, 1, all.sums);
    const masks rank = (to_masks(many) >> 1) + 1;
#ifdef IN_GROUP
    const real middle = group_ranked(all.distances, all.count, (int)rank, 0, all.sums);
#else
    const reals middle = ranked_of(all.distances, all.count, rank, 0);
#endif
    const reals free = many - (reals)2;
    const reals scale = (reals)MAD_TO_SIGMA * ((reals)1 + (reals)few / (free > (reals)1 ? free : (reals)1)) * middle;
    return scale > min_scale ? scale : min_scale;
#endif
}

// Sums of the variances and of the convergence.
#define LINE_SUMS 7

// Compute the number of inliers, the variances, and whether the fit has converged.
//
// Covariance of an M-estimator (Huber, 1981): f A^-1 with A = sum of h h^T / sigma^2 over the inliers. A is diagonal
// for offset and angle at the weighted mean: sum w and sum w u^2. With a given scale f = scale^2 / EFFICIENCY,
// otherwise f = scale^2 (sum psi(z)^2 / (n - 2)) / (mean psi'(z))^2, NaN for two inliers.
//
// Convergence: the gradient of offset and angle is (sum w v, sum w u v) with the robust weights w, and the second
// derivatives are A times the mean of psi'. The square of the Newton step in standard deviations is then g A^-1 g / (f
// mean^2). The rounding of the distances, up to 4 times `rounding` (the rounding of the largest coordinate, in sigmas)
// for each point, adds up to 16 n rounding^2 to g A^-1 g.
INLINE void line_variances(laned_fit *fit, laned_points all, reals rounding) {
    const reals per_scale = (reals)1 / fit->scale;
    reals sums[LINE_SUMS];
    EACH_PART(part) {
        reals sum = 0, sum_uu = 0, slopes = 0, squares = 0, right = 0, right_u = 0;
        masks inliers = 0;
        for (int i = part; i < all.count; i += PARTS) {
            const laned_point at = point_at(all, i);
            const reals x = at.x - fit->line.x, y = at.y - fit->line.y;
            const reals u = fit->line.c * x + fit->line.s * y, v = fit->line.c * y - fit->line.s * x;
            const reals certainty = at.certainty, z = v * certainty * per_scale, weight = loss_weight(z);
            const masks is_in = mask_of(certainty * weight > (reals)0);
            const reals w = kept_where(is_in, certainty * certainty);
            inliers -= is_in;
            sum += w, sum_uu += w * u * u;
            slopes += kept_where(is_in, loss_slope(z));
            squares += kept_where(is_in, weight * weight * z * z);
            right += w * weight * v, right_u += w * weight * u * v;
        }
        sums[0] = sum, sums[1] = sum_uu, sums[2] = slopes, sums[3] = squares, sums[4] = LANED(convert_real)(inliers);
        sums[5] = right, sums[6] = right_u;
        group_put(sums, LINE_SUMS, part, all.sums);
    }
    GROUP_SPACE const reals *totals = group_total(sums, LINE_SUMS, all.sums);
    const reals many = totals[4];
    fit->inliers = to_masks(many);
    reals factor = fit->scale * fit->scale;
    const reals each = totals[2] / many;
#ifdef SCALE
    factor *= (reals)(1 / (real)(EFFICIENCY));
#else
    factor *= totals[3] / (many - (reals)2) / (each * each);
    factor = fit->inliers > 2 ? factor : (reals)REAL_NAN;
#endif
    fit->variance_of_offset = factor / totals[0];
    fit->variance_of_angle = factor / totals[1];
    const reals left = totals[5] * totals[5] / totals[0] + totals[6] * totals[6] / totals[1];
    const reals slope = each > (reals)0 ? each : (reals)0;
    const reals limit = slope * slope * (reals)CONVERGED_SQUARE * factor + (reals)16 * many * rounding * rounding;
    fit->is_open = mask_of(left > limit);
}

// Fit the lines: start, then `steps` reweighted steps. `pairs` (trials, 2) holds the points of the start candidates.
// `rounding`: of the largest coordinate, in sigmas; the scale is at least as large.
INLINE laned_fit line_fit(laned_points all, constant const int *pairs, int trials, int steps, reals min_scale,
                          reals rounding) {
    laned_fit fit = {line_middle(all), min_scale, 0, 0, 0, 0, 0, 0};
    reals present;
    EACH_PART(part) {
        masks points = 0;
        for (int i = part; i < all.count; i += PARTS) points -= mask_of(point_at(all, i).certainty > (reals)0);
        present = LANED(convert_real)(points);
        group_put(&present, 1, part, all.sums);
    }
    fit.points = to_masks(*group_total(&present, 1, all.sums));
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
    line_variances(&fit, all, rounding);
    return fit;
}

// Return the status flags of the fits. Lines without a direction have no results: fewer than two points, or all points
// coincide.
static inline masks line_status(laned_fit fit) {
    const masks few = mask_of(fit.points < 2), bad = few | fit.coincide;
    masks flags = few ? (masks)STATUS_NO_DATA : (fit.coincide ? (masks)STATUS_AMBIGUOUS : (masks)0);
    flags |= ~bad & mask_of(2 * fit.inliers < fit.points) & (masks)STATUS_AMBIGUOUS;
    return flags | (~bad & fit.is_open & (masks)STATUS_NOT_CONVERGED);
}

#endif
