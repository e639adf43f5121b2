// A tree of nodes with 16 children and leaves of 16 triangles (gpuvision/simulation/bvh.py): one ray is tested against
// 16 boxes, or 16 triangles, at once, so rays that have nothing to do with each other cost no more than neighbours. Under
// VECTOR_VARIANT the 16 are a vector, else a loop. BVH_DEPTH is how many nodes lie above each other at most.
//
// The ray meets a triangle in the ray's own frame (Woop, Benthin, Wald: Watertight ray/triangle intersection, 2013). The
// sign of an edge is that of the exact difference of products, so that no ray passes between two triangles at the edge
// they share. Boxes are widened on the host, and the slabs by the rounding of their own three operations.
#ifndef BVH_H
#define BVH_H

#include "common/real.h"

#define WIDTH 16
#define BOX_SLACK ((real)1 + (real)8 * (real)REAL_EPSILON)
#define NO_HIT (-1)

typedef struct {
    real x, y, z, per_x, per_y, per_z; // origin, and one over the direction
    int near_x, near_y, near_z;        // where a node has the planes at which the ray comes in
    int i, j, k;                       // where a leaf has the coordinates across the ray and along it
    real at_i, at_j, at_k;             // the origin in that order
    real lean_i, lean_j, per_k;
    real start, end; // between these multiples of the direction, both excluded
} bvh_ray;

typedef struct {
    real t, u, v;
    int triangle;
} bvh_hit;

typedef struct {
    global const real *nodes;    // (n, 6, 16): the low x, y, z of 16 boxes, then the high ones
    global const int *children;  // (n, 16): a node, or ~leaf
    global const int *axes;      // (n,): along which its children are in order
    global const real *leaves;   // (m, 9, 16): x, y, z of the first corners, the second, the third
    global const int *triangles; // (m, 16): their numbers
} bvh_tree;

// A slab that is (nearly) parallel to the ray is left far away, with finite numbers.
inline real bvh_per(real d) {
    const real least = (real)1e-30;
    return (real)1 / (fabs(d) < least ? copysign(least, d) : d);
}

inline bvh_ray bvh_ray_of(real x, real y, real z, real dx, real dy, real dz, real start, real end) {
    const real ax = fabs(dx), ay = fabs(dy), az = fabs(dz);
    const int along_z = az >= ax && az >= ay, along_y = !along_z && ay >= ax;
    bvh_ray ray;
    ray.x = x, ray.y = y, ray.z = z;
    ray.per_x = bvh_per(dx), ray.per_y = bvh_per(dy), ray.per_z = bvh_per(dz);
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

#ifdef VECTOR_VARIANT
typedef real16 bvh_reals;
typedef bits16 bvh_masks;
typedef real16 bvh_reals_at __attribute__((aligned(sizeof(real))));
#define BVH_LOAD(from) (*(global const bvh_reals_at *)(from))
#define BVH_MASK(comparison) (comparison)
// The built-in fma() is taken apart into scalars by PoCL.
#if __has_builtin(__builtin_elementwise_fma)
#define bvh_fma __builtin_elementwise_fma
#else
#define bvh_fma fma
#endif
// Bit n is lane n. (One instruction where there is one for it; compilers do not find it.)
#if defined(__AVX512DQ__) && __has_builtin(__builtin_ia32_cvtd2mask512) && !defined(REAL_IS_DOUBLE)
inline uint bvh_lanes(bvh_masks mask) { return (ushort)__builtin_ia32_cvtd2mask512(mask); }
#else
inline uint bvh_lanes(bvh_masks mask) {
    const bvh_masks weights = {1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768};
    const bvh_masks set = mask & weights;
#ifdef REAL_IS_DOUBLE
    const long8 half_of_it = set.lo | set.hi;
    const long4 quarter = half_of_it.lo | half_of_it.hi;
    return (uint)(quarter.x | quarter.y | quarter.z | quarter.w);
#else
    const int8 half_of_it = set.lo | set.hi;
    const long2 quarter = as_long2(half_of_it.lo | half_of_it.hi);
    const long both = quarter.x | quarter.y;
    return (uint)both | (uint)(both >> 32);
#endif
}
#endif
#else
typedef real bvh_reals;
typedef bits bvh_masks;
#define BVH_LOAD(from) (*(from))
#define BVH_MASK(comparison) (-(bits)(comparison))
#define bvh_fma fma
#endif

inline int bvh_lowest(uint set) { return (int)popcount((set & -set) - 1); }

#define BVH_INLINE __attribute__((always_inline)) inline

BVH_INLINE bvh_reals bvh_max(bvh_reals a, bvh_reals b) { return a > b ? a : b; }
BVH_INLINE bvh_reals bvh_min(bvh_reals a, bvh_reals b) { return a < b ? a : b; }

// Which boxes the ray meets before `end`.
BVH_INLINE bvh_masks bvh_boxes(const bvh_ray *ray, real end, global const real *node) {
    global const real *far = node + 3 * WIDTH;
    const bvh_reals x = ray->x, y = ray->y, z = ray->z;
    const bvh_reals in_x = (BVH_LOAD(node + ray->near_x) - x) * ray->per_x;
    const bvh_reals in_y = (BVH_LOAD(node + ray->near_y) - y) * ray->per_y;
    const bvh_reals in_z = (BVH_LOAD(node + ray->near_z) - z) * ray->per_z;
    const bvh_reals out_x = (BVH_LOAD(far - ray->near_x) - x) * ray->per_x;
    const bvh_reals out_y = (BVH_LOAD(far + 2 * WIDTH - ray->near_y) - y) * ray->per_y;
    const bvh_reals out_z = (BVH_LOAD(far + 4 * WIDTH - ray->near_z) - z) * ray->per_z;
    const bvh_reals enter = bvh_max(bvh_max(in_x, in_y), bvh_max(in_z, (bvh_reals)ray->start));
    const bvh_reals leave = bvh_min(bvh_min(out_x, out_y), bvh_min(out_z, (bvh_reals)end));
    return BVH_MASK(enter <= leave * BOX_SLACK);
}

// a b - c d with the sign of the exact difference (Kahan).
BVH_INLINE bvh_reals bvh_cross(bvh_reals a, bvh_reals b, bvh_reals c, bvh_reals d) {
    const bvh_reals product = c * d;
    return bvh_fma(a, b, -product) + bvh_fma(-c, d, product);
}

// Which triangles the ray meets before `end`; t det, u det, v det and det.
BVH_INLINE bvh_masks bvh_triangles(const bvh_ray *ray, real end, global const real *leaf, bvh_reals *t, bvh_reals *u,
                                   bvh_reals *v, bvh_reals *det) {
    const bvh_reals at_i = ray->at_i, at_j = ray->at_j, at_k = ray->at_k;
    const bvh_reals lean_i = ray->lean_i, lean_j = ray->lean_j;
    const bvh_reals az = BVH_LOAD(leaf + ray->k) - at_k;
    const bvh_reals bz = BVH_LOAD(leaf + 3 * WIDTH + ray->k) - at_k;
    const bvh_reals cz = BVH_LOAD(leaf + 6 * WIDTH + ray->k) - at_k;
    const bvh_reals ax = bvh_fma(lean_i, az, BVH_LOAD(leaf + ray->i) - at_i);
    const bvh_reals ay = bvh_fma(lean_j, az, BVH_LOAD(leaf + ray->j) - at_j);
    const bvh_reals bx = bvh_fma(lean_i, bz, BVH_LOAD(leaf + 3 * WIDTH + ray->i) - at_i);
    const bvh_reals by = bvh_fma(lean_j, bz, BVH_LOAD(leaf + 3 * WIDTH + ray->j) - at_j);
    const bvh_reals cx = bvh_fma(lean_i, cz, BVH_LOAD(leaf + 6 * WIDTH + ray->i) - at_i);
    const bvh_reals cy = bvh_fma(lean_j, cz, BVH_LOAD(leaf + 6 * WIDTH + ray->j) - at_j);
    const bvh_reals a = bvh_cross(cx, by, cy, bx), b = bvh_cross(ax, cy, ay, cx), c = bvh_cross(bx, ay, by, ax);
    const bvh_reals whole = a + b + c;
    // All of one sign: the smallest is not negative, or the largest is not positive.
    const bvh_reals least = bvh_min(a, bvh_min(b, c)), most = bvh_max(a, bvh_max(b, c));
    const bvh_masks inside = BVH_MASK(least >= 0) | BVH_MASK(most <= 0);
    const bvh_reals size = fabs(whole);
    const bvh_reals along = (a * az + b * bz + c * cz) * ray->per_k;
    const bvh_reals forward = whole < 0 ? -along : along;
    *t = along, *u = b, *v = c, *det = whole;
    return inside & BVH_MASK(size > 0) & BVH_MASK(forward > ray->start * size) & BVH_MASK(forward < end * size);
}

// Which of the 16 boxes the ray meets before `end`, as bits.
BVH_INLINE uint bvh_met(const bvh_ray *ray, real end, global const real *node) {
#ifdef VECTOR_VARIANT
    return bvh_lanes(bvh_boxes(ray, end, node));
#else
    uint met = 0;
    for (int lane = 0; lane < WIDTH; lane++) met |= bvh_boxes(ray, end, node + lane) ? 1u << lane : 0;
    return met;
#endif
}

// Whether the ray meets any triangle of a leaf.
BVH_INLINE int bvh_leaf_any(const bvh_ray *ray, global const real *leaf) {
    bvh_reals t, u, v, det;
#ifdef VECTOR_VARIANT
    return bvh_lanes(bvh_triangles(ray, ray->end, leaf, &t, &u, &v, &det)) != 0;
#else
    for (int lane = 0; lane < WIDTH; lane++)
        if (bvh_triangles(ray, ray->end, leaf + lane, &t, &u, &v, &det)) return 1;
    return 0;
#endif
}

// Takes the hit of a lane if it is nearer.
BVH_INLINE void bvh_take(real t, real u, real v, real det, int triangle, bvh_hit *hit) {
    const real per = (real)1 / det;
    if (t * per < hit->t) *hit = (bvh_hit){t * per, u * per, v * per, triangle};
}

BVH_INLINE void bvh_leaf_closest(const bvh_ray *ray, global const real *leaf, global const int *triangles,
                                 bvh_hit *hit) {
    bvh_reals t, u, v, det;
#ifdef VECTOR_VARIANT
    uint met = bvh_lanes(bvh_triangles(ray, hit->t, leaf, &t, &u, &v, &det));
    if (!met) return;
    real ts[WIDTH], us[WIDTH], vs[WIDTH], dets[WIDTH];
    *(bvh_reals_at *)ts = t, *(bvh_reals_at *)us = u, *(bvh_reals_at *)vs = v, *(bvh_reals_at *)dets = det;
    for (; met; met &= met - 1) {
        const int lane = bvh_lowest(met);
        bvh_take(ts[lane], us[lane], vs[lane], dets[lane], triangles[lane], hit);
    }
#else
    for (int lane = 0; lane < WIDTH; lane++)
        if (bvh_triangles(ray, hit->t, leaf + lane, &t, &u, &v, &det)) bvh_take(t, u, v, det, triangles[lane], hit);
#endif
}

// The next child of those met; they lie in order along the node's own axis.
BVH_INLINE int bvh_next(const bvh_ray *ray, int axis, uint met) {
    const real per = axis == 0 ? ray->per_x : axis == 1 ? ray->per_y : ray->per_z;
    return per < 0 ? 31 - (int)clz(met) : bvh_lowest(met);
}

// Whether the ray meets any triangle.
BVH_INLINE int bvh_any(const bvh_tree *tree, const bvh_ray *ray) {
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    int node = 0, depth = 0;
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
            if (bvh_leaf_any(ray, tree->leaves + (size_t)~child * (9 * WIDTH))) return 1;
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

// The nearest triangle that the ray meets, or NO_HIT.
BVH_INLINE bvh_hit bvh_closest(const bvh_tree *tree, const bvh_ray *ray) {
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    bvh_hit hit = {ray->end, REAL_NAN, REAL_NAN, NO_HIT};
    int node = 0, depth = 0;
    uint met = bvh_met(ray, ray->end, tree->nodes);
    while (true) {
        if (!met) {
            if (!depth) return hit;
            node = nodes[--depth];
            // A hit since may lie before what was left.
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
