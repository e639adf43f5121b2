// Ray queries on the triangles of a scene: the closest hit of a ray, or any hit on a segment.
//
// Inputs:  rays (count, 6), closest_hit: origin [m] and direction of any length; any_hit: both ends of a segment [m].
// Outputs: closest_hit: triangle (count,) index or -1, distance (count,) [m], barycentric (count, 2), status (count,);
//          any_hit: occluded (count,) 0 or 1, status (count,).
// Options: ANY_HIT (any_hit), INPUT, REAL_IS_DOUBLE, DOUBLE_POSITIONS, BVH_DEPTH.
// Variants: vector: a strip of `each` rays per work-item, each ray against 16 boxes at once; work-item: a ray per item.
//
// Positions are relative to the scene's middle. A ray from far away is first cut to the sphere around the scene, so that
// the numbers of the traversal keep their digits.
#include "common/bvh.h"
#include "common/status.h"

#include "common/places.h"

typedef struct {
    place x, y, z;
} spot;

static inline place dot_of(spot a, spot b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline spot moved(spot a, spot b, place by) { return (spot){a.x + b.x * by, a.y + b.y * by, a.z + b.z * by}; }
static inline spot load_spot(global const INPUT *three) { return (spot){three[0], three[1], three[2]}; }
static inline int finite_spot(spot a) {
    return !(not_finite((real)a.x) | not_finite((real)a.y) | not_finite((real)a.z));
}

// Part of a ray in the sphere around the scene.
typedef struct {
    spot origin;
    place ahead, across; // its start and its length, in multiples of the direction
    int misses;
} part;

static inline part part_within(spot origin, spot direction, place radius) {
    const place whole = dot_of(direction, direction), nearest = -dot_of(origin, direction) / whole;
    const spot middle = moved(origin, direction, nearest);
    const place left = radius * radius - dot_of(middle, middle);
    if (!(left > 0 && nearest > 0)) return (part){origin, 0, 1, 1};
    const place half_of_it = sqrt(left / whole);
    return (part){moved(middle, direction, -half_of_it), nearest - half_of_it, 2 * half_of_it, 0};
}

static inline int is_far(spot origin, place radius) { return fabs(origin.x) + fabs(origin.y) + fabs(origin.z) > 8 * radius; }

#ifdef ANY_HIT
AS_IT_IS kernel void any_hit(global const INPUT *restrict rays, global uchar *restrict occluded,
                             global uchar *restrict status, global const real *nodes, global const int *children,
                             global const int *axes, global const real *leaves, global const int *triangles,
                             constant place *middle, const place radius, const real clearance, const ulong count,
                             const ulong each) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    const ulong first = get_global_id(0) * each, end = min(first + each, count);
    for (ulong i = first; i < end; i++) {
        spot origin = moved(load_spot(rays + 6 * i), (spot){middle[0], middle[1], middle[2]}, -1);
        const spot to = moved(load_spot(rays + 6 * i + 3), (spot){middle[0], middle[1], middle[2]}, -1);
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
                direction = moved((spot){0, 0, 0}, direction, within.across);
                start = (real)max((margin - within.ahead) / within.across, (place)0);
                end = (real)(((place)1 - margin - within.ahead) / within.across);
                misses = within.misses || end <= start;
            }
            if (!misses) {
                const bvh_ray ray = bvh_ray_of((real)origin.x, (real)origin.y, (real)origin.z, (real)direction.x,
                                               (real)direction.y, (real)direction.z, start, end);
                hit = bvh_any(&tree, &ray);
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
                                 constant place *middle, const place radius, const real clearance, const ulong count,
                                 const ulong each) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    const ulong first = get_global_id(0) * each, end = min(first + each, count);
    for (ulong i = first; i < end; i++) {
        spot origin = moved(load_spot(rays + 6 * i), (spot){middle[0], middle[1], middle[2]}, -1);
        const spot direction = load_spot(rays + 6 * i + 3);
        const place size = sqrt(dot_of(direction, direction));
        const int good = finite_spot(origin) && finite_spot(direction) && size > 0 && !not_finite((real)size);
        bvh_hit hit = {REAL_NAN, REAL_NAN, REAL_NAN, NO_HIT};
        place ahead = 0;
        if (good) {
            const spot unit = moved((spot){0, 0, 0}, direction, 1 / size);
            int misses = 0;
            if (is_far(origin, radius)) {
                const part within = part_within(origin, unit, radius);
                origin = within.origin, ahead = within.ahead, misses = within.misses;
            }
            if (!misses) {
                const bvh_ray ray =
                    bvh_ray_of((real)origin.x, (real)origin.y, (real)origin.z, (real)unit.x, (real)unit.y, (real)unit.z,
                               (real)max(clearance - ahead, (place)0), (real)INFINITY);
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
