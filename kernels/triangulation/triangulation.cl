// Sensor coordinates (u, v) -> points (G, H) in the sheet of light. CPU runtimes take strips of 16-wide vectors, GPUs
// an item per point; `each` is the number of points of a strip, or of a work-group.
#include "common/lanes.h"
#include "common/sheet.h"

#ifdef VECTOR_VARIANT
typedef INPUT16 inputs_at __attribute__((aligned(sizeof(INPUT))));
#define LOAD(from) convert_real16(*(global const inputs_at *)(from))
#else
#define LOAD(from) ((real)*(from))
#endif

kernel void triangulate(global const INPUT *restrict u, global const INPUT *restrict v, global real *restrict g,
                        global real *restrict h, global uchar *restrict status, global real *restrict sigma_g,
                        global real *restrict sigma_h, const ulong points, const ulong each, constant real *sheet,
                        const real sigma_u, const real sigma_v) {
    // The last vector, or work-group, moves back to end with the last point, and does some points twice: a test for the
    // end within it would cost more than they do.
#ifdef VECTOR_VARIANT
    const ulong first = get_global_id(0) * each, end = min(first + each, points);
    for (ulong next = first; next < end; next += LANES) {
        const ulong i = min(next, points - LANES);
#else
    {
        const ulong i = min(get_group_id(0) * each, points - each) + get_local_id(0);
#endif
        const reals position = LOAD(u + i), sample = LOAD(v + i);
        reals at_g, at_h;
        store_bytes(LANED(sheet_point)(position, sample, sheet, &at_g, &at_h), status + i);
        store_reals(at_g, g + i);
        store_reals(at_h, h + i);
#ifdef SHEET_SIGMAS
        reals of_g, of_h;
        LANED(sheet_sigma)(position, sample, (reals)sigma_u, (reals)sigma_v, sheet, &of_g, &of_h);
        const masks missing = mask_of(LANED(not_finite)(at_g));
        store_reals(nan_where(missing, of_g), sigma_g + i);
        store_reals(nan_where(missing, of_h), sigma_h + i);
#endif
    }
}
