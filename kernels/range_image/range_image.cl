// Profiles over a moving sheet of light -> organised range image: x, y, z per (profile, sample).
//
// Two geometries:
//   straight:            point = origin + G g + H h + L d        (g, h in the sheet, L travelled along d)
//   GEOMETRY_ROTATING:   the ray r = (a, b, 1) of a camera at rest meets the sheet n.(X - p) = e, whose normal turns
//                        about an axis through p:
//                        depth = (e + n.p) / (n.r),  point = origin + depth (a ex + b ey + ez)
// The table is RangeImage.packed in range_image.py, folded on the host in double. INPUT is the profiles' type.
#include "common/lanes.h"
#include "common/lens.h"
#include "common/status.h"

#define SAMPLES_PER_STRIP 1024
#define BLOCK 8  // vectors that are judged together
// These flags come with a value; every other one withholds it.
#define STATUS_INFORMS (STATUS_SATURATED | STATUS_AMBIGUOUS)
#define STATUS_WITHHOLDS (~STATUS_INFORMS & 0xff)

#define LIMIT_LOW 0
#define LIMIT_HIGH 3
#define POINT_ORIGIN 6
#define POINT_E1 9
#define POINT_E2 12
#define POINT_E3 15

#ifdef VECTOR_VARIANT
#define NEXT_LANES (real16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
typedef INPUT16 inputs_at __attribute__((aligned(sizeof(INPUT))));
#else
#define NEXT_LANES 0
typedef INPUT inputs_at;
#endif

inline reals load(global const INPUT *from) { return LANED(convert_real)(*(global const inputs_at *)from); }

#ifdef GEOMETRY_ROTATING

#define RAY_POSITION_ORIGIN 18
#define RAY_SAMPLE_ORIGIN 19
#define RAY_SCALE 20
#define SHEET_HORIZON 21
#define SHEET_NORMAL 22
#define SHEET_REACH 31
#define RAY_LENS 34

// What one profile has of its own: the sheet's normal in (position, sample, depth), the depth's numerator, the least
// denominator, and whether the angle is unknown.
typedef struct {
    real position, sample, depth, reach, horizon;
    int unknown;
} Pose;

inline Pose pose_of(real angle, constant real *table) {
    real cosine;
    const real sine = sincos(angle, &cosine);
#define TURNED(at, step) (table[at] + table[at + step] * cosine + table[at + 2 * step] * sine)
    Pose pose = {TURNED(SHEET_NORMAL, 3), TURNED(SHEET_NORMAL + 1, 3), TURNED(SHEET_NORMAL + 2, 3),
                 TURNED(SHEET_REACH, 1), table[SHEET_HORIZON], not_finite(angle)};
#undef TURNED
    // A sheet through the pinhole is seen edge-on: no ray meets it.
    if (pose.reach == 0) pose.horizon = INFINITY;
    // What is in front of the camera has depth > 0: turn the normal so that this means a denominator > 0.
    if (pose.reach < 0) {
        pose.position = -pose.position;
        pose.sample = -pose.sample;
        pose.depth = -pose.depth;
        pose.reach = -pose.reach;
    }
    return pose;
}

// The point of a light position; `missed` and `folded` say where there is none.
inline void locate(reals position, reals sample, Pose pose, constant real *table, reals *x, reals *y, reals *z,
                   masks *missed, masks *folded) {
    reals a = (position - table[RAY_POSITION_ORIGIN]) * table[RAY_SCALE];
    reals b = (sample - table[RAY_SAMPLE_ORIGIN]) * table[RAY_SCALE];
#ifdef LENS
    *folded = mask_of(LANED(lens_undistort)(&a, &b, table + RAY_LENS));
#else
    *folded = 0;
#endif
    const reals facing = pose.position * a + (pose.sample * b + pose.depth);
    const reals depth = pose.reach / facing;
    *missed = ~mask_of(facing > pose.horizon);
    constant real *e1 = table + POINT_E1, *e2 = table + POINT_E2, *e3 = table + POINT_E3, *o = table + POINT_ORIGIN;
    *x = o[0] + depth * (e1[0] * a + (e2[0] * b + e3[0]));
    *y = o[1] + depth * (e1[1] * a + (e2[1] * b + e3[1]));
    *z = o[2] + depth * (e1[2] * a + (e2[2] * b + e3[2]));
}

#define PROFILES global const INPUT *restrict position, global const INPUT *restrict transport
#define FIRST(i) load(position + i)
#define SECOND(i, sample) ((real)(sample) + (reals)NEXT_LANES)

#else

// What one profile has of its own: where its sheet stands, and whether that is unknown.
typedef struct {
    real x, y, z;
    int unknown;
} Pose;

inline Pose pose_of(real travelled, constant real *table) {
    constant real *d = table + POINT_E3, *o = table + POINT_ORIGIN;
    Pose pose = {o[0] + d[0] * travelled, o[1] + d[1] * travelled, o[2] + d[2] * travelled, not_finite(travelled)};
    return pose;
}

inline void locate(reals g, reals h, Pose pose, constant real *table, reals *x, reals *y, reals *z, masks *missed,
                   masks *folded) {
    constant real *e1 = table + POINT_E1, *e2 = table + POINT_E2;
    *missed = *folded = 0;
    *x = pose.x + (e1[0] * g + e2[0] * h);
    *y = pose.y + (e1[1] * g + e2[1] * h);
    *z = pose.z + (e1[2] * g + e2[2] * h);
}

#define PROFILES                                                                                                       \
    global const INPUT *restrict g, global const INPUT *restrict h, global const INPUT *restrict transport
#define FIRST(i) load(g + i)
#define SECOND(i, sample) load(h + i)

#endif

// Assembles the sample(s) from element i on, and says which are not good. Unless it is told to be careful it writes as
// if all were good: the caller comes again where some are not.
inline masks assemble(const int careful, ulong i, reals first, reals second, Pose pose, global const uchar *given,
                      global real *out_x, global real *out_y, global real *out_z, global uchar *status,
                      constant real *table) {
    constant real *low = table + LIMIT_LOW, *high = table + LIMIT_HIGH;
    const bytes flags_in = *(global const bytes_at *)(given + i);
    const masks flags = LANED(convert_bits)(flags_in);
    reals x, y, z;
    masks missed, folded;
    locate(first, second, pose, table, &x, &y, &z, &missed, &folded);
    // Comparisons that hold: NaN fails them, and limits that are finite keep infinity out.
    const masks inside = mask_of(x >= low[0]) & mask_of(x <= high[0]) & mask_of(y >= low[1]) & mask_of(y <= high[1]) &
                         mask_of(z >= low[2]) & mask_of(z <= high[2]);
    const masks withheld = mask_of((flags & STATUS_WITHHOLDS) != 0);
    const masks good = inside & ~missed & ~folded & ~withheld;
    if (careful) {
        const masks lost =
            mask_of(LANED(not_finite)(x)) | mask_of(LANED(not_finite)(y)) | mask_of(LANED(not_finite)(z));
        const masks unknown =
            mask_of(LANED(not_finite)(first)) | mask_of(LANED(not_finite)(second)) | (masks)(pose.unknown ? -1 : 0);
        // Why a sample is not good; the weightiest reason comes last, and what came in with one keeps it.
        masks reason = ~inside & STATUS_OUT_OF_RANGE;
        reason = (reason & ~lost) | (lost & STATUS_NOT_FINITE);
        reason = (reason & ~missed) | (missed & STATUS_HORIZON);
        reason = (reason & ~folded) | (folded & STATUS_NOT_INVERTIBLE);
        reason = (reason & ~unknown) | (unknown & STATUS_NOT_FINITE);
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

// Items: (samples, profiles). Strips: (strips, profiles).
kernel void assemble_profiles(PROFILES, global const uchar *restrict given, global real *restrict x,
                              global real *restrict y, global real *restrict z, global uchar *restrict status,
                              constant real *table, const uint samples) {
    const uint profile = get_global_id(1);
    const ulong row = (ulong)profile * samples;
    const Pose pose = pose_of((real)transport[profile], table);
#define ASSEMBLE(careful, sample)                                                                                      \
    assemble(careful, row + (sample), FIRST(row + (sample)), SECOND(row + (sample), sample), pose, given, x, y, z,     \
             status, table)
#ifdef VECTOR_VARIANT
    // The last strip takes the remainder too, and its last vector overlaps the one before: no sample is left over, and
    // no other work-item writes there.
    uint sample = get_global_id(0) * SAMPLES_PER_STRIP;
    const uint end = get_global_id(0) + 1 == get_global_size(0) ? samples : sample + SAMPLES_PER_STRIP;
    for (; sample + BLOCK * LANES <= end; sample += BLOCK * LANES) {
        masks bad = 0;
        for (uint k = 0; k < BLOCK; k++) bad |= ASSEMBLE(0, sample + k * LANES);
        if (any_lane(bad))
            for (uint k = 0; k < BLOCK; k++) ASSEMBLE(1, sample + k * LANES);
    }
    for (; sample < end; sample += LANES) ASSEMBLE(1, min(sample, end - LANES));
#else
    ASSEMBLE(1, get_global_id(0));
#endif
}
