// Output of a solved pose in metres about the artwork's origin; the pose was solved in the frame of the rows
// (pose_frame).
#ifndef POSE_RESULT_H
#define POSE_RESULT_H

#include "pose/pose.h"

// Output arrays of the kernels, in the order of the fields of BoardPose (pose.py); deformation and placement may be
// null.
typedef struct {
    global real *pose;
    global real *deformation;
    global real *placement;
    global real *covariance;
    global real *residuals;
    global real *weights;
    global real *scale;
    global real *residual_scale;
    global real *condition;
    global int *rank;
    global int *inliers;
    global ushort *status;
    global real *etch;
    global real *inlier_fraction;
    global real *leverage;
} pose_outputs;

// Limits of an accepted pose: least inlier fraction, largest leverage, largest shift of the placement point [m],
// largest turn [rad].
typedef struct {
    real inlier_fraction, leverage, shift, turn;
} pose_limits;

// Return the pose (x, y, turn) about the artwork's origin as a pose in the frame of the rows.
// cos(turn) - 1 = -2 sin^2(turn / 2) avoids cancellation for small turns.
static inline laned_pose pose_in_frame(real x, real y, real turn, pose_frame frame) {
    const real half_sine = sin(turn / 2), less = -2 * half_sine * half_sine, sine = sin(turn);
    return (laned_pose){(reals)less, (reals)-sine, (reals)sine, (reals)less,
                        (reals)((x + less * frame.x - sine * frame.y) * frame.per_size),
                        (reals)((y + sine * frame.x + less * frame.y) * frame.per_size), 0};
}

// Store residuals [m] and weights of the rows; each item of a group stores other rows.
static inline void store_rows(GROUP_SPACE const solved_pose *fit, pose_rows all, real size, int bad, int count,
                              global real *residuals, global real *weights) {
    const laned_pose pose = fit->pose;
    for (int i = GROUP_ITEM * LANES; i < count; i += GROUP_ITEMS * LANES) {
        const laned_row at = row_of(all, i);
        const masks gone = bad ? (masks)-1 : mask_of(!(at.certainty > (reals)0));
        const reals z = residual_of(pose, at);
        const reals left = nan_where(gone, z * (reals)size);
        const reals weight = kept_where(~gone, loss_weight(z * at.certainty * (reals)(1 / fit->scale)));
        for (int lane = 0; lane < LANES && i + lane < count; lane++) {
            residuals[i + lane] = LANE(left, lane);
            weights[i + lane] = LANE(weight, lane);
        }
    }
}

// Store the covariance of the placement point (at_x, at_y) in the frame of the rows: `lever` is the Jacobian of its x,
// y, and of the other parameters, with respect to the step d; C' = lever C lever^T.
BETWEEN_BARRIERS void store_covariance(private const solved_pose *fit, pose_frame frame, real at_x, real at_y, int bad,
                                       global real *to) {
    const real axx = 1 + FIRST(fit->pose.dxx), axy = FIRST(fit->pose.dxy), ayx = FIRST(fit->pose.dyx),
               ayy = 1 + FIRST(fit->pose.dyy);
    real lever[POSE_PARAMETERS][POSE_PARAMETERS];
    for (int i = 0; i < POSE_PARAMETERS; i++) {
        const real along_x = i == 0 ? 1 : i == 2 ? -at_y : 0, along_y = i == 1 ? 1 : i == 2 ? at_x : 0;
        const real more_x = POSE_PARAMETERS == 6 ? (i == 3 ? at_x : i == 5 ? at_y : 0) : i == 3 ? at_x : 0;
        const real more_y = POSE_PARAMETERS == 6 ? (i == 4 ? at_y : 0) : i == 3 ? at_y : 0;
        lever[0][i] = (axx * (along_x + more_x) + axy * (along_y + more_y)) * frame.size;
        lever[1][i] = (ayx * (along_x + more_x) + ayy * (along_y + more_y)) * frame.size;
        for (int k = 2; k < POSE_PARAMETERS; k++) lever[k][i] = k == i;
    }
    for (int i = 0; i < POSE_PARAMETERS; i++)
        for (int j = 0; j < POSE_PARAMETERS; j++) {
            real total = 0;
            for (int k = 0; k < POSE_PARAMETERS; k++)
                for (int l = 0; l < POSE_PARAMETERS; l++) total += lever[i][k] * fit->covariance[k][l] * lever[j][l];
            to[i * POSE_PARAMETERS + j] = bad ? REAL_NAN : total * fit->covariance_factor;
        }
}

// Check a pose against the limits and store it; a refused pose is stored as NaN.
//
// `verdict` of the caller: STATUS_OK, or the flag with which it refuses the pose: STATUS_AMBIGUOUS, or STATUS_NOT_FINITE of
// the initial or expected pose.
//
// Translation about the origin: T(p) = c + (I + D) (p - c) + t gives t - D c for the centre c of the rows. Deformation:
// I + D = R(theta) ((1 + kx, shear), (0, 1 + ky)), kx and theta from its first column.
static inline void store_pose(GROUP_SPACE const solved_pose *fit, pose_rows all, pose_frame frame, ushort verdict,
                              long item, int count, pose_limits limits, real place_x, real place_y, pose_outputs to) {
    const int all_finite = verdict != STATUS_NOT_FINITE, few = fit->present < POSE_PARAMETERS;
    // Below an inlier fraction of 0.75 two outliers may agree by chance. Half the leverage limit then requires that two
    // other rows check each row.
    const real leverage = fit->inlier_fraction > 0.75f ? limits.leverage : limits.leverage / 2;
    // Where the normal equations of the last step were singular, the steps ended before the pose of least loss: the
    // weights of Huber's loss can be so unequal although all rows count as inliers.
    const int refused = verdict == STATUS_AMBIGUOUS || fit->is_singular || fit->rank < POSE_PARAMETERS ||
                        fit->inliers < POSE_PARAMETERS ||
                        !(fit->inlier_fraction >= limits.inlier_fraction) || !(fit->leverage < leverage) ||
                        !(fit->covariance_factor < (real)INFINITY);
    const real axx = 1 + FIRST(fit->pose.dxx), axy = FIRST(fit->pose.dxy), ayx = FIRST(fit->pose.dyx),
               ayy = 1 + FIRST(fit->pose.dyy), length = sqrt(axx * axx + ayx * ayx), c = axx / length, s = ayx / length;
    const real move_x = FIRST(fit->pose.x) * frame.size, move_y = FIRST(fit->pose.y) * frame.size;
    // Placement point in the frame of the rows, and its shift [m].
    const real at_x = (place_x - frame.x) * frame.per_size, at_y = (place_y - frame.y) * frame.per_size;
    const real shift_x = move_x + ((axx - 1) * at_x + axy * at_y) * frame.size;
    const real shift_y = move_y + (ayx * at_x + (ayy - 1) * at_y) * frame.size, turn = atan2(ayx, axx);
    const int away = !(sqrt(shift_x * shift_x + shift_y * shift_y) <= limits.shift) || !(fabs(turn) <= limits.turn);
    const int bad = few || refused || away || !all_finite;
    store_rows(fit, all, frame.size, bad, count, to.residuals + item * count, to.weights + item * count);
    if (GROUP_ITEM) return;
    to.status[item] = !all_finite    ? STATUS_NOT_FINITE
                      : few          ? STATUS_NO_DATA
                      : refused      ? STATUS_AMBIGUOUS
                      : away         ? STATUS_OUT_OF_RANGE
                      : fit->is_open ? STATUS_NOT_CONVERGED
                                     : STATUS_OK;
    to.pose[3 * item] = bad ? REAL_NAN : move_x - ((axx - 1) * frame.x + axy * frame.y);
    to.pose[3 * item + 1] = bad ? REAL_NAN : move_y - (ayx * frame.x + (ayy - 1) * frame.y);
    to.pose[3 * item + 2] = bad ? REAL_NAN : turn;
    if (to.deformation) {
        to.deformation[3 * item] = bad ? REAL_NAN : POSE_PARAMETERS > 3 ? length - 1 : 0;
        to.deformation[3 * item + 1] = bad ? REAL_NAN : POSE_PARAMETERS > 3 ? c * ayy - s * axy - 1 : 0;
        to.deformation[3 * item + 2] = bad ? REAL_NAN : POSE_PARAMETERS == 6 ? c * axy + s * ayy : 0;
    }
    if (to.placement) {
        to.placement[2 * item] = bad ? REAL_NAN : place_x + shift_x;
        to.placement[2 * item + 1] = bad ? REAL_NAN : place_y + shift_y;
    }
    const solved_pose own = *fit;
    store_covariance(&own, frame, at_x, at_y, bad, to.covariance + item * POSE_PARAMETERS * POSE_PARAMETERS);
    to.etch[item] = bad ? REAL_NAN : FIRST(fit->pose.etch) * frame.size;
    to.scale[item] = bad ? REAL_NAN : fit->scale;
    to.residual_scale[item] = bad ? REAL_NAN : fit->residual_scale;
    to.condition[item] = few || !all_finite ? REAL_NAN : fit->condition;
    to.inlier_fraction[item] = few || !all_finite ? REAL_NAN : fit->inlier_fraction;
    to.leverage[item] = few || !all_finite ? REAL_NAN : fit->leverage;
    to.rank[item] = few ? min(fit->rank, fit->present) : fit->rank;
    to.inliers[item] = fit->inliers;
}

#endif
