// From rough poses to good ones: Levenberg and Marquardt's steps on the sum of r^2 / (c^2 + r^2), r from a point to the
// line nearest to it, exactly: the map only says which few to look at. One start a work-item.
#include "field/field.h"
#include "common/status.h"

typedef struct {
    float cost, xx, xy, yy, xt, yt, tt, x, y, t;
} normal_equations;

typedef struct {
    float first_x, first_y, per_cell;
    int rows, columns;
} field_grid;

// A point seen from a pose: its residual and that one's slopes.
typedef struct {
    float r, x, y, t;
} field_row;

static inline field_row row_of(float2 point, float3 pose, float2 turn, constant float *shapes, global const uchar *nearest,
                        field_grid grid) {
    const float dx = turn.x * point.x - turn.y * point.y, dy = turn.y * point.x + turn.x * point.y;
    const float x = pose.x + dx, y = pose.y + dy;
    const int column = convert_int_sat_rte((x - grid.first_x) * grid.per_cell);
    const int row = convert_int_sat_rte((y - grid.first_y) * grid.per_cell);
    const size_t cell = (size_t)clamp(row, 0, grid.rows - 1) * grid.columns + clamp(column, 0, grid.columns - 1);
    global const uchar *may = nearest + NEAREST * cell;
    field_offset offset = field_away(shapes + SHAPE * may[0], x, y);
    for (int k = 1; k < NEAREST && may[k] != may[0]; k++) {
        const field_offset other = field_away(shapes + SHAPE * may[k], x, y);
        offset = fabs(other.away) < fabs(offset.away) ? other : offset;
    }
    const field_row result = {offset.away, offset.x, offset.y, offset.y * dx - offset.x * dy};
    return result;
}

// Whether it is finite and within the reach, by squares.
static inline int point_counts(float2 point, float farthest) { return point.x * point.x + point.y * point.y <= farthest; }

static inline normal_equations equations_at(global const float *points, int count, float3 pose, constant float *shapes,
                                     global const uchar *nearest, field_grid grid, float square, float farthest) {
    const float2 turn = (float2)(cos(pose.z), sin(pose.z));
    normal_equations sum = {0};
    for (int i = 0; i < count; i++) {
        const float2 point = (float2)(points[2 * i], points[2 * i + 1]);
        if (!point_counts(point, farthest)) continue;
        const field_row at = row_of(point, pose, turn, shapes, nearest, grid);
        const float share = square / (square + at.r * at.r), weight = share * share, pull = weight * at.r;
        sum.cost += 1.0f - share;
        sum.xx += weight * at.x * at.x;
        sum.xy += weight * at.x * at.y;
        sum.yy += weight * at.y * at.y;
        sum.xt += weight * at.x * at.t;
        sum.yt += weight * at.y * at.t;
        sum.tt += weight * at.t * at.t;
        sum.x += pull * at.x;
        sum.y += pull * at.y;
        sum.t += pull * at.t;
    }
    return sum;
}

// Cofactors of a symmetric matrix (xx, xy, yy, xt, yt, tt), as its own fields.
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

// Solves (M + damping) step = -g; angles in units of 1 / lever, so that damping means the same for all three.
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

static inline void store_symmetric(global float *to, normal_equations of, float scale) {
    to[0] = of.xx * scale;
    to[1] = to[3] = of.xy * scale;
    to[2] = to[6] = of.xt * scale;
    to[4] = of.yy * scale;
    to[5] = to[7] = of.yt * scale;
    to[8] = of.tt * scale;
}

kernel void field_refine(global const float *restrict points, global const float *restrict starts,
                         global float *restrict poses, global float *restrict covariance,
                         global float *restrict information, global float *restrict score,
                         global float *restrict scale, global float *restrict share, global uchar *restrict status,
                         constant float *shapes, global const uchar *restrict nearest, const int count,
                         const int rows, const int columns, const float first_x, const float first_y,
                         const float cell, const float square, const float farthest, const int steps) {
    const size_t i = get_global_id(0);
    const field_grid grid = {first_x, first_y, 1.0f / cell, rows, columns};
    float3 pose = (float3)(starts[3 * i], starts[3 * i + 1], starts[3 * i + 2]);
    float levers = 0, used = 0;
    for (int k = 0; k < count; k++) {
        const float2 point = (float2)(points[2 * k], points[2 * k + 1]);
        if (!point_counts(point, farthest)) continue;
        levers += point.x * point.x + point.y * point.y;
        used += 1;
    }
    const int finite = fabs(pose.x) + fabs(pose.y) + fabs(pose.z) < 1e6f;
    const float lever = 1.0f / sqrt(levers / fmax(used, 1.0f) + 1e-12f);
    normal_equations here = {0};
    if (finite) here = equations_at(points, count, pose, shapes, nearest, grid, square, farthest);
    float damping = 1e-4f;
    for (int step = 0; finite && step < steps && damping < 1e6f; step++) {
        const float3 by = damped_step(here, damping, lever);
        const float3 next = pose + by;
        const normal_equations there = equations_at(points, count, next, shapes, nearest, grid, square, farthest);
        // As good as the sum's rounding can tell: near the least cost the step says more than the cost.
        const int better = there.cost <= here.cost * 1.000004f;
        damping = better ? fmax(0.1f * damping, 1e-7f) : 10.0f * damping;
        pose = better ? next : pose;
        here = better ? there : here;
        if (fabs(by.x) + fabs(by.y) + fabs(by.z) / lever < 3e-6f) break;
    }
    // The curvature of the cost, and what the points' own scatter makes of it.
    const float2 turn = (float2)(cos(pose.z), sin(pose.z));
    normal_equations bent = {0};
    float bends = 0, pulls = 0, close = 0;
    for (int k = 0; finite && k < count; k++) {
        const float2 point = (float2)(points[2 * k], points[2 * k + 1]);
        if (!point_counts(point, farthest)) continue;
        const field_row at = row_of(point, pose, turn, shapes, nearest, grid);
        const float part = square / (square + at.r * at.r), weight = part * part;
        const float bend = fmax(weight * (4.0f * part - 3.0f), 0.0f);
        bends += bend;
        pulls += weight * weight * at.r * at.r;
        close += at.r * at.r < square;
        bent.xx += bend * at.x * at.x;
        bent.xy += bend * at.x * at.y;
        bent.yy += bend * at.y * at.y;
        bent.xt += bend * at.x * at.t * lever;
        bent.yt += bend * at.y * at.t * lever;
        bent.tt += bend * at.t * at.t * lever * lever;
    }
    normal_equations inverse = cofactors(bent);
    const float determinant = bent.xx * inverse.xx + bent.xy * inverse.xy + bent.xt * inverse.xt;
    const float minors = inverse.xx + inverse.yy + inverse.tt, all = bent.xx + bent.yy + bent.tt;
    const int few = used < 4 || bends < 4;
    const float last_x = first_x + cell * (float)(columns - 1), last_y = first_y + cell * (float)(rows - 1);
    const int outside = !(pose.x >= first_x && pose.x <= last_x && pose.y >= first_y && pose.y <= last_y);
    const int weak = !(determinant > (float)WEAKEST * all * minors);
    const int bad = !finite || few || outside;
    status[i] = !finite ? STATUS_NOT_FINITE
                        : (few ? STATUS_LOW_SIGNAL : (outside ? STATUS_OUT_OF_RANGE : (weak ? STATUS_AMBIGUOUS : STATUS_OK)));
    const float variance = pulls / fmax(bends - 3.0f, 1.0f) + 1e-12f;
    poses[3 * i] = bad ? NAN : pose.x;
    poses[3 * i + 1] = bad ? NAN : pose.y;
    poses[3 * i + 2] = bad ? NAN : pose.z - 6.2831853071795865f * rint(pose.z / 6.2831853071795865f);
    score[i] = bad ? NAN : here.cost / used;
    scale[i] = bad ? NAN : sqrt(variance);
    share[i] = bad ? NAN : close / used;
    bent.xt /= lever;
    bent.yt /= lever;
    bent.tt /= lever * lever;
    inverse.xt *= lever;
    inverse.yt *= lever;
    inverse.tt *= lever * lever;
    store_symmetric(information + 9 * i, bent, bad ? NAN : 1.0f / variance);
    store_symmetric(covariance + 9 * i, inverse, bad || weak ? NAN : variance / determinant);
}
