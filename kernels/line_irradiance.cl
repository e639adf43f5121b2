// Irradiance of receivers (position, normal) from all lit segments, unoccluded. CPU runtimes take strips of 16
// receivers, GPUs an item per receiver. Segments that lie alike, along one direction in surfaces of one normal, share a
// frame: receivers are turned into it once, and shifted to each segment. Both in `place`, double wherever the device
// has it: 1e-6 of a segment's length away from it, single would have no digit left.
#include "line_irradiance.h"
#include "status.h"

#ifdef WIDE_PLACES
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double place;
#ifdef STRIP
typedef double16 places;
#define convert_places convert_double16
#else
typedef double places;
#define convert_places convert_double
#endif
#else
typedef float place;
#ifdef STRIP
typedef float16 places;
#define convert_places convert_float16
#else
typedef float places;
#define convert_places convert_float
#endif
#endif
#ifdef STRIP
#define narrow convert_real16
#else
#define narrow convert_real
#endif

#define FEW 16

// Places and normals of 16 receivers, six numbers each, as columns. (From single numbers the compilers make gathers.)
#if defined(STRIP) && __has_builtin(__builtin_shufflevector)
typedef INPUT inputs __attribute__((ext_vector_type(16)));
typedef inputs inputs_at __attribute__((aligned(sizeof(INPUT))));
#define PART(a, b, first)                                                                                              \
    __builtin_shufflevector(a, b, first, first + 2, first + 4, first + 6, first + 8, first + 10, first + 12,           \
                            first + 14, first + 16, first + 18, first + 20, first + 22, first + 24, first + 26,        \
                            first + 28, first + 30)
// Of 48 numbers in three vectors, the 16 from `first` on, each third.
__attribute__((always_inline)) inline places third(inputs a, inputs b, inputs c, int first) {
    if (first == 0) {
        const inputs two = __builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0);
        return convert_places(
            __builtin_shufflevector(two, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29));
    }
    if (first == 1) {
        const inputs two = __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0);
        return convert_places(
            __builtin_shufflevector(two, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30));
    }
    const inputs two = __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0);
    return convert_places(__builtin_shufflevector(two, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31));
}
inline void load_columns(global const INPUT *at, places *columns) {
    global const inputs_at *from = (global const inputs_at *)at;
    const inputs a = from[0], b = from[1], c = from[2], d = from[3], e = from[4], f = from[5];
#pragma unroll
    for (int parity = 0; parity < 2; parity++) {
        const inputs one = parity ? PART(a, b, 1) : PART(a, b, 0);
        const inputs two = parity ? PART(c, d, 1) : PART(c, d, 0);
        const inputs three = parity ? PART(e, f, 1) : PART(e, f, 0);
#pragma unroll
        for (int n = 0; n < 3; n++) columns[2 * n + parity] = third(one, two, three, n);
    }
}
#elif defined(STRIP)
inline void load_columns(global const INPUT *from, places *columns) {
    for (int n = 0; n < 6; n++) {
        global const INPUT *at = from + n;
        columns[n] = (places)(at[0], at[6], at[12], at[18], at[24], at[30], at[36], at[42],
                              at[48], at[54], at[60], at[66], at[72], at[78], at[84], at[90]);
    }
}
#else
inline void load_columns(global const INPUT *from, places *columns) {
    for (int n = 0; n < 6; n++) columns[n] = from[n];
}
#endif

inline places placed(places x, places y, places z, global const place *row) {
    return x * row[0] + (y * row[1] + (z * row[2] + row[3]));
}
inline reals turned(reals x, reals y, reals z, global const real *row) { return x * row[0] + y * row[1] + z * row[2]; }

// `middle`: what is subtracted from places first. rows, for each frame: from a place to how far it lies before the
// first segment's start along the line, above the surface, and aside (three factors and what is added each). axes: of
// normals, along the line, against the surface's normal, and against what is aside. `firsts`: where the segments of
// each frame begin, and the end of the last; the first `alone` frames have one segment. starts: what a segment adds to
// the three lengths of its frame, and its length; lines: its length, exitance / 2 pi.
AS_IT_IS kernel void line_irradiance(global const INPUT *restrict receivers, global real *restrict irradiance,
                                     global uchar *restrict status, constant place *restrict middle,
                                     global const place *restrict rows, global const real *restrict axes,
                                     global const uint *restrict firsts, global const place *restrict starts,
                                     global const real *restrict lines, const uint alone, const uint frames,
                                     const ulong count, const ulong each) {
    // The last vector, or work-group, moves back to end with the last receiver.
#ifdef STRIP
    const ulong begin = get_global_id(0) * each, end = min(begin + each, count);
    for (ulong next = begin; next < end; next += LANES) {
        const ulong i = min(next, count - LANES);
#else
    {
        const ulong i = min(get_group_id(0) * each, count - each) + get_local_id(0);
#endif
        places columns[6];
        load_columns(receivers + 6 * i, columns);
        const places x = columns[0] - middle[0], y = columns[1] - middle[1], z = columns[2] - middle[2];
        // Normals may be of any length.
        const places ax = fabs(columns[3]), ay = fabs(columns[4]), az = fabs(columns[5]);
        const places two = ax > ay ? ax : ay, scale = (place)1 / (two > az ? two : az);
        const reals nx = narrow(columns[3] * scale), ny = narrow(columns[4] * scale), nz = narrow(columns[5] * scale);
        const reals per = (real)1 / sqrt(nx * nx + ny * ny + nz * nz);
        const reals normal_x = nx * per, normal_y = ny * per, normal_z = nz * per;
        places sum = (place)0;
        uint k = 0;
        while (k < alone) {
            // Few are summed in `real`.
            reals few = (reals)0;
            for (const uint to = min(k + FEW, alone); k < to; k++) {
                global const place *row = rows + 12 * k;
                global const real *axis = axes + 9 * k;
                const reals height = narrow(placed(x, y, z, row + 4));
                // Most pairs do not face each other.
                if (!any_of(mask_of(height > (reals)0))) continue;
                const places tau = placed(x, y, z, row);
                const reals aside = narrow(placed(x, y, z, row + 8));
                const reals by_u = turned(normal_x, normal_y, normal_z, axis);
                const reals foot = turned(normal_x, normal_y, normal_z, axis + 3) * height +
                                   turned(normal_x, normal_y, normal_z, axis + 6) * aside;
                // The far end, too, may be near.
                few += lines[2 * k + 1] * LANED(end_factor)(narrow(tau), narrow(tau + starts[4 * k + 3]),
                                                            (reals)lines[2 * k], height, aside, by_u, foot);
            }
            sum += convert_places(few);
        }
        for (uint frame = alone; frame < frames; frame++) {
            global const place *row = rows + 12 * frame;
            global const real *axis = axes + 9 * frame;
            const places before = placed(x, y, z, row), above = placed(x, y, z, row + 4);
            const places beside = placed(x, y, z, row + 8);
            const reals by_u = turned(normal_x, normal_y, normal_z, axis);
            const reals by_n = turned(normal_x, normal_y, normal_z, axis + 3);
            const reals by_w = turned(normal_x, normal_y, normal_z, axis + 6);
            const uint last = firsts[frame + 1];
            while (k < last) {
                reals few = (reals)0;
                for (const uint to = min(k + FEW, last); k < to; k++) {
                    global const place *start = starts + 4 * k;
                    const reals height = narrow(above + start[1]);
                    if (!any_of(mask_of(height > (reals)0))) continue;
                    const places tau = before + start[0];
                    const reals aside = narrow(beside + start[2]), foot = by_n * height + by_w * aside;
                    few += lines[2 * k + 1] * LANED(end_factor)(narrow(tau), narrow(tau + start[3]),
                                                                (reals)lines[2 * k], height, aside, by_u, foot);
                }
                sum += convert_places(few);
            }
        }
        reals result = narrow(sum);
        const masks bad = mask_of(LANED(not_finite)(narrow(x))) | mask_of(LANED(not_finite)(narrow(y))) |
                          mask_of(LANED(not_finite)(narrow(z))) | mask_of(LANED(not_finite)(normal_x)) |
                          mask_of(LANED(not_finite)(normal_y)) | mask_of(LANED(not_finite)(normal_z)) |
                          mask_of(LANED(not_finite)(result));
        result = nan_where(bad, result);
        store_reals(result, irradiance + i);
        store_bytes(convert_bytes(bad & (masks)STATUS_NOT_FINITE), status + i);
    }
}
