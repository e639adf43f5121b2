// Which parts of segments are seen from points, by visible.h; a row is a point and a segment's ends.
#include "places.h"
#include "status.h"
#include "visible.h"

// Of the ray to the nearest place of the segment: a clearance takes no more of it.
#define MOST_CLEARANCE ((real)0.25)

// The plane through both; nothing of it where they lie on a line.
inline int view_of(view *v, global const INPUT *row, constant place *middle, real clearance) {
    const place x = row[0], y = row[1], z = row[2];
    const place to_x = row[3] - x, to_y = row[4] - y, to_z = row[5] - z;
    const place sx = (place)row[6] - row[3], sy = (place)row[7] - row[4], sz = (place)row[8] - row[5];
    const place square = sx * sx + sy * sy + sz * sz, per = (place)1 / square;
    const place start = (to_x * sx + to_y * sy + to_z * sz) * per;
    // From the point to the foot of the segment's line: from the end that is nearer, which keeps its digits.
    const place end = start + 1;
    const int by_end = fabs(end) < fabs(start);
    const place share = by_end ? end : start;
    const place fx = (by_end ? row[6] - x : to_x) - share * sx, fy = (by_end ? row[7] - y : to_y) - share * sy;
    const place fz = (by_end ? row[8] - z : to_z) - share * sz;
    const place depth = sqrt(fx * fx + fy * fy + fz * fz), per_depth = (place)1 / depth;
    const place dx = fx * per_depth, dy = fy * per_depth, dz = fz * per_depth, size = sqrt(square);
    const place away = start > 0 ? start : end < 0 ? -end : 0;
    const real nearest = (real)sqrt(depth * depth + away * away * square);
    v->x = (real)(x - middle[0]), v->y = (real)(y - middle[1]), v->z = (real)(z - middle[2]);
    v->start_x = (real)(row[3] - middle[0]), v->start_y = (real)(row[4] - middle[1]);
    v->start_z = (real)(row[5] - middle[2]);
    v->step_x = (real)sx, v->step_y = (real)sy, v->step_z = (real)sz;
    v->deep_x = (real)dx, v->deep_y = (real)dy, v->deep_z = (real)dz;
    v->across_x = (real)((sy * dz - sz * dy) / size), v->across_y = (real)((sz * dx - sx * dz) / size);
    v->across_z = (real)((sx * dy - sy * dx) / size);
    v->along_x = (real)(depth * sx * per - start * dx), v->along_y = (real)(depth * sy * per - start * dy);
    v->along_z = (real)(depth * sz * per - start * dz);
    const real share_of_it = fmin(clearance / nearest, MOST_CLEARANCE), deep = (real)depth;
    v->far = deep - share_of_it * deep;
    v->near = fmax(share_of_it, (real)1e-12) * deep;
    v->lift_deep = 1, v->lift_along = 0, v->lift = v->near;
    view_set_plane(v);
    v->halves[4] = view_half_of(v, -v->deep_x, -v->deep_y, -v->deep_z, -v->far);
    v->halves[5] = view_half_of(v, v->deep_x, v->deep_y, v->deep_z, v->near);
    return deep > 0 && !not_finite(v->along_x + v->along_y + v->along_z) && !not_finite(v->across_x);
}

inline int is_finite_row(global const INPUT *row) {
    int wrong = 0;
    for (int n = 0; n < 9; n++) wrong |= not_finite((real)row[n]);
    return !wrong;
}

// Writes a visible interval; one that goes on from where the last ended is part of it.
inline int keep(global real *restrict to, int count, int most, real *last, real start, real stop) {
    if (!(start < stop)) return count;
    count += *last != start;
    if (count <= most) {
        if (*last != start) to[2 * count - 2] = start;
        to[2 * count - 1] = stop;
    }
    *last = stop;
    return count;
}

AS_IT_IS kernel void visible_intervals(global const INPUT *restrict rows, global real *restrict intervals,
                              global int *restrict counts, global uchar *restrict status, global const real *nodes,
                              global const int *children, global const int *axes, global const real *leaves,
                              global const int *triangles, constant place *middle, const real clearance, const int most,
                              const ulong total, const ulong each) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    const ulong begin = get_global_id(0) * each, stop = min(begin + each, total);
    int hint = NO_HINT;
    for (ulong i = begin; i < stop; i++) {
        global real *to = intervals + i * 2 * most;
        for (int n = 0; n < 2 * most; n++) to[n] = REAL_NAN;
        view v;
        const int is_finite = is_finite_row(rows + 9 * i);
        const int has_plane = is_finite && view_of(&v, rows + 9 * i, middle, clearance);
        int count = 0, is_whole = 1;
        real last = -1, from = 0, until = has_plane ? 1 : 0;
        while (from < 1 && has_plane) {
            hidden dark = hidden_none(from, until);
            view_trace(&tree, &v, &dark, &hint);
            if (dark.is_full && until - from > LEAST_WINDOW) {
                until = (real)0.5 * (from + until);
                continue;
            }
            is_whole &= !dark.is_full;
            hidden_sort(&dark);
            real start = dark.from;
            for (int n = 0; n < dark.count; n++) {
                count = keep(to, count, most, &last, start, dark.low[n]);
                start = dark.high[n];
            }
            if (dark.from < dark.to) count = keep(to, count, most, &last, start, dark.to);
            from = until, until = 1;
        }
        counts[i] = count;
        status[i] = !is_finite ? STATUS_NOT_FINITE
                    : !has_plane ? STATUS_HORIZON
                    : count > most || !is_whole ? STATUS_AMBIGUOUS
                                                : STATUS_OK;
    }
}
