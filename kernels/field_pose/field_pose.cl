// Poses of a robot on its field from the points of a view: exhaustive search of a grid, and refinement.
//
// A program has one of the two kernels: COST_LEVELS builds the search, otherwise the refinement is built. Each kernel
// states its inputs and options.
#ifdef COST_LEVELS
// Cost of the points of a view at every pose of a grid (exhaustive search).
//
// The positions are the centres of the map's cells: for one heading, a point is one shift of the map (shift_sums.h).
// The cost of a pose is the mean of the levels of the cells in which the points lie.
//
// Inputs:  points (count, 2) in the robot's frame [m]; points that are not finite, or out of range, are not used.
// Tables:  level (map rows, stride) uint16 (distance_map.cl), border: cells around the positions; headings (headings,
//          2) cosine and sine; per_cell: cells per metre; max_range_squared: square of the largest range [m2].
// Outputs: scores, least, column (shift_sums.h); seen (headings,) number of points used.
// Options: COST_LEVELS, CAPACITY (size of the array of shifts), WITH_SCORES.
// Variants: vector: a work-item per heading and `each` rows of positions; work-item: a group of BLOCK items per heading
//          and block of positions.
#include "common/shift_sums.h"
#include "field_pose/field_shift.h"

#ifdef VECTOR_VARIANT
kernel void field_pose_search(global const float *restrict points, global float *restrict scores,
                              global float *restrict least, global int *restrict column, global int *restrict seen,
                              global const ushort *restrict level, constant float *headings, const int count,
                              const int rows, const int columns, const int border, const int stride,
                              const float per_cell, const float max_range_squared, const int each) {
    const int turn = (int)get_global_id(1), first = (int)get_global_id(0) * each, end = min(first + each, rows);
    const float2 heading = (float2)(headings[2 * turn], headings[2 * turn + 1]);
    int shifts[CAPACITY], used = 0;
    for (int i = 0; i < count; i++) {
        const float2 point = (float2)(points[2 * i], points[2 * i + 1]);
        const int shift = shift_of(point, heading, per_cell, max_range_squared, border, stride);
        shifts[used] = shift;
        used += shift >= 0;
    }
    if (first == 0) seen[turn] = used;
    sum_rows(level, shifts, used, turn, first, end, rows, columns, stride, scores, least, column);
}
#else
kernel void field_pose_search(global const float *restrict points, global float *restrict scores,
                              global float *restrict least, global int *restrict column, global int *restrict seen,
                              global const ushort *restrict level, constant float *headings, const int count,
                              const int rows, const int columns, const int border, const int stride,
                              const float per_cell, const float max_range_squared, const int each) {
    const int item = (int)get_local_id(0), turn = (int)get_group_id(2);
    local int shifts[CAPACITY], used;
    local uint key;
    if (item == 0) {
        used = 0;
        key = NO_KEY;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int i = item; i < count; i += BLOCK) {
        const int shift = shift_of((float2)(points[2 * i], points[2 * i + 1]),
                                   (float2)(headings[2 * turn], headings[2 * turn + 1]), per_cell, max_range_squared,
                                   border, stride);
        if (shift >= 0) shifts[atomic_inc(&used)] = shift;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    sum_block(level, shifts, used, &key, columns, stride, scores, least, column);
    if (item == 0 && get_group_id(1) == 0 && get_group_id(0) == 0) seen[turn] = used;
}
#endif
#else
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
#include "field_pose/field_refinement.h"

kernel void field_pose_refinement(global const float *restrict points, global const float *restrict starts,
                                  global float *restrict poses, global float *restrict covariance,
                                  global float *restrict information, global float *restrict score,
                                  global float *restrict scale, global float *restrict share,
                                  global ushort *restrict status, constant float *shapes,
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
    // Rounding of the coordinates changes a distance by up to e = epsilon (|x| + |y| + size of the view), and the sum of
    // the costs r^2 share / c^2 by up to 2 e sum |psi| / c^2 <= (2 e / c) sqrt(used sum) (Cauchy-Schwarz).
    const float rounding = FLT_EPSILON * (fabs(pose.x) + fabs(pose.y) + 1.0f / lever);
    const float slack = 2.0f * rounding * sqrt(used / scale_squared);
    float damping = 1e-4f;
    for (int step = 0; finite && step < steps && damping < 1e6f; step++) {
        const float3 by = damped_step(here, damping, lever);
        const float3 next = pose + by;
        const normal_equations there =
            equations_at(points, count, next, shapes, nearest, grid, scale_squared, max_range_squared);
        // Accept a cost that is equal within the rounding of the distances and of the sum: near the minimum the step is
        // more accurate than the difference of costs.
        const int better = there.cost <= here.cost * 1.000004f + slack * sqrt(here.cost);
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
    const int is_open = has_not_converged(hessian, known, here, lever, variance);
    status[i] = !finite   ? STATUS_NOT_FINITE
                : few     ? STATUS_LOW_SIGNAL
                : outside ? STATUS_OUT_OF_RANGE
                          : (weak ? STATUS_AMBIGUOUS : STATUS_OK) | (is_open ? STATUS_NOT_CONVERGED : STATUS_OK);
    known.xt /= lever;
    known.yt /= lever;
    known.tt /= lever * lever;
    spread.xt *= lever;
    spread.yt *= lever;
    spread.tt *= lever * lever;
    store_symmetric(information + 9 * i, known, bad ? NAN : 1.0f / variance);
    store_symmetric(covariance + 9 * i, spread, bad || weak ? NAN : variance);
}
#endif
