// Bidirectional reflectance, 1/sr, of unit directions away from the surface, whose normal is z. BRDF_LAMBERT, _PHONG,
// _OREN_NAYAR, _GGX or _WARD says which; `model` holds its parameters as gpuvision/simulation/reflectance.py has them.
#ifndef BRDF_H
#define BRDF_H
#include "real.h"

#define PI_REAL ((real)3.14159265358979323846)

typedef struct {
    real x, y, z;
} Direction;

inline real dot_of(Direction a, Direction b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

inline real brdf_above(Direction in, Direction out, constant real *model) {
#if defined(BRDF_LAMBERT)
    return model[0] / PI_REAL;
#elif defined(BRDF_PHONG)
    const real cosine = in.z * out.z - in.x * out.x - in.y * out.y;
    return model[0] * (model[1] + (real)2) / ((real)2 * PI_REAL) * pow(max(cosine, (real)0), model[1]);
#elif defined(BRDF_OREN_NAYAR)
    const real across = in.x * out.x + in.y * out.y;
    const real per = across > (real)0 ? max(in.z, out.z) : (real)1;
    return model[0] * (model[1] + model[2] * across / per);
#elif defined(BRDF_GGX)
    const real square = model[0] * model[0], rest = (real)1 - square;
    const Direction half_way = {in.x + out.x, in.y + out.y, in.z + out.z};
    const real length = dot_of(half_way, half_way);
    // sin^2 + alpha^2 cos^2: of the sine itself, which a smooth surface's lobe is all about.
    const real spread = (half_way.x * half_way.x + half_way.y * half_way.y + square * half_way.z * half_way.z) / length;
    const real masked = out.z * sqrt(square + rest * in.z * in.z) + in.z * sqrt(square + rest * out.z * out.z);
    const real away = max((real)1 - (real)0.5 * sqrt(length), (real)0), away2 = away * away;
    const real fresnel = model[1] + ((real)1 - model[1]) * away2 * away2 * away;
    return fresnel * (square / (PI_REAL * spread * spread)) * (real)0.5 / masked;
#elif defined(BRDF_WARD)
    const Direction half_way = {in.x + out.x, in.y + out.y, in.z + out.z};
    const real x = half_way.x / (model[1] * half_way.z), y = half_way.y / (model[2] * half_way.z);
    const real upright = half_way.z * half_way.z;
    return model[0] / (PI_REAL * model[1] * model[2]) * exp(-(x * x + y * y)) * dot_of(half_way, half_way) /
           (upright * upright);
#endif
}

// Nothing where either direction lies below the surface.
inline real brdf(Direction in, Direction out, constant real *model) {
    return in.z > (real)0 && out.z > (real)0 ? brdf_above(in, out, model) : (real)0;
}

#endif
