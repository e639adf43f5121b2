// The convex hull of two boxes against the tree of kernels/common/bvh.h: at the part t of the way from one to the other the
// hull is a box again, whose sides move evenly. So a third box meets it if six straight lines in t leave an interval.
#ifndef SHAFT_H
#define SHAFT_H
#include "common/bvh.h"

#define SHAFT_SLACK ((real)16 * (real)REAL_EPSILON)

typedef struct {
    real low[3], per_low[3], high[3], per_high[3];
} shaft;

inline shaft shaft_of(const real *low, const real *high, const real *to_low, const real *to_high, real pad) {
    shaft hull;
    for (int k = 0; k < 3; k++) {
        hull.low[k] = low[k] - pad, hull.high[k] = high[k] + pad;
        hull.per_low[k] = bvh_per(to_low[k] - low[k]);
        hull.per_high[k] = bvh_per(to_high[k] - high[k]);
    }
    return hull;
}

// Narrows (first, last) to where the hull's box overlaps along one axis.
BVH_INLINE void shaft_narrow(const shaft *hull, int axis, bvh_reals low, bvh_reals high, bvh_reals *first,
                             bvh_reals *last) {
    const bvh_reals under = (high - hull->low[axis]) * hull->per_low[axis];
    const bvh_reals over = (low - hull->high[axis]) * hull->per_high[axis];
    if (hull->per_low[axis] > 0) *last = bvh_min(*last, under);
    else *first = bvh_max(*first, under);
    if (hull->per_high[axis] > 0) *first = bvh_max(*first, over);
    else *last = bvh_min(*last, over);
}

BVH_INLINE bvh_masks shaft_node(const shaft *hull, global const real *node) {
    bvh_reals first = (bvh_reals)0, last = (bvh_reals)1;
    for (int axis = 0; axis < 3; axis++)
        shaft_narrow(hull, axis, BVH_LOAD(node + axis * WIDTH), BVH_LOAD(node + (3 + axis) * WIDTH), &first, &last);
    return BVH_MASK(first <= last + SHAFT_SLACK);
}

BVH_INLINE bvh_masks shaft_leaf(const shaft *hull, global const real *leaf) {
    bvh_reals first = (bvh_reals)0, last = (bvh_reals)1;
    for (int axis = 0; axis < 3; axis++) {
        const bvh_reals a = BVH_LOAD(leaf + axis * WIDTH), b = BVH_LOAD(leaf + (3 + axis) * WIDTH);
        const bvh_reals c = BVH_LOAD(leaf + (6 + axis) * WIDTH);
        shaft_narrow(hull, axis, bvh_min(a, bvh_min(b, c)), bvh_max(a, bvh_max(b, c)), &first, &last);
    }
    return BVH_MASK(first <= last + SHAFT_SLACK);
}

#endif
