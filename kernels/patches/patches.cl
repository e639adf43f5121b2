// Form factors of receivers and patches, or the irradiance of receivers from the exitance of patches.
//
// Inputs:  receivers (count, 6), position [m] and normal of any length, type INPUT; patch_light: exitance (patches,) [W/m2].
// Outputs: form_factors: factors (count, patches); patch_light: irradiance (count,) [W/m2]; status (count,) flags.
// Tables:  triangles (t,) PatchTriangle; starts (patches + 1,) first triangle of each patch;
//          slacks (patches,) [m] added to the clearance at the patch; the tree of common/bvh.h.
// Options: FACTORS (form_factors), OCCLUSION (shadow rays), INPUT, POSITION (type of `middle`), REAL_IS_DOUBLE, BVH_DEPTH.
// Variants: vector: 16 receivers in a vector, `each` receivers per work-item; work-item: one receiver per item.
//
// A triangle's hidden fraction is estimated with shadow rays; the larger its form factor, the more rays.
#include "patches/patches.h"
#include "common/bvh.h"
#include "common/status.h"

// Triangle of a patch: PatchTriangle in patches.py.
typedef struct {
    real corner[3], edge_1[3], edge_2[3], normal[3]; // first corner; edges from it to the others; unit normal
} PatchTriangle;

INLINE vector vector_at(global const real *at) { return (vector){(reals)at[0], (reals)at[1], (reals)at[2]}; }

static inline reals load_column(global const INPUT *receivers, int column, POSITION less) {
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

// Whether the ray is free; the first `after` and the last `before` metres are skipped (surfaces at the ends).
static inline int is_free(const bvh_tree *tree, const real *place, const real *way, real after, real before,
                          bvh_occluder *last) {
    const real per = after + before > 0 ? (real)1 / sqrt(dot_of(way, way)) : 0;
    const real start = after * per, end = 1 - before * per;
    if (!(start < end)) return 1;
    const bvh_ray ray = bvh_ray_of(place[0], place[1], place[2], way[0], way[1], way[2], start, end);
    return !bvh_any(tree, &ray, last);
}

// Visible fraction of a polygon's light: rays to the middles of side x side fields, each weighted by the light that a small
// patch there would send.
__attribute__((noinline)) real free_part(const bvh_tree *tree, const view *own, int side, real after, real before) {
    real through = 0, whole = 0;
    bvh_occluder last = NO_OCCLUDER;
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
        if (is_free(tree, own->place, way, after, before, &last)) through += sent;
    }
    return whole > 0 ? through / whole : 0;
}

// Fields along a side: `rays` rays for a form factor of 1, at most 16 x 16.
static inline int side_of(real factor, real rays) { return clamp((int)ceil(sqrt(factor * rays)), 1, 16); }

#ifdef VECTOR_VARIANT
INLINE void spread(real (*to)[LANES], vector from) {
    *(reals_at *)to[0] = from.x, *(reals_at *)to[1] = from.y, *(reals_at *)to[2] = from.z;
}
#endif

// Form factor times the visible fraction.
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

// Arguments that both kernels share; a macro, because a struct of pointers would lose `restrict`.
#define SCENE_TABLES                                                                                                   \
    global uchar *restrict status, global const PatchTriangle *restrict triangles, global const int *restrict starts,  \
        global const real *restrict slacks, global const real *nodes, global const int *children,                      \
        global const int *axes, global const real *leaves, global const int *numbers, constant POSITION *middle,          \
        const real shallow, const real clearance, const real rays, const uint patches, const ulong count,              \
        const ulong each

typedef struct {
    vector place, normal; // position from the middle; unit normal
    masks bad;            // a number is not finite
} receiver;

INLINE receiver load_receiver(global const INPUT *at, constant POSITION *middle) {
    receiver one;
    one.place = (vector){load_column(at, 0, middle[0]), load_column(at, 1, middle[1]), load_column(at, 2, middle[2])};
    vector normal = {load_column(at, 3, 0), load_column(at, 4, 0), load_column(at, 5, 0)};
    normal = patch_times((reals)1 / fmax(fmax(fabs(normal.x), fabs(normal.y)), fabs(normal.z)), normal);
    one.normal = normal = patch_times((reals)1 / sqrt(patch_dot(normal, normal)), normal);
    one.bad = mask_of(LANED(not_finite)(one.place.x)) | mask_of(LANED(not_finite)(one.place.y)) |
              mask_of(LANED(not_finite)(one.place.z)) | mask_of(LANED(not_finite)(normal.x)) |
              mask_of(LANED(not_finite)(normal.y)) | mask_of(LANED(not_finite)(normal.z));
    return one;
}

// Form factor of a receiver and one triangle, with occlusion if `tree` is given.
INLINE reals triangle_factor(const receiver *one, global const PatchTriangle *row, const bvh_tree *tree, real shallow,
                             real rays, real clearance, real slack) {
    const vector place = one->place, normal = one->normal;
    const vector first = {row->corner[0] - place.x, row->corner[1] - place.y, row->corner[2] - place.z};
    // Most pairs do not face each other. `shallow`: heights within rounding count as in the plane.
    const masks facing = mask_of(-patch_dot(first, vector_at(row->normal)) > (reals)shallow);
    if (!any_lane(facing)) return (reals)0;
    const vector edge_1 = vector_at(row->edge_1), edge_2 = vector_at(row->edge_2);
    const vector back = {-edge_1.x - edge_2.x, -edge_1.y - edge_2.y, -edge_1.z - edge_2.z};
    const vector corner[3] = {first, patch_sum(first, edge_1), patch_sum(patch_sum(first, edge_1), edge_2)};
    const vector edge[3] = {edge_1, edge_2, back};
    const reals height[3] = {patch_dot(corner[0], normal), patch_dot(corner[1], normal), patch_dot(corner[2], normal)};
    const masks above = mask_of(height[0] > (reals)0) | mask_of(height[1] > (reals)0) | mask_of(height[2] > (reals)0);
    if (!any_lane(facing & above)) return (reals)0;
    const polygon shape = patch_cut(corner, edge, height);
    const reals factor = zero_where(~(facing & above), patch_factor(&shape, normal));
#ifdef OCCLUSION
    return seen_part(tree, factor, place, normal, &shape, rays, clearance, max(clearance, slack));
#else
    return factor;
#endif
}

#ifdef FACTORS
kernel void form_factors(global const INPUT *restrict receivers, global real *restrict factors, SCENE_TABLES) {
    const bvh_tree tree = {nodes, children, axes, leaves, numbers};
    const sample_range own = samples_of_item(each, count);
    for (ulong next = own.begin; next < own.end; next += LANES) {
        const ulong i = whole_vector(next, count);
        const receiver one = load_receiver(receivers + 6 * i, middle);
        for (uint patch = 0; patch < patches; patch++) {
            reals sum = (reals)0;
            for (int t = starts[patch]; t < starts[patch + 1]; t++)
                sum += triangle_factor(&one, triangles + t, &tree, shallow, rays, clearance, slacks[patch]);
            sum = nan_where(one.bad, sum);
            for (int lane = 0; lane < LANES; lane++) factors[(i + lane) * patches + patch] = ((const real *)&sum)[lane];
        }
        store_bytes(convert_bytes(one.bad & (masks)STATUS_NOT_FINITE), status + i);
    }
}
#else
kernel void patch_light(global const INPUT *restrict receivers, global const real *restrict exitance,
                        global real *restrict irradiance, SCENE_TABLES) {
    const bvh_tree tree = {nodes, children, axes, leaves, numbers};
    const sample_range own = samples_of_item(each, count);
    for (ulong next = own.begin; next < own.end; next += LANES) {
        const ulong i = whole_vector(next, count);
        const receiver one = load_receiver(receivers + 6 * i, middle);
        reals total = (reals)0;
        for (uint patch = 0; patch < patches; patch++) {
            if (exitance[patch] == 0) continue;
            reals sum = (reals)0;
            for (int t = starts[patch]; t < starts[patch + 1]; t++)
                sum += triangle_factor(&one, triangles + t, &tree, shallow, rays, clearance, slacks[patch]);
            total += exitance[patch] * sum;
        }
        const masks wrong = one.bad | mask_of(LANED(not_finite)(total));
        store_reals(nan_where(wrong, total), irradiance + i);
        store_bytes(convert_bytes(wrong & (masks)STATUS_NOT_FINITE), status + i);
    }
}
#endif
