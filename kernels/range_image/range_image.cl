// Range image: profiles over a moving sheet of light -> point (x, y, z) per (profile, sample) in the scene [m].
//
// Two geometries (gpuvision/ranging/sheet_motion.py):
//     straight transport:  point = origin + G e1 + H e2 + L e3     (G, H in the sheet, L travelled along e3)
// SHEET_BENT:              the same for light at the distance d = f(G, H) from the plane of G and H (bent, below)
// GEOMETRY_ROTATING:   the ray r = (a, b, 1) of a camera at rest meets the sheet n.(X - p) = e, whose normal n turns
//                          about an axis through p:
//                          depth = (e + n.p) / (n.r),  point = origin + depth (a e1 + b e2 + e3)
//
// Inputs:  g, h        (profiles, samples) INPUT [m]; under GEOMETRY_ROTATING instead: position (profiles, samples)
// [px]
//          transport   (profiles,) INPUT [m], or the angle of the sheet [rad]
//          given       (profiles, samples) uchar: status flags of the readout
//          table       RangeTable
// Outputs: x, y, z     (profiles, samples) real [m]; NaN under a flag other than SATURATED and AMBIGUOUS
//          status      (profiles, samples) uchar: the given flags, and NOT_FINITE, NOT_INVERTIBLE, HORIZON, OUT_OF_RANGE
// Build options: INPUT, INPUT16 (float or double), REAL_IS_DOUBLE, SHEET_BENT, GEOMETRY_ROTATING, LENS, LENS_K2,
//          LENS_K3, LENS_K4, CAMERA and its options (common/camera.h) with SAMPLES_ARE_COLUMNS where the samples run
//          along the columns axis of the image, PAST_CACHES, VECTOR_VARIANT.
// Work:    vector variant: global size (strips of SAMPLES_PER_STRIP samples, profiles), the last strip up to twice as
//          long. Otherwise: one work-item per sample, (samples, profiles).
#include "common/camera.h"
#include "common/lens.h"
#include "common/load.h"
#include "common/status.h"

#define SAMPLES_PER_STRIP 1024  // _STRIP in range_image.py
#define BLOCK 8                 // vectors that are tested together for bad samples
// A sample with only these flags keeps its value; every other flag withholds it.
#define STATUS_INFORMS (STATUS_SATURATED | STATUS_AMBIGUOUS)
#define STATUS_WITHHOLDS (~STATUS_INFORMS & 0xff)

// Parameters, in the order of the tables in sheet_motion.py.
typedef struct {
    real low[3], high[3];             // limits of x, y, z [m]
    real origin[3];                   // of the points
    real e1[3], e2[3], e3[3];         // axes of the points
#ifdef SHEET_BENT
    real bend[3];                     // gg, gh, hh of f, over the distance D of the pinhole from the plane [1/m^2]
    real pinhole[2];                  // G and H of the pinhole [m]
    real across[3];                   // normal of the plane, of length D [m]
#endif
#ifdef GEOMETRY_ROTATING
    real position_origin, sample_origin;  // a = (position - position_origin) position_scale, b likewise
    real position_scale, sample_scale;
    real horizon;                     // smallest n.r that counts
    real normal[9];                   // n = normal[0..2] + normal[3..5] cos(angle) + normal[6..8] sin(angle)
    real reach[3];                    // e + n.p, in the same way [m]
#ifdef LENS
    real lens[7];                     // table of lens.h, for (a, b)
#endif
#ifdef CAMERA
    real camera[63];                  // table of camera.h: pixels are positions and samples, the output is (a, b)
#endif
#endif
} RangeTable;

#ifdef GEOMETRY_ROTATING

// Sheet of one profile: its normal along position, sample and depth, the numerator e + n.p of the depth, the smallest
// denominator n.r, and whether the angle is not finite.
typedef struct {
    real position, sample, depth, reach, horizon;
    int unknown;
} Pose;

// fixed + cosine_part cos + sine_part sin.
static inline real turned(real fixed, real cosine_part, real sine_part, real cosine, real sine) {
    return fixed + cosine_part * cosine + sine_part * sine;
}

static inline Pose pose_of(real angle, constant RangeTable *table) {
    constant real *n = table->normal, *reach = table->reach;
    real cosine;
    const real sine = sincos(angle, &cosine);
    Pose pose = {turned(n[0], n[3], n[6], cosine, sine),
                 turned(n[1], n[4], n[7], cosine, sine),
                 turned(n[2], n[5], n[8], cosine, sine),
                 turned(reach[0], reach[1], reach[2], cosine, sine),
                 table->horizon,
                 not_finite(angle)};
    // A sheet of light through the pinhole is edge-on for the camera: no ray intersects it in a point.
    if (pose.reach == 0) pose.horizon = INFINITY;
    // In front of the camera the depth is > 0: turn the normal so that the denominator is > 0 there as well.
    if (pose.reach < 0) {
        pose.position = -pose.position;
        pose.sample = -pose.sample;
        pose.depth = -pose.depth;
        pose.reach = -pose.reach;
    }
    return pose;
}

// Compute the point of a light position. `missed`: the ray does not meet the sheet; `folded`: beyond the fold of the
// lens, or behind the tilted sensor.
static inline void locate(reals position, reals sample, Pose pose, constant RangeTable *table, reals *x, reals *y,
                          reals *z, masks *missed, masks *folded) {
    reals a = (position - table->position_origin) * table->position_scale;
    reals b = (sample - table->sample_origin) * table->sample_scale;
#if defined(LENS)
    *folded = mask_of(LANED(lens_undistort)(&a, &b, table->lens));
#elif defined(CAMERA)
    reals back_a, back_b;
#ifdef SAMPLES_ARE_COLUMNS
    *folded = LANED(camera_correction)(sample, position, table->camera, &back_b, &back_a);
#else
    *folded = LANED(camera_correction)(position, sample, table->camera, &back_a, &back_b);
#endif
    a += back_a;
    b += back_b;
#else
    *folded = 0;
#endif
    const reals facing = pose.position * a + (pose.sample * b + pose.depth);
    const reals depth = pose.reach / facing;
    *missed = ~mask_of(facing > pose.horizon);
    constant real *e1 = table->e1, *e2 = table->e2, *e3 = table->e3, *o = table->origin;
    *x = o[0] + depth * (e1[0] * a + (e2[0] * b + e3[0]));
    *y = o[1] + depth * (e1[1] * a + (e2[1] * b + e3[1]));
    *z = o[2] + depth * (e1[2] * a + (e2[2] * b + e3[2]));
}

#else

// Sheet of one profile: its origin in the scene, and whether the transport is not finite.
typedef struct {
    real x, y, z;
    int unknown;
} Pose;

static inline Pose pose_of(real travelled, constant RangeTable *table) {
    constant real *d = table->e3, *o = table->origin;
    Pose pose = {o[0] + d[0] * travelled, o[1] + d[1] * travelled, o[2] + d[2] * travelled, not_finite(travelled)};
    return pose;
}

#ifdef SHEET_BENT
// Move (g, h), where the ray of the camera meets the mean plane, to where it meets the bent sheet; return the share s of
// the way from the plane to the pinhole. `missed`: the ray does not meet the sheet in front of the pinhole.
//
// With V the vector from (g, h) to the pinhole along the plane and F = f / D, the light is at the share s where
//     s = F((g, h) + s V),  F quadratic:  F(V) s^2 - (1 - grad F . V) s + F(g, h) = 0
// Of the two roots, take the one that tends to 0 with F. The form 2c / (b + sqrt(b^2 - 4ac)) avoids cancellation; no
// iteration is needed.
// Where F is too large for this root, the divisor is NaN or negative.
static inline reals bent(reals *g, reals *h, constant RangeTable *table, masks *missed) {
    constant real *f = table->bend;
    const reals to_g = table->pinhole[0] - *g, to_h = table->pinhole[1] - *h;
    const reals here = *g * (f[0] * *g + f[1] * *h) + f[2] * *h * *h;
    const reals there = to_g * (f[0] * to_g + f[1] * to_h) + f[2] * to_h * to_h;
    const reals slope = to_g * (2 * f[0] * *g + f[1] * *h) + to_h * (f[1] * *g + 2 * f[2] * *h);
    const reals b = 1 - slope, divisor = b + sqrt(b * b - 4 * there * here);
    const reals share = 2 * here / divisor;
    *missed = ~(mask_of(divisor > 0) & mask_of(share < 1));
    *g += share * to_g;
    *h += share * to_h;
    return share;
}
#endif

// Compute the point of (g, h); no lens folds here.
static inline void locate(reals g, reals h, Pose pose, constant RangeTable *table, reals *x, reals *y, reals *z,
                          masks *missed, masks *folded) {
    constant real *e1 = table->e1, *e2 = table->e2;
    *missed = *folded = 0;
#ifdef SHEET_BENT
    constant real *across = table->across;
    const reals share = bent(&g, &h, table, missed);
    *x = pose.x + (e1[0] * g + e2[0] * h + across[0] * share);
    *y = pose.y + (e1[1] * g + e2[1] * h + across[1] * share);
    *z = pose.z + (e1[2] * g + e2[2] * h + across[2] * share);
#else
    *x = pose.x + (e1[0] * g + e2[0] * h);
    *y = pose.y + (e1[1] * g + e2[1] * h);
    *z = pose.z + (e1[2] * g + e2[2] * h);
#endif
}

#endif

// Flags of samples that are not good; a later reason has priority. A sample with a withholding flag gets no further
// flag.
static inline masks reasons(masks inside, masks missed, masks folded, masks lost, masks unknown) {
    masks reason = ~inside & STATUS_OUT_OF_RANGE;
    reason = (reason & ~lost) | (lost & STATUS_NOT_FINITE);
    reason = (reason & ~missed) | (missed & STATUS_HORIZON);
    reason = (reason & ~folded) | (folded & STATUS_NOT_INVERTIBLE);
    return (reason & ~unknown) | (unknown & STATUS_NOT_FINITE);
}

// Assemble the LANES samples from element i = row + sample on; return the mask of the samples that are not good.
// Without `careful` the outputs are written as if all samples were good: the caller repeats a block that has a bad
// sample with `careful`. The arrays are separate parameters, since `restrict` is lost for pointers in a struct (20 % of
// the time).
static inline masks assemble(const int careful, ulong row, uint sample, Pose pose, global const INPUT *first_input,
                             global const INPUT *second_input, global const uchar *given, global real *out_x,
                             global real *out_y, global real *out_z, global uchar *status,
                             constant RangeTable *table) {
    const ulong i = row + sample;
    const reals first = load_inputs(first_input + i);
#ifdef GEOMETRY_ROTATING
    const reals second = (real)sample + to_reals(LANE_NUMBERS);
#else
    const reals second = load_inputs(second_input + i);
#endif
    const bytes flags_in = *(global const bytes_at *)(given + i);
    const masks flags = LANED(convert_bits)(flags_in);
    reals x, y, z;
    masks missed, folded;
    locate(first, second, pose, table, &x, &y, &z, &missed, &folded);
    // These comparisons are false for NaN, and limits that are finite exclude infinity.
    constant real *low = table->low, *high = table->high;
    const masks inside = mask_of(x >= low[0]) & mask_of(x <= high[0]) & mask_of(y >= low[1]) & mask_of(y <= high[1]) &
                         mask_of(z >= low[2]) & mask_of(z <= high[2]);
    const masks withheld = mask_of((flags & STATUS_WITHHOLDS) != 0);
    const masks good = inside & ~missed & ~folded & ~withheld;
    if (careful) {
        const masks lost =
            mask_of(LANED(not_finite)(x)) | mask_of(LANED(not_finite)(y)) | mask_of(LANED(not_finite)(z));
        const masks unknown =
            mask_of(LANED(not_finite)(first)) | mask_of(LANED(not_finite)(second)) | (masks)(pose.unknown ? -1 : 0);
        const masks reason = reasons(inside, missed, folded, lost, unknown);
        store_bytes(convert_bytes(flags | (reason & ~withheld)), status + i);
        x = nan_where(~good, x);
        y = nan_where(~good, y);
        z = nan_where(~good, z);
    } else {
        store_bytes(flags_in, status + i);
    }
    store_reals(x, out_x + i);
    store_reals(y, out_y + i);
    store_reals(z, out_z + i);
    return ~good;
}

// The same for `vectors` vectors of samples.
static inline masks assemble_block(const int careful, uint vectors, ulong row, uint sample, Pose pose,
                                   global const INPUT *first, global const INPUT *second, global const uchar *given,
                                   global real *x, global real *y, global real *z, global uchar *status,
                                   constant RangeTable *table) {
    masks bad = 0;
    for (uint k = 0; k < vectors; k++) {
        bad |= assemble(careful, row, sample + k * LANES, pose, first, second, given, x, y, z, status, table);
    }
    return bad;
}

kernel void assemble_profiles(
#ifdef GEOMETRY_ROTATING
    global const INPUT *restrict position,
#else
    global const INPUT *restrict g, global const INPUT *restrict h,
#endif
    global const INPUT *restrict transport, global const uchar *restrict given, global real *restrict x,
    global real *restrict y, global real *restrict z, global uchar *restrict status, constant RangeTable *table,
    const uint samples) {
    const uint profile = get_global_id(1);
    const ulong row = (ulong)profile * samples;
    const Pose pose = pose_of((real)transport[profile], table);
#ifdef GEOMETRY_ROTATING
    global const INPUT *first = position, *second = 0;
#else
    global const INPUT *first = g, *second = h;
#endif
#ifdef VECTOR_VARIANT
    // The last strip also contains the remainder, and its last vector overlaps the previous vector: every sample is
    // covered, and no other work-item writes there.
    uint sample = get_global_id(0) * SAMPLES_PER_STRIP;
    const uint end = get_global_id(0) + 1 == get_global_size(0) ? samples : sample + SAMPLES_PER_STRIP;
    for (; sample + BLOCK * LANES <= end; sample += BLOCK * LANES) {
        const masks bad =
            assemble_block(0, BLOCK, row, sample, pose, first, second, given, x, y, z, status, table);
        if (any_lane(bad)) {
            assemble_block(1, BLOCK, row, sample, pose, first, second, given, x, y, z, status, table);
        }
    }
    for (; sample < end; sample += LANES) {
        assemble(1, row, min(sample, end - LANES), pose, first, second, given, x, y, z, status, table);
    }
#else
    if (get_global_id(0) >= samples) return;
    assemble(1, row, get_global_id(0), pose, first, second, given, x, y, z, status, table);
#endif
}
