// Poses of boards, one for each set of equations; a work-item each. CPU runtimes take sixteen equations, or starts, at
// a time.
#include "pose.h"
#include "status.h"

// Numbers of a row: normal, place, displacement seen, sigma.
#define ROW 7

kernel void pose_sets(global const INPUT *restrict rows,
#ifdef WITH_NEAR
                      global const INPUT *restrict near,
#endif
                      global real *restrict pose, global real *restrict deformation, global real *restrict placement,
                      global real *restrict covariance, global real *restrict residuals, global real *restrict weights,
                      global real *restrict scale, global real *restrict spread, global real *restrict condition,
                      global int *restrict rank, global int *restrict inliers, global uchar *restrict status,
                      const long poses, const int count, constant int *subsets, const int trials, const int steps,
                      const real smallest, const real share, const real agreement, const real place_x,
                      const real place_y) {
    const long item = (long)get_global_id(0);
    if (item >= poses) return;
    real nx[CAPACITY], ny[CAPACITY], px[CAPACITY], py[CAPACITY], ex[CAPACITY], ey[CAPACITY], certainty[CAPACITY];
    reals room[CAPACITY];
    const int padded = (count + LANES - 1) / LANES * LANES;
    global const INPUT *row = rows + item * count * ROW;
    real sum = 0, middle_x = 0, middle_y = 0;
    int all_finite = 1;
    for (int i = 0; i < padded; i++) {
        const int at = min(i, count - 1) * ROW;
        int good = i < count;
        for (int k = 0; k < ROW; k++) good &= !not_finite((real)row[at + k]);
        good &= row[at + 6] > 0;
        nx[i] = good ? row[at] : 0;
        ny[i] = good ? row[at + 1] : 0;
        px[i] = good ? row[at + 2] : 0;
        py[i] = good ? row[at + 3] : 0;
        ex[i] = good ? row[at + 4] : 0;
        ey[i] = good ? row[at + 5] : 0;
        certainty[i] = good ? 1 / (real)row[at + 6] : 0;
        sum += good;
        middle_x += px[i];
        middle_y += py[i];
    }
    middle_x /= max(sum, (real)1);
    middle_y /= max(sum, (real)1);
    // About the middle, in units of the size: then a turn and a shift are alike, and the digits are where they count.
    real square = 0;
    for (int i = 0; i < padded; i++) {
        px[i] = certainty[i] > 0 ? px[i] - middle_x : 0;
        py[i] = certainty[i] > 0 ? py[i] - middle_y : 0;
        square += px[i] * px[i] + py[i] * py[i];
    }
    const real size = square > 0 ? sqrt(square / sum) : 1, per_size = 1 / size;
    for (int i = 0; i < padded; i++) {
        px[i] *= per_size, py[i] *= per_size, ex[i] *= per_size, ey[i] *= per_size;
        certainty[i] *= size;
    }
    laned_pose about = {0, 0, 0, 0, 0, 0};
#ifdef WITH_NEAR
    const real x = near[3 * item], y = near[3 * item + 1], turn = near[3 * item + 2];
    all_finite = !(not_finite(x) | not_finite(y) | not_finite(turn));
    const real half_sine = sin(turn / 2), less = -2 * half_sine * half_sine, sine = sin(turn);
    about = (laned_pose){(reals)less, (reals)-sine, (reals)sine, (reals)less,
                         (reals)((x + less * middle_x - sine * middle_y) * per_size),
                         (reals)((y + sine * middle_x + less * middle_y) * per_size)};
#endif
    const pose_rows all = {nx, ny, px, py, ex, ey, certainty, padded};
    const solved_pose fit = pose_solved(about, all, subsets, trials, steps, smallest, share, room);

    const int few = fit.present < FREEDOMS;
    const int refused = fit.rank < FREEDOMS || fit.inliers < FREEDOMS || fit.inliers < agreement * fit.present;
    const int bad = few || refused || !all_finite;
    status[item] = !all_finite ? STATUS_NOT_FINITE : few ? STATUS_HOLE : refused ? STATUS_AMBIGUOUS : STATUS_OK;
    const real axx = 1 + FIRST(fit.pose.dxx), axy = FIRST(fit.pose.dxy), ayx = FIRST(fit.pose.dyx),
               ayy = 1 + FIRST(fit.pose.dyy), length = sqrt(axx * axx + ayx * ayx), c = axx / length, s = ayx / length;
    const real move_x = FIRST(fit.pose.x) * size, move_y = FIRST(fit.pose.y) * size;
    pose[3 * item] = bad ? REAL_NAN : move_x - ((axx - 1) * middle_x + axy * middle_y);
    pose[3 * item + 1] = bad ? REAL_NAN : move_y - (ayx * middle_x + (ayy - 1) * middle_y);
    pose[3 * item + 2] = bad ? REAL_NAN : atan2(ayx, axx);
    deformation[3 * item] = bad ? REAL_NAN : FREEDOMS > 3 ? length - 1 : 0;
    deformation[3 * item + 1] = bad ? REAL_NAN : FREEDOMS > 3 ? c * ayy - s * axy - 1 : 0;
    deformation[3 * item + 2] = bad ? REAL_NAN : FREEDOMS == 6 ? c * axy + s * ayy : 0;
    // From a step about the middle to the pose of the placement point.
    const real at_x = (place_x - middle_x) * per_size, at_y = (place_y - middle_y) * per_size;
    placement[2 * item] = bad ? REAL_NAN : place_x + move_x + ((axx - 1) * at_x + axy * at_y) * size;
    placement[2 * item + 1] = bad ? REAL_NAN : place_y + move_y + (ayx * at_x + (ayy - 1) * at_y) * size;
    real lever[FREEDOMS][FREEDOMS];
    for (int i = 0; i < FREEDOMS; i++) {
        const real along_x = i == 0 ? 1 : i == 2 ? -at_y : 0, along_y = i == 1 ? 1 : i == 2 ? at_x : 0;
        const real more_x = FREEDOMS == 6 ? (i == 3 ? at_x : i == 5 ? at_y : 0) : i == 3 ? at_x : 0;
        const real more_y = FREEDOMS == 6 ? (i == 4 ? at_y : 0) : i == 3 ? at_y : 0;
        lever[0][i] = (axx * (along_x + more_x) + axy * (along_y + more_y)) * size;
        lever[1][i] = (ayx * (along_x + more_x) + ayy * (along_y + more_y)) * size;
        for (int k = 2; k < FREEDOMS; k++) lever[k][i] = k == i;
    }
    for (int i = 0; i < FREEDOMS; i++)
        for (int j = 0; j < FREEDOMS; j++) {
            real total = 0;
            for (int k = 0; k < FREEDOMS; k++)
                for (int l = 0; l < FREEDOMS; l++) total += lever[i][k] * fit.covariance[k][l] * lever[j][l];
            covariance[(item * FREEDOMS + i) * FREEDOMS + j] = bad ? REAL_NAN : total;
        }
    for (int i = 0; i < count; i += LANES) {
        const laned_row at = row_of(all, i);
        const masks gone = bad ? (masks)-1 : mask_of(!(at.certainty > (reals)0));
        const reals z = residual_of(fit.pose, at);
        const reals left = nan_where(gone, z * (reals)size);
        const reals weight = kept_where(~gone, loss_weight(z * at.certainty * (reals)(1 / fit.scale)));
        for (int lane = 0; lane < LANES && i + lane < count; lane++) {
            residuals[item * count + i + lane] = LANE(left, lane);
            weights[item * count + i + lane] = LANE(weight, lane);
        }
    }
    scale[item] = bad ? REAL_NAN : fit.scale;
    spread[item] = bad ? REAL_NAN : fit.spread;
    condition[item] = few || !all_finite ? REAL_NAN : fit.condition;
    rank[item] = few ? min(fit.rank, fit.present) : fit.rank;
    inliers[item] = fit.inliers;
}
