// Lines through sets of points, one line for each set. CPU runtimes take sixteen lines a work-item, GPUs one.
#include "line_fit/line_fit.h"
#include "common/status.h"

#ifdef VECTOR_VARIANT
typedef long16 places;
#else
typedef long places;
#endif
// Of each lane, the value at its place.
#ifdef VECTOR_VARIANT
#define AT(from, place)                                                                                                \
    (reals)((from)[place.s0], (from)[place.s1], (from)[place.s2], (from)[place.s3], (from)[place.s4], (from)[place.s5],  \
            (from)[place.s6], (from)[place.s7], (from)[place.s8], (from)[place.s9], (from)[place.sa], (from)[place.sb],  \
            (from)[place.sc], (from)[place.sd], (from)[place.se], (from)[place.sf])
#define LANE_NUMBERS (places)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#else
#define AT(from, place) ((real)(from)[place])
#define LANE_NUMBERS 0L
#endif

kernel void line_fit_sets(global const INPUT *restrict points,
#ifdef WITH_SIGMA
                          global const INPUT *restrict sigma,
#endif
                          global real *restrict normal, global real *restrict distance, global real *restrict centre,
                          global real *restrict covariance, global real *restrict scale, global int *restrict inliers,
                          global real *restrict weights, global uchar *restrict status, const long lines,
                          const int count, constant int *pairs, const int trials, const int steps,
                          const real smallest) {
    reals x[CAPACITY], y[CAPACITY], certainty[CAPACITY], distances[CAPACITY];
    const long first = (long)get_global_id(0) * LANES;
    if (first >= lines) return;
    const places line = min((places)first + LANE_NUMBERS, (places)(lines - 1));
    const places set = line * (places)count;
    // Near the first points: coordinates of a large image have few digits left for distances.
    reals origin_x = 0, origin_y = 0, reach = 0;
    masks found = 0;
    for (int i = 0; i < count; i++) {
        const places at = set + (places)i;
        const reals px = AT(points, 2 * at), py = AT(points, (2 * at + 1));
        masks good = ~(mask_of(LANED(not_finite)(px)) | mask_of(LANED(not_finite)(py)));
#ifdef WITH_SIGMA
        const reals of = AT(sigma, at);
        good &= mask_of(of > (reals)0) & ~mask_of(LANED(not_finite)(of));
        certainty[i] = kept_where(good, (reals)1 / of);
#else
        certainty[i] = kept_where(good, (reals)1);
#endif
        x[i] = kept_where(good, px);
        y[i] = kept_where(good, py);
        origin_x = good & ~found ? px : origin_x;
        origin_y = good & ~found ? py : origin_y;
        found |= good;
        const reals far = (FABS(x[i]) + FABS(y[i])) * certainty[i];
        reach = far > reach ? far : reach;
    }
    for (int i = 0; i < count; i++) {
        const masks good = mask_of(certainty[i] > (reals)0);
        x[i] = kept_where(good, x[i] - origin_x);
        y[i] = kept_where(good, y[i] - origin_y);
    }
    // No scale below what the points' own rounding makes.
    const reals rounding = (reals)REAL_EPSILON * reach + (reals)1e-30f;
    const reals floor_of_scale = rounding > (reals)smallest ? rounding : (reals)smallest;
    const laned_points all = {x, y, certainty, distances, count};
    laned_fit fit = line_fit(all, pairs, trials, steps, floor_of_scale);

    const masks few = mask_of(fit.points < 2);
    const masks bad = few | fit.coincide;
    masks flags = few ? (masks)STATUS_NO_DATA : (fit.coincide ? (masks)STATUS_AMBIGUOUS : (masks)0);
    flags |= ~bad & mask_of(2 * fit.inliers < fit.points) & (masks)STATUS_AMBIGUOUS;
    // One way along a line is as good as the other: to the right, or straight up.
    const masks back = mask_of(fit.line.c < (reals)0) | (mask_of(fit.line.c == (reals)0) & mask_of(fit.line.s < (reals)0));
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
        status[i] = (uchar)LANE_BITS(flags, lane);
    }
#ifdef WITH_WEIGHTS
    for (int k = 0; k < count; k++) {
        const reals v = line_distance(fit.line, x[k], y[k]);
        const masks there = ~bad & mask_of(certainty[k] > (reals)0);
        const reals weight = kept_where(there, loss_weight(v * certainty[k] / fit.scale));
        for (int lane = 0; lane < LANES && first + lane < lines; lane++)
            weights[(first + lane) * count + k] = LANE(weight, lane);
    }
#endif
}
