// Reflections in curved mirrors: positions on the mirror at which given points appear from the lens, and the mirrors
// that may show given lines.
//
// mirror_points: Inputs:  points (count, 6): position and step [m], type INPUT; lens_place (3,).
//                Outputs: per point up to `kept` reflections: places, moves (derivative by the step) (count, kept, 3),
//                         densities (solid angle of the lens' rays per area at the point [1/m2]), triangles; counts, status.
// mirror_facets: Inputs:  lines (count, 6), both ends [m]; lens_place (3,). Outputs: near (count, blocks) 0 or 1.
// Tables:  table (n,), MirrorTriangle; block_table (blocks,), MirrorBlock: groups of triangles; starts (blocks + 1,): first
//          triangle of each block; numbers (n,): index of each triangle in the scene.
// Options: INPUT, REAL_IS_DOUBLE. Variants: vector: 16 points or lines per work-item; work-item: one.
//
// Law of reflection. A triangle with normals n_i at its corners p_i has the normal N = sum b_i n_i and the surface
// S = sum b_i (p_i - f_i n_i / 2), with f_i = (p - p_i) n_i for p on the flat triangle: exact for surfaces of second degree.
// With c and q, the vectors from S to the lens and to the point, reflection requires along both edges e
//     R = NN ((c e) (q N) + (q e) (c N)) - 2 (e N) (c N) (q N) = 0,
// a polynomial, linear for a flat mirror; it is solved by Newton's method. R = w q with a w that does not depend on q, which
// also gives the derivative of the position, and the solid angle of the lens' rays per area at the point,
//     |S_x x S_y . c| |w_1 x w_2 . q| / (|c|^3 |q| |det dR|);  for a plane 1 / (|c| + |q|)^2.
#include "common/lanes.h"
#include "common/status.h"

#define STEPS 16          // Newton steps
#define ASTRAY ((real)5) // barycentric distance from which Newton's method does not return
#define TANGENTS 4        // tangent refinements of the cone test
// Largest barycentric distance of the start value outside the triangle.
#define MARGIN ((real)0.5)
#ifdef REAL_IS_DOUBLE
#define NEAR_ENOUGH ((real)1e-7)
#define SLACK ((real)1e-12)
#define GRAZING ((real)1e-9)
#define EDGE ((real)1e-10)
#else
#define NEAR_ENOUGH ((real)1e-3)
#define SLACK ((real)1e-5)
#define GRAZING ((real)1e-4)
#define EDGE ((real)1e-5)
#endif

typedef struct {
    reals x, y, z;
} Vector;

typedef struct {
    real x, y, z;
} Fixed;

// Triangle of a mirror: MirrorTriangle in mirror_points.py. f_i as above; x and y: barycentric weights of corners 1 and 2.
typedef struct {
    Fixed corner, edges[2];         // first corner; edges from it to corners 1 and 2
    Fixed normals[3];               // at the three corners
    real f_by_x[3], f_by_y[3];      // derivatives of f_0, f_1, f_2: products of the edges with the normals
    real f1_at_first, f2_at_first;  // f_1 and f_2 at the first corner; f_0 is 0 there
    real one_sided;                 // 1: only the side of the normals reflects
} MirrorTriangle;

// Block of triangles: MirrorBlock in mirror_points.py.
typedef struct {
    Fixed middle;                       // of the bounding ball
    real radius;
    Fixed axis;                         // of the cone of the normals
    real cosine_of_twice, sine_of_twice;  // of twice the cone's half angle
    real one_sided;                     // 1: only the side of the normals reflects
    real sine;                          // of the half angle
} MirrorBlock;

typedef struct {
    Vector place, along_x, along_y;   // point of the surface and its derivatives by x and y (barycentric)
    Vector to_lens, to_point, w1, w2;
    reals up_lens, up_point;          // components of to_lens and to_point along the normal
    reals r1, r2, r1x, r1y, r2x, r2y; // R along both edges and its derivatives
} Reflection;

INLINE reals dot_of(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE reals dot_fixed(Vector a, Fixed b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE Vector sum_of(Vector a, Vector b) { return (Vector){a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE Vector scaled(Vector a, reals by) { return (Vector){a.x * by, a.y * by, a.z * by}; }
INLINE Vector mixed(reals a, Fixed u, reals b, Fixed v, reals c, Fixed w) {
    return (Vector){a * u.x + b * v.x + c * w.x, a * u.y + b * v.y + c * w.y, a * u.z + b * v.z + c * w.z};
}
INLINE Vector cross_of(Vector a, Vector b) {
    return (Vector){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
INLINE Vector moved(Vector a, Fixed by, real sign) { return (Vector){a.x + sign * by.x, a.y + sign * by.y, a.z + sign * by.z}; }
INLINE Vector minus(Vector a, Vector b) { return (Vector){a.x - b.x, a.y - b.y, a.z - b.z}; }
INLINE masks positive(reals value) { return mask_of(value > (reals)(real)0); }

// Vector w of an edge: NN ((c e) N + (c N) e) - 2 (e N) (c N) N.
INLINE Vector weight_of(Vector c, reals up, Vector n, reals square, Fixed edge) {
    const reals along = square * dot_fixed(c, edge) - (real)2 * dot_fixed(n, edge) * up, beside = square * up;
    return (Vector){along * n.x + beside * edge.x, along * n.y + beside * edge.y, along * n.z + beside * edge.z};
}

// Derivative of R of an edge when position and normal change by `s` and `m`.
INLINE reals slope_of(const Reflection *it, Vector n, reals square, Vector s, Vector m, Fixed edge) {
    const reals ce = dot_fixed(it->to_lens, edge), qe = dot_fixed(it->to_point, edge), ne = dot_fixed(n, edge);
    const reals se = dot_fixed(s, edge), sn = dot_of(s, n), c = it->up_lens, q = it->up_point;
    const reals cx = dot_of(it->to_lens, m) - sn, qx = dot_of(it->to_point, m) - sn;
    return (real)2 * dot_of(n, m) * (ce * q + qe * c) + square * (ce * qx + qe * cx - se * (c + q)) -
           (real)2 * (dot_fixed(m, edge) * c * q + ne * (cx * q + c * qx));
}

INLINE Reflection reflection_at(reals x, reals y, Vector point, Vector lens, global const MirrorTriangle *row) {
    const Fixed corner = row->corner, e1 = row->edges[0], e2 = row->edges[1];
    const Fixed n0 = row->normals[0], n1 = row->normals[1], n2 = row->normals[2];
    global const real *f_x = row->f_by_x, *f_y = row->f_by_y;
    const reals b0 = (real)1 - x - y;
    const reals f0 = f_x[0] * x + f_y[0] * y, f1 = row->f1_at_first + f_x[1] * x + f_y[1] * y;
    const reals f2 = row->f2_at_first + f_x[2] * x + f_y[2] * y;
    const reals half_of_it = (real)-0.5;
    Reflection it;
    const Vector bend = mixed(b0 * f0, n0, x * f1, n1, y * f2, n2);
    const Vector bend_x = mixed(b0 * f_x[0] - f0, n0, x * f_x[1] + f1, n1, y * f_x[2], n2);
    const Vector bend_y = mixed(b0 * f_y[0] - f0, n0, x * f_y[1], n1, y * f_y[2] + f2, n2);
    it.place = sum_of(mixed((reals)(real)1, corner, x, e1, y, e2), scaled(bend, half_of_it));
    it.along_x = moved(scaled(bend_x, half_of_it), e1, 1);
    it.along_y = moved(scaled(bend_y, half_of_it), e2, 1);
    it.to_lens = minus(lens, it.place);
    it.to_point = minus(point, it.place);
    const Vector n = mixed(b0, n0, x, n1, y, n2);
    const Vector nx = {(reals)(n1.x - n0.x), (reals)(n1.y - n0.y), (reals)(n1.z - n0.z)};
    const Vector ny = {(reals)(n2.x - n0.x), (reals)(n2.y - n0.y), (reals)(n2.z - n0.z)};
    const reals square = dot_of(n, n);
    it.up_lens = dot_of(it.to_lens, n);
    it.up_point = dot_of(it.to_point, n);
    it.w1 = weight_of(it.to_lens, it.up_lens, n, square, e1);
    it.w2 = weight_of(it.to_lens, it.up_lens, n, square, e2);
    it.r1 = dot_of(it.w1, it.to_point);
    it.r2 = dot_of(it.w2, it.to_point);
    it.r1x = slope_of(&it, n, square, it.along_x, nx, e1);
    it.r1y = slope_of(&it, n, square, it.along_y, ny, e1);
    it.r2x = slope_of(&it, n, square, it.along_x, nx, e2);
    it.r2y = slope_of(&it, n, square, it.along_y, ny, e2);
    return it;
}

// R at a corner. The side of the surface on which the lens lies is added to `lens_sides` (1: above, 2: below), the
// sides of the points to `above` and `below`.
INLINE void at_corner(Vector point, Fixed lens, global const MirrorTriangle *row, int corner, reals *r1, reals *r2,
                      int *lens_sides, masks *above, masks *below) {
    const Fixed n = row->normals[corner], e1 = row->edges[0], e2 = row->edges[1];
    Fixed place = row->corner;
    if (corner) {
        const Fixed edge = row->edges[corner - 1];
        place = (Fixed){place.x + edge.x, place.y + edge.y, place.z + edge.z};
    }
    const real cx = lens.x - place.x, cy = lens.y - place.y, cz = lens.z - place.z;
    const real c = cx * n.x + cy * n.y + cz * n.z, twice = (real)2 * c;
    const Vector q = moved(point, place, -1);
    const reals up = dot_fixed(q, n);
    *r1 = (cx * e1.x + cy * e1.y + cz * e1.z - twice * row->f_by_x[corner]) * up + c * dot_fixed(q, e1);
    *r2 = (cx * e2.x + cy * e2.y + cz * e2.z - twice * row->f_by_y[corner]) * up + c * dot_fixed(q, e2);
    *lens_sides |= c > 0 ? 1 : 2;
    *above |= positive(up);
    *below |= positive(-up);
}

// Start value: solution of R interpolated linearly between the corners. Returns the lanes in which it lies near the triangle.
INLINE masks guessed(Vector point, Fixed lens, global const MirrorTriangle *row, reals *x, reals *y) {
    reals u0, v0, u1, v1, u2, v2;
    int lens_sides = 0;
    masks above = 0, below = 0;
    at_corner(point, lens, row, 0, &u0, &v0, &lens_sides, &above, &below);
    at_corner(point, lens, row, 1, &u1, &v1, &lens_sides, &above, &below);
    at_corner(point, lens, row, 2, &u2, &v2, &lens_sides, &above, &below);
    // At a silhouette lens and point may be on one side of the surface only between the corners.
    const masks facing = ((lens_sides & 1) ? above : (masks)0) | (((lens_sides & 2) && row->one_sided == 0) ? below : (masks)0);
    const reals a = u1 * v2 - u2 * v1, b = u2 * v0 - u0 * v2, c = u0 * v1 - u1 * v0, whole = a + b + c;
    const reals per = (real)1 / whole, least = -MARGIN;
    *x = b * per;
    *y = c * per;
    return facing & mask_of(a * per > least) & mask_of(*x > least) & mask_of(*y > least);
}

// Whether a block of triangles may show a point (conservative). Tilting the normal by an angle turns the reflected ray by
// twice that angle, so the point lies in a cone around the ray reflected at the block's centre, with a half angle of
// twice the half angle of the normals plus the angles that the block subtends at the lens and at the point.
INLINE masks may_show(Vector point, Fixed lens, global const MirrorBlock *block) {
    const Fixed middle = block->middle, axis = block->axis;
    const real radius = block->radius, cx = lens.x - middle.x, cy = lens.y - middle.y, cz = lens.z - middle.z;
    const real square = cx * cx + cy * cy + cz * cz, per = (real)1 / sqrt(square);
    const real sine = radius * per, cosine = sqrt(max((real)1 - sine * sine, (real)0));
    const real cos_all = block->cosine_of_twice * cosine - block->sine_of_twice * sine;
    const real sin_all = block->sine_of_twice * cosine + block->cosine_of_twice * sine;
    const real facing = per * (cx * axis.x + cy * axis.y + cz * axis.z);
    if (block->one_sided > 0 && facing < -(block->sine + sine + SLACK)) return mask_of((reals)(real)0 > (reals)(real)0);
    const Vector q = moved(point, middle, -1);
    const reals far = dot_of(q, q), room = far - radius * radius, zero = (real)0;
    // Cones with half angles of 90 degrees or more do not exclude any point. The cosine is 0 or less, or NaN, also where
    // the normals alone have such a cone, and where the lens is in the ball.
    if (!(cos_all > (real)0)) return mask_of(far >= zero);
    const real up = (real)2 * facing;
    const Fixed on = {up * axis.x - cx * per, up * axis.y - cy * per, up * axis.z - cz * per};
    const reals least = cos_all * sqrt(room > zero ? room : zero) - (reals)(sin_all * radius);
    return mask_of(room <= zero) | mask_of(dot_fixed(q, on) >= least - SLACK * sqrt(far));
}

INLINE reals within(reals value, real limit) {
    const reals high = limit, low = -limit;
    value = value > high ? high : value;
    return value < low ? low : value;
}

// Clamp a start value to the triangle and its neighbourhood.
INLINE reals within_triangle(reals value, masks near) {
    const reals low = (real)-0.1, high = (real)1.1;
    value = zero_where(~near, value);
    value = value < low ? low : value;
    return value > high ? high : value;
}

// Newton's method from the start value. Returns the lanes that converged in the triangle with lens and point on one side.
INLINE masks solved(masks near, Vector point, Vector lens, global const MirrorTriangle *row, reals *x, reals *y,
                    Reflection *it) {
    reals step = (real)1;
    for (int n = 0; n < STEPS; n++) {
        *it = reflection_at(*x, *y, point, lens, row);
        const reals per = (real)1 / (it->r1x * it->r2y - it->r1y * it->r2x);
        const reals dx = within((it->r1 * it->r2y - it->r2 * it->r1y) * per, (real)0.5);
        const reals dy = within((it->r2 * it->r1x - it->r1 * it->r2x) * per, (real)0.5);
        *x -= dx;
        *y -= dy;
        step = fabs(dx) + fabs(dy);
        // Drop lanes that left the neighbourhood: they do not return.
        near &= mask_of(fabs(*x) + fabs(*y) < ASTRAY);
        if (!any_lane(near & mask_of(step > NEAR_ENOUGH))) break;
    }
    *it = reflection_at(*x, *y, point, lens, row);
    const reals zero = (real)0;
    // Widen the triangle by rounding: a point on the edge of two triangles must lie in at least one.
    const reals least = -EDGE, most = (real)1 + EDGE;
    const masks inside = mask_of(*x >= least) & mask_of(*y >= least) & mask_of(*x + *y <= most);
    const masks outside = mask_of(it->up_lens > zero) | mask_of((reals)row->one_sided == zero);
    // R is also zero where lens and point are in the plane of the surface: reject grazing solutions.
    const reals ways = sqrt(dot_of(it->to_lens, it->to_lens) * dot_of(it->to_point, it->to_point));
    const masks sides = positive(it->up_lens * it->up_point - GRAZING * GRAZING * ways);
    return near & inside & sides & outside & mask_of(step <= NEAR_ENOUGH);
}

// Solid angle of the lens' rays per area perpendicular to them at the point.
INLINE reals concentration(const Reflection *it) {
    const reals lens_side = dot_of(it->to_lens, cross_of(it->along_x, it->along_y));
    const reals point_side = dot_of(it->to_point, cross_of(it->w1, it->w2));
    const reals slopes = it->r1x * it->r2y - it->r1y * it->r2x;
    const reals square = dot_of(it->to_lens, it->to_lens);
    return fabs(lens_side * point_side / (square * sqrt(square * dot_of(it->to_point, it->to_point)) * slopes));
}

// Derivative of the position on the mirror when the point moves by `step`.
INLINE Vector place_moves(const Reflection *it, Vector step) {
    const reals s1 = dot_of(it->w1, step), s2 = dot_of(it->w2, step);
    const reals det = (real)-1 / (it->r1x * it->r2y - it->r1y * it->r2x);
    const reals dx = (s1 * it->r2y - s2 * it->r1y) * det, dy = (s2 * it->r1x - s1 * it->r2x) * det;
    return sum_of(scaled(it->along_x, dx), scaled(it->along_y, dy));
}

// Load a column of LANES points; lanes beyond the last point repeat it.
INLINE reals loaded(global const INPUT *points, int column, INPUT middle, int last) {
    real each[LANES];
    for (int n = 0; n < LANES; n++) each[n] = (real)(points[6 * min(n, last) + column] - middle);
    return *(reals_at *)each;
}

INLINE void unpacked(reals value, real *to) { *(reals_at *)to = value; }

kernel void mirror_points(global const INPUT *restrict points, global const INPUT *restrict lens_place,
                          global INPUT *restrict places, global real *restrict moves, global real *restrict densities,
                          global int *restrict triangles, global uchar *restrict counts, global uchar *restrict status,
                          global const MirrorTriangle *restrict table, global const int *restrict numbers,
                          global const MirrorBlock *restrict block_table, global const int *restrict starts,
                          constant INPUT *middle, const uint blocks, const uint kept, const ulong count) {
    const ulong i = get_global_id(0) * LANES;
    if (i >= count) return;
    const int last = (int)min(count - i, (ulong)LANES) - 1;
    global const INPUT *at = points + 6 * i;
    const Vector point = {loaded(at, 0, middle[0], last), loaded(at, 1, middle[1], last),
                          loaded(at, 2, middle[2], last)};
    const Vector step = {loaded(at, 3, 0, last), loaded(at, 4, 0, last), loaded(at, 5, 0, last)};
    const Fixed lens = {(real)(lens_place[0] - middle[0]), (real)(lens_place[1] - middle[1]),
                        (real)(lens_place[2] - middle[2])};
    const Vector lens_wide = {(reals)lens.x, (reals)lens.y, (reals)lens.z};
    const masks bad = mask_of(LANED(not_finite)(point.x + point.y + point.z)) |
                      mask_of(LANED(not_finite)(step.x + step.y + step.z));
    uint found[LANES];
    for (int n = 0; n < LANES; n++) found[n] = 0;
    for (uint b = 0; b < blocks; b++) {
        const masks may = may_show(point, lens, block_table + b) & ~bad;
        if (!any_lane(may)) continue;
        for (uint k = starts[b]; k < (uint)starts[b + 1]; k++) {
            global const MirrorTriangle *row = table + k;
            reals x, y;
            const masks near = guessed(point, lens, row, &x, &y) & may;
            if (!any_lane(near)) continue;
            x = within_triangle(x, near);
            y = within_triangle(y, near);
            Reflection it;
            const masks met = solved(near, point, lens_wide, row, &x, &y, &it);
            if (!any_lane(met)) continue;
            const Vector move = place_moves(&it, step);
            real values[7][LANES];
            bits shown[LANES];
            unpacked(it.place.x, values[0]), unpacked(it.place.y, values[1]), unpacked(it.place.z, values[2]);
            unpacked(move.x, values[3]), unpacked(move.y, values[4]), unpacked(move.z, values[5]);
            unpacked(concentration(&it), values[6]);
            unpacked(as_reals(met), (real *)shown);
            for (int n = 0; n <= last; n++) {
                if (!shown[n]) continue;
                if (found[n] < kept) {
                    const size_t slot = (i + n) * kept + found[n];
                    for (int m = 0; m < 3; m++) {
                        places[3 * slot + m] = (INPUT)values[m][n] + middle[m];
                        moves[3 * slot + m] = values[3 + m][n];
                    }
                    densities[slot] = values[6][n];
                    triangles[slot] = numbers[k];
                }
                found[n]++;
            }
        }
    }
    real wrong[LANES];
    unpacked(as_reals(bad), wrong);
    for (int n = 0; n <= last; n++) {
        for (uint m = found[n]; m < kept; m++) {
            const size_t slot = (i + n) * kept + m;
            triangles[slot] = -1;
            densities[slot] = REAL_NAN;
            for (int k = 0; k < 3; k++) places[3 * slot + k] = moves[3 * slot + k] = REAL_NAN;
        }
        counts[i + n] = (uchar)min(found[n], kept);
        status[i + n] = as_bits(wrong[n]) ? STATUS_NOT_FINITE : found[n] > kept ? STATUS_AMBIGUOUS : STATUS_OK;
    }
}

// Depth of y = start + t way inside a cone, y axis - cosine |y|, a concave function of t; and its derivative.
INLINE reals inside_cone(Vector start, Vector way, reals t, Fixed axis, real cosine, reals *slope) {
    const Vector y = sum_of(start, scaled(way, t));
    const reals length = sqrt(dot_of(y, y));
    *slope = dot_fixed(way, axis) - cosine * (dot_of(y, way) / length);
    return dot_fixed(y, axis) - cosine * length;
}

// Whether a lens may see a part of a line in a block of mirrors (conservative). The cone of `may_show` around a ball lies in
// a cone with its apex before the ball; tangents bound the concave depth of the line in it from above.
INLINE masks may_show_part(Vector start, Vector way, Fixed lens, global const MirrorBlock *block) {
    const Fixed middle = block->middle, axis = block->axis;
    const real radius = block->radius, cx = lens.x - middle.x, cy = lens.y - middle.y, cz = lens.z - middle.z;
    const real square = cx * cx + cy * cy + cz * cz, per = (real)1 / sqrt(square);
    const real sine = radius * per, cosine = sqrt(max((real)1 - sine * sine, (real)0));
    const real cos_all = block->cosine_of_twice * cosine - block->sine_of_twice * sine;
    const real sin_all = block->sine_of_twice * cosine + block->cosine_of_twice * sine;
    const reals zero = (real)0, one = (real)1;
    if (!(cos_all > (real)0)) return mask_of(way.x - way.x <= zero);
    const real up = (real)2 * per * (cx * axis.x + cy * axis.y + cz * axis.z), back = radius / sin_all;
    const Fixed on = {up * axis.x - cx * per, up * axis.y - cy * per, up * axis.z - cz * per};
    const Vector from = {start.x - (middle.x - back * on.x), start.y - (middle.y - back * on.y),
                         start.z - (middle.z - back * on.z)};
    reals low = zero, high = one, low_slope, high_slope, slope;
    reals at_low = inside_cone(from, way, low, on, cos_all, &low_slope);
    reals at_high = inside_cone(from, way, high, on, cos_all, &high_slope);
    const reals slack = SLACK * ((reals)back + sqrt(dot_of(from, from)) + sqrt(dot_of(way, way)));
    masks seen = mask_of(at_low >= -slack) | mask_of(at_high >= -slack);
    masks open = ~seen & mask_of(low_slope > zero) & mask_of(high_slope < zero);
    for (int n = 0; n < TANGENTS && any_lane(open); n++) {
        const reals place = (at_high - at_low + low_slope * low - high_slope * high) / (low_slope - high_slope);
        open &= mask_of(at_low + low_slope * (place - low) >= -slack);
        const reals value = inside_cone(from, way, place, on, cos_all, &slope);
        seen |= open & mask_of(value >= -slack);
        open &= ~seen;
        const masks rising = mask_of(slope > zero);
        low = rising ? place : low, at_low = rising ? value : at_low, low_slope = rising ? slope : low_slope;
        high = rising ? high : place, at_high = rising ? at_high : value, high_slope = rising ? high_slope : slope;
    }
    return seen | open;
}

// Blocks of mirrors in which a lens may see each line.
kernel void mirror_facets(global const INPUT *restrict lines, global const INPUT *restrict lens_place,
                          global uchar *restrict near, global const MirrorBlock *restrict block_table,
                          constant INPUT *middle, const uint blocks, const ulong count) {
    const ulong i = get_global_id(0) * LANES;
    if (i >= count) return;
    const int last = (int)min(count - i, (ulong)LANES) - 1;
    global const INPUT *at = lines + 6 * i;
    const Vector start = {loaded(at, 0, middle[0], last), loaded(at, 1, middle[1], last),
                          loaded(at, 2, middle[2], last)};
    const Vector end = {loaded(at, 3, middle[0], last), loaded(at, 4, middle[1], last), loaded(at, 5, middle[2], last)};
    const Fixed lens = {(real)(lens_place[0] - middle[0]), (real)(lens_place[1] - middle[1]),
                        (real)(lens_place[2] - middle[2])};
    const Vector way = minus(end, start);
    for (uint b = 0; b < blocks; b++) {
        real seen[LANES];
        unpacked(as_reals(may_show_part(start, way, lens, block_table + b)), seen);
        for (int lane = 0; lane <= last; lane++) near[(i + lane) * blocks + b] = as_bits(seen[lane]) != 0;
    }
}
