// Bounding volume hierarchy (BVH): nodes with 16 children and leaves with 16 triangles, or four of each (FOUR_WIDE); rays
// are traced one after the other.
//
// One ray is tested against all boxes of a node or all triangles of a leaf. 16 are a vector in the vector variant, a loop
// in the work-item variant; four are a vector. No work is shared between rays, so bvh_closest costs the same for unrelated and for neighbouring rays. bvh_any costs less
// for neighbouring rays: a ray first tests the leaf that occluded the ray before it (bvh_occluder).
// gpuvision/simulation/scene/bvh.py builds the tree.
//
// Build options: BVH_DEPTH, not less than the number of nodes on any path from the root; REAL_IS_DOUBLE; VECTOR_VARIANT;
// CONVEX_PARTS (occluded_irradiance only);
// FOUR_WIDE, work-item variant: nodes with four children and leaves with four triangles. A work-item tests a whole node or
// leaf with vectors of four: 6 or 9 loads of 16 bytes in single precision. The items of a warp read different nodes, and
// each load of an item touches a sector: with 16 children and loads of single numbers these are 96 sectors for a node.
//
// Watertight intersection (Woop, Benthin, Wald: Watertight Ray/Triangle Intersection, JCGT 2013): the corners are
// transformed into the ray's frame, and the sign of each edge function is the sign of the exact difference of products. No
// ray passes between two triangles at their common edge. The host widens the boxes; BOX_SLACK covers the rounding of the
// reciprocal and of the slab test.
#ifndef BVH_H
#define BVH_H

#include "common/lanes.h"

#ifdef FOUR_WIDE
#define WIDTH 4
typedef real4 node_reals;
#ifdef REAL_IS_DOUBLE
typedef long4 node_masks;
#else
typedef int4 node_masks;
#endif
INLINE node_reals load_node(global const real *from) { return *(global const node_reals *)from; }
INLINE node_reals node_max(node_reals a, node_reals b) { return a > b ? a : b; }
INLINE node_reals node_min(node_reals a, node_reals b) { return a < b ? a : b; }
INLINE uint node_bits(node_masks mask) {
    const node_masks set = mask & (node_masks)(1, 2, 4, 8);
    return (uint)(set.x | set.y | set.z | set.w);
}
INLINE int node_any(node_masks mask) { return node_bits(mask) != 0; }
#define mask_of_nodes(comparison) (comparison)
#else
#define WIDTH 16
typedef reals node_reals;
typedef masks node_masks;
#define load_node load_reals
#define node_max lane_max
#define node_min lane_min
#define node_bits lane_bits
#define node_any any_compared
#define mask_of_nodes mask_of
#endif
typedef node_reals node_reals_at __attribute__((aligned(sizeof(real))));
#define BOX_SLACK ((real)1 + (real)8 * (real)REAL_EPSILON)
#define NO_HIT (-1)

typedef struct {
    real per_x, per_y, per_z;          // reciprocal of the direction
    real enter_x, enter_y, enter_z;    // minus the origin times the reciprocal, rounded down
    real leave_x, leave_y, leave_z;    // the same, rounded up
    int near_x, near_y, near_z;        // offsets in a node of the planes at which the ray enters a box
    int i, j, k;                       // offsets in a leaf: coordinates across (i, j) and along (k) the ray
    real at_i, at_j, at_k;             // origin in the order i, j, k
    real lean_i, lean_j, per_k;        // shear to the ray's frame; reciprocal of the direction along k
    real start, end;                   // open interval of multiples of the direction
} bvh_ray;

typedef struct {
    real t, u, v;
    int triangle;
} bvh_hit;

typedef struct {
    global const real *nodes;    // (n, 6, WIDTH): low x, y, z of the boxes, then high x, y, z
    global const int *children;  // (n, WIDTH): index of a node, or ~index of a leaf
    global const int *axes;      // (n,): axis along which the children are sorted
    global const real *leaves;   // (m, 9, WIDTH): x, y, z of the first corners, of the second, of the third
    global const int *triangles; // (m, WIDTH): triangle indices
#ifdef CONVEX_PARTS
    global const real *parts; // (m, PART_ROW): convex parts (occluded_irradiance/visible.h)
#endif
} bvh_tree;

// Reciprocal of a direction component. A component near zero is replaced by 1e-30: the slab of a parallel ray is then
// left far away, with finite numbers.
static inline real bvh_reciprocal(real d) {
    const real least = (real)1e-30;
    return (real)1 / (fabs(d) < least ? copysign(least, d) : d);
}

// Bounds of -origin * per: two roundings of the product and of the sum are 2^-23 of it in single precision; twice that.
static inline void bvh_bounds(real origin, real per, real *below, real *above) {
    const real product = -origin * per, margin = (real)2 * (real)REAL_EPSILON * fabs(product);
    *below = product - margin, *above = product + margin;
}

static inline bvh_ray bvh_ray_of(real x, real y, real z, real dx, real dy, real dz, real start, real end) {
    const real ax = fabs(dx), ay = fabs(dy), az = fabs(dz);
    const int along_z = az >= ax && az >= ay, along_y = !along_z && ay >= ax;
    bvh_ray ray;
    ray.per_x = bvh_reciprocal(dx), ray.per_y = bvh_reciprocal(dy), ray.per_z = bvh_reciprocal(dz);
    bvh_bounds(x, ray.per_x, &ray.enter_x, &ray.leave_x);
    bvh_bounds(y, ray.per_y, &ray.enter_y, &ray.leave_y);
    bvh_bounds(z, ray.per_z, &ray.enter_z, &ray.leave_z);
    ray.near_x = ray.per_x < 0 ? 3 * WIDTH : 0;
    ray.near_y = (ray.per_y < 0 ? 3 * WIDTH : 0) + WIDTH;
    ray.near_z = (ray.per_z < 0 ? 3 * WIDTH : 0) + 2 * WIDTH;
    ray.i = along_z ? 0 : along_y ? 2 * WIDTH : WIDTH;
    ray.j = along_z ? WIDTH : along_y ? 0 : 2 * WIDTH;
    ray.k = along_z ? 2 * WIDTH : along_y ? WIDTH : 0;
    ray.at_i = along_z ? x : along_y ? z : y;
    ray.at_j = along_z ? y : along_y ? x : z;
    ray.at_k = along_z ? z : along_y ? y : x;
    ray.per_k = (real)1 / (along_z ? dz : along_y ? dy : dx);
    ray.lean_i = -(along_z ? dx : along_y ? dz : dy) * ray.per_k;
    ray.lean_j = -(along_z ? dy : along_y ? dx : dz) * ray.per_k;
    ray.start = start, ray.end = end;
    return ray;
}

// Slab test: boxes that the ray meets before `end`. A plane at p is met at (p - origin) per = p per - origin per, one fused
// multiply-add. The product is bounded outward on either side, so no box is missed for any origin.
INLINE node_masks bvh_boxes(const bvh_ray *ray, real end, global const real *node) {
    global const real *far = node + 3 * WIDTH;
    const node_reals per_x = (node_reals)ray->per_x, per_y = (node_reals)ray->per_y, per_z = (node_reals)ray->per_z;
    const node_reals in_x = lane_fma(load_node(node + ray->near_x), per_x, (node_reals)ray->enter_x);
    const node_reals in_y = lane_fma(load_node(node + ray->near_y), per_y, (node_reals)ray->enter_y);
    const node_reals in_z = lane_fma(load_node(node + ray->near_z), per_z, (node_reals)ray->enter_z);
    const node_reals out_x = lane_fma(load_node(far - ray->near_x), per_x, (node_reals)ray->leave_x);
    const node_reals out_y = lane_fma(load_node(far + 2 * WIDTH - ray->near_y), per_y, (node_reals)ray->leave_y);
    const node_reals out_z = lane_fma(load_node(far + 4 * WIDTH - ray->near_z), per_z, (node_reals)ray->leave_z);
    const node_reals enter = node_max(node_max(in_x, in_y), node_max(in_z, (node_reals)ray->start));
    const node_reals leave = node_min(node_min(out_x, out_y), node_min(out_z, (node_reals)end));
    return mask_of_nodes(enter <= leave * BOX_SLACK);
}

// a b - c d with the sign of the exact difference (Kahan): the rounding error of c d, from a fused multiply-add, is added
// back.
INLINE node_reals bvh_cross(node_reals a, node_reals b, node_reals c, node_reals d) {
    const node_reals product = c * d;
    return lane_fma(a, b, -product) + lane_fma(-c, d, product);
}

// Triangles that the ray meets before `end`. Returns t, u, v times the determinant, and the determinant.
INLINE node_masks bvh_triangles(const bvh_ray *ray, real end, global const real *leaf, node_reals *t, node_reals *u,
                                   node_reals *v, node_reals *det) {
    const node_reals at_i = ray->at_i, at_j = ray->at_j, at_k = ray->at_k;
    const node_reals lean_i = ray->lean_i, lean_j = ray->lean_j;
    const node_reals az = load_node(leaf + ray->k) - at_k;
    const node_reals bz = load_node(leaf + 3 * WIDTH + ray->k) - at_k;
    const node_reals cz = load_node(leaf + 6 * WIDTH + ray->k) - at_k;
    const node_reals ax = lane_fma(lean_i, az, load_node(leaf + ray->i) - at_i);
    const node_reals ay = lane_fma(lean_j, az, load_node(leaf + ray->j) - at_j);
    const node_reals bx = lane_fma(lean_i, bz, load_node(leaf + 3 * WIDTH + ray->i) - at_i);
    const node_reals by = lane_fma(lean_j, bz, load_node(leaf + 3 * WIDTH + ray->j) - at_j);
    const node_reals cx = lane_fma(lean_i, cz, load_node(leaf + 6 * WIDTH + ray->i) - at_i);
    const node_reals cy = lane_fma(lean_j, cz, load_node(leaf + 6 * WIDTH + ray->j) - at_j);
    const node_reals a = bvh_cross(cx, by, cy, bx), b = bvh_cross(ax, cy, ay, cx), c = bvh_cross(bx, ay, by, ax);
    const node_reals whole = a + b + c;
    // Inside: all edge functions have one sign.
    const node_reals least = node_min(a, node_min(b, c)), most = node_max(a, node_max(b, c));
    const node_masks inside = mask_of_nodes(least >= 0) | mask_of_nodes(most <= 0);
    const node_reals size = fabs(whole);
    const node_reals along = (a * az + b * bz + c * cz) * ray->per_k;
    const node_reals forward = whole < 0 ? -along : along;
    *t = along, *u = b, *v = c, *det = whole;
    return inside & mask_of_nodes(size > 0) & mask_of_nodes(forward > ray->start * size) &
           mask_of_nodes(forward < end * size);
}

// Boxes that the ray meets before `end`, one bit per box.
INLINE uint bvh_met(const bvh_ray *ray, real end, global const real *node) {
#if defined(VECTOR_VARIANT) || defined(FOUR_WIDE)
    return node_bits(bvh_boxes(ray, end, node));
#else
    uint met = 0;
    for (int lane = 0; lane < WIDTH; lane++) met |= bvh_boxes(ray, end, node + lane) ? 1u << lane : 0;
    return met;
#endif
}

// Whether the ray meets any triangle of a leaf.
INLINE int bvh_leaf_any(const bvh_ray *ray, global const real *leaf) {
    node_reals t, u, v, det;
#if defined(VECTOR_VARIANT) || defined(FOUR_WIDE)
    return node_any(bvh_triangles(ray, ray->end, leaf, &t, &u, &v, &det));
#else
    for (int lane = 0; lane < WIDTH; lane++)
        if (bvh_triangles(ray, ray->end, leaf + lane, &t, &u, &v, &det)) return 1;
    return 0;
#endif
}

// Keep the hit of one lane if it is the nearest so far.
INLINE void bvh_keep_nearest(real t, real u, real v, real det, int triangle, bvh_hit *hit) {
    const real per = (real)1 / det;
    if (t * per < hit->t) *hit = (bvh_hit){t * per, u * per, v * per, triangle};
}

INLINE void bvh_leaf_closest(const bvh_ray *ray, global const real *leaf, global const int *triangles,
                                 bvh_hit *hit) {
    node_reals t, u, v, det;
#if defined(VECTOR_VARIANT) || defined(FOUR_WIDE)
    uint met = node_bits(bvh_triangles(ray, hit->t, leaf, &t, &u, &v, &det));
    if (!met) return;
    real ts[WIDTH], us[WIDTH], vs[WIDTH], dets[WIDTH];
    *(node_reals_at *)ts = t, *(node_reals_at *)us = u, *(node_reals_at *)vs = v, *(node_reals_at *)dets = det;
#ifdef FOUR_WIDE
    // Unrolled, with constant indices: the arrays stay in registers.
#pragma unroll
    for (int lane = 0; lane < WIDTH; lane++)
        if (met >> lane & 1) bvh_keep_nearest(ts[lane], us[lane], vs[lane], dets[lane], triangles[lane], hit);
#else
    for (; met; met &= met - 1) {
        const int lane = lowest_bit(met);
        bvh_keep_nearest(ts[lane], us[lane], vs[lane], dets[lane], triangles[lane], hit);
    }
#endif
#else
    for (int lane = 0; lane < WIDTH; lane++)
        if (bvh_triangles(ray, hit->t, leaf + lane, &t, &u, &v, &det)) bvh_keep_nearest(t, u, v, det, triangles[lane], hit);
#endif
}

// Next child to visit: the nearest along the node's sort axis.
INLINE int bvh_next(const bvh_ray *ray, int axis, uint met) {
    const real per = axis == 0 ? ray->per_x : axis == 1 ? ray->per_y : ray->per_z;
    return per < 0 ? 31 - (int)clz(met) : lowest_bit(met);
}

// Leaf that occluded the last occluded ray of a sequence, and `trust`, a counter of repeated occluders.
//
// Neighbouring shadow rays are often occluded by the same leaf. A ray tests this leaf before it traverses the tree if
// `trust` is positive. Each occluded ray adds 1 to `trust` if the same leaf occludes it again, else subtracts 1, whether
// the leaf was tested first or not: in a sequence of unrelated rays `trust` falls, and the leaf is not tested.
typedef struct {
    int leaf, trust; // ~index of the leaf (0: none); between -MOST_TRUST and MOST_TRUST
} bvh_occluder;

#define NO_OCCLUDER ((bvh_occluder){0, 0})
#define MOST_TRUST 4

INLINE void bvh_remember(bvh_occluder *last, int leaf) {
    last->trust = leaf == last->leaf ? min(last->trust + 1, MOST_TRUST) : max(last->trust - 1, -MOST_TRUST);
    last->leaf = leaf;
}

// Whether the ray meets any triangle.
//
// The result does not depend on `last` if every triangle that bvh_triangles accepts lies in boxes that bvh_boxes accepts.
// The two round differently where a ray passes an edge or ends on a triangle. To first order, epsilon = 2^-23 in single
// precision: bvh_triangles moves a corner across the ray by at most half an epsilon of its distance along that axis and two
// epsilon of the ray's own travel along the axis, and t by about 6 epsilon. bvh_boxes allows 4 epsilon of the largest
// coordinate (padding by the host), 2 epsilon of the origin (bvh_bounds), and 8 epsilon of t (BOX_SLACK). This is an
// estimate, no proof; test_rays.py compares orders of rays to edges, corners and surfaces.
INLINE int bvh_any(const bvh_tree *tree, const bvh_ray *ray, bvh_occluder *last) {
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    int node = 0, depth = 0;
    const int tested = last->trust > 0 ? last->leaf : 0;
    if (tested && bvh_leaf_any(ray, tree->leaves + (size_t)~tested * (9 * WIDTH))) {
        bvh_remember(last, tested);
        return 1;
    }
    uint met = bvh_met(ray, ray->end, tree->nodes);
    while (true) {
        if (!met) {
            if (!depth) return 0;
            node = nodes[--depth];
            met = left[depth];
        }
        const int lane = bvh_next(ray, tree->axes[node], met);
        met ^= 1u << lane;
        const int child = tree->children[node * WIDTH + lane];
        if (child < 0) {
            if (child != tested && bvh_leaf_any(ray, tree->leaves + (size_t)~child * (9 * WIDTH))) {
                bvh_remember(last, child);
                return 1;
            }
            continue;
        }
        if (met) {
            nodes[depth] = node;
            left[depth++] = met;
        }
        node = child;
        met = bvh_met(ray, ray->end, tree->nodes + (size_t)node * (6 * WIDTH));
    }
}

// Nearest triangle on the ray, or NO_HIT.
INLINE bvh_hit bvh_closest(const bvh_tree *tree, const bvh_ray *ray) {
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    bvh_hit hit = {ray->end, REAL_NAN, REAL_NAN, NO_HIT};
    int node = 0, depth = 0;
    uint met = bvh_met(ray, ray->end, tree->nodes);
    while (true) {
        if (!met) {
            if (!depth) return hit;
            node = nodes[--depth];
            // A hit found meanwhile may lie before the remaining boxes: test them again.
            met = left[depth] & bvh_met(ray, hit.t, tree->nodes + (size_t)node * (6 * WIDTH));
            continue;
        }
        const int lane = bvh_next(ray, tree->axes[node], met);
        met ^= 1u << lane;
        const int child = tree->children[node * WIDTH + lane];
        if (child < 0) {
            const real before = hit.t;
            const size_t leaf = ~child;
            bvh_leaf_closest(ray, tree->leaves + leaf * (9 * WIDTH), tree->triangles + leaf * WIDTH, &hit);
            if (hit.t < before) met &= bvh_met(ray, hit.t, tree->nodes + (size_t)node * (6 * WIDTH));
            continue;
        }
        if (met) {
            nodes[depth] = node;
            left[depth++] = met;
        }
        node = child;
        met = bvh_met(ray, hit.t, tree->nodes + (size_t)node * (6 * WIDTH));
    }
}

#endif
