// Bidirectional reflectance distribution functions [1/sr] of unit directions away from a surface with normal z.
//
// One of BRDF_LAMBERT, _PHONG, _OREN_NAYAR, _GGX, _WARD selects the function; `model` holds its parameters in the order
// of gpuvision/simulation/scene/reflectance.py.
#ifndef BRDF_H
#define BRDF_H
#include "common/lanes.h"

#define PI_REAL ((real)3.14159265358979323846)

typedef struct {
    reals x, y, z;
} Direction;

static inline reals dot_of(Direction a, Direction b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline reals larger_of(reals a, reals b) { return a > b ? a : b; }
#if defined(BRDF_PHONG) && defined(VECTOR_VARIANT) && defined(REAL_IS_DOUBLE)
// pow() of double16 vectors returns infinity for some lanes on PoCL 3.1: compute lane by lane.
static inline reals power_of(reals base, real exponent) {
    real lanes[LANES];
    *(reals_at *)lanes = base;
    for (int n = 0; n < LANES; n++) lanes[n] = pow(lanes[n], exponent);
    return *(const reals_at *)lanes;
}
#elif defined(BRDF_PHONG)
static inline reals power_of(reals base, real exponent) { return pow(base, (reals)exponent); }
#endif

static inline reals brdf_above(Direction in, Direction out, constant real *model) {
#if defined(BRDF_LAMBERT)
    return (reals)(model[0] / PI_REAL);
#elif defined(BRDF_PHONG)
    const reals cosine = in.z * out.z - in.x * out.x - in.y * out.y;
    const reals lobe = power_of(larger_of(cosine, (reals)0), model[1]);
    return model[0] * (model[1] + (real)2) / ((real)2 * PI_REAL) * lobe;
#elif defined(BRDF_OREN_NAYAR)
    const reals across = in.x * out.x + in.y * out.y;
    const reals per = across > (reals)0 ? larger_of(in.z, out.z) : (reals)1;
    return model[0] * (model[1] + model[2] * across / per);
#elif defined(BRDF_GGX)
    const real square = model[0] * model[0], rest = (real)1 - square;
    const Direction half_way = {in.x + out.x, in.y + out.y, in.z + out.z};
    const reals length = dot_of(half_way, half_way);
    // sin^2 + alpha^2 cos^2 from the sine itself: 1 - cos^2 would cancel in the narrow lobe of a smooth surface.
    const reals sine2 = half_way.x * half_way.x + half_way.y * half_way.y;
    const reals spread = (sine2 + square * half_way.z * half_way.z) / length;
    const reals masked = out.z * sqrt(square + rest * in.z * in.z) + in.z * sqrt(square + rest * out.z * out.z);
    const reals away = larger_of((real)1 - (real)0.5 * sqrt(length), (reals)0), away2 = away * away;
    const reals fresnel = model[1] + ((real)1 - model[1]) * away2 * away2 * away;
    return fresnel * (square / (PI_REAL * spread * spread)) * (real)0.5 / masked;
#elif defined(BRDF_WARD)
    const Direction half_way = {in.x + out.x, in.y + out.y, in.z + out.z};
    const reals x = half_way.x / (model[1] * half_way.z), y = half_way.y / (model[2] * half_way.z);
    const reals upright = half_way.z * half_way.z;
    return model[0] / (PI_REAL * model[1] * model[2]) * exp(-(x * x + y * y)) * dot_of(half_way, half_way) /
           (upright * upright);
#endif
}

// The reflectance; 0 where a direction lies below the surface.
static inline reals brdf(Direction in, Direction out, constant real *model) {
    const masks above = mask_of(in.z > (reals)0) & mask_of(out.z > (reals)0);
    return zero_where(~above, brdf_above(in, out, model));
}

#endif
