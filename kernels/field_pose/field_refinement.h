// Residuals, normal equations and Levenberg-Marquardt steps of the refinement of a pose on a field. The cost is
// sum r^2 / (c^2 + r^2) (Geman-McClure loss) over the points, r the exact distance of a point to the nearest line.
#ifndef FIELD_REFINEMENT_H
#define FIELD_REFINEMENT_H

#include "distance_map/field.h"
#include "common/status.h"

// Cost; normal matrix J^T W J by (x, y, t); gradient J^T W r. t is the heading.
typedef struct {
    float cost, xx, xy, yy, xt, yt, tt, x, y, t;
} normal_equations;

// Grid of the distance map; per_cell: cells per metre.
typedef struct {
    float first_x, first_y, per_cell;
    int rows, columns;
} field_grid;

// Residual r of a point at a pose [m], and its derivatives by x, y and t.
typedef struct {
    float r, x, y, t;
} field_row;

// Compute residual and derivatives of a point. `turn` holds cosine and sine of the heading. The derivative by the
// heading is the gradient times the derivative of the rotated point, (-dy, dx).
static inline field_row row_of(float2 point, float3 pose, float2 turn, constant float *shapes,
                               global const uchar *nearest, field_grid grid) {
    const float dx = turn.x * point.x - turn.y * point.y, dy = turn.y * point.x + turn.x * point.y;
    const float x = pose.x + dx, y = pose.y + dy;
    const int column = convert_int_sat_rte((x - grid.first_x) * grid.per_cell);
    const int row = convert_int_sat_rte((y - grid.first_y) * grid.per_cell);
    const size_t cell = (size_t)clamp(row, 0, grid.rows - 1) * grid.columns + clamp(column, 0, grid.columns - 1);
    global const uchar *candidates = nearest + NEAREST * cell;
    field_offset offset = field_distance(shapes + SHAPE * candidates[0], x, y);
    for (int k = 1; k < NEAREST && candidates[k] != candidates[0]; k++) {
        const field_offset other = field_distance(shapes + SHAPE * candidates[k], x, y);
        offset = fabs(other.distance) < fabs(offset.distance) ? other : offset;
    }
    const field_row result = {offset.distance, offset.x, offset.y, offset.y * dx - offset.x * dy};
    return result;
}

// Return whether a point is finite and within the largest range (given as its square). NaN compares false.
static inline int point_counts(float2 point, float max_range_squared) {
    return point.x * point.x + point.y * point.y <= max_range_squared;
}

// Sum cost and normal equations at a pose.
//
// With share = c^2 / (c^2 + r^2) the cost of a point is r^2 share / c^2, and its derivative by r is 2 r share^2 / c^2:
// the weight of iteratively reweighted least squares is share^2. The factor 2 / c^2 is omitted: it does not change the
// step. The cost is also 1 - share, which cancels for r << c: for a noise of c / 250 its rounding was 3e-3 of the cost,
// and steps to a lower cost were rejected.
static inline normal_equations equations_at(global const float *points, int count, float3 pose, constant float *shapes,
                                            global const uchar *nearest, field_grid grid, float scale_squared,
                                            float max_range_squared) {
    const float2 turn = (float2)(cos(pose.z), sin(pose.z));
    const float per_square = 1.0f / scale_squared;
    normal_equations sum = {0};
    for (int i = 0; i < count; i++) {
        const float2 point = (float2)(points[2 * i], points[2 * i + 1]);
        if (!point_counts(point, max_range_squared)) continue;
        const field_row at = row_of(point, pose, turn, shapes, nearest, grid);
        const float share = scale_squared / (scale_squared + at.r * at.r), weight = share * share, psi = weight * at.r;
        sum.cost += at.r * at.r * share * per_square;
        sum.xx += weight * at.x * at.x;
        sum.xy += weight * at.x * at.y;
        sum.yy += weight * at.y * at.y;
        sum.xt += weight * at.x * at.t;
        sum.yt += weight * at.y * at.t;
        sum.tt += weight * at.t * at.t;
        sum.x += psi * at.x;
        sum.y += psi * at.y;
        sum.t += psi * at.t;
    }
    return sum;
}

// Return the cofactors of the symmetric matrix (xx, xy, yy, xt, yt, tt), in the same fields.
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

// Solve (M + damping trace(M) I) step = -g by cofactors.
//
// The heading is scaled to a length, t / lever, with lever = 1 / (root-mean-square distance of the points): the damping
// then affects all three unknowns equally.
//
// The damping is added to a copy: Mesa 22.3 passes structs by reference, so that a change of a parameter changes the
// variable of the caller.
static inline float3 damped_step(const normal_equations undamped, float damping, float lever) {
    normal_equations of = undamped;
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

// Rounding error of a pose [m], [rad] in a field of 20 m.
#define POSE_ROUNDING 3e-5f

// Return whether a pose has not converged: the Newton step from it exceeds the rounding, and a tenth of a standard
// deviation (CONVERGED_SQUARE). `hessian`: second derivatives of the cost over 2 / c^2, and `known`: variance times the
// inverse covariance, both by (x, y, t / lever). `at`: gradient at the pose. The damping bounds the step along a
// direction that the points do not determine.
static inline int has_not_converged(normal_equations hessian, normal_equations known, normal_equations at, float lever,
                                    float variance) {
    normal_equations of = hessian;
    of.x = at.x;
    of.y = at.y;
    of.t = at.t * lever;
    const float3 left = damped_step(of, 1e-4f, 1.0f);
    const float square = known.xx * left.x * left.x + known.yy * left.y * left.y + known.tt * left.z * left.z +
                         2 * (known.xy * left.x * left.y + known.xt * left.x * left.z + known.yt * left.y * left.z);
    const int is_beyond_rounding = fabs(left.x) + fabs(left.y) > POSE_ROUNDING || fabs(left.z) * lever > POSE_ROUNDING;
    return is_beyond_rounding && square > CONVERGED_SQUARE * variance;
}

// Store a symmetric matrix times `scale` as (3, 3).
static inline void store_symmetric(global float *to, normal_equations of, float scale) {
    to[0] = of.xx * scale;
    to[1] = to[3] = of.xy * scale;
    to[2] = to[6] = of.xt * scale;
    to[4] = of.yy * scale;
    to[5] = to[7] = of.yt * scale;
    to[8] = of.tt * scale;
}

// Return a b a for symmetric matrices, times `scale`.
static inline normal_equations sandwich(normal_equations a, normal_equations b, float scale) {
    const float3 a0 = (float3)(a.xx, a.xy, a.xt), a1 = (float3)(a.xy, a.yy, a.yt), a2 = (float3)(a.xt, a.yt, a.tt);
    const float3 b0 = (float3)(b.xx, b.xy, b.xt), b1 = (float3)(b.xy, b.yy, b.yt), b2 = (float3)(b.xt, b.yt, b.tt);
    const float3 c0 = (float3)(dot(b0, a0), dot(b1, a0), dot(b2, a0));
    const float3 c1 = (float3)(dot(b0, a1), dot(b1, a1), dot(b2, a1));
    const float3 c2 = (float3)(dot(b0, a2), dot(b1, a2), dot(b2, a2));
    normal_equations result = {0};
    result.xx = scale * dot(a0, c0);
    result.xy = scale * dot(a0, c1);
    result.yy = scale * dot(a1, c1);
    result.xt = scale * dot(a0, c2);
    result.yt = scale * dot(a1, c2);
    result.tt = scale * dot(a2, c2);
    return result;
}

#endif
