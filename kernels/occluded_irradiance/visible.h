// Visible part of a segment from a point: exact, as intervals of the segment.
//
// The plane through the point and the segment cuts every occluding triangle along a line. The part of the segment behind
// that line is hidden. One traversal of the tree (common/bvh.h) finds all such lines, 16 boxes or 16 triangles at once.
//
// Coordinates in the plane, relative to the point: `deep` towards the segment's line, and `along`, such that along / deep
// is the position on the segment (0 at its start, 1 at its end) at which the ray through a place arrives. Only the
// ratio matters: both may be scaled by a common factor, so the cut between two corners needs no division. The cut of an
// edge is bit-equal for both triangles that share the edge: adjacent triangles leave no gap.
#ifndef VISIBLE_H
#define VISIBLE_H

#include "common/bvh.h"

#define VIEW_HALVES 6 // half-spaces that bound the view: start and end of the window, both sides of the plane, both surfaces
// Capacity for hidden intervals. A segment with more of them is traced in halves, down to this fraction of its length.
#define MAX_HIDDEN 32
#define SMALLEST_WINDOW ((real)0.0001)
// Smallest gap between two hidden intervals; smaller gaps are rounding.
#define SMALLEST_GAP ((real)4 * (real)REAL_EPSILON)
// Numbers of a row of bvh_tree.parts (ConvexParts.table in gpuvision/simulation/scene/convex_parts.py): lower corner of the
// box, 0, upper corner, 0; apex, axis and squared sine of the cone, 0.
#define PART_ROW 16

// Half-space x X + y Y + z Z >= least; at_x, at_y, at_z: offsets in a node of the box corner farthest along (x, y, z).
typedef struct {
    real x, y, z, least;
    int at_x, at_y, at_z;
} view_half;

typedef struct {
    real x, y, z;                                     // point
    real across_x, across_y, across_z;                // unit normal of the plane
    real deep_x, deep_y, deep_z;                      // unit vector from the point towards the segment's line
    real along_x, along_y, along_z;                   // along the segment, scaled so that along / deep runs from 0 to 1
    real near, far;                                   // occluders lie at depths between these
    real lift_deep, lift_along, lift;                 // and where lift_deep deep + lift_along along > lift
    real start_x, start_y, start_z;                   // start of the segment
    real step_x, step_y, step_z;                      // from its start to its end
    real from, to;                                    // window: part of the segment that is searched
    real low_x, low_y, low_z, high_x, high_y, high_z; // bounding box of the point and the window
    view_half halves[VIEW_HALVES];                    // occluders reach into all of these
#ifdef CONVEX_PARTS
    real above;                                       // x X + y Y + z Z of halves[5] from which a place is surely in it
#endif
} view;

// Hidden intervals in local memory, in groups of HIDDEN_GROUP items: number n of an item is HIDDEN_GROUP numbers after
// number n - 1, so that the items of a warp access different banks. Otherwise they lie in private memory.
#ifdef HIDDEN_GROUP
#define HIDDEN_AT(n) ((n) * HIDDEN_GROUP)
typedef local real *hidden_numbers;
#else
#define HIDDEN_AT(n) (n)
typedef real hidden_numbers[MAX_HIDDEN];
#endif

// Part [from, to] of the segment that is not hidden at its ends, and the hidden intervals inside it (disjoint, unsorted).
typedef struct {
    real from, to;
    int count, is_full;
    hidden_numbers low, high;
} hidden;

INLINE view_half view_half_of(const view *view, real x, real y, real z, real beyond) {
    const real size = fabs(x) + fabs(y) + fabs(z);
    const real reach = fmax(fabs(view->x), fmax(fabs(view->y), fabs(view->z)));
    view_half half_space;
    half_space.x = x, half_space.y = y, half_space.z = z;
    // Rounding that the widening of the boxes does not cover.
    half_space.least = x * view->x + y * view->y + z * view->z + beyond - (real)4 * (real)REAL_EPSILON * size * reach;
    half_space.at_x = x < 0 ? 0 : 3 * WIDTH;
    half_space.at_y = (y < 0 ? 0 : 3 * WIDTH) + WIDTH;
    half_space.at_z = (z < 0 ? 0 : 3 * WIDTH) + 2 * WIDTH;
    return half_space;
}

// Set the first two half-spaces: rays to places between `from` and `to` of the segment.
INLINE void view_set_window(view *view, real from, real to) {
    view->from = from, view->to = to;
    view->halves[0] = view_half_of(view, view->along_x - from * view->deep_x, view->along_y - from * view->deep_y,
                                   view->along_z - from * view->deep_z, 0);
    view->halves[1] = view_half_of(view, to * view->deep_x - view->along_x, to * view->deep_y - view->along_y,
                                   to * view->deep_z - view->along_z, 0);
}

// Smallest interval that holds the point and both ends of the window on one axis, widened by rounding.
INLINE void view_interval(real point, real start, real step, real from, real to, real *low, real *high) {
    const real first = start + from * step, last = start + to * step;
    const real slack = (real)4 * (real)REAL_EPSILON * (fabs(first) + fabs(last) + fabs(point));
    *low = fmin(point, fmin(first, last)) - slack;
    *high = fmax(point, fmax(first, last)) + slack;
}

// Set the bounding box of the point and the window.
INLINE void view_set_box(view *view) {
    view_interval(view->x, view->start_x, view->step_x, view->from, view->to, &view->low_x, &view->high_x);
    view_interval(view->y, view->start_y, view->step_y, view->from, view->to, &view->low_y, &view->high_y);
    view_interval(view->z, view->start_z, view->step_z, view->from, view->to, &view->low_z, &view->high_z);
}

// Set the next two half-spaces: both sides of the plane.
INLINE void view_set_plane(view *view) {
    view->halves[2] = view_half_of(view, view->across_x, view->across_y, view->across_z, 0);
    view->halves[3] = view_half_of(view, -view->across_x, -view->across_y, -view->across_z, 0);
}

// Largest depth of a box in a half-space.
INLINE reals view_reach(const view_half *half_space, global const real *node) {
    const reals x = half_space->x, y = half_space->y, z = half_space->z;
    return lane_fma(x, load_reals(node + half_space->at_x),
                   lane_fma(y, load_reals(node + half_space->at_y),
                           lane_fma(z, load_reals(node + half_space->at_z), -(reals)half_space->least)));
}

// Boxes that reach into all half-spaces. The box of a missing child is inverted and fails.
INLINE masks view_boxes(const view *view, global const real *node) {
    const view_half *all = view->halves;
    const reals window = lane_min(view_reach(all, node), view_reach(all + 1, node));
    const reals plane = lane_min(view_reach(all + 2, node), view_reach(all + 3, node));
    const reals beyond = lane_min(view_reach(all + 4, node), view_reach(all + 5, node));
    const masks around =
        mask_of(load_reals(node) <= view->high_x) & mask_of(load_reals(node + WIDTH) <= view->high_y) &
        mask_of(load_reals(node + 2 * WIDTH) <= view->high_z) & mask_of(load_reals(node + 3 * WIDTH) >= view->low_x) &
        mask_of(load_reals(node + 4 * WIDTH) >= view->low_y) & mask_of(load_reals(node + 5 * WIDTH) >= view->low_z);
    return around & mask_of(lane_min(lane_min(window, plane), beyond) >= (reals)0);
}

INLINE uint view_met(const view *view, global const real *node) {
#ifdef VECTOR_VARIANT
    return lane_bits(view_boxes(view, node));
#else
    uint met = 0;
    for (int lane = 0; lane < WIDTH; lane++) met |= view_boxes(view, node + lane) ? 1u << lane : 0;
    return met;
#endif
}

// Clip the interval [enter, leave] of a line to where a linear function, v1 at its start and v2 at its end, is positive.
INLINE void view_cut(reals v1, reals v2, reals *enter, reals *leave) {
    const reals cut = v1 / (v1 - v2);
    *enter = v1 < (reals)0 ? lane_max(*enter, cut) : *enter;
    *leave = v2 < (reals)0 ? lane_min(*leave, cut) : *leave;
}

// Interpolate between two corners on either side of the plane, times the sum of their distances from it (no division).
// Adjacent triangles pass the corners of their common edge in either order and must get equal bits. A compiler that
// contracts one of two products into their sum would round the sum differently in the other order, and not all compilers
// obey FP_CONTRACT. Here each product is an explicit fma with `zero`, a zero that the compiler does not know: both products
// are rounded before they are added, and nothing is left to contract.
INLINE reals view_mix(reals one, reals off_one, reals two, reals off_two, reals zero) {
    return lane_fma(one, off_two, zero) + lane_fma(two, off_one, zero);
}

// Dot product of one vector with LANES vectors, by fused multiply-adds.
INLINE reals lane_dot(real x, real y, real z, reals px, reals py, reals pz) {
    return lane_fma((reals)x, px, lane_fma((reals)y, py, (reals)z * pz));
}

// Ends of the line along which the plane cuts each triangle, times a positive weight. Returns the triangles that are cut.
INLINE masks view_lines(const view *view, global const real *leaf, reals *deep, reals *along,
                                reals *weight) {
    const reals zero = (reals)0;
    const reals x = view->x, y = view->y, z = view->z;
    const reals ax = load_reals(leaf) - x, ay = load_reals(leaf + WIDTH) - y, az = load_reals(leaf + 2 * WIDTH) - z;
    const reals bx = load_reals(leaf + 3 * WIDTH) - x, by = load_reals(leaf + 4 * WIDTH) - y;
    const reals bz = load_reals(leaf + 5 * WIDTH) - z;
    const reals cx = load_reals(leaf + 6 * WIDTH) - x, cy = load_reals(leaf + 7 * WIDTH) - y;
    const reals cz = load_reals(leaf + 8 * WIDTH) - z;
    const reals off_a = lane_dot(view->across_x, view->across_y, view->across_z, ax, ay, az), off_b = lane_dot(view->across_x, view->across_y, view->across_z, bx, by, bz), off_c = lane_dot(view->across_x, view->across_y, view->across_z, cx, cy, cz);
    const masks behind_a = mask_of(off_a < zero), behind_b = mask_of(off_b < zero);
    const masks behind_c = mask_of(off_c < zero);
    const masks cuts_ab = behind_a ^ behind_b, cuts_ca = behind_a ^ behind_c, apart = cuts_ab | cuts_ca;
    const reals deep_a = lane_dot(view->deep_x, view->deep_y, view->deep_z, ax, ay, az), deep_b = lane_dot(view->deep_x, view->deep_y, view->deep_z, bx, by, bz), deep_c = lane_dot(view->deep_x, view->deep_y, view->deep_z, cx, cy, cz);
    const reals along_a = lane_dot(view->along_x, view->along_y, view->along_z, ax, ay, az), along_b = lane_dot(view->along_x, view->along_y, view->along_z, bx, by, bz), along_c = lane_dot(view->along_x, view->along_y, view->along_z, cx, cy, cz);
    const reals far_a = fabs(off_a), far_b = fabs(off_b), far_c = fabs(off_c);
    const reals unknown_zero = view->from - view->from; // no constant: the difference of NaN is NaN
    // Exactly two of the three edges are cut: one that ends at corner b, one that ends at corner c.
    const reals deep_to_b = cuts_ab ? deep_a : deep_c, deep_to_c = cuts_ca ? deep_a : deep_b;
    const reals along_to_b = cuts_ab ? along_a : along_c, along_to_c = cuts_ca ? along_a : along_b;
    const reals far_to_b = cuts_ab ? far_a : far_c, far_to_c = cuts_ca ? far_a : far_b;
    deep[0] = view_mix(deep_b, far_b, deep_to_b, far_to_b, unknown_zero);
    deep[1] = view_mix(deep_c, far_c, deep_to_c, far_to_c, unknown_zero);
    along[0] = view_mix(along_b, far_b, along_to_b, far_to_b, unknown_zero);
    along[1] = view_mix(along_c, far_c, along_to_c, far_to_c, unknown_zero);
    weight[0] = far_b + far_to_b;
    weight[1] = far_c + far_to_c;
    return apart;
}

// Interval of the segment hidden by each triangle of a leaf; empty where low > high.
typedef struct {
    reals low, high;
} shadows;

#ifdef VECTOR_VARIANT
// Merge the shadows of neighbouring lanes (2n, 2n + 1) where they touch: the two triangles of a quadrangle often do. Lane
// 2n gets both shadows, lane 2n + 1 an empty one.
INLINE void shadows_join(shadows *cast) {
    const masks is_even = {-1, 0, -1, 0, -1, 0, -1, 0, -1, 0, -1, 0, -1, 0, -1, 0};
    const reals low = cast->low, high = cast->high;
    const reals other_low = low.s1032547698badcfe, other_high = high.s1032547698badcfe;
    const masks joins = mask_of(low <= other_high + SMALLEST_GAP) & mask_of(other_low <= high + SMALLEST_GAP);
    cast->low = joins ? lane_min(low, other_low) : low;
    cast->high = joins & ~is_even ? cast->low : joins ? lane_max(high, other_high) : high;
}
#endif

INLINE void view_shadows(const view *view, global const real *leaf, shadows *cast) {
    reals deep[2], along[2], weight[2];
    masks hides = view_lines(view, leaf, deep, along, weight);
    const reals zero = (reals)0;
    reals deep1 = deep[0], deep2 = deep[1], along1 = along[0], along2 = along[1];
    const reals weight1 = weight[0], weight2 = weight[1];
    // Keep triangles with a part before the segment's surface, beyond the near limit, above the receiver.
    reals far1 = view->far * weight1 - deep1, far2 = view->far * weight2 - deep2;
    const reals near1 = deep1 - view->near * weight1, near2 = deep2 - view->near * weight2;
    const reals lift1 = view->lift_deep * deep1 + view->lift_along * along1 - view->lift * weight1;
    const reals lift2 = view->lift_deep * deep2 + view->lift_along * along2 - view->lift * weight2;
    hides &= mask_of(lane_max(far1, far2) >= zero) & mask_of(lane_max(near1, near2) >= zero) &
             mask_of(lane_max(lift1, lift2) >= zero);
    cast->low = (reals)1, cast->high = zero;
#ifndef VECTOR_VARIANT
    // A work-item saves the cuts of a triangle that is out of the window. Few vectors have no triangle in the window.
    hides &= mask_of(along1 >= view->from * deep1) | mask_of(along2 >= view->from * deep2);
    hides &= mask_of(along1 <= view->to * deep1) | mask_of(along2 <= view->to * deep2);
    if (!hides) return;
#endif
    const reals least = lane_min(lane_min(near1, near2), lane_min(lift1, lift2));
    if (any_compared(hides & mask_of(least < zero))) {
        reals enter = zero, leave = (reals)1;
        view_cut(near1, near2, &enter, &leave);
        view_cut(lift1, lift2, &enter, &leave);
        const masks is_cut1 = mask_of(enter > zero), is_cut2 = mask_of(leave < (reals)1);
        const reals step_deep = deep2 - deep1, step_along = along2 - along1, step_far = far2 - far1;
        // The part of the triangle's line between both cuts. Rounding can place a cut slightly before the near limit.
        const reals nearest = view->near * lane_min(weight1, weight2);
        deep2 = lane_max(is_cut2 ? lane_fma(leave, step_deep, deep1) : deep2, nearest);
        along2 = is_cut2 ? lane_fma(leave, step_along, along1) : along2;
        far2 = is_cut2 ? lane_fma(leave, step_far, far1) : far2;
        deep1 = lane_max(is_cut1 ? lane_fma(enter, step_deep, deep1) : deep1, nearest);
        along1 = is_cut1 ? lane_fma(enter, step_along, along1) : along1;
        far1 = is_cut1 ? lane_fma(enter, step_far, far1) : far1;
        hides &= mask_of(enter < leave) & mask_of(lane_max(far1, far2) >= zero);
    }
    // Cut at the far limit, where far1 + t (far2 - far1) = 0, times |far1| + |far2|: no division, whose latency delays the
    // divisions below (2 to 4 % of the time of a profile). These products of four lengths must not underflow: coordinates
    // of a micrometre and a limit of a micrometre [m] give 1e-24, in single precision 1e-38 is the least.
    const masks beyond1 = mask_of(far1 < zero), beyond2 = mask_of(far2 < zero);
    const reals share1 = fabs(far2), share2 = fabs(far1);
    const reals cut_deep = lane_fma(share1, deep1, share2 * deep2), cut_along = lane_fma(share1, along1, share2 * along2);
    const reals first = (beyond1 ? cut_along : along1) / (beyond1 ? cut_deep : deep1);
    const reals last = (beyond2 ? cut_along : along2) / (beyond2 ? cut_deep : deep2);
    cast->low = hides ? lane_min(first, last) : cast->low, cast->high = hides ? lane_max(first, last) : cast->high;
}

INLINE void hidden_begin(hidden *all, real from, real to) {
    all->from = from, all->to = to;
    all->count = 0, all->is_full = 0;
}

// Add [low, high] to the hidden intervals. These are disjoint, so one pass merges every interval that it touches.
INLINE void hidden_add(hidden *all, real low, real high) {
    if (!(low < high && low < all->to && high > all->from)) return;
    for (int n = 0; n < all->count;) {
        if (low <= all->high[HIDDEN_AT(n)] + SMALLEST_GAP && all->low[HIDDEN_AT(n)] <= high + SMALLEST_GAP) {
            low = fmin(low, all->low[HIDDEN_AT(n)]), high = fmax(high, all->high[HIDDEN_AT(n)]);
            all->count--;
            all->low[HIDDEN_AT(n)] = all->low[HIDDEN_AT(all->count)], all->high[HIDDEN_AT(n)] = all->high[HIDDEN_AT(all->count)];
        } else n++;
    }
    const int at_start = low <= all->from + SMALLEST_GAP, at_end = high >= all->to - SMALLEST_GAP;
    if (at_start && at_end) all->from = all->to;
    else if (at_start) all->from = high;
    else if (at_end) all->to = low;
    else if (all->count == MAX_HIDDEN) all->is_full = 1;
    else {
        all->low[HIDDEN_AT(all->count)] = low, all->high[HIDDEN_AT(all->count)] = high;
        all->count++;
    }
}

// Sort the hidden intervals along the segment (insertion sort: few, nearly sorted).
INLINE void hidden_sort(hidden *all) {
    for (int n = 1; n < all->count; n++) {
        const real low = all->low[HIDDEN_AT(n)], high = all->high[HIDDEN_AT(n)];
        int at = n;
        for (; at > 0 && all->low[HIDDEN_AT(at - 1)] > low; at--) {
            all->low[HIDDEN_AT(at)] = all->low[HIDDEN_AT(at - 1)], all->high[HIDDEN_AT(at)] = all->high[HIDDEN_AT(at - 1)];
        }
        all->low[HIDDEN_AT(at)] = low, all->high[HIDDEN_AT(at)] = high;
    }
}

INLINE int hidden_is_done(const hidden *all) { return all->is_full || all->from >= all->to; }

// Add the shadows of a leaf. The vector variant first merges those of neighbouring lanes, which are mostly neighbouring
// triangles: fewer intervals are then merged with the list.
INLINE void hidden_add_all(hidden *all, const shadows *cast) {
    const reals low = cast->low, high = cast->high;
    masks hides = mask_of(low < high) & mask_of(low < all->to) & mask_of(high > all->from);
#ifdef VECTOR_VARIANT
    const real *lows = (const real *)&cast->low, *highs = (const real *)&cast->high;
    uint left = lane_bits(hides);
    if (!left) return;
    real first = lows[lowest_bit(left)], last = highs[lowest_bit(left)];
    while (left &= left - 1) {
        const real next = lows[lowest_bit(left)], end = highs[lowest_bit(left)];
        if (next <= last + SMALLEST_GAP && first <= end + SMALLEST_GAP) first = fmin(first, next), last = fmax(last, end);
        else {
            hidden_add(all, first, last);
            first = next, last = end;
        }
    }
    hidden_add(all, first, last);
#else
    for (int n = 0; n < all->count; n++) hides &= mask_of(low < all->low[HIDDEN_AT(n)]) | mask_of(high > all->high[HIDDEN_AT(n)]);
    if (hides) hidden_add(all, low, high);
#endif
}

#ifdef CONVEX_PARTS
// Smallest of the lanes, by halves.
INLINE real least_lane(reals v) {
    const real8 half_of_it = v.lo < v.hi ? v.lo : v.hi;
    const real4 quarter = half_of_it.lo < half_of_it.hi ? half_of_it.lo : half_of_it.hi;
    const real even = quarter.x < quarter.z ? quarter.x : quarter.z, odd = quarter.y < quarter.w ? quarter.y : quarter.w;
    return even < odd ? even : odd;
}

// Smallest x p for p from low to high.
INLINE real least_product(real x, real low, real high) {
    const real one = x * low, other = x * high;
    return one < other ? one : other;
}

// Whether the convex part of a leaf lies above the receiver's surface. `part`: row of the leaf in bvh_tree.parts, with the
// box around the part; it is infinite for a leaf whose triangles do not all belong to one convex part.
INLINE int view_part_is_above(const view *view, global const real *part) {
    const view_half *surface = view->halves + 5;
    return least_product(surface->x, part[0], part[4]) + least_product(surface->y, part[1], part[5]) +
               least_product(surface->z, part[2], part[6]) >=
           view->above;
}

// Whether the point lies in the cone from which all triangles of a leaf of a convex part face away.
INLINE int view_is_behind(const view *view, global const real *part) {
    const real x = part[8] - view->x, y = part[9] - view->y, z = part[10] - view->z;
    const real along = x * part[11] + y * part[12] + z * part[13];
    return along > 0 && along * along >= part[14] * (x * x + y * y + z * z);
}
#endif

// Add the shadows of the leaves among a node's children. Returns the children that are nodes.
//
// CONVEX_PARTS (vector variant): a convex solid above the receiver's surface is seen from outside. It hides one interval,
// and each ray that meets it enters through a triangle that faces the point, above the receiver's surface. So leaves of its
// surface whose triangles all face away are left out, and the shadows of another leaf are added as one interval from the
// smallest low to the largest high: the solid hides all between them. Merging single shadows takes as long as their
// arithmetic, because its branches depend on the data.
INLINE uint view_leaves(const bvh_tree *tree, const view *view, int node, uint met, hidden *all) {
    global const int *children = tree->children + node * WIDTH;
#ifdef VECTOR_VARIANT
    const uint leaves = met & lane_bits(to_masks(*(global const ints_at *)children < 0));
    // Compute all shadows before any is merged: merging branches on the data and would stall the arithmetic of the next.
    shadows single[WIDTH];
    int single_count = 0;
#ifdef CONVEX_PARTS
    real low[WIDTH], high[WIDTH];
    int part_count = 0;
#endif
    for (uint left = leaves; left; left &= left - 1) {
        const size_t leaf = ~children[lowest_bit(left)];
        shadows *cast = single + single_count;
#ifdef CONVEX_PARTS
        global const real *part = tree->parts + PART_ROW * leaf;
        const int is_part = view_part_is_above(view, part);
        if (is_part && view_is_behind(view, part)) continue;
#endif
        view_shadows(view, tree->leaves + leaf * (9 * WIDTH), cast);
#ifdef CONVEX_PARTS
        if (is_part) {
            low[part_count] = least_lane(cast->low), high[part_count++] = -least_lane(-cast->high);
            continue;
        }
#endif
        shadows_join(cast);
        single_count++;
    }
#ifdef CONVEX_PARTS
    for (int n = 0; n < part_count && !hidden_is_done(all); n++) hidden_add(all, low[n], high[n]);
#endif
    for (int n = 0; n < single_count && !hidden_is_done(all); n++) hidden_add_all(all, single + n);
    return met & ~leaves;
#else
    uint inner = 0;
    for (; met; met &= met - 1) {
        const int child = children[lowest_bit(met)];
        if (child >= 0) inner |= met & -met;
        else if (!hidden_is_done(all)) {
            global const real *leaf = tree->leaves + (size_t)~child * (9 * WIDTH);
            for (int lane = 0; lane < WIDTH; lane++) {
                shadows cast;
                view_shadows(view, leaf + lane, &cast);
                hidden_add_all(all, &cast);
            }
        }
    }
    return inner;
#endif
}

// Add the shadows of the leaves among a node's children that the view meets. Returns the other children that it meets.
INLINE uint view_node(const bvh_tree *tree, view *view, int node, hidden *all) {
    if (all->from > view->from || all->to < view->to) view_set_window(view, all->from, all->to);
    return view_leaves(tree, view, node, view_met(view, tree->nodes + (size_t)node * (6 * WIDTH)), all);
}

// Add the shadows of the leaves below a node.
INLINE void view_walk(const bvh_tree *tree, view *view, int node, hidden *all) {
    int nodes[BVH_DEPTH];
    uint left[BVH_DEPTH];
    int depth = 0;
    while (!hidden_is_done(all)) {
        const uint inner = view_node(tree, view, node, all);
        if (inner) nodes[depth] = node, left[depth++] = inner;
        if (!depth) return;
        const uint lane = lowest_bit(left[depth - 1]);
        node = tree->children[nodes[depth - 1] * WIDTH + lane];
        left[depth - 1] &= left[depth - 1] - 1;
        if (!left[depth - 1]) depth--;
    }
}

#ifdef VECTOR_VARIANT
// Sort a set of the root's children by the distance of their boxes' middles from the point, the nearest last. Return their
// number.
INLINE int view_order(const bvh_tree *tree, const view *view, uint set, int *order) {
    global const real *low = tree->nodes, *high = low + 3 * WIDTH;
    const reals x = load_reals(low) + load_reals(high) - (real)2 * view->x;
    const reals y = load_reals(low + WIDTH) + load_reals(high + WIDTH) - (real)2 * view->y;
    const reals z = load_reals(low + 2 * WIDTH) + load_reals(high + 2 * WIDTH) - (real)2 * view->z;
    real far[WIDTH], sorted[WIDTH];
    store_private(x * x + y * y + z * z, far);
    int count = 0;
    for (; set; set &= set - 1) {
        const int lane = lowest_bit(set);
        int at = count++;
        for (; at > 0 && sorted[at - 1] < far[lane]; at--) sorted[at] = sorted[at - 1], order[at] = order[at - 1];
        sorted[at] = far[lane], order[at] = tree->children[lane];
    }
    return count;
}
#endif

// Find the hidden intervals of the window. Stop when all of it is hidden, or when they exceed the capacity. The vector
// variant visits the root's children in the order of their distance: near triangles hide more, so that the window shrinks
// sooner, and fewer leaves are visited (a tenth less on a board with 40 parts).
INLINE void view_trace(const bvh_tree *tree, view *view, hidden *all) {
    view_set_window(view, all->from, all->to);
    view_set_box(view);
#ifdef VECTOR_VARIANT
    int order[WIDTH];
    for (int left = view_order(tree, view, view_node(tree, view, 0, all), order); left;) view_walk(tree, view, order[--left], all);
#else
    view_walk(tree, view, 0, all);
#endif
}

#endif
