// Reflectance of pairs of directions (towards the light, towards the eye), each of any length, the normal being z.
#include "brdf.h"
#include "status.h"

inline Direction direction_of(global const INPUT *at) {
    const real x = at[0], y = at[1], z = at[2];
    const real largest = fmax(fmax(fabs(x), fabs(y)), fabs(z));
    const Direction scaled = {x / largest, y / largest, z / largest};
    const real per = (real)1 / sqrt(dot_of(scaled, scaled));
    const Direction unit = {scaled.x * per, scaled.y * per, scaled.z * per};
    return unit;
}

kernel void reflectance(global const INPUT *restrict directions, global real *restrict value,
                        global uchar *restrict status, constant real *model) {
    const size_t i = get_global_id(0);
    const Direction in = direction_of(directions + 6 * i), out = direction_of(directions + 6 * i + 3);
    const int bad = not_finite(in.x) | not_finite(in.y) | not_finite(in.z) | not_finite(out.x) | not_finite(out.y) |
                    not_finite(out.z);
    const real result = brdf(in, out, model);
    value[i] = bad ? REAL_NAN : result;
    status[i] = bad ? STATUS_NOT_FINITE : STATUS_OK;
}
