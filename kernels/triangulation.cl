// Sensor coordinates (u, v) -> points (G, H) in the sheet of light, one work-item per point. The body is straight-line
// code, which CPU runtimes vectorise across work-items; explicit 16-wide strips were slower on both of them.
#include "sheet.h"

kernel void triangulate(global const INPUT *restrict u, global const INPUT *restrict v, global real *restrict g,
                        global real *restrict h, global uchar *restrict status, global real *restrict sigma_g,
                        global real *restrict sigma_h, const ulong points, constant real *sheet, const real sigma_u,
                        const real sigma_v) {
    // The last group moves back to end with the last point, and does some points twice: a test for the end in the body
    // would cost the vectorisation, and a group size that divides every number of points does not exist.
    const size_t start = min(get_group_id(0) * get_local_size(0), (size_t)points - get_local_size(0));
    const size_t i = start + get_local_id(0);
    const real position = u[i], sample = v[i];
    real at_g, at_h;
    const uchar flags = sheet_point(position, sample, sheet, &at_g, &at_h);
    g[i] = at_g;
    h[i] = at_h;
    status[i] = flags;
#ifdef SHEET_SIGMAS
    real of_g, of_h;
    sheet_sigma(position, sample, sigma_u, sigma_v, sheet, &of_g, &of_h);
    sigma_g[i] = flags ? REAL_NAN : of_g;
    sigma_h[i] = flags ? REAL_NAN : of_h;
#endif
}
