// What of a segment is seen from a point: exactly, by intervals. The plane through both cuts every triangle in its way
// along a line, and what lies behind that line, seen from the point, is hidden. One walk through the tree of bvh.h finds
// them all, 16 boxes or 16 triangles at once.
//
// In the plane a place has two coordinates, from the point: `deep`, towards the segment's line, and `along`, such that
// along / deep is where on the segment (0 at its start, 1 at its end) the place is seen. A cut between two corners is
// always made from the corner before the plane to the one behind it, so that two triangles at an edge they share leave
// no slit.
#ifndef VISIBLE_H
#define VISIBLE_H

#include "bvh.h"

#define VIEW_HALVES 6
#define HIDDEN_MOST 32
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
    view->halves[0] = view_half_of(view, view->along_x - from * view->deep_x, view->along_y - from * view->deep_y,
                                   view->along_z - from * view->deep_z, 0);
    view->halves[1] = view_half_of(view, to * view->deep_x - view->along_x, to * view->deep_y - view->along_y,
                                   to * view->deep_z - view->along_z, 0);
}

// Sets the next two: both sides of the plane.
BVH_INLINE void view_set_plane(view *view) {
    view->halves[2] = view_half_of(view, view->across_x, view->across_y, view->across_z, 0);
    view->halves[3] = view_half_of(view, -view->across_x, -view->across_y, -view->across_z, 0);
}

// Which boxes reach into all halves.
BVH_INLINE bvh_masks view_boxes(const view *view, global const real *node) {
    bvh_masks met = BVH_MASK(BVH_LOAD(node) <= BVH_LOAD(node + 3 * WIDTH));
#pragma unroll
    for (int n = 0; n < VIEW_HALVES; n++) {
        const view_half *each = view->halves + n;
        met &= BVH_MASK(BVH_LOAD(node + each->at_x) * each->x + BVH_LOAD(node + each->at_y) * each->y +
                            BVH_LOAD(node + each->at_z) * each->z >=
                        (bvh_reals)each->least);
    }
    return met;
}

BVH_INLINE uint view_met(const view *view, global const real *node) {
#ifdef STRIP
    return bvh_lanes(view_boxes(view, node));
#else
    uint met = 0;
    for (int lane = 0; lane < WIDTH; lane++) met |= view_boxes(view, node + lane) ? 1u << lane : 0;
    return met;
#endif
}

#ifdef STRIP
BVH_INLINE int view_any(bvh_masks mask) { return bvh_lanes(mask) != 0; }
#else
BVH_INLINE int view_any(bvh_masks mask) { return mask != 0; }
#endif

// Cuts what lies between two places down to where a linear function is not negative; its values there are v1 and v2.
BVH_INLINE bvh_masks view_cut(bvh_reals v1, bvh_reals v2, bvh_reals *enter, bvh_reals *leave) {
    const bvh_reals zero = (bvh_reals)0;
    const bvh_masks out1 = BVH_MASK(v1 < zero), out2 = BVH_MASK(v2 < zero);
    if (view_any(out1 ^ out2)) {
        const bvh_reals cut = v1 / (v1 - v2);
        *enter = out1 ? bvh_max(*enter, cut) : *enter;
        *leave = out2 ? bvh_min(*leave, cut) : *leave;
    }
    return ~(out1 & out2);
}

// Which triangles hide something, and from where to where on the segment.
BVH_INLINE bvh_masks view_triangles(const view *view, global const real *leaf, bvh_reals *low, bvh_reals *high) {
    const bvh_reals zero = (bvh_reals)0;
    const bvh_reals x = view->x, y = view->y, z = view->z;
    const bvh_reals ax = BVH_LOAD(leaf) - x, ay = BVH_LOAD(leaf + WIDTH) - y, az = BVH_LOAD(leaf + 2 * WIDTH) - z;
    const bvh_reals bx = BVH_LOAD(leaf + 3 * WIDTH) - x, by = BVH_LOAD(leaf + 4 * WIDTH) - y;
    const bvh_reals bz = BVH_LOAD(leaf + 5 * WIDTH) - z;
    const bvh_reals cx = BVH_LOAD(leaf + 6 * WIDTH) - x, cy = BVH_LOAD(leaf + 7 * WIDTH) - y;
    const bvh_reals cz = BVH_LOAD(leaf + 8 * WIDTH) - z;
#define VIEW_DOT(name, corner)                                                                                         \
    (view->name##_x * corner##x + view->name##_y * corner##y + view->name##_z * corner##z)
    const bvh_reals off_a = VIEW_DOT(across, a), off_b = VIEW_DOT(across, b), off_c = VIEW_DOT(across, c);
    const bvh_masks behind_a = BVH_MASK(off_a < zero), behind_b = BVH_MASK(off_b < zero);
    const bvh_masks behind_c = BVH_MASK(off_c < zero);
    const bvh_masks apart = (behind_a ^ behind_b) | (behind_a ^ behind_c);
    if (!view_any(apart)) return apart;
    const bvh_reals deep_a = VIEW_DOT(deep, a), deep_b = VIEW_DOT(deep, b), deep_c = VIEW_DOT(deep, c);
    const bvh_reals along_a = VIEW_DOT(along, a), along_b = VIEW_DOT(along, b), along_c = VIEW_DOT(along, c);
#undef VIEW_DOT
    // The corner that is alone on its side, and the two others.
    const bvh_masks is_a = ~(behind_b ^ behind_c), is_b = ~(behind_a ^ behind_c);
    const bvh_reals off_1 = is_a ? off_a : is_b ? off_b : off_c, off_2 = is_a ? off_b : is_b ? off_c : off_a;
    const bvh_reals off_3 = is_a ? off_c : is_b ? off_a : off_b;
    const bvh_reals deep_1 = is_a ? deep_a : is_b ? deep_b : deep_c, deep_2 = is_a ? deep_b : is_b ? deep_c : deep_a;
    const bvh_reals deep_3 = is_a ? deep_c : is_b ? deep_a : deep_b;
    const bvh_reals along_1 = is_a ? along_a : is_b ? along_b : along_c;
    const bvh_reals along_2 = is_a ? along_b : is_b ? along_c : along_a;
    const bvh_reals along_3 = is_a ? along_c : is_b ? along_a : along_b;
    const bvh_masks before = BVH_MASK(off_1 >= zero);
    const bvh_reals share_2 = (before ? off_1 : off_2) / fabs(off_1 - off_2);
    const bvh_reals share_3 = (before ? off_1 : off_3) / fabs(off_1 - off_3);
    const bvh_reals step_deep_2 = before ? deep_2 - deep_1 : deep_1 - deep_2;
    const bvh_reals step_deep_3 = before ? deep_3 - deep_1 : deep_1 - deep_3;
    const bvh_reals step_along_2 = before ? along_2 - along_1 : along_1 - along_2;
    const bvh_reals step_along_3 = before ? along_3 - along_1 : along_1 - along_3;
    const bvh_reals deep1 = bvh_fma(share_2, step_deep_2, before ? deep_1 : deep_2);
    const bvh_reals deep2 = bvh_fma(share_3, step_deep_3, before ? deep_1 : deep_3);
    const bvh_reals along1 = bvh_fma(share_2, step_along_2, before ? along_1 : along_2);
    const bvh_reals along2 = bvh_fma(share_3, step_along_3, before ? along_1 : along_3);
    bvh_reals enter = zero, leave = (bvh_reals)1;
    bvh_masks hides = apart & view_cut(view->far - deep1, view->far - deep2, &enter, &leave);
    hides &= view_cut(deep1 - view->near, deep2 - view->near, &enter, &leave);
    hides &= view_cut(view->lift_deep * deep1 + view->lift_along * along1 - view->lift,
                      view->lift_deep * deep2 + view->lift_along * along2 - view->lift, &enter, &leave);
    hides &= BVH_MASK(enter < leave);
    if (!view_any(hides)) return hides;
    const bvh_masks is_cut1 = BVH_MASK(enter > zero), is_cut2 = BVH_MASK(leave < (bvh_reals)1);
    const bvh_reals step_deep = deep2 - deep1, step_along = along2 - along1;
    // By rounding a cut may come out nearer than the nearest.
    const bvh_reals near = (bvh_reals)view->near;
    const bvh_reals first = (is_cut1 ? bvh_fma(enter, step_along, along1) : along1) /
                            bvh_max(is_cut1 ? bvh_fma(enter, step_deep, deep1) : deep1, near);
    const bvh_reals last = (is_cut2 ? bvh_fma(leave, step_along, along1) : along2) /
                           bvh_max(is_cut2 ? bvh_fma(leave, step_deep, deep1) : deep2, near);
    *low = bvh_min(first, last), *high = bvh_max(first, last);
    return hides;
}

BVH_INLINE hidden hidden_none(real from, real to) {
    hidden none;
    none.from = from, none.to = to;
    none.count = 0, none.is_full = 0;
    return none;
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

BVH_INLINE void view_leaf(const view *view, global const real *leaf, hidden *all) {
    bvh_reals low = (bvh_reals)0, high = (bvh_reals)0;
#ifdef STRIP
    uint met = bvh_lanes(view_triangles(view, leaf, &low, &high));
    if (!met) return;
    real lows[WIDTH], highs[WIDTH];
    *(bvh_reals_at *)lows = low, *(bvh_reals_at *)highs = high;
    for (; met; met &= met - 1) {
        const int lane = bvh_lowest(met);
        hidden_add(all, lows[lane], highs[lane]);
    }
#else
    for (int lane = 0; lane < WIDTH; lane++)
        if (view_triangles(view, leaf + lane, &low, &high)) hidden_add(all, low, high);
#endif
}

// Finds what is hidden; stops when all is, or when more than can be kept is.
BVH_INLINE void view_trace(const bvh_tree *tree, view *view, hidden *all) {
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    int node = 0, depth = 0;
    view_set_window(view, all->from, all->to);
    uint met = view_met(view, tree->nodes);
    while (true) {
        if (!met) {
            if (!depth) return;
            node = nodes[--depth];
            met = left[depth];
        }
        const int lane = bvh_lowest(met);
        met &= met - 1;
        const int child = tree->children[node * WIDTH + lane];
        if (child < 0) {
            view_leaf(view, tree->leaves + (size_t)~child * (9 * WIDTH), all);
            if (all->is_full || all->from >= all->to) return;
            continue;
        }
        if (met) {
            nodes[depth] = node;
            left[depth++] = met;
        }
        node = child;
        met = view_met(view, tree->nodes + (size_t)node * (6 * WIDTH));
    }
}

#endif
