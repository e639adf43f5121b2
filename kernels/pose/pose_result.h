// Rows about their middle, and what is said of a solved pose.
#ifndef POSE_RESULT_H
#define POSE_RESULT_H

#include "pose/pose.h"
#include "common/status.h"

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
    global real *etch;
    global real *agreement;
    global real *leverage;
} pose_outputs;

// What is asked of a pose.
typedef struct {
    real agreement, leverage, shift, turn;
} pose_limits;

// Takes rows to where their middle is zero and their size one: then a turn and a shift are alike, and the digits are
// where they count. There are `sum` of them, and their places add up to (sum_x, sum_y).
static inline pose_frame framed(private pose_rows *all, real sum, real sum_x, real sum_y) {
    private real *px = (private real *)all->px, *py = (private real *)all->py;
    private real *ex = (private real *)all->ex, *ey = (private real *)all->ey;
    private real *certainty = (private real *)all->certainty;
    const real x = sum_x / max(sum, (real)1), y = sum_y / max(sum, (real)1);
    real square = 0;
    for (int i = 0; i < all->count; i++) {
        px[i] = certainty[i] > 0 ? px[i] - x : 0;
        py[i] = certainty[i] > 0 ? py[i] - y : 0;
        square += px[i] * px[i] + py[i] * py[i];
    }
    const real size = square > 0 ? sqrt(square / sum) : 1, per_size = 1 / size;
    for (int i = 0; i < all->count; i++) {
        px[i] *= per_size, py[i] *= per_size, ex[i] *= per_size, ey[i] *= per_size;
        certainty[i] *= size;
    }
    all->etch *= size;
    return (pose_frame){x, y, size, per_size};
}

static inline laned_pose pose_near(real x, real y, real turn, pose_frame frame) {
    const real half_sine = sin(turn / 2), less = -2 * half_sine * half_sine, sine = sin(turn);
    return (laned_pose){(reals)less, (reals)-sine, (reals)sine, (reals)less,
                        (reals)((x + less * frame.x - sine * frame.y) * frame.per_size),
                        (reals)((y + sine * frame.x + less * frame.y) * frame.per_size), 0};
}

static inline void store_pose(solved_pose fit, pose_rows all, pose_frame frame, int all_finite, long item, int count,
                       pose_limits asked, real place_x, real place_y, pose_outputs to) {
    const int few = fit.present < OF_POSE;
    // Where many disagree two that agree may do so by chance: each must have two others.
    const real leverage = fit.agreement > 0.75f ? asked.leverage : asked.leverage / 2;
    const int refused = fit.rank < OF_POSE || fit.inliers < OF_POSE || !(fit.agreement >= asked.agreement) ||
                        !(fit.leverage < leverage);
    const real axx = 1 + FIRST(fit.pose.dxx), axy = FIRST(fit.pose.dxy), ayx = FIRST(fit.pose.dyx),
               ayy = 1 + FIRST(fit.pose.dyy), length = sqrt(axx * axx + ayx * ayx), c = axx / length, s = ayx / length;
    const real move_x = FIRST(fit.pose.x) * frame.size, move_y = FIRST(fit.pose.y) * frame.size;
    // From a step about the middle to the pose of the placement point.
    const real at_x = (place_x - frame.x) * frame.per_size, at_y = (place_y - frame.y) * frame.per_size;
    const real shift_x = move_x + ((axx - 1) * at_x + axy * at_y) * frame.size;
    const real shift_y = move_y + (ayx * at_x + (ayy - 1) * at_y) * frame.size, turn = atan2(ayx, axx);
    const int away = !(sqrt(shift_x * shift_x + shift_y * shift_y) <= asked.shift) || !(fabs(turn) <= asked.turn);
    const int bad = few || refused || away || !all_finite;
    to.status[item] = !all_finite ? STATUS_NOT_FINITE
                      : few       ? STATUS_NO_DATA
                      : refused   ? STATUS_AMBIGUOUS
                      : away      ? STATUS_OUT_OF_RANGE
                                  : STATUS_OK;
    to.pose[3 * item] = bad ? REAL_NAN : move_x - ((axx - 1) * frame.x + axy * frame.y);
    to.pose[3 * item + 1] = bad ? REAL_NAN : move_y - (ayx * frame.x + (ayy - 1) * frame.y);
    to.pose[3 * item + 2] = bad ? REAL_NAN : turn;
    to.deformation[3 * item] = bad ? REAL_NAN : OF_POSE > 3 ? length - 1 : 0;
    to.deformation[3 * item + 1] = bad ? REAL_NAN : OF_POSE > 3 ? c * ayy - s * axy - 1 : 0;
    to.deformation[3 * item + 2] = bad ? REAL_NAN : OF_POSE == 6 ? c * axy + s * ayy : 0;
    to.placement[2 * item] = bad ? REAL_NAN : place_x + shift_x;
    to.placement[2 * item + 1] = bad ? REAL_NAN : place_y + shift_y;
    real lever[OF_POSE][OF_POSE];
    for (int i = 0; i < OF_POSE; i++) {
        const real along_x = i == 0 ? 1 : i == 2 ? -at_y : 0, along_y = i == 1 ? 1 : i == 2 ? at_x : 0;
        const real more_x = OF_POSE == 6 ? (i == 3 ? at_x : i == 5 ? at_y : 0) : i == 3 ? at_x : 0;
        const real more_y = OF_POSE == 6 ? (i == 4 ? at_y : 0) : i == 3 ? at_y : 0;
        lever[0][i] = (axx * (along_x + more_x) + axy * (along_y + more_y)) * frame.size;
        lever[1][i] = (ayx * (along_x + more_x) + ayy * (along_y + more_y)) * frame.size;
        for (int k = 2; k < OF_POSE; k++) lever[k][i] = k == i;
    }
    for (int i = 0; i < OF_POSE; i++)
        for (int j = 0; j < OF_POSE; j++) {
            real total = 0;
            for (int k = 0; k < OF_POSE; k++)
                for (int l = 0; l < OF_POSE; l++) total += lever[i][k] * fit.covariance[k][l] * lever[j][l];
            to.covariance[(item * OF_POSE + i) * OF_POSE + j] = bad ? REAL_NAN : total;
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
    to.etch[item] = bad ? REAL_NAN : FIRST(fit.pose.etch) * frame.size;
    to.scale[item] = bad ? REAL_NAN : fit.scale;
    to.spread[item] = bad ? REAL_NAN : fit.spread;
    to.condition[item] = few || !all_finite ? REAL_NAN : fit.condition;
    to.agreement[item] = few || !all_finite ? REAL_NAN : fit.agreement;
    to.leverage[item] = few || !all_finite ? REAL_NAN : fit.leverage;
    to.rank[item] = few ? min(fit.rank, fit.present) : fit.rank;
    to.inliers[item] = fit.inliers;
}

#endif
