// Rows about their middle, and what is said of a solved pose.
#ifndef POSE_RESULT_H
#define POSE_RESULT_H

#include "pose.h"
#include "status.h"

typedef struct {
    real x, y, size, per_size;
} pose_frame;

// As the kernels have them, in the order of BoardPose.
typedef struct {
    global real *pose;
    global real *deformation;
    global real *placement;
    global real *covariance;
    global real *residuals;
    global real *weights;
    global real *scale;
    global real *spread;
    global real *condition;
    global int *rank;
    global int *inliers;
    global uchar *status;
} pose_outputs;

// Takes rows to where their middle is zero and their size one: then a turn and a shift are alike, and the digits are
// where they count. There are `sum` of them, and their places add up to (sum_x, sum_y).
inline pose_frame framed(pose_rows all, real sum, real sum_x, real sum_y) {
    private real *px = (private real *)all.px, *py = (private real *)all.py;
    private real *ex = (private real *)all.ex, *ey = (private real *)all.ey;
    private real *certainty = (private real *)all.certainty;
    const real x = sum_x / max(sum, (real)1), y = sum_y / max(sum, (real)1);
    real square = 0;
    for (int i = 0; i < all.count; i++) {
        px[i] = certainty[i] > 0 ? px[i] - x : 0;
        py[i] = certainty[i] > 0 ? py[i] - y : 0;
        square += px[i] * px[i] + py[i] * py[i];
    }
    const real size = square > 0 ? sqrt(square / sum) : 1, per_size = 1 / size;
    for (int i = 0; i < all.count; i++) {
        px[i] *= per_size, py[i] *= per_size, ex[i] *= per_size, ey[i] *= per_size;
        certainty[i] *= size;
    }
    return (pose_frame){x, y, size, per_size};
}

inline laned_pose pose_near(real x, real y, real turn, pose_frame frame) {
    const real half_sine = sin(turn / 2), less = -2 * half_sine * half_sine, sine = sin(turn);
    return (laned_pose){(reals)less, (reals)-sine, (reals)sine, (reals)less,
                        (reals)((x + less * frame.x - sine * frame.y) * frame.per_size),
                        (reals)((y + sine * frame.x + less * frame.y) * frame.per_size)};
}

inline void store_pose(solved_pose fit, pose_rows all, pose_frame frame, int all_finite, long item, int count,
                       real agreement, real place_x, real place_y, pose_outputs to) {
    const int few = fit.present < FREEDOMS;
    const int refused = fit.rank < FREEDOMS || fit.inliers < FREEDOMS || fit.inliers < agreement * fit.present;
    const int bad = few || refused || !all_finite;
    to.status[item] = !all_finite ? STATUS_NOT_FINITE : few ? STATUS_HOLE : refused ? STATUS_AMBIGUOUS : STATUS_OK;
    const real axx = 1 + FIRST(fit.pose.dxx), axy = FIRST(fit.pose.dxy), ayx = FIRST(fit.pose.dyx),
               ayy = 1 + FIRST(fit.pose.dyy), length = sqrt(axx * axx + ayx * ayx), c = axx / length, s = ayx / length;
    const real move_x = FIRST(fit.pose.x) * frame.size, move_y = FIRST(fit.pose.y) * frame.size;
    to.pose[3 * item] = bad ? REAL_NAN : move_x - ((axx - 1) * frame.x + axy * frame.y);
    to.pose[3 * item + 1] = bad ? REAL_NAN : move_y - (ayx * frame.x + (ayy - 1) * frame.y);
    to.pose[3 * item + 2] = bad ? REAL_NAN : atan2(ayx, axx);
    to.deformation[3 * item] = bad ? REAL_NAN : FREEDOMS > 3 ? length - 1 : 0;
    to.deformation[3 * item + 1] = bad ? REAL_NAN : FREEDOMS > 3 ? c * ayy - s * axy - 1 : 0;
    to.deformation[3 * item + 2] = bad ? REAL_NAN : FREEDOMS == 6 ? c * axy + s * ayy : 0;
    // From a step about the middle to the pose of the placement point.
    const real at_x = (place_x - frame.x) * frame.per_size, at_y = (place_y - frame.y) * frame.per_size;
    to.placement[2 * item] = bad ? REAL_NAN : place_x + move_x + ((axx - 1) * at_x + axy * at_y) * frame.size;
    to.placement[2 * item + 1] = bad ? REAL_NAN : place_y + move_y + (ayx * at_x + (ayy - 1) * at_y) * frame.size;
    real lever[FREEDOMS][FREEDOMS];
    for (int i = 0; i < FREEDOMS; i++) {
        const real along_x = i == 0 ? 1 : i == 2 ? -at_y : 0, along_y = i == 1 ? 1 : i == 2 ? at_x : 0;
        const real more_x = FREEDOMS == 6 ? (i == 3 ? at_x : i == 5 ? at_y : 0) : i == 3 ? at_x : 0;
        const real more_y = FREEDOMS == 6 ? (i == 4 ? at_y : 0) : i == 3 ? at_y : 0;
        lever[0][i] = (axx * (along_x + more_x) + axy * (along_y + more_y)) * frame.size;
        lever[1][i] = (ayx * (along_x + more_x) + ayy * (along_y + more_y)) * frame.size;
        for (int k = 2; k < FREEDOMS; k++) lever[k][i] = k == i;
    }
    for (int i = 0; i < FREEDOMS; i++)
        for (int j = 0; j < FREEDOMS; j++) {
            real total = 0;
            for (int k = 0; k < FREEDOMS; k++)
                for (int l = 0; l < FREEDOMS; l++) total += lever[i][k] * fit.covariance[k][l] * lever[j][l];
            to.covariance[(item * FREEDOMS + i) * FREEDOMS + j] = bad ? REAL_NAN : total;
        }
    for (int i = 0; i < count; i += LANES) {
        const laned_row at = row_of(all, i);
        const masks gone = bad ? (masks)-1 : mask_of(!(at.certainty > (reals)0));
        const reals z = residual_of(fit.pose, at);
        const reals left = nan_where(gone, z * (reals)frame.size);
        const reals weight = kept_where(~gone, loss_weight(z * at.certainty * (reals)(1 / fit.scale)));
        for (int lane = 0; lane < LANES && i + lane < count; lane++) {
            to.residuals[item * count + i + lane] = LANE(left, lane);
            to.weights[item * count + i + lane] = LANE(weight, lane);
        }
    }
    to.scale[item] = bad ? REAL_NAN : fit.scale;
    to.spread[item] = bad ? REAL_NAN : fit.spread;
    to.condition[item] = few || !all_finite ? REAL_NAN : fit.condition;
    to.rank[item] = few ? min(fit.rank, fit.present) : fit.rank;
    to.inliers[item] = fit.inliers;
}

#endif
