// Poses of boards, one for each set of equations; a work-item each. CPU runtimes take sixteen equations, or starts, at
// a time.
#include "pose/pose_result.h"

// Numbers of a row: normal, place, displacement seen, sigma; and with ETCHED how much the etching displaces it.
#ifdef ETCHED
#define ROW 8
#else
#define ROW 7
#endif

kernel void pose_sets(global const INPUT *restrict rows,
#ifdef WITH_NEAR
                      global const INPUT *restrict near,
#endif
                      global real *restrict pose, global real *restrict deformation, global real *restrict placement,
                      global real *restrict covariance, global real *restrict residuals, global real *restrict weights,
                      global real *restrict scale, global real *restrict spread, global real *restrict condition,
                      global int *restrict rank, global int *restrict inliers, global uchar *restrict status,
                      global real *restrict etch, global real *restrict agreement,
                      global real *restrict leverage,                       const long poses, const int count, constant int *subsets, const int trials, const int steps,
                      const real smallest, const real share, const real least_agreeing,
                      const real largest_leverage, const real shift_within, const real turn_within, const real place_x,
                      const real place_y, const real etch_certainty) {
    const long item = (long)get_global_id(0);
    if (item >= poses) return;
    real nx[CAPACITY], ny[CAPACITY], px[CAPACITY], py[CAPACITY], ex[CAPACITY], ey[CAPACITY], certainty[CAPACITY];
    reals room[CAPACITY];
#ifdef ETCHED
    real grows[CAPACITY];
#else
    private real *grows = 0;
#endif
    const int padded = (count + LANES - 1) / LANES * LANES;
    global const INPUT *row = rows + item * count * ROW;
    real sum = 0, sum_x = 0, sum_y = 0;
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
#ifdef ETCHED
        grows[i] = good ? row[at + 7] : 0;
#endif
        sum += good;
        sum_x += px[i];
        sum_y += py[i];
    }
    pose_rows all = {nx, ny, px, py, ex, ey, certainty, grows, padded, etch_certainty};
    const pose_frame frame = framed(&all, sum, sum_x, sum_y);
    laned_pose about = {0, 0, 0, 0, 0, 0, 0};
#ifdef WITH_NEAR
    const real x = near[3 * item], y = near[3 * item + 1], turn = near[3 * item + 2];
    all_finite = !(not_finite(x) | not_finite(y) | not_finite(turn));
    about = pose_near(x, y, turn, frame);
#endif
    const solved_pose fit = pose_solved(about, all, subsets, trials, steps, smallest, share, room);

    const pose_outputs outputs = {pose,   deformation, placement, covariance, residuals, weights,
                                  scale,  spread,      condition, rank,       inliers,   status,     etch,
                                  agreement, leverage};
    const pose_limits asked = {least_agreeing, largest_leverage, shift_within, turn_within};
    store_pose(fit, all, frame, all_finite, item, count, asked, place_x, place_y, outputs);
}
