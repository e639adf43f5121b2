// Residuals, normal equations and Levenberg-Marquardt steps of the refinement of a pose on a field. The cost is
// sum r^2 / (c^2 + r^2) (Geman-McClure loss) over the points, r the exact distance of a point to the nearest line.
#ifndef FIELD_REFINEMENT_H
#define FIELD_REFINEMENT_H

#include "common/group.h"
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

// Points of a view, and the field to which they are compared; `sums`: room of a group (common/group.h), else null.
typedef struct {
    global const float *points;
    int count;
    float max_range_squared, scale_squared;
    constant float *shapes;
    global const uchar *nearest;
    field_grid grid;
    GROUP_SPACE float *sums;
} field_view;

// Replace the partial sums of the items of a group by the totals. A work-item that solves a problem alone has the
// totals.
#ifdef IN_GROUP
#define NUMBERS(of) (int)(sizeof(*(of)) / sizeof(float))
#define put_numbers(of, part, view) group_put((private const float *)(of), NUMBERS(of), part, (view).sums)
#define total_numbers(of, view) group_numbers((private float *)(of), NUMBERS(of), (view).sums)
INLINE void group_numbers(private float *numbers, int count, local float *sums) {
    local const float *totals = group_total(0, count, sums);
    for (int k = 0; k < count; k++) numbers[k] = totals[k];
}
#else
#define put_numbers(of, part, view)
#define total_numbers(of, view)
#endif

// Number of points within the largest range, and the sum of their squared distances [m2].
typedef struct {
    float used, squares;
} field_range;

INLINE field_range range_of(field_view view) {
    field_range range;
    EACH_PART(part) {
        range = (field_range){0, 0};
        for (int k = part; k < view.count; k += PARTS) {
            const float2 point = (float2)(view.points[2 * k], view.points[2 * k + 1]);
            if (!point_counts(point, view.max_range_squared)) continue;
            range.squares += point.x * point.x + point.y * point.y;
            range.used += 1;
        }
        put_numbers(&range, part, view);
    }
    total_numbers(&range, view);
    return range;
}

// Sum cost and normal equations at a pose.
//
// With share = c^2 / (c^2 + r^2) the cost of a point is 1 - share, and its derivative by r is 2 r share^2 / c^2: the
// weight of iteratively reweighted least squares is share^2. The factor 2 / c^2 is omitted: it does not change the
// step.
INLINE normal_equations equations_at(field_view view, float3 pose) {
    const float2 turn = (float2)(cos(pose.z), sin(pose.z));
    const float scale_squared = view.scale_squared;
    normal_equations total;
    EACH_PART(part) {
        normal_equations sum = {0};
        for (int i = part; i < view.count; i += PARTS) {
            const float2 point = (float2)(view.points[2 * i], view.points[2 * i + 1]);
            if (!point_counts(point, view.max_range_squared)) continue;
            const field_row at = row_of(point, pose, turn, view.shapes, view.nearest, view.grid);
            const float share = scale_squared / (scale_squared + at.r * at.r), weight = share * share;
            const float psi = weight * at.r;
            sum.cost += 1.0f - share;
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
        put_numbers(&sum, part, view);
        total = sum;
    }
    total_numbers(&total, view);
    return total;
}

// Sums of the covariance: H and S below in the fields of matrices, and sums of psi'(r), psi(r)^2 and inliers.
typedef struct {
    normal_equations hessian, scatter;
    float curvature, psi_squared, inliers;
} field_scatter;

// Covariance of an M-estimator for residuals of unequal variance (Huber, 1981, section 6.3): H^-1 S H^-1 with
// H = sum psi'(r) h h^T, S = sum psi(r)^2 h h^T, psi(r) = r share^2 and psi'(r) = share^2 (4 share - 3), clipped at
// 0. Points near ends and crossings of lines, and far points on oblique lines, err more than others, and have more
// weight in the heading. For equal variances S is variance H, with variance = sum psi^2 / (sum psi' - 3); as many
// points as PRIOR_POINTS are taken to have it, so that few points do not give too small a covariance by chance.
// The heading is scaled by lever.
INLINE field_scatter scatter_at(field_view view, float3 pose, float lever) {
    const float2 turn = (float2)(cos(pose.z), sin(pose.z));
    const float scale_squared = view.scale_squared;
    field_scatter total;
    EACH_PART(part) {
        field_scatter sum = {{0}, {0}, 0, 0, 0};
        for (int k = part; k < view.count; k += PARTS) {
            const float2 point = (float2)(view.points[2 * k], view.points[2 * k + 1]);
            if (!point_counts(point, view.max_range_squared)) continue;
            const field_row at = row_of(point, pose, turn, view.shapes, view.nearest, view.grid);
            const float part = scale_squared / (scale_squared + at.r * at.r), weight = part * part;
            const float curvature = fmax(weight * (4.0f * part - 3.0f), 0.0f);
            sum.curvature += curvature;
            sum.psi_squared += weight * weight * at.r * at.r;
            sum.inliers += at.r * at.r < scale_squared;
            sum.hessian.xx += curvature * at.x * at.x;
            sum.hessian.xy += curvature * at.x * at.y;
            sum.hessian.yy += curvature * at.y * at.y;
            sum.hessian.xt += curvature * at.x * at.t * lever;
            sum.hessian.yt += curvature * at.y * at.t * lever;
            sum.hessian.tt += curvature * at.t * at.t * lever * lever;
            const float square = weight * weight * at.r * at.r;
            sum.scatter.xx += square * at.x * at.x;
            sum.scatter.xy += square * at.x * at.y;
            sum.scatter.yy += square * at.y * at.y;
            sum.scatter.xt += square * at.x * at.t * lever;
            sum.scatter.yt += square * at.y * at.t * lever;
            sum.scatter.tt += square * at.t * at.t * lever * lever;
        }
        put_numbers(&sum, part, view);
        total = sum;
    }
    total_numbers(&total, view);
    return total;
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
