// Reflectance of pairs of directions (towards the light, towards the eye), each of any length, the normal being z. CPU
// runtimes take strips, 16 pairs at once, GPUs an item per pair.
#include "reflectance/brdf.h"
#include "common/status.h"

typedef reals places;
#ifdef VECTOR_VARIANT
#define convert_places convert_real16
#else
#define convert_places convert_real
#endif
#include "common/six_columns.h"

static inline Direction direction_of(const reals *at) {
    const reals largest = larger_of(larger_of(fabs(at[0]), fabs(at[1])), fabs(at[2]));
    const Direction scaled = {at[0] / largest, at[1] / largest, at[2] / largest};
    const reals per = (real)1 / sqrt(dot_of(scaled, scaled));
    const Direction unit = {scaled.x * per, scaled.y * per, scaled.z * per};
    return unit;
}

static inline masks no_direction(Direction a) {
    return mask_of(LANED(not_finite)(a.x)) | mask_of(LANED(not_finite)(a.y)) | mask_of(LANED(not_finite)(a.z));
}

AS_IT_IS kernel void reflectance(global const INPUT *restrict directions, global real *restrict value,
                                 global uchar *restrict status, constant real *model, const ulong count,
                                 const ulong each) {
    // The last vector, or work-group, moves back to end with the last pair.
#ifdef VECTOR_VARIANT
    const ulong begin = get_global_id(0) * each, end = min(begin + each, count);
    for (ulong next = begin; next < end; next += LANES) {
        const ulong i = min(next, count - LANES);
#else
    {
        const ulong i = min(get_group_id(0) * each, count - each) + get_local_id(0);
#endif
        reals columns[6];
        load_columns(directions + 6 * i, columns);
        const Direction in = direction_of(columns), out = direction_of(columns + 3);
        const masks bad = no_direction(in) | no_direction(out);
        store_reals(nan_where(bad, brdf(in, out, model)), value + i);
        store_bytes(convert_bytes(bad & (masks)STATUS_NOT_FINITE), status + i);
    }
}
