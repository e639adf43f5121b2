// Visible parts of a segment, or of a line of segments, from one receiver: by intervals (visible.h) or by shadow rays.
//
// The kernel variant defines, before it includes this file, the type `receiving` and the function that takes a visible
// part: add_seen with INTERVALS, add_part with RAYS.
#ifndef VISIBLE_PART_H
#define VISIBLE_PART_H
#include "occluded_irradiance/segment_view.h"

#ifdef INTERVALS
// Pass the visible parts to add_seen. Returns 0 if the hidden intervals exceed the capacity even in the smallest window:
// the result is then incomplete (AMBIGUOUS).
static inline int add_visible(const bvh_tree *tree, const placement *from, view *v, hidden *dark, receiving *to) {
    // Part above the receiver's plane, widened by rounding; the closed form cuts it exactly.
    const real toward = from->toward, toward_end = from->toward_end;
    const real slack = (real)8 * (real)REAL_EPSILON, horizon = toward / (toward - toward_end);
    const real begin = toward < 0 ? fmax(horizon - slack, (real)0) : 0;
    const real end = toward_end < 0 ? fmin(horizon + slack, (real)1) : 1;
    int is_whole = 1;
    real low = begin, high = end;
    while (low < end) {
        hidden_begin(dark, low, high);
        view_trace(tree, v, dark);
        if (dark->is_full && high - low > SMALLEST_WINDOW) {
            high = (real)0.5 * (low + high);
            continue;
        }
        is_whole &= !dark->is_full;
        hidden_sort(dark);
        // Extend an end that lies at the horizon to the end of the line: the closed form cuts there exactly.
        if (dark->from < dark->to) add_seen(dark, dark->from == begin ? 0 : dark->from, dark->to == end ? 1 : dark->to, to);
        low = high, high = end;
    }
    return is_whole;
}
#endif

#ifdef RAYS
// Pass the visible parts to add_part: one ray from the receiver to the middle of each of `samples` parts.
static inline void add_sampled(const bvh_tree *tree, const segment_axes *of, const placement *from, const observer *at,
                        real clearance, uint samples, receiving *to) {
    const real over = fmin(clearance, CLEARANCE_SHARE * from->height);
    const real lift = fmin(clearance, CLEARANCE_SHARE * fmax(from->toward, from->toward_end));
    const real origin[3] = {at->x + lift * at->nx, at->y + lift * at->ny, at->z + lift * at->nz};
    const real start[3] = {of->x + over * of->ex, of->y + over * of->ey, of->z + over * of->ez};
    const real per = (real)1 / (real)samples;
    const real ux = of->ux * of->length, uy = of->uy * of->length, uz = of->uz * of->length;
    uint begun = 0, seen = 0;
    bvh_occluder last = NO_OCCLUDER;
    for (uint n = 0; n <= samples; n++) {
        int hit = 1;
        if (n < samples) {
            const real t = ((real)n + (real)0.5) * per;
            const real dx = start[0] + t * ux - origin[0], dy = start[1] + t * uy - origin[1];
            const real dz = start[2] + t * uz - origin[2];
            const bvh_ray ray = bvh_ray_of(origin[0], origin[1], origin[2], dx, dy, dz, 0, 1);
            hit = bvh_any(tree, &ray, &last);
        }
        if (!hit) {
            begun = seen ? begun : n;
            seen = 1;
        } else if (seen) {
            add_part((real)begun * per, n == samples ? (real)1 : (real)n * per, to);
            seen = 0;
        }
    }
}
#endif

#endif
