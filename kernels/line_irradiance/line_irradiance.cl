// Irradiance of receivers (position, normal) from all lit segments, unoccluded. CPU runtimes take strips of 16
// receivers, GPUs an item per receiver. Segments that lie alike, along one direction in surfaces of one normal, share a
// frame: receivers are turned into it once, and shifted to each segment. Both in `place`, double wherever the device
// has it: 1e-6 of a segment's length away from it, single would have no digit left.
#include "line_irradiance/line_irradiance.h"
#include "common/status.h"

#ifdef WIDE_PLACES
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double place;
#ifdef VECTOR_VARIANT
typedef double16 places;
#define convert_places convert_double16
#else
typedef double places;
#define convert_places convert_double
#endif
#else
typedef float place;
#ifdef VECTOR_VARIANT
typedef float16 places;
#define convert_places convert_float16
#else
typedef float places;
#define convert_places convert_float
#endif
#endif
#ifdef VECTOR_VARIANT
#define narrow convert_real16
#else
#define narrow convert_real
#endif

#define FEW 16

#include "common/six_columns.h"

static inline places placed(places x, places y, places z, global const place *row) {
    return x * row[0] + (y * row[1] + (z * row[2] + row[3]));
}
static inline reals turned(reals x, reals y, reals z, global const real *row) { return x * row[0] + y * row[1] + z * row[2]; }

// `middle`: what is subtracted from places first. rows, for each frame: from a place to how far it lies before the
// first segment's start along the line, above the surface, and aside (three factors and what is added each). axes: of
// normals, along the line, against the surface's normal, and against what is aside. `firsts`: where the segments of
// each frame begin, and the end of the last; the first `alone` frames have one segment. starts: what a segment adds to
// the three lengths of its frame, and its length; lines: its length, the square of that, exitance / 2 pi.
AS_IT_IS kernel void line_irradiance(global const INPUT *restrict receivers, global real *restrict irradiance,
                                     global uchar *restrict status, constant place *restrict middle,
                                     global const place *restrict rows, global const real *restrict axes,
                                     global const uint *restrict firsts, global const place *restrict starts,
                                     global const real *restrict lines, const uint alone, const uint frames,
                                     const ulong count, const ulong each) {
    // The last vector, or work-group, moves back to end with the last receiver.
#ifdef VECTOR_VARIANT
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
                global const real *axis = axes + 9 * k, *line = lines + 3 * k;
                const reals height = narrow(placed(x, y, z, row + 4));
                // Most pairs do not face each other.
                if (!any_of(mask_of(height > (reals)0))) continue;
                const places tau = placed(x, y, z, row);
                const reals aside = narrow(placed(x, y, z, row + 8));
                const reals by_u = turned(normal_x, normal_y, normal_z, axis);
                const reals foot = turned(normal_x, normal_y, normal_z, axis + 3) * height +
                                   turned(normal_x, normal_y, normal_z, axis + 6) * aside;
                // The far end, too, may be near.
                const reals light = LANED(end_factor)(narrow(tau), narrow(tau + starts[4 * k + 3]), (reals)line[0],
                                                      (reals)line[1], height, aside, by_u, foot);
                few += line[2] * light;
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
                    global const real *line = lines + 3 * k;
                    const reals height = narrow(above + start[1]);
                    if (!any_of(mask_of(height > (reals)0))) continue;
                    const places tau = before + start[0];
                    const reals aside = narrow(beside + start[2]), foot = by_n * height + by_w * aside;
                    const reals light = LANED(end_factor)(narrow(tau), narrow(tau + start[3]), (reals)line[0],
                                                          (reals)line[1], height, aside, by_u, foot);
                    few += line[2] * light;
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
