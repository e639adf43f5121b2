// Robust straight lines through sets of points, one line per set, with covariance and status (line_fit.h).
//
// Inputs:  points (lines, count, 2) x, y, type INPUT; with WITH_SIGMA also sigma (lines, count), in the unit of the
//          points. A point that is not finite, or whose sigma is not positive and finite, is missing.
// Tables:  pairs (trials, 2): points of the start candidates.
// Outputs: normal (lines, 2), (n_x, n_y) with n_y > 0, or n_x = -1 for a vertical line; distance (lines,) n . p from
//          the origin; centre (lines, 2); covariance (lines, 2, 2) of angle [rad] and offset at the centre; scale
//          (lines,); inliers (lines,); status (lines,); with WITH_WEIGHTS also weights (lines, count), 0 to 1.
// Options: INPUT, REAL_IS_DOUBLE, WITH_SIGMA, WITH_WEIGHTS, CAPACITY (size of the point arrays), GIVEN_SCALE,
//          EFFICIENCY (line_fit.h), loss options (common/robust.h).
// Variants: vector: 16 lines per work-item, a line per lane; the last lanes of the last vector repeat the last line,
//          and are not stored. work-item: a group of up to 64 items per line; the items share the points and the start
//          candidates. Each pass reads the points from global memory (line_fit_points.h). The results do not depend on
//          the size of the group (common/group.h).
#ifndef VECTOR_VARIANT
#define GROUP_PER_PROBLEM
#endif
#include "line_fit/line_fit.h"

#ifdef VECTOR_VARIANT
// Gather the values of global memory at the index in each lane.
static inline reals gather(global const INPUT *from, long16 at) {
    return (reals)(from[at.s0], from[at.s1], from[at.s2], from[at.s3], from[at.s4], from[at.s5], from[at.s6],
                   from[at.s7], from[at.s8], from[at.s9], from[at.sa], from[at.sb], from[at.sc], from[at.sd],
                   from[at.se], from[at.sf]);
}
#endif

kernel void line_fit_sets(global const INPUT *restrict points,
#ifdef WITH_SIGMA
                          global const INPUT *restrict sigma,
#endif
                          global real *restrict normal, global real *restrict distance, global real *restrict centre,
                          global real *restrict covariance, global real *restrict scale, global int *restrict inliers,
                          global real *restrict weights, global ushort *restrict status, const long lines,
                          const int count, constant int *pairs, const int trials, const int steps,
                          const real min_scale) {
#ifdef IN_GROUP
    const long first = (long)get_group_id(0);
    local real sums[ROOM_FOR_SUMS], distances[ROOM_FOR_DISTANCES];
#ifdef WITH_SIGMA
    global const INPUT *sigma_of_line = sigma + first * count;
#else
    global const INPUT *sigma_of_line = 0;
#endif
    const laned_points given = {points + 2 * first * count, sigma_of_line, 0, 0, distances, sums, count};
    real reach;
    const laned_points all = about_first_point(given, &reach);
    const real origin_x = all.origin_x, origin_y = all.origin_y;
#else
    reals x[CAPACITY], y[CAPACITY], certainty[CAPACITY], distances[CAPACITY];
    const long first = (long)get_global_id(0) * LANES;
    if (first >= lines) return;
    const long16 line = min((long16)first + LANED(convert_long)(LANE_NUMBERS), (long16)(lines - 1));
    const long16 set = line * (long16)count;
    // Coordinates relative to the first valid point: coordinates of a large image leave few digits for distances.
    reals origin_x = 0, origin_y = 0, reach = 0;
    masks found = 0;
    for (int i = 0; i < count; i++) {
        const long16 at = set + (long16)i;
        const reals px = gather(points, 2 * at), py = gather(points, 2 * at + 1);
        masks good = ~(mask_of(LANED(not_finite)(px)) | mask_of(LANED(not_finite)(py)));
#ifdef WITH_SIGMA
        const reals of = gather(sigma, at);
        good &= mask_of(of > (reals)0) & ~mask_of(LANED(not_finite)(of));
        certainty[i] = kept_where(good, (reals)1 / of);
#else
        certainty[i] = kept_where(good, (reals)1);
#endif
        x[i] = kept_where(good, px);
        y[i] = kept_where(good, py);
        origin_x = (good & ~found) ? px : origin_x;
        origin_y = (good & ~found) ? py : origin_y;
        found |= good;
        const reals far = (FABS(x[i]) + FABS(y[i])) * certainty[i];
        reach = far > reach ? far : reach;
    }
    for (int i = 0; i < count; i++) {
        const masks good = mask_of(certainty[i] > (reals)0);
        x[i] = kept_where(good, x[i] - origin_x);
        y[i] = kept_where(good, y[i] - origin_y);
    }
    const laned_points all = {x, y, certainty, distances, count, 0};
#endif
    // The scale is at least the rounding error of the coordinates: eps times the largest |x| + |y|, in sigmas.
    const reals rounding = (reals)REAL_EPSILON * reach + (reals)1e-30f;
    const reals least_scale = rounding > (reals)min_scale ? rounding : (reals)min_scale;
    const laned_fit fit = line_fit(all, pairs, trials, steps, least_scale, rounding);

    const masks bad = mask_of(fit.points < 2) | fit.coincide;
#ifdef WITH_WEIGHTS
    for (int k = GROUP_ITEM; k < count; k += GROUP_ITEMS) {
        const laned_point at = point_at(all, k);
        const reals v = line_distance(fit.line, at.x, at.y);
        const masks there = ~bad & mask_of(at.certainty > (reals)0);
        const reals weight = kept_where(there, loss_weight(v * at.certainty / fit.scale));
        for (int lane = 0; lane < LANES && first + lane < lines; lane++)
            weights[(first + lane) * count + k] = LANE(weight, lane);
    }
#endif
    if (GROUP_ITEM) return;
    const masks flags = line_status(fit);
    // The direction is ambiguous by half a turn: choose c > 0, or c = 0 and s > 0.
    const masks back =
        mask_of(fit.line.c < (reals)0) | (mask_of(fit.line.c == (reals)0) & mask_of(fit.line.s < (reals)0));
    const reals c = back ? -fit.line.c : fit.line.c, s = back ? -fit.line.s : fit.line.s;
    const reals at_x = fit.line.x + origin_x, at_y = fit.line.y + origin_y;
    const reals nx = nan_where(bad, -s), ny = nan_where(bad, c), d = nan_where(bad, c * at_y - s * at_x);
    const reals cx = nan_where(bad, at_x), cy = nan_where(bad, at_y), of = nan_where(bad, fit.scale);
    const reals angle = nan_where(bad, fit.variance_of_angle), offset = nan_where(bad, fit.variance_of_offset);
    const masks in = bad ? (masks)0 : fit.inliers;
    for (int lane = 0; lane < LANES && first + lane < lines; lane++) {
        const long i = first + lane;
        normal[2 * i] = LANE(nx, lane);
        normal[2 * i + 1] = LANE(ny, lane);
        distance[i] = LANE(d, lane);
        centre[2 * i] = LANE(cx, lane);
        centre[2 * i + 1] = LANE(cy, lane);
        covariance[4 * i] = LANE(angle, lane);
        covariance[4 * i + 1] = covariance[4 * i + 2] = 0;
        covariance[4 * i + 3] = LANE(offset, lane);
        scale[i] = LANE(of, lane);
        inliers[i] = (int)LANE_BITS(in, lane);
        status[i] = (ushort)LANE_BITS(flags, lane);
    }
}
