// Visible intervals of segments from apexes: exact occlusion, as fractions of the segment.
//
// Inputs:  fans (count, FAN): apex, both ends of the segment [m], and per end the fraction of the way from the apex at which
//          the ray begins (0; with a plane mirror on the way the fraction at the mirror, and the apex is the mirror image of
//          the lens), type INPUT.
// Outputs: intervals (count, kept, 2) fractions of the segment, NaN behind the last; counts (count,); status (count,).
// Tables:  the tree of common/bvh.h; middle. Options: INPUT, REAL_IS_DOUBLE, BVH_DEPTH. Variants: vector: boxes and
//          triangles in vectors of 16; work-item: one after the other. One fan per work-item in both.
//
// Coordinates in the plane of the fan: place = apex + a (end 0 - apex) + b (end 1 - apex). The fan is a >= 0, b >= 0; the
// segment is a + b = 1, at the fraction b / (a + b) of its length; rays begin where a / near 0 + b / near 1 = 1. All these
// are linear along the line in which a triangle cuts the plane, so clipping is exact.
//
// A short segment makes a narrow fan: a and b of a far corner are large (distance / length of the segment), while a + b is
// moderate, and 1 along the whole line in which the segment's own triangle cuts the plane. A sum of a and b would lose these
// digits, and the triangle would hide the segment. So a + b (`far`) has its own gradient, a is far - b, and the plane's
// normal is (end 0 - apex) x (end 1 - end 0).
#include "common/bvh.h"
#include "common/status.h"

#define FAN 11         // numbers per fan
#define HIDDEN_KEPT 48 // capacity for disjoint hidden intervals

typedef struct {
    real x, y, z;
} Vector;

typedef struct {
    Vector apex, across;    // apex; unit normal of the plane
    Vector a, b, far, near; // gradients of a, b, a + b, a / near 0 + b / near 1
    real per_0, change;     // 1 / near 0; 1 / near 1 - 1 / near 0
    real flat;              // a corner within this distance of the plane counts as in the plane [m]
} Fan;

static inline Vector minus(Vector a, Vector b) { return (Vector){a.x - b.x, a.y - b.y, a.z - b.z}; }
static inline real dot_of(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline Vector cross_of(Vector a, Vector b) {
    return (Vector){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
static inline Vector scaled(Vector a, real by) { return (Vector){a.x * by, a.y * by, a.z * by}; }
static inline Vector combined(real a, Vector u, real b, Vector v) {
    return (Vector){a * u.x + b * v.x, a * u.y + b * v.y, a * u.z + b * v.z};
}

// Set up a fan; return 0 for a segment on a line through the apex.
static inline int fan_of(const Vector *corners, real near_0, real near_1, real least_near, Fan *fan) {
    const Vector one = minus(corners[1], corners[0]), two = minus(corners[2], corners[0]);
    const Vector along = minus(corners[2], corners[1]), normal = cross_of(one, along);
    const real square = dot_of(normal, normal), reach = dot_of(one, one) + dot_of(two, two);
    if (!(square > (real)64 * (real)REAL_EPSILON * (real)REAL_EPSILON * reach * reach)) return 0;
    fan->apex = corners[0];
    fan->across = scaled(normal, (real)1 / sqrt(square));
    fan->a = scaled(cross_of(two, normal), (real)1 / square);
    fan->b = scaled(cross_of(normal, one), (real)1 / square);
    fan->per_0 = (real)1 / max(near_0, least_near);
    fan->change = (real)1 / max(near_1, least_near) - fan->per_0;
    fan->far = scaled(cross_of(along, normal), (real)1 / square);
    fan->near = combined(fan->per_0, fan->far, fan->change, fan->b);
    fan->flat = (real)16 * (real)REAL_EPSILON * sqrt(reach);
    return 1;
}

// Largest (sign 1) or smallest (sign -1) value of a linear function over boxes.
INLINE reals extreme(Vector of, real sign, const reals *middle, const reals *half_size) {
    return of.x * middle[0] + of.y * middle[1] + of.z * middle[2] +
           sign * (fabs(of.x) * half_size[0] + fabs(of.y) * half_size[1] + fabs(of.z) * half_size[2]);
}

// Boxes that may contain an occluder of the fan.
INLINE masks fan_boxes(const Fan *fan, global const real *node) {
    const real apex[3] = {fan->apex.x, fan->apex.y, fan->apex.z};
    reals middle[3], half_size[3];
    for (int k = 0; k < 3; k++) {
        const reals low = load_reals(node + k * WIDTH), high = load_reals(node + (3 + k) * WIDTH);
        middle[k] = (real)0.5 * (low + high) - apex[k];
        half_size[k] = (real)0.5 * (high - low);
    }
    const real slack = (real)16 * (real)REAL_EPSILON;
    // A missing child has infinite bounds: its values are NaN and its comparisons false.
    return mask_of(extreme(fan->across, 1, middle, half_size) >= -fan->flat) &
           mask_of(extreme(fan->across, -1, middle, half_size) <= fan->flat) &
           mask_of(extreme(fan->a, 1, middle, half_size) >= -slack) &
           mask_of(extreme(fan->b, 1, middle, half_size) >= -slack) &
           mask_of(extreme(fan->far, -1, middle, half_size) <= (real)1 + slack) &
           mask_of(extreme(fan->near, 1, middle, half_size) >= (real)1 - slack);
}

// Clip [low, high] of a line to where a linear function, `start` and `end` at its ends, is positive.
INLINE void cut(reals start, reals end, reals *low, reals *high) {
    const reals zero = (real)0, place = start / (start - end);
    *low = start < zero ? lane_max(*low, place) : *low;
    *high = end < zero ? lane_min(*high, place) : *high;
    *high = ((start < zero) & (end < zero)) ? (reals)(real)-1 : *high;
}

// Triangles that hide a part of the segment, and the hidden intervals.
INLINE masks fan_triangles(const Fan *fan, real slack, global const real *leaf, reals *from, reals *to) {
    reals d[3], f[3], b[3]; // f: a + b
    for (int n = 0; n < 3; n++) {
        global const real *at = leaf + 3 * n * WIDTH;
        const reals x = load_reals(at) - fan->apex.x, y = load_reals(at + WIDTH) - fan->apex.y;
        const reals z = load_reals(at + 2 * WIDTH) - fan->apex.z;
        const reals off = fan->across.x * x + fan->across.y * y + fan->across.z * z;
        d[n] = fabs(off) <= (reals)fan->flat ? (reals)(real)0 : off;
        f[n] = fan->far.x * x + fan->far.y * y + fan->far.z * z;
        b[n] = fan->b.x * x + fan->b.y * y + fan->b.z * z;
    }
    const reals zero = (real)0, one = (real)1;
    const masks s0 = mask_of(d[0] < zero), s1 = mask_of(d[1] < zero), s2 = mask_of(d[2] < zero);
    const masks lone_0 = (s0 ^ s1) & (s0 ^ s2), lone_1 = (s1 ^ s0) & (s1 ^ s2), crossed = (s0 ^ s1) | (s0 ^ s2);
    // k: the corner alone on its side of the plane; i, j: the other two.
    const reals dk = lone_0 ? d[0] : lone_1 ? d[1] : d[2], di = lone_0 ? d[1] : d[0];
    const reals fk = lone_0 ? f[0] : lone_1 ? f[1] : f[2], fi = lone_0 ? f[1] : f[0];
    const reals bk = lone_0 ? b[0] : lone_1 ? b[1] : b[2], bi = lone_0 ? b[1] : b[0];
    const masks early = lone_0 | lone_1;
    const reals dj = early ? d[2] : d[1], fj = early ? f[2] : f[1], bj = early ? b[2] : b[1];
    const reals i = dk / (dk - di), j = dk / (dk - dj);
    const reals f0 = fk + i * (fi - fk), b0 = bk + i * (bi - bk), f1 = fk + j * (fj - fk), b1 = bk + j * (bj - bk);
    reals low = zero, high = one;
    cut(f0 - b0, f1 - b1, &low, &high);
    cut(b0, b1, &low, &high);
    const real most = (real)1 - slack, least = (real)1 + slack;
    cut(most - f0, most - f1, &low, &high);
    cut(fan->per_0 * f0 + fan->change * b0 - least, fan->per_0 * f1 + fan->change * b1 - least, &low, &high);
    const reals start = (b0 + low * (b1 - b0)) / (f0 + low * (f1 - f0));
    const reals end = (b0 + high * (b1 - b0)) / (f0 + high * (f1 - f0));
    *from = lane_min(start, end);
    *to = lane_max(start, end);
    return crossed & mask_of(high > low);
}

typedef struct {
    real from[HIDDEN_KEPT], to[HIDDEN_KEPT];
    int count, lost;
} Hidden;

// Insert an interval into the sorted, disjoint intervals; merge the intervals that it touches.
static inline void hide(Hidden *hidden, real from, real to, real gap) {
    int first = 0;
    while (first < hidden->count && hidden->to[first] < from - gap) first++;
    int behind = first;
    while (behind < hidden->count && hidden->from[behind] <= to + gap) {
        from = min(from, hidden->from[behind]);
        to = max(to, hidden->to[behind]);
        behind++;
    }
    const int joined = behind - first;
    if (!joined && hidden->count == HIDDEN_KEPT) {
        hidden->lost = 1;
        return;
    }
    if (!joined)
        for (int n = hidden->count; n > first; n--) hidden->from[n] = hidden->from[n - 1], hidden->to[n] = hidden->to[n - 1];
    else
        for (int n = behind; n < hidden->count; n++)
            hidden->from[n - joined + 1] = hidden->from[n], hidden->to[n - joined + 1] = hidden->to[n];
    hidden->from[first] = from, hidden->to[first] = to;
    hidden->count += 1 - joined;
}

// Add the intervals that the triangles of a leaf hide.
INLINE void hide_leaf(const Fan *fan, real slack, global const real *leaf, Hidden *hidden) {
    reals from, to;
#ifdef VECTOR_VARIANT
    uint met = lane_bits(fan_triangles(fan, slack, leaf, &from, &to));
    if (!met) return;
    real starts[WIDTH], ends[WIDTH];
    *(reals_at *)starts = from, *(reals_at *)ends = to;
    for (; met; met &= met - 1) hide(hidden, starts[lowest_bit(met)], ends[lowest_bit(met)], slack);
#else
    for (int lane = 0; lane < WIDTH; lane++)
        if (fan_triangles(fan, slack, leaf + lane, &from, &to)) hide(hidden, from, to, slack);
#endif
}

INLINE uint fan_met(const Fan *fan, global const real *node) {
#ifdef VECTOR_VARIANT
    return lane_bits(fan_boxes(fan, node));
#else
    uint met = 0;
    for (int lane = 0; lane < WIDTH; lane++) met |= fan_boxes(fan, node + lane) ? 1u << lane : 0;
    return met;
#endif
}

// Add the intervals that all triangles hide; stop when the whole segment is hidden.
static inline void hide_all(const bvh_tree *tree, const Fan *fan, real slack, Hidden *hidden) {
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    int node = 0, depth = 0;
    uint met = fan_met(fan, tree->nodes);
    while (true) {
        if (!met) {
            if (!depth) return;
            node = nodes[--depth];
            met = left[depth];
        }
        const int lane = lowest_bit(met);
        met ^= 1u << lane;
        const int child = tree->children[node * WIDTH + lane];
        if (child < 0) {
            hide_leaf(fan, slack, tree->leaves + (size_t)~child * (9 * WIDTH), hidden);
            if (hidden->count == 1 && hidden->from[0] <= slack && hidden->to[0] >= (real)1 - slack) return;
            continue;
        }
        if (met) {
            nodes[depth] = node;
            left[depth++] = met;
        }
        node = child;
        met = fan_met(fan, tree->nodes + (size_t)node * (6 * WIDTH));
    }
}

// Write the visible intervals; return their number, or -1 if they exceed `kept`.
static inline int show(const Hidden *hidden, real slack, uint kept, global real *to) {
    uint count = 0;
    real start = 0;
    for (int n = 0; n <= hidden->count; n++) {
        const real end = n < hidden->count ? hidden->from[n] : (real)1;
        if (end > start + slack) {
            if (count == kept) return -1;
            to[2 * count] = start, to[2 * count + 1] = end;
            count++;
        }
        if (n < hidden->count) start = hidden->to[n];
    }
    return (int)count;
}

kernel void fan_intervals(global const INPUT *restrict fans, global real *restrict intervals,
                          global uchar *restrict counts, global uchar *restrict status, global const real *nodes,
                          global const int *children, global const int *axes, global const real *leaves,
                          global const int *triangles, constant INPUT *middle, const real slack, const uint kept,
                          const ulong count) {
    const ulong i = get_global_id(0);
    if (i >= count) return;
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    global const INPUT *at = fans + i * FAN;
    Vector corners[3];
    int good = 1;
    for (int n = 0; n < 3; n++) { // by field: Mesa 25.0 does not copy a structure to an element of an array
        corners[n].x = (real)(at[3 * n] - middle[0]);
        corners[n].y = (real)(at[3 * n + 1] - middle[1]);
        corners[n].z = (real)(at[3 * n + 2] - middle[2]);
    }
    for (int n = 0; n < FAN; n++) good &= !not_finite((real)at[n]);
    global real *to = intervals + i * kept * 2;
    Hidden hidden;
    hidden.count = hidden.lost = 0;
    Fan fan;
    int shown = 0;
    if (good && fan_of(corners, (real)at[9], (real)at[10], slack, &fan)) {
        hide_all(&tree, &fan, slack, &hidden);
        shown = hidden.lost ? -1 : show(&hidden, slack, kept, to);
    }
    for (uint n = max(shown, 0); n < kept; n++) to[2 * n] = to[2 * n + 1] = REAL_NAN;
    counts[i] = (uchar)max(shown, 0);
    status[i] = !good ? STATUS_NOT_FINITE : shown < 0 ? STATUS_AMBIGUOUS : STATUS_OK;
}
