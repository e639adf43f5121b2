// Profiles over a moving sheet of light -> organised range image: x, y, z per (profile, sample).
//
// Two geometries (GEOMETRY_ROTATING or not), the same two walks for both:
//   straight: point = origin + G g + H h + L d                   (g, h in the sheet, L travelled along d)
//   rotating: the ray r = (a, b, 1) of a camera at rest meets the sheet n.(X - p) = e, whose normal turns about an axis
//             through p:  depth = (e + n.p) / (n.r),  point = origin + depth (r.x ex + r.y ey + ez)
// The tables are StraightTransport.packed and RotatingSheet.packed in range_image.py, folded on the host in double.
//
// assemble_item:  one work-item per sample, coalesced (GPUs).
// assemble_strip: one work-item per STRIP samples of a profile, 16 at a time (CPU runtimes).
#include "real.h"
#include "status.h"

#include "lens.h"

#define STRIP 1024
// These flags come with a value; every other one withholds it.
#define STATUS_INFORMS (STATUS_SATURATED | STATUS_AMBIGUOUS)

#define LIMIT_LOW 0
#define LIMIT_HIGH 3
#define POINT_ORIGIN 6
#define POINT_E1 9
#define POINT_E2 12
#define POINT_E3 15

#ifdef GEOMETRY_ROTATING

#define RAY_POSITION_ORIGIN 18
#define RAY_SAMPLE_ORIGIN 19
#define RAY_SCALE 20
#define SHEET_HORIZON 21
#define SHEET_NORMAL 22
#define SHEET_NORMAL_COS 25
#define SHEET_NORMAL_SIN 28
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

#ifdef LENS
#define UNDISTORT(SUFFIX, a, b, table) lens_undistort##SUFFIX(&a, &b, table + RAY_LENS)
#else
#define UNDISTORT(SUFFIX, a, b, table) 0
#endif

#define ALONG_RAY(axis)                                                                                                \
    (table[POINT_ORIGIN + (axis)] +                                                                                    \
     depth * (table[POINT_E1 + (axis)] * a + table[POINT_E2 + (axis)] * b + table[POINT_E3 + (axis)]))
#define POINT(SUFFIX, REAL, BITS)                                                                                      \
    inline BITS point##SUFFIX(REAL position, REAL sample, Pose pose, constant real *table, REAL *x, REAL *y,           \
                              REAL *z) {                                                                               \
        REAL a = (position - table[RAY_POSITION_ORIGIN]) * table[RAY_SCALE];                                           \
        REAL b = (sample - table[RAY_SAMPLE_ORIGIN]) * table[RAY_SCALE];                                               \
        const BITS folded = UNDISTORT(SUFFIX, a, b, table);                                                            \
        const REAL facing = pose.position * a + pose.sample * b + pose.depth;                                          \
        const REAL depth = pose.reach / facing;                                                                        \
        *x = ALONG_RAY(0);                                                                                             \
        *y = ALONG_RAY(1);                                                                                             \
        *z = ALONG_RAY(2);                                                                                             \
        const BITS missed = facing > pose.horizon ? (BITS)0 : (BITS)STATUS_HORIZON;                                    \
        return folded ? (BITS)STATUS_FOLDED : missed;                                                                  \
    }

#else

// What one profile has of its own: where its sheet stands, and whether that is unknown.
typedef struct {
    real x, y, z;
    int unknown;
} Pose;

inline Pose pose_of(real travel, constant real *table) {
    Pose pose = {table[POINT_ORIGIN] + table[POINT_E3] * travel, table[POINT_ORIGIN + 1] + table[POINT_E3 + 1] * travel,
                 table[POINT_ORIGIN + 2] + table[POINT_E3 + 2] * travel, not_finite(travel)};
    return pose;
}

#define POINT(SUFFIX, REAL, BITS)                                                                                      \
    inline BITS point##SUFFIX(REAL g, REAL h, Pose pose, constant real *table, REAL *x, REAL *y, REAL *z) {            \
        *x = pose.x + (table[POINT_E1] * g + table[POINT_E2] * h);                                                     \
        *y = pose.y + (table[POINT_E1 + 1] * g + table[POINT_E2 + 1] * h);                                             \
        *z = pose.z + (table[POINT_E1 + 2] * g + table[POINT_E2 + 2] * h);                                             \
        return (BITS)0;                                                                                                \
    }

#endif
POINT(, real, int)
POINT(16, real16, bits16)

#define OUTSIDE(v, axis) ((v < table[LIMIT_LOW + axis]) | (v > table[LIMIT_HIGH + axis]))

// One point with its flags: NaN wherever a flag says that there is none. The causes rank: what came in, the lens'
// fold and the horizon, then the limits; a later one is not looked at where an earlier one holds.
#define JUDGED(SUFFIX, REAL, BITS)                                                                                     \
    inline BITS judged##SUFFIX(REAL first, REAL second, BITS given, Pose pose, constant real *table, REAL *x,          \
                               REAL *y, REAL *z) {                                                                     \
        const BITS unknown = not_finite##SUFFIX(first) | not_finite##SUFFIX(second) | (BITS)pose.unknown;              \
        const BITS withheld = given & (BITS)(~STATUS_INFORMS & 0xff);                                                  \
        BITS status = point##SUFFIX(first, second, pose, table, x, y, z);                                              \
        const BITS lost = not_finite##SUFFIX(*x) | not_finite##SUFFIX(*y) | not_finite##SUFFIX(*z);                    \
        const BITS outside = OUTSIDE(*x, 0) | OUTSIDE(*y, 1) | OUTSIDE(*z, 2);                                         \
        status = (status == (BITS)0) & (lost != (BITS)0) ? (BITS)STATUS_NOT_FINITE : status;                           \
        status = (status == (BITS)0) & (outside != (BITS)0) ? (BITS)STATUS_OUT_OF_RANGE : status;                      \
        status = unknown != (BITS)0 ? (BITS)STATUS_NOT_FINITE : status;                                                \
        status = withheld != (BITS)0 ? (BITS)0 : status;                                                               \
        const BITS gone = (status | withheld) != (BITS)0;                                                              \
        *x = gone ? (REAL)REAL_NAN : *x;                                                                               \
        *y = gone ? (REAL)REAL_NAN : *y;                                                                               \
        *z = gone ? (REAL)REAL_NAN : *z;                                                                               \
        return given | status;                                                                                         \
    }
JUDGED(, real, int)
JUDGED(16, real16, bits16)

#ifdef GEOMETRY_ROTATING
#define PROFILES global const INPUT *restrict position, global const INPUT *restrict travel
#define FIRST_AT(i) ((real)position[i])
#define SECOND_AT(i, sample) ((real)(sample))
#define FIRST_16(i) convert_real16(vload16(0, position + (i)))
#define SECOND_16(i, sample) ((real)(sample) + COUNT_16)
#define COUNT_16 (real16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#else
#define PROFILES                                                                                                       \
    global const INPUT *restrict g, global const INPUT *restrict h, global const INPUT *restrict travel
#define FIRST_AT(i) ((real)g[i])
#define SECOND_AT(i, sample) ((real)h[i])
#define FIRST_16(i) convert_real16(vload16(0, g + (i)))
#define SECOND_16(i, sample) convert_real16(vload16(0, h + (i)))
#endif
#define IMAGE                                                                                                          \
    global const uchar *restrict given, global real *restrict x, global real *restrict y, global real *restrict z,     \
        global uchar *restrict status, constant real *table, const uint samples

// Columns across, profiles down: (samples, profiles) work-items.
kernel void assemble_item(PROFILES, IMAGE) {
    const uint sample = get_global_id(0), profile = get_global_id(1);
    const ulong i = (ulong)profile * samples + sample;
    const Pose pose = pose_of((real)travel[profile], table);
    real px, py, pz;
    status[i] = (uchar)judged(FIRST_AT(i), SECOND_AT(i, sample), given[i], pose, table, &px, &py, &pz);
    x[i] = px;
    y[i] = py;
    z[i] = pz;
}

// Strips across, profiles down.
kernel void assemble_strip(PROFILES, IMAGE) {
    const uint start = get_global_id(0) * STRIP, profile = get_global_id(1);
    const uint end = min(start + STRIP, samples);
    const ulong row = (ulong)profile * samples;
    const Pose pose = pose_of((real)travel[profile], table);
    uint sample = start;
    for (; sample + 16 <= end; sample += 16) {
        const ulong i = row + sample;
        real16 px, py, pz;
        const bits16 flags = convert_bits16(vload16(0, given + i));
        const bits16 found = judged16(FIRST_16(i), SECOND_16(i, sample), flags, pose, table, &px, &py, &pz);
        vstore16(convert_uchar16(found), 0, status + i);
        vstore16(px, 0, x + i);
        vstore16(py, 0, y + i);
        vstore16(pz, 0, z + i);
    }
    for (; sample < end; ++sample) {
        const ulong i = row + sample;
        real px, py, pz;
        status[i] = (uchar)judged(FIRST_AT(i), SECOND_AT(i, sample), given[i], pose, table, &px, &py, &pz);
        x[i] = px;
        y[i] = py;
        z[i] = pz;
    }
}
