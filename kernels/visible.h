// What of a segment is seen from a point: exactly, by intervals. The plane through both cuts every triangle in its way
// along a line, and what lies behind that line, seen from the point, is hidden. One walk through the tree of bvh.h
// finds them all, 16 boxes or 16 triangles at once.
//
// In the plane a place has two coordinates, from the point: `deep`, towards the segment's line, and `along`, such that
// along / deep is where on the segment (0 at its start, 1 at its end) the place is seen. A cut between two corners is
// always made from the corner before the plane to the one behind it, so that two triangles at an edge they share leave
// no slit.
#ifndef VISIBLE_H
#define VISIBLE_H

#include "bvh.h"

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

// Sets the first two halves: what is seen between two places of the segment. And what is around it.
BVH_INLINE void view_set_window(view *view, real from, real to) {
    view->from = from, view->to = to;
    view->halves[0] = view_half_of(view, view->along_x - from * view->deep_x, view->along_y - from * view->deep_y,
                                   view->along_z - from * view->deep_z, 0);
    view->halves[1] = view_half_of(view, to * view->deep_x - view->along_x, to * view->deep_y - view->along_y,
                                   to * view->deep_z - view->along_z, 0);
#define VIEW_AROUND(x)                                                                                                 \
    const real first_##x = view->start_##x + from * view->step_##x, last_##x = view->start_##x + to * view->step_##x;  \
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
#ifdef STRIP
    return bvh_lanes(view_boxes(view, node));
#else
    uint met = 0;
    for (int lane = 0; lane < WIDTH; lane++) met |= view_boxes(view, node + lane) ? 1u << lane : 0;
    return met;
#endif
}

// Whether any lane is set. (An or over comparisons is one instruction, where the compiler sees that it is one.)
#if !defined(STRIP)
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

// The two ends of the line along which the plane cuts a triangle; returns which triangles it cuts.
BVH_INLINE bvh_masks view_lines(const view *view, global const real *leaf, bvh_reals *deep, bvh_reals *along) {
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
    deep[0] = bvh_fma(share_2, step_deep_2, before ? deep_1 : deep_2);
    deep[1] = bvh_fma(share_3, step_deep_3, before ? deep_1 : deep_3);
    along[0] = bvh_fma(share_2, step_along_2, before ? along_1 : along_2);
    along[1] = bvh_fma(share_3, step_along_3, before ? along_1 : along_3);
    return apart;
}

// Which triangles hide something, and from where to where on the segment.
BVH_INLINE bvh_masks view_triangles(const view *view, global const real *leaf, bvh_reals *low, bvh_reals *high) {
    bvh_reals deep[2], along[2];
    const bvh_masks cut = view_lines(view, leaf, deep, along);
    if (!view_any(cut)) return cut;
    const bvh_reals zero = (bvh_reals)0;
    const bvh_reals deep1 = deep[0], deep2 = deep[1], along1 = along[0], along2 = along[1];
    // Whether what lies between is in the window, before the segment's surface, before the point, above its surface.
    const bvh_reals far1 = view->far - deep1, far2 = view->far - deep2;
    const bvh_reals near1 = deep1 - view->near, near2 = deep2 - view->near;
    const bvh_reals lift1 = view->lift_deep * deep1 + view->lift_along * along1 - view->lift;
    const bvh_reals lift2 = view->lift_deep * deep2 + view->lift_along * along2 - view->lift;
#define VIEW_OUT(name)                                                                                                 \
    const bvh_masks out_##name##1 = BVH_MASK(name##1 < zero), out_##name##2 = BVH_MASK(name##2 < zero)
    VIEW_OUT(far);
    VIEW_OUT(near);
    VIEW_OUT(lift);
#undef VIEW_OUT
    bvh_masks hides = cut & ~((out_far1 & out_far2) | (out_near1 & out_near2) | (out_lift1 & out_lift2));
    hides &= BVH_MASK(along1 >= view->from * deep1) | BVH_MASK(along2 >= view->from * deep2);
    hides &= BVH_MASK(along1 <= view->to * deep1) | BVH_MASK(along2 <= view->to * deep2);
    if (!view_any(hides)) return hides;
    bvh_reals enter = zero, leave = (bvh_reals)1;
    if (view_any(hides & (out_far1 | out_far2 | out_near1 | out_near2 | out_lift1 | out_lift2))) {
        view_cut(far1, far2, &enter, &leave);
        view_cut(near1, near2, &enter, &leave);
        view_cut(lift1, lift2, &enter, &leave);
        hides &= BVH_MASK(enter < leave);
    }
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

// Finds what is hidden; stops when all is, or when more than can be kept is. Looks first into the leaf that hid all
// from the last point: it often does again.
BVH_INLINE void view_trace(const bvh_tree *tree, view *view, hidden *all, int *hint) {
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    int node = 0, depth = 0, is_begun = 0, child = *hint;
    uint met = 0;
    view->from = all->from, view->to = all->to;
    while (true) {
        if (child < 0) {
            view_leaf(view, tree->leaves + (size_t)~child * (9 * WIDTH), all);
            if (all->is_full || all->from >= all->to) {
                *hint = child;
                return;
            }
        } else if (is_begun) {
            node = child;
            met = view_met(view, tree->nodes + (size_t)node * (6 * WIDTH));
        }
        if (!met) {
            if (depth) {
                node = nodes[--depth];
                met = left[depth];
            } else {
                if (is_begun) return;
                is_begun = 1;
                view_set_window(view, all->from, all->to);
                child = 0;
                continue;
            }
        }
        child = tree->children[node * WIDTH + bvh_lowest(met)];
        met &= met - 1;
        if (child >= 0 && met) {
            nodes[depth] = node;
            left[depth++] = met;
            met = 0;
        }
    }
}

#endif
