// Refinement of robot poses by Levenberg-Marquardt steps on the robust cost of points near field lines.
//
// The cost is sum r^2 / (c^2 + r^2) (Geman-McClure loss) over the points, r the exact distance of a point to the
// nearest line. The distance map only selects up to NEAREST candidate lines per cell.
//
// Inputs:  points (count, 2) in the robot's frame [m]; starts (starts, 3) x, y [m], heading [rad]; scale_squared: c^2
//          [m2]; max_range_squared: square of the largest range of a point [m2].
// Tables:  shapes (lines, SHAPE) (field.h); nearest (rows, columns, NEAREST) (distance_map.cl), with first_x, first_y,
//          cell: centre of the first cell and size of a cell [m].
// Outputs: poses (starts, 3); covariance, information (starts, 3, 3) [m2, m rad, rad2, and inverse]; score (starts,)
//          mean cost, 0 to 1; scale (starts,) standard deviation of an inlier's distance [m]; share (starts,) fraction
//          of the points within c of a line; status (starts,).
// Options: MIN_EIGENVALUE_RATIO: least ratio of eigenvalues of a determined pose; PRIOR_POINTS: see the covariance.
//
// One work-item refines one start.
#include "distance_map/field.h"
#include "common/status.h"

// Cost; normal matrix J^T W J by (x, y, t); gradient J^T W r. t is the heading.
typedef struct {
    float cost, xx, xy, yy, xt, yt, tt, x, y, t;
} normal_equations;

// Grid of the distance map; per_cell: cells per metre.
typedef struct {
    float first_x, first_y, per_cell;
    int rows, columns;
} field_grid;

// Residual r of a point at a pose [m], and its derivatives by x, y and t.
typedef struct {
    float r, x, y, t;
} field_row;

// Compute residual and derivatives of a point. `turn` holds cosine and sine of the heading. The derivative by the
// heading is the gradient times the derivative of the rotated point, (-dy, dx).
static inline field_row row_of(float2 point, float3 pose, float2 turn, constant float *shapes,
                               global const uchar *nearest, field_grid grid) {
    const float dx = turn.x * point.x - turn.y * point.y, dy = turn.y * point.x + turn.x * point.y;
    const float x = pose.x + dx, y = pose.y + dy;
    const int column = convert_int_sat_rte((x - grid.first_x) * grid.per_cell);
    const int row = convert_int_sat_rte((y - grid.first_y) * grid.per_cell);
    const size_t cell = (size_t)clamp(row, 0, grid.rows - 1) * grid.columns + clamp(column, 0, grid.columns - 1);
    global const uchar *candidates = nearest + NEAREST * cell;
    field_offset offset = field_distance(shapes + SHAPE * candidates[0], x, y);
    for (int k = 1; k < NEAREST && candidates[k] != candidates[0]; k++) {
        const field_offset other = field_distance(shapes + SHAPE * candidates[k], x, y);
        offset = fabs(other.distance) < fabs(offset.distance) ? other : offset;
    }
    const field_row result = {offset.distance, offset.x, offset.y, offset.y * dx - offset.x * dy};
    return result;
}

// Return whether a point is finite and within the largest range (given as its square). NaN compares false.
static inline int point_counts(float2 point, float max_range_squared) {
    return point.x * point.x + point.y * point.y <= max_range_squared;
}

// Sum cost and normal equations at a pose.
//
// With share = c^2 / (c^2 + r^2) the cost of a point is 1 - share, and its derivative by r is 2 r share^2 / c^2: the
// weight of iteratively reweighted least squares is share^2. The factor 2 / c^2 is omitted: it does not change the
// step.
static inline normal_equations equations_at(global const float *points, int count, float3 pose, constant float *shapes,
                                            global const uchar *nearest, field_grid grid, float scale_squared,
                                            float max_range_squared) {
    const float2 turn = (float2)(cos(pose.z), sin(pose.z));
    normal_equations sum = {0};
    for (int i = 0; i < count; i++) {
        const float2 point = (float2)(points[2 * i], points[2 * i + 1]);
        if (!point_counts(point, max_range_squared)) continue;
        const field_row at = row_of(point, pose, turn, shapes, nearest, grid);
        const float share = scale_squared / (scale_squared + at.r * at.r), weight = share * share, psi = weight * at.r;
        sum.cost += 1.0f - share;
        sum.xx += weight * at.x * at.x;
        sum.xy += weight * at.x * at.y;
        sum.yy += weight * at.y * at.y;
        sum.xt += weight * at.x * at.t;
        sum.yt += weight * at.y * at.t;
        sum.tt += weight * at.t * at.t;
        sum.x += psi * at.x;
        sum.y += psi * at.y;
        sum.t += psi * at.t;
    }
    return sum;
}

// Return the cofactors of the symmetric matrix (xx, xy, yy, xt, yt, tt), in the same fields.
static inline normal_equations cofactors(normal_equations of) {
    normal_equations c = {0};
    c.xx = of.yy * of.tt - of.yt * of.yt;
    c.xy = of.xt * of.yt - of.xy * of.tt;
    c.xt = of.xy * of.yt - of.xt * of.yy;
    c.yy = of.xx * of.tt - of.xt * of.xt;
    c.yt = of.xy * of.xt - of.xx * of.yt;
    c.tt = of.xx * of.yy - of.xy * of.xy;
    return c;
}

// Solve (M + damping trace(M) I) step = -g by cofactors.
//
// The heading is scaled to a length, t / lever, with lever = 1 / (root-mean-square distance of the points): the damping
// then affects all three unknowns equally.
static inline float3 damped_step(normal_equations of, float damping, float lever) {
    const float more = damping * (of.xx + of.yy + of.tt * lever * lever) + 1e-20f;
    of.xx += more;
    of.yy += more;
    of.xt *= lever;
    of.yt *= lever;
    of.tt = of.tt * lever * lever + more;
    of.t *= lever;
    const normal_equations c = cofactors(of);
    const float scale = -1.0f / (of.xx * c.xx + of.xy * c.xy + of.xt * c.xt);
    return (float3)((c.xx * of.x + c.xy * of.y + c.xt * of.t) * scale,
                    (c.xy * of.x + c.yy * of.y + c.yt * of.t) * scale,
                    (c.xt * of.x + c.yt * of.y + c.tt * of.t) * scale * lever);
}

// Store a symmetric matrix times `scale` as (3, 3).
static inline void store_symmetric(global float *to, normal_equations of, float scale) {
    to[0] = of.xx * scale;
    to[1] = to[3] = of.xy * scale;
    to[2] = to[6] = of.xt * scale;
    to[4] = of.yy * scale;
    to[5] = to[7] = of.yt * scale;
    to[8] = of.tt * scale;
}

// Return a b a for symmetric matrices, times `scale`.
static inline normal_equations sandwich(normal_equations a, normal_equations b, float scale) {
    const float3 a0 = (float3)(a.xx, a.xy, a.xt), a1 = (float3)(a.xy, a.yy, a.yt), a2 = (float3)(a.xt, a.yt, a.tt);
    const float3 b0 = (float3)(b.xx, b.xy, b.xt), b1 = (float3)(b.xy, b.yy, b.yt), b2 = (float3)(b.xt, b.yt, b.tt);
    const float3 c0 = (float3)(dot(b0, a0), dot(b1, a0), dot(b2, a0));
    const float3 c1 = (float3)(dot(b0, a1), dot(b1, a1), dot(b2, a1));
    const float3 c2 = (float3)(dot(b0, a2), dot(b1, a2), dot(b2, a2));
    normal_equations result = {0};
    result.xx = scale * dot(a0, c0);
    result.xy = scale * dot(a0, c1);
    result.yy = scale * dot(a1, c1);
    result.xt = scale * dot(a0, c2);
    result.yt = scale * dot(a1, c2);
    result.tt = scale * dot(a2, c2);
    return result;
}

kernel void field_pose_refinement(global const float *restrict points, global const float *restrict starts,
                                  global float *restrict poses, global float *restrict covariance,
                                  global float *restrict information, global float *restrict score,
                                  global float *restrict scale, global float *restrict share,
                                  global uchar *restrict status, constant float *shapes,
                                  global const uchar *restrict nearest, const int count, const int rows,
                                  const int columns, const float first_x, const float first_y, const float cell,
                                  const float scale_squared, const float max_range_squared, const int steps) {
    const size_t i = get_global_id(0);
    const field_grid grid = {first_x, first_y, 1.0f / cell, rows, columns};
    float3 pose = (float3)(starts[3 * i], starts[3 * i + 1], starts[3 * i + 2]);
    float sum_squares = 0, used = 0;
    for (int k = 0; k < count; k++) {
        const float2 point = (float2)(points[2 * k], points[2 * k + 1]);
        if (!point_counts(point, max_range_squared)) continue;
        sum_squares += point.x * point.x + point.y * point.y;
        used += 1;
    }
    const int finite = fabs(pose.x) + fabs(pose.y) + fabs(pose.z) < 1e6f;
    const float lever = 1.0f / sqrt(sum_squares / fmax(used, 1.0f) + 1e-12f);
    normal_equations here = {0};
    if (finite) here = equations_at(points, count, pose, shapes, nearest, grid, scale_squared, max_range_squared);
    float damping = 1e-4f;
    for (int step = 0; finite && step < steps && damping < 1e6f; step++) {
        const float3 by = damped_step(here, damping, lever);
        const float3 next = pose + by;
        const normal_equations there =
            equations_at(points, count, next, shapes, nearest, grid, scale_squared, max_range_squared);
        // Accept a cost that is equal within the rounding of the sum: near the minimum the step is more accurate than
        // the difference of costs.
        const int better = there.cost <= here.cost * 1.000004f;
        damping = better ? fmax(0.1f * damping, 1e-7f) : 10.0f * damping;
        pose = better ? next : pose;
        here = better ? there : here;
        if (fabs(by.x) + fabs(by.y) + fabs(by.z) / lever < 3e-6f) break;
    }
    // Covariance of an M-estimator for residuals of unequal variance (Huber, 1981, section 6.3): H^-1 S H^-1 with
    // H = sum psi'(r) h h^T, S = sum psi(r)^2 h h^T, psi(r) = r share^2 and psi'(r) = share^2 (4 share - 3), clipped at
    // 0. Points near ends and crossings of lines, and far points on oblique lines, err more than others, and have more
    // weight in the heading. For equal variances S is variance H, with variance = sum psi^2 / (sum psi' - 3); as many
    // points as PRIOR_POINTS are taken to have it, so that few points do not give too small a covariance by chance.
    // The heading is scaled by lever.
    const float2 turn = (float2)(cos(pose.z), sin(pose.z));
    normal_equations hessian = {0}, scatter = {0};
    float sum_curvature = 0, sum_psi_squared = 0, inliers = 0;
    for (int k = 0; finite && k < count; k++) {
        const float2 point = (float2)(points[2 * k], points[2 * k + 1]);
        if (!point_counts(point, max_range_squared)) continue;
        const field_row at = row_of(point, pose, turn, shapes, nearest, grid);
        const float part = scale_squared / (scale_squared + at.r * at.r), weight = part * part;
        const float curvature = fmax(weight * (4.0f * part - 3.0f), 0.0f);
        sum_curvature += curvature;
        sum_psi_squared += weight * weight * at.r * at.r;
        inliers += at.r * at.r < scale_squared;
        hessian.xx += curvature * at.x * at.x;
        hessian.xy += curvature * at.x * at.y;
        hessian.yy += curvature * at.y * at.y;
        hessian.xt += curvature * at.x * at.t * lever;
        hessian.yt += curvature * at.y * at.t * lever;
        hessian.tt += curvature * at.t * at.t * lever * lever;
        const float square = weight * weight * at.r * at.r;
        scatter.xx += square * at.x * at.x;
        scatter.xy += square * at.x * at.y;
        scatter.yy += square * at.y * at.y;
        scatter.xt += square * at.x * at.t * lever;
        scatter.yt += square * at.y * at.t * lever;
        scatter.tt += square * at.t * at.t * lever * lever;
    }
    normal_equations inverse = cofactors(hessian);
    const float determinant = hessian.xx * inverse.xx + hessian.xy * inverse.xy + hessian.xt * inverse.xt;
    const float minors = inverse.xx + inverse.yy + inverse.tt, all = hessian.xx + hessian.yy + hessian.tt;
    const int few = used < 4 || sum_curvature < 4;
    const float last_x = first_x + cell * (float)(columns - 1), last_y = first_y + cell * (float)(rows - 1);
    const int outside = !(pose.x >= first_x && pose.x <= last_x && pose.y >= first_y && pose.y <= last_y);
    // det > MIN_EIGENVALUE_RATIO trace (sum of principal minors): for eigenvalues l1 << l2 <= l3 this bounds l1 / l3.
    const int weak = !(determinant > (float)MIN_EIGENVALUE_RATIO * all * minors);
    const int bad = !finite || few || outside;
    status[i] = !finite ? STATUS_NOT_FINITE
                        : (few ? STATUS_LOW_SIGNAL
                               : (outside ? STATUS_OUT_OF_RANGE : (weak ? STATUS_AMBIGUOUS : STATUS_OK)));
    const float variance = sum_psi_squared / fmax(sum_curvature - 3.0f, 1.0f) + 1e-12f;
    poses[3 * i] = bad ? NAN : pose.x;
    poses[3 * i + 1] = bad ? NAN : pose.y;
    poses[3 * i + 2] = bad ? NAN : pose.z - 6.2831853071795865f * rint(pose.z / 6.2831853071795865f);
    score[i] = bad ? NAN : here.cost / used;
    scale[i] = bad ? NAN : sqrt(variance);
    share[i] = bad ? NAN : inliers / used;
    // S / variance, of about the size of H: no product below underflows. Rounding adds 1e-6 m to a residual.
    const float own = (used / (used + PRIOR_POINTS)) * sum_curvature / fmax(sum_curvature - 3.0f, 1.0f) / variance;
    const float prior = PRIOR_POINTS / (used + PRIOR_POINTS) + 1e-12f / variance;
    scatter.xx = own * scatter.xx + prior * hessian.xx;
    scatter.xy = own * scatter.xy + prior * hessian.xy;
    scatter.yy = own * scatter.yy + prior * hessian.yy;
    scatter.xt = own * scatter.xt + prior * hessian.xt;
    scatter.yt = own * scatter.yt + prior * hessian.yt;
    scatter.tt = own * scatter.tt + prior * hessian.tt;
    normal_equations known = hessian, spread = sandwich(inverse, scatter, 1.0f / (determinant * determinant));
    if (!weak) {
        const normal_equations cofactor = cofactors(scatter);
        const float size = scatter.xx * cofactor.xx + scatter.xy * cofactor.xy + scatter.xt * cofactor.xt;
        known = sandwich(hessian, cofactor, 1.0f / size);
    }
    known.xt /= lever;
    known.yt /= lever;
    known.tt /= lever * lever;
    spread.xt *= lever;
    spread.yt *= lever;
    spread.tt *= lever * lever;
    store_symmetric(information + 9 * i, known, bad ? NAN : 1.0f / variance);
    store_symmetric(covariance + 9 * i, spread, bad || weak ? NAN : variance);
}
