// What of a segment is seen from a point: exactly, by intervals. The plane through both cuts every triangle in its way
// along a line, and what lies behind that line, seen from the point, is hidden. One walk through the tree of bvh.h
// finds them all, 16 boxes or 16 triangles at once.
//
// In the plane a place has two coordinates, from the point: `deep`, towards the segment's line, and `along`, such that
// along / deep is where on the segment (0 at its start, 1 at its end) the place is seen. So both may be multiples, and
// a cut between two corners needs no division. It comes out the same for both triangles at an edge: they leave no
// slit.
#ifndef VISIBLE_H
#define VISIBLE_H

#include "common/bvh.h"

#define VIEW_HALVES 6
// A node, where a leaf is to be.
#define NO_HINT 0
#define HIDDEN_MOST 32
// Where more than that hides parts of a segment, it is taken by halves; down to this much of it.
#define LEAST_WINDOW ((real)0.0001)
// What separates two hidden intervals at least: less is rounding.
#define HIDDEN_SLIT ((real)4 * (real)REAL_EPSILON)

// The places with x X + y Y + z Z >= least; (at_x, at_y, at_z) is where a node has the corners that go farthest.
typedef struct {
    real x, y, z, least;
    int at_x, at_y, at_z;
} view_half;

typedef struct {
    real x, y, z;                      // the point
    real across_x, across_y, across_z; // off the plane
    real deep_x, deep_y, deep_z;       // unit
    real along_x, along_y, along_z;    // of the length that makes `along` what it is
    real near, far;                    // in `deep`: what hides lies between
    real lift_deep, lift_along, lift;  // and where lift_deep deep + lift_along along > lift
    real start_x, start_y, start_z;    // of the segment
    real step_x, step_y, step_z;       // from there to its end
    real from, to;                     // the window
    real low_x, low_y, low_z, high_x, high_y, high_z; // around the point and the window
    view_half halves[VIEW_HALVES];     // it lies in all of these: window's start and end, both sides of the plane, ...
} view;

// The part [from, to] of the segment that is still of interest, and what is hidden within, apart from its ends.
typedef struct {
    real from, to;
    int count, is_full;
    real low[HIDDEN_MOST], high[HIDDEN_MOST];
} hidden;

BVH_INLINE view_half view_half_of(const view *view, real x, real y, real z, real beyond) {
    const real size = fabs(x) + fabs(y) + fabs(z);
    const real reach = fmax(fabs(view->x), fmax(fabs(view->y), fabs(view->z)));
    view_half half_space;
    half_space.x = x, half_space.y = y, half_space.z = z;
    // The roundings that boxes are not yet widened by.
    half_space.least = x * view->x + y * view->y + z * view->z + beyond - (real)4 * (real)REAL_EPSILON * size * reach;
    half_space.at_x = x < 0 ? 0 : 3 * WIDTH;
    half_space.at_y = (y < 0 ? 0 : 3 * WIDTH) + WIDTH;
    half_space.at_z = (z < 0 ? 0 : 3 * WIDTH) + 2 * WIDTH;
    return half_space;
}

// Sets the first two halves: what is seen between two places of the segment.
BVH_INLINE void view_set_window(view *view, real from, real to) {
    view->from = from, view->to = to;
    view->halves[0] = view_half_of(view, view->along_x - from * view->deep_x, view->along_y - from * view->deep_y,
                                   view->along_z - from * view->deep_z, 0);
    view->halves[1] = view_half_of(view, to * view->deep_x - view->along_x, to * view->deep_y - view->along_y,
                                   to * view->deep_z - view->along_z, 0);
}

// Sets what is around the point and the window.
BVH_INLINE void view_set_around(view *view) {
#define VIEW_AROUND(x)                                                                                                 \
    const real first_##x = view->start_##x + view->from * view->step_##x;                                              \
    const real last_##x = view->start_##x + view->to * view->step_##x;                                                 \
    const real slack_##x = (real)4 * (real)REAL_EPSILON * (fabs(first_##x) + fabs(last_##x) + fabs(view->x));         \
    view->low_##x = fmin(view->x, fmin(first_##x, last_##x)) - slack_##x;                                              \
    view->high_##x = fmax(view->x, fmax(first_##x, last_##x)) + slack_##x
    VIEW_AROUND(x);
    VIEW_AROUND(y);
    VIEW_AROUND(z);
#undef VIEW_AROUND
}

// Sets the next two: both sides of the plane.
BVH_INLINE void view_set_plane(view *view) {
    view->halves[2] = view_half_of(view, view->across_x, view->across_y, view->across_z, 0);
    view->halves[3] = view_half_of(view, -view->across_x, -view->across_y, -view->across_z, 0);
}

// How far a box reaches into a half.
BVH_INLINE bvh_reals view_reach(const view_half *half_space, global const real *node) {
    const bvh_reals x = half_space->x, y = half_space->y, z = half_space->z;
    return bvh_fma(x, BVH_LOAD(node + half_space->at_x),
                   bvh_fma(y, BVH_LOAD(node + half_space->at_y),
                           bvh_fma(z, BVH_LOAD(node + half_space->at_z), -(bvh_reals)half_space->least)));
}

// Which boxes reach into all halves; no child does, as its box is inside out.
BVH_INLINE bvh_masks view_boxes(const view *view, global const real *node) {
    const view_half *all = view->halves;
    const bvh_reals window = bvh_min(view_reach(all, node), view_reach(all + 1, node));
    const bvh_reals plane = bvh_min(view_reach(all + 2, node), view_reach(all + 3, node));
    const bvh_reals beyond = bvh_min(view_reach(all + 4, node), view_reach(all + 5, node));
    const bvh_masks around =
        BVH_MASK(BVH_LOAD(node) <= view->high_x) & BVH_MASK(BVH_LOAD(node + WIDTH) <= view->high_y) &
        BVH_MASK(BVH_LOAD(node + 2 * WIDTH) <= view->high_z) & BVH_MASK(BVH_LOAD(node + 3 * WIDTH) >= view->low_x) &
        BVH_MASK(BVH_LOAD(node + 4 * WIDTH) >= view->low_y) & BVH_MASK(BVH_LOAD(node + 5 * WIDTH) >= view->low_z);
    return around & BVH_MASK(bvh_min(bvh_min(window, plane), beyond) >= (bvh_reals)0);
}

BVH_INLINE uint view_met(const view *view, global const real *node) {
#ifdef VECTOR_VARIANT
    return bvh_lanes(view_boxes(view, node));
#else
    uint met = 0;
    for (int lane = 0; lane < WIDTH; lane++) met |= view_boxes(view, node + lane) ? 1u << lane : 0;
    return met;
#endif
}

// Whether any lane is set. (An or over comparisons is one instruction, where the compiler sees that it is one.)
#if !defined(VECTOR_VARIANT)
BVH_INLINE int view_any(bvh_masks mask) { return mask != 0; }
#elif __has_builtin(__builtin_reduce_or)
BVH_INLINE int view_any(bvh_masks mask) { return __builtin_reduce_or(mask) != 0; }
#else
BVH_INLINE int view_any(bvh_masks mask) { return bvh_lanes(mask) != 0; }
#endif

// Where a linear function is negative at both of two places nothing is left of what lies between; else it begins, or
// ends, where the function is zero.
BVH_INLINE void view_cut(bvh_reals v1, bvh_reals v2, bvh_reals *enter, bvh_reals *leave) {
    const bvh_reals cut = v1 / (v1 - v2);
    *enter = v1 < (bvh_reals)0 ? bvh_max(*enter, cut) : *enter;
    *leave = v2 < (bvh_reals)0 ? bvh_min(*leave, cut) : *leave;
}

// What a corner and one on the other side of the plane have, each times how far the other is from the plane. Both
// products are rounded, so that it is the same whichever corner comes first.
BVH_INLINE bvh_reals view_mix(bvh_reals one, bvh_reals off_one, bvh_reals two, bvh_reals off_two) {
#pragma OPENCL FP_CONTRACT OFF
    const bvh_reals first = one * off_two;
    const bvh_reals second = two * off_one;
    return first + second;
}

// The two ends of the line along which the plane cuts a triangle, each times its weight, which is positive; returns
// which triangles it cuts.
BVH_INLINE bvh_masks view_lines(const view *view, global const real *leaf, bvh_reals *deep, bvh_reals *along,
                                bvh_reals *weight) {
    const bvh_reals zero = (bvh_reals)0;
    const bvh_reals x = view->x, y = view->y, z = view->z;
    const bvh_reals ax = BVH_LOAD(leaf) - x, ay = BVH_LOAD(leaf + WIDTH) - y, az = BVH_LOAD(leaf + 2 * WIDTH) - z;
    const bvh_reals bx = BVH_LOAD(leaf + 3 * WIDTH) - x, by = BVH_LOAD(leaf + 4 * WIDTH) - y;
    const bvh_reals bz = BVH_LOAD(leaf + 5 * WIDTH) - z;
    const bvh_reals cx = BVH_LOAD(leaf + 6 * WIDTH) - x, cy = BVH_LOAD(leaf + 7 * WIDTH) - y;
    const bvh_reals cz = BVH_LOAD(leaf + 8 * WIDTH) - z;
#define VIEW_DOT(name, corner)                                                                                         \
    bvh_fma((bvh_reals)view->name##_x, corner##x,                                                                      \
            bvh_fma((bvh_reals)view->name##_y, corner##y, (bvh_reals)view->name##_z * corner##z))
    const bvh_reals off_a = VIEW_DOT(across, a), off_b = VIEW_DOT(across, b), off_c = VIEW_DOT(across, c);
    const bvh_masks behind_a = BVH_MASK(off_a < zero), behind_b = BVH_MASK(off_b < zero);
    const bvh_masks behind_c = BVH_MASK(off_c < zero);
    const bvh_masks cuts_ab = behind_a ^ behind_b, cuts_ca = behind_a ^ behind_c, apart = cuts_ab | cuts_ca;
    const bvh_reals deep_a = VIEW_DOT(deep, a), deep_b = VIEW_DOT(deep, b), deep_c = VIEW_DOT(deep, c);
    const bvh_reals along_a = VIEW_DOT(along, a), along_b = VIEW_DOT(along, b), along_c = VIEW_DOT(along, c);
#undef VIEW_DOT
    const bvh_reals far_a = fabs(off_a), far_b = fabs(off_b), far_c = fabs(off_c);
    // Two of the three edges are cut.
    const bvh_reals deep_bc = view_mix(deep_b, far_b, deep_c, far_c);
    const bvh_reals along_bc = view_mix(along_b, far_b, along_c, far_c);
    deep[0] = cuts_ab ? view_mix(deep_a, far_a, deep_b, far_b) : deep_bc;
    deep[1] = cuts_ca ? view_mix(deep_a, far_a, deep_c, far_c) : deep_bc;
    along[0] = cuts_ab ? view_mix(along_a, far_a, along_b, far_b) : along_bc;
    along[1] = cuts_ca ? view_mix(along_a, far_a, along_c, far_c) : along_bc;
    weight[0] = far_b + (cuts_ab ? far_a : far_c);
    weight[1] = far_c + (cuts_ca ? far_a : far_b);
    return apart;
}

// What each of a leaf's triangles hides of the segment, from `low` to `high`; nothing where low is above high.
typedef struct {
    bvh_reals low, high;
} shadows;

#ifdef VECTOR_VARIANT
// Joins every other shadow with the next one, where they touch: two triangles of a quadrangle often lie side by side.
BVH_INLINE void shadows_join(shadows *cast) {
    const bvh_masks is_even = {-1, 0, -1, 0, -1, 0, -1, 0, -1, 0, -1, 0, -1, 0, -1, 0};
    const bvh_reals low = cast->low, high = cast->high;
    const bvh_reals other_low = low.s1032547698badcfe, other_high = high.s1032547698badcfe;
    const bvh_masks joins = BVH_MASK(low <= other_high + HIDDEN_SLIT) & BVH_MASK(other_low <= high + HIDDEN_SLIT);
    const bvh_masks stays = joins & is_even, goes = joins & ~is_even;
    cast->low = goes ? (bvh_reals)1 : stays ? bvh_min(low, other_low) : low;
    cast->high = goes ? (bvh_reals)0 : stays ? bvh_max(high, other_high) : high;
}
#endif

BVH_INLINE void view_shadows(const view *view, global const real *leaf, shadows *cast) {
    bvh_reals deep[2], along[2], weight[2];
    bvh_masks hides = view_lines(view, leaf, deep, along, weight);
    const bvh_reals zero = (bvh_reals)0;
    const bvh_reals deep1 = deep[0], deep2 = deep[1], along1 = along[0], along2 = along[1];
    const bvh_reals weight1 = weight[0], weight2 = weight[1];
    // Whether what lies between is before the segment's surface, before the point, above its surface, in the window.
    const bvh_reals far1 = view->far * weight1 - deep1, far2 = view->far * weight2 - deep2;
    const bvh_reals near1 = deep1 - view->near * weight1, near2 = deep2 - view->near * weight2;
    const bvh_reals lift1 = view->lift_deep * deep1 + view->lift_along * along1 - view->lift * weight1;
    const bvh_reals lift2 = view->lift_deep * deep2 + view->lift_along * along2 - view->lift * weight2;
    hides &= BVH_MASK(bvh_max(far1, far2) >= zero) & BVH_MASK(bvh_max(near1, near2) >= zero) &
             BVH_MASK(bvh_max(lift1, lift2) >= zero);
    hides &= BVH_MASK(along1 >= view->from * deep1) | BVH_MASK(along2 >= view->from * deep2);
    hides &= BVH_MASK(along1 <= view->to * deep1) | BVH_MASK(along2 <= view->to * deep2);
    cast->low = (bvh_reals)1, cast->high = zero;
    if (!view_any(hides)) return;
    bvh_reals enter = zero, leave = (bvh_reals)1;
    view_cut(far1, far2, &enter, &leave);
    const bvh_reals least = bvh_min(bvh_min(near1, near2), bvh_min(lift1, lift2));
    if (view_any(hides & BVH_MASK(least < zero))) {
        view_cut(near1, near2, &enter, &leave);
        view_cut(lift1, lift2, &enter, &leave);
    }
    hides &= BVH_MASK(enter < leave);
    const bvh_masks is_cut1 = BVH_MASK(enter > zero), is_cut2 = BVH_MASK(leave < (bvh_reals)1);
    const bvh_reals step_deep = deep2 - deep1, step_along = along2 - along1;
    // By rounding a cut may come out nearer than the nearest.
    const bvh_reals nearest = view->near * bvh_min(weight1, weight2);
    const bvh_reals first = (is_cut1 ? bvh_fma(enter, step_along, along1) : along1) /
                            bvh_max(is_cut1 ? bvh_fma(enter, step_deep, deep1) : deep1, nearest);
    const bvh_reals last = (is_cut2 ? bvh_fma(leave, step_along, along1) : along2) /
                           bvh_max(is_cut2 ? bvh_fma(leave, step_deep, deep1) : deep2, nearest);
    cast->low = hides ? bvh_min(first, last) : cast->low, cast->high = hides ? bvh_max(first, last) : cast->high;
#ifdef VECTOR_VARIANT
    shadows_join(cast);
#endif
}

BVH_INLINE void hidden_begin(hidden *all, real from, real to) {
    all->from = from, all->to = to;
    all->count = 0, all->is_full = 0;
}

// Hides [low, high]. What is kept is apart from each other and from the ends: so a single pass finds all that join.
BVH_INLINE void hidden_add(hidden *all, real low, real high) {
    if (!(low < high && low < all->to && high > all->from)) return;
    for (int n = 0; n < all->count;) {
        if (low <= all->high[n] + HIDDEN_SLIT && all->low[n] <= high + HIDDEN_SLIT) {
            low = fmin(low, all->low[n]), high = fmax(high, all->high[n]);
            all->count--;
            all->low[n] = all->low[all->count], all->high[n] = all->high[all->count];
        } else n++;
    }
    const int at_start = low <= all->from + HIDDEN_SLIT, at_end = high >= all->to - HIDDEN_SLIT;
    if (at_start && at_end) all->from = all->to;
    else if (at_start) all->from = high;
    else if (at_end) all->to = low;
    else if (all->count == HIDDEN_MOST) all->is_full = 1;
    else {
        all->low[all->count] = low, all->high[all->count] = high;
        all->count++;
    }
}

// Puts them in order along the segment.
BVH_INLINE void hidden_sort(hidden *all) {
    for (int n = 1; n < all->count; n++) {
        const real low = all->low[n], high = all->high[n];
        int at = n;
        for (; at > 0 && all->low[at - 1] > low; at--) {
            all->low[at] = all->low[at - 1], all->high[at] = all->high[at - 1];
        }
        all->low[at] = low, all->high[at] = high;
    }
}

BVH_INLINE int hidden_is_done(const hidden *all) { return all->is_full || all->from >= all->to; }

// Hides what a leaf's triangles do; returns how much that is of what was not hidden yet (twice where two do).
BVH_INLINE real hidden_add_all(hidden *all, const shadows *cast) {
    const bvh_reals low = cast->low, high = cast->high;
    bvh_masks hides = BVH_MASK(low < high) & BVH_MASK(low < all->to) & BVH_MASK(high > all->from);
    for (int n = 0; n < all->count; n++) hides &= BVH_MASK(low < all->low[n]) | BVH_MASK(high > all->high[n]);
    real gone = 0;
    if (!view_any(hides)) return gone;
#ifdef VECTOR_VARIANT
    const real *lows = (const real *)&cast->low, *highs = (const real *)&cast->high;
    for (uint left = bvh_lanes(hides); left; left &= left - 1) {
        const int lane = bvh_lowest(left);
        gone += highs[lane] - lows[lane];
        hidden_add(all, lows[lane], highs[lane]);
    }
#else
    if (hides) gone = high - low, hidden_add(all, low, high);
#endif
    return gone;
}

BVH_INLINE real view_leaf(const bvh_tree *tree, const view *view, int child, hidden *all) {
    global const real *leaf = tree->leaves + (size_t)~child * (9 * WIDTH);
    shadows cast;
    real gone = 0;
#ifdef VECTOR_VARIANT
    view_shadows(view, leaf, &cast);
    gone = hidden_add_all(all, &cast);
#else
    for (int lane = 0; lane < WIDTH; lane++) {
        view_shadows(view, leaf + lane, &cast);
        gone += hidden_add_all(all, &cast);
    }
#endif
    return gone;
}

// Hides what the leaves among a node's children do, but for `known`; returns those children that are nodes. `hint`
// becomes the leaf that hides most, if that is more than `most`.
BVH_INLINE uint view_leaves(const bvh_tree *tree, const view *view, int node, uint met, int known, hidden *all,
                            real *most, int *hint) {
    uint inner = 0;
    int count = 0, leaves[WIDTH];
    for (; met; met &= met - 1) {
        const int child = tree->children[node * WIDTH + bvh_lowest(met)];
        if (child >= 0) inner |= met & -met;
        else if (child != known) leaves[count++] = child;
    }
#ifdef VECTOR_VARIANT
    // All shadows first: to look at one would hold up the next, whose arithmetic a core begins meanwhile.
    shadows cast[WIDTH];
    for (int n = 0; n < count; n++) view_shadows(view, tree->leaves + (size_t)~leaves[n] * (9 * WIDTH), cast + n);
#endif
    for (int n = 0; n < count && !hidden_is_done(all); n++) {
#ifdef VECTOR_VARIANT
        const real gone = hidden_add_all(all, cast + n);
#else
        const real gone = view_leaf(tree, view, leaves[n], all);
#endif
        if (gone > *most) *most = gone, *hint = leaves[n];
    }
    return inner;
}

// Finds what is hidden; stops when all is, or when more than can be kept is. Looks first into the leaf that hid most
// from the last point: it often does again.
BVH_INLINE void view_trace(const bvh_tree *tree, view *view, hidden *all, int *hint) {
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    int node = 0, depth = 0;
    const int known = *hint;
    real most = 0;
    view_set_window(view, all->from, all->to);
    view_set_around(view);
    if (known < 0) view_leaf(tree, view, known, all);
    while (!hidden_is_done(all)) {
        if (all->from > view->from || all->to < view->to) view_set_window(view, all->from, all->to);
        const uint met = view_met(view, tree->nodes + (size_t)node * (6 * WIDTH));
        const uint inner = view_leaves(tree, view, node, met, known, all, &most, hint);
        if (inner) nodes[depth] = node, left[depth++] = inner;
        if (!depth) return;
        const uint lane = bvh_lowest(left[depth - 1]);
        node = tree->children[nodes[depth - 1] * WIDTH + lane];
        left[depth - 1] &= left[depth - 1] - 1;
        if (!left[depth - 1]) depth--;
    }
}

#endif
