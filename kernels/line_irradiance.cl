// Irradiance of receivers (position, normal) from all lit segments, unoccluded. CPU runtimes take strips of 16
// receivers, GPUs an item per receiver. Places are subtracted and turned into each segment's frame in `place`, double
// wherever the device has it: 1e-6 of a segment's length away from it, single would have no digit left.
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

// A row: start, direction, normal, across (3 places each), length; and in real the last four again, exitance / 2 pi.
#define PLACES 13
#define REALS 11

inline places load_places(global const INPUT *receivers, int column) {
#ifdef STRIP
    global const INPUT *at = receivers + column;
    return (places)(at[0], at[6], at[12], at[18], at[24], at[30], at[36], at[42],
                    at[48], at[54], at[60], at[66], at[72], at[78], at[84], at[90]);
#else
    return receivers[column];
#endif
}

inline places dot3(places x, places y, places z, global const place *row) {
    return x * row[0] + y * row[1] + z * row[2];
}
inline reals turned(reals x, reals y, reals z, global const real *row) { return x * row[0] + y * row[1] + z * row[2]; }

kernel void line_irradiance(global const INPUT *restrict receivers, global real *restrict irradiance,
                            global uchar *restrict status, global const place *restrict segment_places,
                            global const real *restrict segment_reals, const uint segments, const ulong count,
                            const ulong each) {
    // The last vector, or work-group, moves back to end with the last receiver.
#ifdef STRIP
    const ulong begin = get_global_id(0) * each, end = min(begin + each, count);
    for (ulong next = begin; next < end; next += LANES) {
        const ulong i = min(next, count - LANES);
#else
    {
        const ulong i = min(get_group_id(0) * each, count - each) + get_local_id(0);
#endif
        global const INPUT *at = receivers + 6 * i;
        const places x = load_places(at, 0), y = load_places(at, 1), z = load_places(at, 2);
        places nx = load_places(at, 3), ny = load_places(at, 4), nz = load_places(at, 5);
        const places longest = fmax(fmax(fabs(nx), fabs(ny)), fabs(nz));
        nx /= longest;
        ny /= longest;
        nz /= longest;
        const places per = (place)1 / sqrt(nx * nx + ny * ny + nz * nz);
        const reals normal_x = narrow(nx * per), normal_y = narrow(ny * per), normal_z = narrow(nz * per);
        places sum = (place)0;
        for (uint k = 0; k < segments; k++) {
            global const place *row = segment_places + k * PLACES;
            global const real *more = segment_reals + k * REALS;
            const places dx = x - row[0], dy = y - row[1], dz = z - row[2];
            const reals height = narrow(dot3(dx, dy, dz, row + 6));
            // Most pairs do not face each other.
            if (!any_lane(mask_of(height > (reals)0))) continue;
            const places along = dot3(dx, dy, dz, row + 3);
            const reals by_u = turned(normal_x, normal_y, normal_z, more);
            const reals by_n = turned(normal_x, normal_y, normal_z, more + 3);
            const reals by_w = turned(normal_x, normal_y, normal_z, more + 6);
            const reals aside = narrow(dot3(dx, dy, dz, row + 9));
            // The far end, too, may be near.
            const reals past = narrow(row[12] - along);
            sum += convert_places(more[10] * LANED(line_factor)(narrow(along), height, aside, past, (reals)more[9],
                                                               by_u, by_n, by_w));
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
