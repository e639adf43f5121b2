// Diffuse light from patches of a scene, each a few triangles of one exitance, on receivers (place, normal): as form
// factors, or summed. CPU runtimes take strips of 16 receivers, GPUs an item per receiver. Which part of a triangle is
// hidden is asked with rays, more of them the larger it is in view.
#include "patches/patches.h"
#include "common/bvh.h"
#include "common/status.h"

// A triangle: first corner, two edges, unit normal.
#define ROW 12

INLINE vector vector_at(global const real *row) { return (vector){(reals)row[0], (reals)row[1], (reals)row[2]}; }

static inline reals load_column(global const INPUT *receivers, int column, PLACE less) {
#ifdef VECTOR_VARIANT
    global const INPUT *at = receivers + column;
    real values[LANES];
    for (int lane = 0; lane < LANES; lane++) values[lane] = (real)(at[6 * lane] - less);
    return *(reals_at *)values;
#else
    return (real)(receivers[column] - less);
#endif
}

#ifdef OCCLUSION
typedef struct {
    real place[3], normal[3], corner[4][3];
} view;

INLINE real dot_of(const real *a, const real *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Metres at either end do not count: the surfaces that the ends lie on.
static inline int is_free(const bvh_tree *tree, const real *place, const real *way, real after, real before) {
    const real per = after + before > 0 ? (real)1 / sqrt(dot_of(way, way)) : 0;
    const real start = after * per, end = 1 - before * per;
    if (!(start < end)) return 1;
    const bvh_ray ray = bvh_ray_of(place[0], place[1], place[2], way[0], way[1], way[2], start, end);
    return !bvh_any(tree, &ray);
}

// The part of a polygon's light that gets through, by rays to the middles of side x side fields of it, each for what it
// would send if it were small.
__attribute__((noinline)) real free_part(const bvh_tree *tree, const view *own, int side, real after, real before) {
    real through = 0, whole = 0;
    for (int field = 0; field < side * side; field++) {
        const real s = (field % side + (real)0.5) / side, t = (field / side + (real)0.5) / side;
        real way[3], along[3], across[3];
        for (int n = 0; n < 3; n++) {
            const real a = own->corner[0][n], b = own->corner[1][n], c = own->corner[2][n], d = own->corner[3][n];
            along[n] = (b - a) + t * ((a - b) + (c - d));
            across[n] = (d - a) + s * ((a - b) + (c - d));
            way[n] = a + s * (b - a) + t * across[n];
        }
        const real front[3] = {along[1] * across[2] - along[2] * across[1], along[2] * across[0] - along[0] * across[2],
                               along[0] * across[1] - along[1] * across[0]};
        const real square = dot_of(way, way);
        const real sent = fabs(dot_of(way, front) * dot_of(way, own->normal)) / (square * square);
        whole += sent;
        if (is_free(tree, own->place, way, after, before)) through += sent;
    }
    return whole > 0 ? through / whole : 0;
}

// What large triangles send is asked with many rays: `rays` for one that fills the view.
static inline int side_of(real factor, real rays) { return clamp((int)ceil(sqrt(factor * rays)), 1, 16); }

#ifdef VECTOR_VARIANT
INLINE void spread(real (*to)[LANES], vector from) {
    *(reals_at *)to[0] = from.x, *(reals_at *)to[1] = from.y, *(reals_at *)to[2] = from.z;
}
#endif

// A factor without what is hidden.
INLINE reals seen_part(const bvh_tree *tree, reals factor, vector place, vector normal, const polygon *shape,
                             real rays, real after, real before) {
#ifdef VECTOR_VARIANT
    real factors[LANES], all[18][LANES];
    *(reals_at *)factors = factor;
    spread(all, place);
    spread(all + 3, normal);
    for (int n = 0; n < 4; n++) spread(all + 6 + 3 * n, shape->corner[n]);
    for (int lane = 0; lane < LANES; lane++) {
        if (!(factors[lane] > 0)) continue;
        view own;
        for (int n = 0; n < 3; n++) own.place[n] = all[n][lane], own.normal[n] = all[3 + n][lane];
        for (int n = 0; n < 12; n++) own.corner[n / 3][n % 3] = all[6 + n][lane];
        factors[lane] *= free_part(tree, &own, side_of(factors[lane], rays), after, before);
    }
    return *(reals_at *)factors;
#else
    if (!(factor > 0)) return factor;
    view own = {{place.x, place.y, place.z}, {normal.x, normal.y, normal.z}, {{0}}};
    for (int n = 0; n < 4; n++)
        own.corner[n][0] = shape->corner[n].x, own.corner[n][1] = shape->corner[n].y,
        own.corner[n][2] = shape->corner[n].z;
    return factor * free_part(tree, &own, side_of(factor, rays), after, before);
#endif
}
#endif

#ifdef FACTORS
kernel void form_factors(global const INPUT *restrict receivers, global real *restrict factors,
#else
kernel void patch_light(global const INPUT *restrict receivers, global const real *restrict exitance,
                        global real *restrict irradiance,
#endif
                         global uchar *restrict status, global const real *restrict triangles,
                         global const int *restrict starts, global const real *restrict slacks,
                         global const real *nodes, global const int *children, global const int *axes,
                         global const real *leaves, global const int *numbers,
                         constant PLACE *middle, const real shallow, const real clearance, const real rays,
                         const uint patches, const ulong count, const ulong each) {
#ifdef OCCLUSION
    const bvh_tree tree = {nodes, children, axes, leaves, numbers};
#endif
    // The last vector, or work-group, moves back to end with the last receiver.
#ifdef VECTOR_VARIANT
    const ulong begin = get_global_id(0) * each, end = min(begin + each, count);
    for (ulong following = begin; following < end; following += LANES) {
        const ulong i = min(following, count - LANES);
#else
    {
        const ulong i = min(get_group_id(0) * each, count - each) + get_local_id(0);
#endif
        global const INPUT *at = receivers + 6 * i;
        const vector place = {load_column(at, 0, middle[0]), load_column(at, 1, middle[1]),
                              load_column(at, 2, middle[2])};
        vector normal = {load_column(at, 3, 0), load_column(at, 4, 0), load_column(at, 5, 0)};
        normal = patch_times((reals)1 / fmax(fmax(fabs(normal.x), fabs(normal.y)), fabs(normal.z)), normal);
        normal = patch_times((reals)1 / sqrt(patch_dot(normal, normal)), normal);
        const masks bad = mask_of(LANED(not_finite)(place.x)) | mask_of(LANED(not_finite)(place.y)) |
                          mask_of(LANED(not_finite)(place.z)) | mask_of(LANED(not_finite)(normal.x)) |
                          mask_of(LANED(not_finite)(normal.y)) | mask_of(LANED(not_finite)(normal.z));
        reals total = (reals)0;
        for (uint patch = 0; patch < patches; patch++) {
#ifndef FACTORS
            if (exitance[patch] == 0) continue;
#endif
            reals whole = (reals)0;
            for (int t = starts[patch]; t < starts[patch + 1]; t++) {
                global const real *row = triangles + (size_t)t * ROW;
                const vector first = {row[0] - place.x, row[1] - place.y, row[2] - place.z};
                // Most pairs do not face each other; what a surface adds to itself is rounding.
                const masks facing = mask_of(-patch_dot(first, vector_at(row + 9)) > (reals)shallow);
                if (!any_lane(facing)) continue;
                const vector one = vector_at(row + 3), two = vector_at(row + 6);
                const vector back = {-one.x - two.x, -one.y - two.y, -one.z - two.z};
                const vector corner[3] = {first, patch_sum(first, one), patch_sum(patch_sum(first, one), two)};
                const vector edge[3] = {one, two, back};
                const reals height[3] = {patch_dot(corner[0], normal), patch_dot(corner[1], normal),
                                         patch_dot(corner[2], normal)};
                const masks above = mask_of(height[0] > (reals)0) | mask_of(height[1] > (reals)0) |
                                    mask_of(height[2] > (reals)0);
                if (!any_lane(facing & above)) continue;
                const polygon shape = patch_cut(corner, edge, height);
                reals factor = zero_where(~(facing & above), patch_factor(&shape, normal));
#ifdef OCCLUSION
                factor = seen_part(&tree, factor, place, normal, &shape, rays, clearance,
                                   max(clearance, slacks[patch]));
#endif
                whole += factor;
            }
#ifdef FACTORS
            whole = nan_where(bad, whole);
#ifdef VECTOR_VARIANT
            for (int lane = 0; lane < LANES; lane++)
                factors[(i + lane) * patches + patch] = ((const real *)&whole)[lane];
#else
            factors[i * patches + patch] = whole;
#endif
#else
            total += exitance[patch] * whole;
#endif
        }
#ifndef FACTORS
        const masks wrong = bad | mask_of(LANED(not_finite)(total));
        store_reals(nan_where(wrong, total), irradiance + i);
        store_bytes(convert_bytes(wrong & (masks)STATUS_NOT_FINITE), status + i);
#else
        store_bytes(convert_bytes(bad & (masks)STATUS_NOT_FINITE), status + i);
#endif
    }
}
