// Robust poses of boards from feature rows, each with its covariance, residuals and status.
//
// Each row is one scalar equation n . (T^-1(p + e) - p) = g etch of the pose T (pose.h). The pose minimises
// sum rho(residual / (sigma scale)) with the loss rho of common/robust.h.
//
// Inputs:  rows (poses, count) PoseRow; start (poses, 3) with WITH_INITIAL_POSE: initial pose x, y [m], theta [rad].
// Tables:  subsets (trials / LANES, FREEDOMS, LANES): rows of the start candidates.
// Outputs: pose (poses, 3) x, y [m], theta [rad]; deformation (poses, 3); placement (poses, 2) [m]; covariance (poses,
//          POSE_PARAMETERS, POSE_PARAMETERS) of the placement point [m2, m rad, rad2]; residuals (poses, count) [m];
//          weights (poses, count), 0 to 1; etch (poses,) [m]; (poses,): scale, residual_scale, condition, rank,
//          inliers, status, inlier_fraction, leverage. Refused poses are NaN.
// Options: INPUT, REAL_IS_DOUBLE, WITH_INITIAL_POSE (initial pose; otherwise no motion), POSE_PARAMETERS, FREEDOMS,
//          WITH_ETCH_BIAS, CAPACITY, START_STEPS, GIVEN_SCALE, EFFICIENCY (pose.h), loss options (common/robust.h).
// Variants: vector: a work-item per pose, 16 rows or 16 start candidates in a vector; work-item: a group of up to 64
//          items per pose; the items share the rows and the start candidates. Each pass reads the rows from global
//          memory (pose_group_rows.h). The results do not depend on the size of the group (common/group.h).
#ifndef VECTOR_VARIANT
#define GROUP_PER_PROBLEM
#endif
#include "pose/pose_input.h"
#include "pose/pose_result.h"

kernel void pose_sets(global const PoseRow *restrict rows,
#ifdef WITH_INITIAL_POSE
                      global const INPUT *restrict start,
#endif
                      global real *restrict pose, global real *restrict deformation, global real *restrict placement,
                      global real *restrict covariance, global real *restrict residuals, global real *restrict weights,
                      global real *restrict scale, global real *restrict residual_scale,
                      global real *restrict condition, global int *restrict rank, global int *restrict inliers,
                      global ushort *restrict status, global real *restrict etch, global real *restrict inlier_fraction,
                      global real *restrict leverage, const long poses, const int count, constant int *subsets,
                      const int trials, const int steps, const real min_scale, const real rank_tolerance,
                      const real min_inlier_fraction, const real max_leverage, const real max_shift,
                      const real max_turn, const real place_x, const real place_y,
                      const real etch_certainty) {
#ifdef IN_GROUP
    const long item = (long)get_group_id(0);
    local real sums[ROOM_FOR_SUMS], distances[ROOM_FOR_DISTANCES];
    const pose_room room = {distances, sums};
    const pose_rows all = framed_rows(rows + item * count, count, etch_certainty, sums);
    const pose_frame frame = all.frame;
#else
    const long item = (long)get_global_id(0);
    if (item >= poses) return;
    real numbers[POSE_COLUMNS][CAPACITY];
    reals distances[CAPACITY];
    const pose_room room = {distances, 0};
    pose_rows all = rows_in(numbers, (count + LANES - 1) / LANES * LANES, etch_certainty);
    for (int i = 0; i < all.count; i++)
        put_row(all, i, read_row(rows + item * count + min(i, count - 1), i < count));
    const pose_frame frame = centre_rows(&all);
#endif
    ushort verdict = STATUS_OK;
    laned_pose about = {0, 0, 0, 0, 0, 0, 0};
#ifdef WITH_INITIAL_POSE
    const real x = start[3 * item], y = start[3 * item + 1], turn = start[3 * item + 2];
    verdict = not_finite(x) | not_finite(y) | not_finite(turn) ? STATUS_NOT_FINITE : STATUS_OK;
    about = pose_in_frame(x, y, turn, frame);
#endif
    GROUP_SPACE solved_pose fit;
    if (GROUP_ITEM == 0) fit.pose = about;
    group_barrier();
    pose_solved(&fit, all, subsets, trials, steps, min_scale, rank_tolerance, room);

    const pose_outputs outputs = {pose,   deformation, placement, covariance, residuals, weights,
                                  scale,  residual_scale,      condition, rank,       inliers,   status,     etch,
                                  inlier_fraction, leverage};
    const pose_limits limits = {min_inlier_fraction, max_leverage, max_shift, max_turn};
    store_pose(&fit, all, frame, verdict, item, count, limits, place_x, place_y, outputs);
}
