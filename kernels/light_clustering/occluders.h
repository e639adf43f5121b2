// Test of a triangle for light clustering: whether it may hide a part of a lit cluster from a receiver of a block.
#ifndef OCCLUDERS_H
#define OCCLUDERS_H
#include "light_clustering/light_bounds.h"
#include "light_clustering/shaft.h"

typedef struct {
    reals x, y, z;
} vectors;

// Bounds of a set of points with normals: box, disc, and cone of normals.
typedef struct {
    real centre[3], low[3], high[3], normal[3];
    real radius, slab, spread, most_height;
} extent;

INLINE vectors corner_of(global const real *leaf, int corner) {
    global const real *at = leaf + 3 * corner * WIDTH;
    const vectors v = {load_reals(at), load_reals(at + WIDTH), load_reals(at + 2 * WIDTH)};
    return v;
}

INLINE vectors from(vectors v, const real *place) {
    const vectors way = {v.x - place[0], v.y - place[1], v.z - place[2]};
    return way;
}

INLINE vectors cross(vectors p, vectors q) {
    const vectors n = {p.y * q.z - p.z * q.y, p.z * q.x - p.x * q.z, p.x * q.y - p.y * q.x};
    return n;
}

INLINE reals along(vectors v, real x, real y, real z) { return v.x * x + v.y * y + v.z * z; }
INLINE reals size_of(vectors v) { return sqrt(v.x * v.x + v.y * v.y + v.z * v.z); }

INLINE reals highest(vectors a, vectors b, vectors c, const real *up) {
    const reals u = along(a, up[0], up[1], up[2]), v = along(b, up[0], up[1], up[2]);
    return lane_max(lane_max(u, v), along(c, up[0], up[1], up[2]));
}

// Upper bound of the height of a point above any of the planes.
INLINE reals rise(const extent *many, vectors corner) {
    const vectors way = from(corner, many->centre);
    return along(way, many->normal[0], many->normal[1], many->normal[2]) + many->spread * size_of(way) +
           many->most_height;
}

// Interval of the points along a direction, from a level.
INLINE void between(const extent *many, vectors n, reals size, reals level, reals *low,
                        reals *high) {
    const reals middle = along(n, many->centre[0], many->centre[1], many->centre[2]) - level;
    reals front = (reals)0, back = (reals)0;
    const reals parts[3] = {n.x, n.y, n.z};
    for (int k = 0; k < 3; k++) {
        const reals one = parts[k] * (many->low[k] - many->centre[k]);
        const reals two = parts[k] * (many->high[k] - many->centre[k]);
        front += lane_max(one, two), back += lane_min(one, two);
    }
    const reals cosine = fabs(along(n, many->normal[0], many->normal[1], many->normal[2]));
    const reals sine = sqrt(lane_max(size * size - cosine * cosine, (reals)0));
    const reals disc = cosine * many->slab + sine * many->radius;
    *low = middle + lane_max(back, -disc), *high = middle + lane_min(front, disc);
}

// Return the triangles of a leaf that may hide a part of the lit cluster from a receiver. Such a triangle intersects
// the convex hull of both, rises above the plane of each, and has the receiver on one side of its plane and a part of
// the cluster on the other side. In projection from the receiver, no edge of the triangle has the whole cluster on its
// outer side.
INLINE int hides(const shaft *hull, BLOCK_SPACE const block_receivers *all, int receivers, const extent *got,
                 const extent *out, global const real *lit, int count, real margin, global const real *leaf) {
    masks left = shaft_leaf(hull, leaf);
    if (!any_compared(left)) return 0;
    const vectors a = corner_of(leaf, 0), b = corner_of(leaf, 1), c = corner_of(leaf, 2);
    left &= mask_of(lane_max(rise(got, a), lane_max(rise(got, b), rise(got, c))) > margin);
    if (!any_compared(left)) return 0;
    const vectors p = {b.x - a.x, b.y - a.y, b.z - a.z}, q = {c.x - a.x, c.y - a.y, c.z - a.z};
    const vectors n = cross(p, q);
    const reals level = n.x * a.x + n.y * a.y + n.z * a.z, slack = margin * size_of(n);
    masks above = (masks)(0), below = (masks)(0);
    for (int i = 0; i < count; i++) {
        const real normal[3] = {lit[SEGMENT_NORMAL], lit[SEGMENT_NORMAL + 1], lit[SEGMENT_NORMAL + 2]};
        const masks over = left & mask_of(highest(a, b, c, normal) > lit[SEGMENT_HEIGHT] + margin);
        const reals start = along(n, lit[SEGMENT_START], lit[SEGMENT_START + 1], lit[SEGMENT_START + 2]) - level;
        const reals end = along(n, lit[SEGMENT_END], lit[SEGMENT_END + 1], lit[SEGMENT_END + 2]) - level;
        above |= over & mask_of(lane_max(start, end) > slack);
        below |= over & mask_of(lane_min(start, end) < -slack);
        lit += SEGMENT_SIZE;
    }
    left &= above | below;
    if (!any_compared(left)) return 0;
    for (int i = 0; i < receivers; i++) {
        real place[3], normal[3];
        for (int k = 0; k < 3; k++) place[k] = all->places[3 * i + k], normal[k] = all->normals[3 * i + k];
        const vectors u = from(a, place), v = from(b, place), w = from(c, place);
        const reals top = highest(u, v, w, normal);
        const reals side = along(n, place[0], place[1], place[2]) - level;
        masks may = left & mask_of(top > margin);
        may &= (mask_of(side > slack) & below) | (mask_of(side < -slack) & above);
        if (!any_compared(may)) continue;
        // The cone from the receiver over the triangle: inside is where all edges have the sign of `side`, turned.
        for (int edge = 0; edge < 3; edge++) {
            const vectors m = edge == 0 ? cross(u, v) : edge == 1 ? cross(v, w) : cross(w, u);
            reals first, last;
            between(out, m, size_of(m), along(m, place[0], place[1], place[2]), &first, &last);
            may &= (mask_of(side < 0) & mask_of(last > 0)) | (mask_of(side > 0) & mask_of(first < 0));
            if (!any_compared(may)) break;
        }
        if (any_compared(may)) return 1;
    }
    return 0;
}

INLINE extent extent_of_block(const block_bounds *block) {
    extent got;
    for (int k = 0; k < 3; k++) {
        got.centre[k] = block->centre[k], got.low[k] = block->low[k], got.high[k] = block->high[k];
        got.normal[k] = block->normal[k];
    }
    got.radius = block->radius, got.slab = block->slab;
    got.spread = block->spread, got.most_height = block->most_height;
    return got;
}

INLINE extent extent_of_cluster(global const real *row) {
    extent out;
    for (int k = 0; k < 3; k++) {
        out.centre[k] = row[NODE_CENTRE + k], out.low[k] = row[NODE_LOW + k], out.high[k] = row[NODE_HIGH + k];
        out.normal[k] = row[NODE_NORMAL + k];
    }
    out.radius = row[NODE_RADIUS], out.slab = row[NODE_SLAB];
    out.spread = row[NODE_SPREAD], out.most_height = row[NODE_MAX_HEIGHT];
    return out;
}

#endif
