// Ray queries on the triangles of a scene: the closest hit of a ray, or any hit on a segment.
//
// Inputs:  rays (count, 6), closest_hit: origin [m] and direction of any length; any_hit: both ends of a segment [m].
// Outputs: closest_hit: triangle (count,) index or -1, distance (count,) [m], barycentric (count, 2), status (count,);
//          any_hit: occluded (count,) 0 or 1, status (count,).
// Options: ANY_HIT (any_hit), INPUT, REAL_IS_DOUBLE, BVH_DEPTH, FOUR_WIDE (common/bvh.h); DOUBLE_POSITIONS or, in the
//          work-item variant, TWO_FLOAT_POSITIONS (common/places.h).
// Variants: vector: a strip of `each` rays per work-item, each ray against 16 boxes at once; work-item: a ray per item,
//          against the four boxes of a node at once (FOUR_WIDE).
//
// Positions are relative to the scene's middle. A ray from far away is first cut to the sphere around the scene, so that
// the numbers of the traversal keep their digits.
#include "common/status.h"
#include "rays/clipped_ray.h"

#ifdef ANY_HIT
AS_IT_IS kernel void any_hit(global const INPUT *restrict rays, global uchar *restrict occluded,
                             global uchar *restrict status, global const real *nodes, global const int *children,
                             global const int *axes, global const real *leaves, global const int *triangles,
                             constant place *middle, const amount radius, const real clearance, const ulong count,
                             const ulong each) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    const ulong first = get_global_id(0) * each, end = min(first + each, count);
    bvh_occluder last = NO_OCCLUDER;
    for (ulong i = first; i < end; i++) {
        spot origin = from_middle(rays + 6 * i, middle);
        const spot to = from_middle(rays + 6 * i + 3, middle);
        spot direction = moved(to, origin, -1);
        const int good = finite_spot(origin) && finite_spot(to);
        const real length = sqrt((real)dot_of(direction, direction));
        const real margin = clearance > 0 ? clearance / length : 0;
        int hit = 0;
        if (good && length > 0 && margin < (real)0.5) {
            real start = margin, end = (real)1 - margin;
            int misses = 0;
            if (is_far(origin, radius)) {
                const part within = part_within(origin, direction, radius);
                origin = within.origin;
                direction = scaled(direction, within.across);
                start = (real)max(after_start(margin, 0, within) / within.across, (amount)0);
                end = (real)(after_start(1, margin, within) / within.across);
                misses = within.misses || end <= start;
            }
            if (!misses) {
                const bvh_ray ray = ray_from(origin, direction, start, end);
                hit = bvh_any(&tree, &ray, &last);
            }
        }
        occluded[i] = (uchar)hit;
        status[i] = good ? STATUS_OK : STATUS_NOT_FINITE;
    }
}
#else
AS_IT_IS kernel void closest_hit(global const INPUT *restrict rays, global int *restrict triangle,
                                 global real *restrict distance, global real *restrict barycentric,
                                 global uchar *restrict status, global const real *nodes, global const int *children,
                                 global const int *axes, global const real *leaves, global const int *triangles,
                                 constant place *middle, const amount radius, const real clearance, const ulong count,
                                 const ulong each) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    const ulong first = get_global_id(0) * each, end = min(first + each, count);
    for (ulong i = first; i < end; i++) {
        spot origin = from_middle(rays + 6 * i, middle);
        const spot direction = direction_at(rays + 6 * i + 3);
        const amount size = size_of(direction);
        const int good = finite_spot(origin) && finite_spot(direction) && size > 0 && !not_finite((real)size);
        bvh_hit hit = {REAL_NAN, REAL_NAN, REAL_NAN, NO_HIT};
        amount ahead = 0;
        if (good) {
            const spot unit = unit_of(direction);
            int misses = 0;
            if (is_far(origin, radius)) {
                const part within = part_within(origin, unit, radius);
                origin = within.origin, ahead = as_amount(within.ahead), misses = within.misses;
            }
            if (!misses) {
                const bvh_ray ray =
                    ray_from(origin, unit, (real)max(clearance - ahead, (amount)0), (real)INFINITY);
                hit = bvh_closest(&tree, &ray);
            }
        }
        const int met = hit.triangle != NO_HIT;
        triangle[i] = hit.triangle;
        distance[i] = met ? (real)(hit.t + ahead) : REAL_NAN;
        barycentric[2 * i] = hit.u;
        barycentric[2 * i + 1] = hit.v;
        status[i] = !good ? STATUS_NOT_FINITE : met ? STATUS_OK : STATUS_NO_DATA;
    }
}
#endif
