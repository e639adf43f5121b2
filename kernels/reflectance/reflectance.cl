// Reflectance (BRDF) of pairs of directions on a surface with normal z.
//
// Inputs:  directions (count, 6), to the light and to the eye, each of any length, type INPUT.
// Outputs: value (count,) [1/sr], NaN where a direction is not finite or zero; status (count,) flags.
// Tables:  model, the parameters of the BRDF (brdf.h).
// Options: BRDF_LAMBERT, _PHONG, _OREN_NAYAR, _GGX or _WARD; INPUT; REAL_IS_DOUBLE.
// Variants: vector: 16 pairs in a vector, `each` pairs per work-item; work-item: one pair per item.
#include "reflectance/brdf.h"
#include "common/status.h"

#define COLUMN_TYPE reals
#define CONVERT_COLUMN LANED(convert_real)
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
    const sample_range own = samples_of_item(each, count);
    for (ulong next = own.begin; next < own.end; next += LANES) {
        const ulong i = whole_vector(next, count);
        reals columns[6];
        load_columns(directions + 6 * i, columns);
        const Direction in = direction_of(columns), out = direction_of(columns + 3);
        const masks bad = no_direction(in) | no_direction(out);
        store_reals(nan_where(bad, brdf(in, out, model)), value + i);
        store_bytes(convert_bytes(bad & (masks)STATUS_NOT_FINITE), status + i);
    }
}
