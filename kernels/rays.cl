// Rays against the triangles of a scene: the closest, or whether there is any. CPU runtimes take a strip of rays per
// work-item, one after another, each against 16 boxes at once; GPUs an item per ray.
#include "bvh.h"
#include "status.h"

inline int all_finite(const real *six) {
    int wrong = 0;
    for (int n = 0; n < 6; n++) wrong |= not_finite(six[n]);
    return !wrong;
}

// The scene's middle is subtracted before the numbers are rounded to `real`.
inline void load_ray(global const INPUT *six, constant INPUT *middle, real *ray) {
    for (int n = 0; n < 3; n++) {
        ray[n] = (real)(six[n] - middle[n]);
#ifdef SEGMENTS
        ray[n + 3] = (real)(six[n + 3] - six[n]);
#else
        ray[n + 3] = (real)six[n + 3];
#endif
    }
}

#ifdef SEGMENTS
kernel void any_hit(global const INPUT *restrict rays, global uchar *restrict occluded, global uchar *restrict status,
                    global const real *nodes, global const int *children, global const int *axes,
                    global const real *leaves, global const int *triangles, constant INPUT *middle,
                    const real clearance, const ulong count, const ulong each) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    const ulong first = get_global_id(0) * each, end = min(first + each, count);
    for (ulong i = first; i < end; i++) {
        real six[6];
        load_ray(rays + 6 * i, middle, six);
        const int good = all_finite(six);
        const real length = sqrt(six[3] * six[3] + six[4] * six[4] + six[5] * six[5]);
        const real margin = clearance > 0 ? clearance / length : 0;
        int hit = 0;
        if (good && length > 0 && margin < (real)0.5) {
            const bvh_ray ray = bvh_ray_of(six[0], six[1], six[2], six[3], six[4], six[5], margin, (real)1 - margin);
            hit = bvh_any(&tree, &ray);
        }
        occluded[i] = (uchar)hit;
        status[i] = good ? STATUS_OK : STATUS_NOT_FINITE;
    }
}
#else
kernel void closest_hit(global const INPUT *restrict rays, global int *restrict triangle, global real *restrict distance,
                        global real *restrict barycentric, global uchar *restrict status, global const real *nodes,
                        global const int *children, global const int *axes, global const real *leaves,
                        global const int *triangles, constant INPUT *middle, const real clearance, const ulong count,
                        const ulong each) {
    const bvh_tree tree = {nodes, children, axes, leaves, triangles};
    const ulong first = get_global_id(0) * each, end = min(first + each, count);
    for (ulong i = first; i < end; i++) {
        real six[6];
        load_ray(rays + 6 * i, middle, six);
        const real length = sqrt(six[3] * six[3] + six[4] * six[4] + six[5] * six[5]);
        const int good = all_finite(six) && length > 0 && !not_finite(length);
        bvh_hit hit = {REAL_NAN, REAL_NAN, REAL_NAN, NO_HIT};
        if (good) {
            const real per = (real)1 / length;
            const bvh_ray ray = bvh_ray_of(six[0], six[1], six[2], six[3] * per, six[4] * per, six[5] * per, clearance,
                                           (real)INFINITY);
            hit = bvh_closest(&tree, &ray);
        }
        const int met = hit.triangle != NO_HIT;
        triangle[i] = hit.triangle;
        distance[i] = met ? hit.t : REAL_NAN;
        barycentric[2 * i] = hit.u;
        barycentric[2 * i + 1] = hit.v;
        status[i] = !good ? STATUS_NOT_FINITE : met ? STATUS_OK : STATUS_HOLE;
    }
}
#endif
