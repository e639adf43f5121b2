// Shaft culling: the convex hull of two boxes against the tree of common/bvh.h.
//
// At the fraction t between the two boxes the hull is a box whose sides are linear in t. A third box meets the hull if the
// six linear inequalities in t leave a non-empty interval.
#ifndef SHAFT_H
#define SHAFT_H
#include "common/bvh.h"

#define SHAFT_SLACK ((real)16 * (real)REAL_EPSILON)

typedef struct {
    real low[3], per_low[3], high[3], per_high[3];
} shaft;

static inline shaft shaft_of(const real *low, const real *high, const real *to_low, const real *to_high, real pad) {
    shaft hull;
    for (int k = 0; k < 3; k++) {
        hull.low[k] = low[k] - pad, hull.high[k] = high[k] + pad;
        hull.per_low[k] = bvh_reciprocal(to_low[k] - low[k]);
        hull.per_high[k] = bvh_reciprocal(to_high[k] - high[k]);
    }
    return hull;
}

// Clip the interval [first, last] of t to where the hull overlaps [low, high] along one axis.
INLINE void shaft_narrow(const shaft *hull, int axis, reals low, reals high, reals *first,
                             reals *last) {
    const reals under = (high - hull->low[axis]) * hull->per_low[axis];
    const reals over = (low - hull->high[axis]) * hull->per_high[axis];
    if (hull->per_low[axis] > 0) *last = lane_min(*last, under);
    else *first = lane_max(*first, under);
    if (hull->per_high[axis] > 0) *first = lane_max(*first, over);
    else *last = lane_min(*last, over);
}

INLINE masks shaft_node(const shaft *hull, global const real *node) {
    reals first = (reals)0, last = (reals)1;
    for (int axis = 0; axis < 3; axis++)
        shaft_narrow(hull, axis, load_reals(node + axis * WIDTH), load_reals(node + (3 + axis) * WIDTH), &first, &last);
    return mask_of(first <= last + SHAFT_SLACK);
}

INLINE masks shaft_leaf(const shaft *hull, global const real *leaf) {
    reals first = (reals)0, last = (reals)1;
    for (int axis = 0; axis < 3; axis++) {
        const reals a = load_reals(leaf + axis * WIDTH), b = load_reals(leaf + (3 + axis) * WIDTH);
        const reals c = load_reals(leaf + (6 + axis) * WIDTH);
        shaft_narrow(hull, axis, lane_min(a, lane_min(b, c)), lane_max(a, lane_max(b, c)), &first, &last);
    }
    return mask_of(first <= last + SHAFT_SLACK);
}

#endif
