// Grey levels of a blurred shape, and their derivatives by the shape and the blur.
//
// Options: ROUND, FREEDOMS as in blob.cl; RATIO: inner over outer size of a ring or a cross; else a disc or a square.
#ifndef BLOB_MODEL_H
#define BLOB_MODEL_H
#include "common/least_squares.h"
#include "common/robust.h"

// Shape of a fiducial; its position is relative to the nominal position [px], [rad].
typedef struct {
    real x, y, size, angle;
} blob_shape;

// Cosine and sine of the angle of a shape; a round shape has the angle 0.
#ifdef ROUND
static inline real cosine_of(blob_shape shape) { return 1; }
static inline real sine_of(blob_shape shape) { return 0; }
#else
static inline real cosine_of(blob_shape shape) { return cos(shape.angle); }
static inline real sine_of(blob_shape shape) { return sin(shape.angle); }
#endif

// Grey level of the model (0 to 1) and its derivatives with respect to the shape and the blur.
typedef struct {
    reals level, row[FREEDOMS + 1];
} blob_model;

// Step blurred by a Gaussian at t standard deviations, and its derivative; clamped at 3.5 standard deviations.
// Odd polynomial approximation, error 2.4e-4: an odd error does not move an edge.
#define STEP_END (real)3.5f
static inline reals blurred_step(reals t, private reals *density) {
    const reals end = (reals)STEP_END;
    const reals within = (t > end) ? end : ((t < -end) ? -end : t), v = within * (reals)(1 / STEP_END), q = v * v;
    const reals even =
        (((((reals)-0.711542f * q + 2.831766f) * q - 4.759453f) * q + 4.513241f) * q - 2.767476f) * q + 1.393465f;
    *density = ((((((reals)(-0.711542f * 11) * q + 2.831766f * 9) * q - 4.759453f * 7) * q + 4.513241f * 5) * q -
                 2.767476f * 3) * q + 1.393465f) * (reals)(1 / STEP_END);
    return v * even + (reals)0.5f;
}

#ifdef ROUND
// Add a disc whose radius is the fraction `share` of the size. Its edge is curved: to first order in blur / radius the
// level is lower by half of that ratio times the density.
static inline void add_disc(reals r, real size, real share, real sign, real per_blur, private blob_model *model) {
    reals density;
    const reals t = (share * size - r) * per_blur;
    const reals step = blurred_step(t, &density);
    const reals slope = sign * per_blur * density;
    model->level += sign * (step - density * ((real)0.5f / (share * size * per_blur)));
    model->row[0] += slope;
    model->row[2] += share * slope;
    model->row[3] -= t * slope;
}

static inline blob_model model_at(reals x, reals y, blob_shape shape, real cosine, real sine, real blur) {
    const reals square = x * x + y * y + (reals)1e-12f, per = rsqrt(square), r = square * per;
    const real per_blur = 1 / blur;
    blob_model model = {0, {0, 0, 0, 0}};
    add_disc(r, shape.size, 1, 1, per_blur, &model);
#ifdef RATIO
    add_disc(r, shape.size, (real)(RATIO), -1, per_blur, &model);
#endif
    model.row[1] = model.row[0] * y * per;
    model.row[0] *= x * per;
    return model;
}
#else
// Band between two edges at -half_ and half_: level, and derivatives by position, half width and blur.
typedef struct {
    reals level, place, half_, blur;
} blob_band;

static inline blob_band band_at(reals u, real half_, real per_blur) {
    blob_band band;
    reals density;
    const reals t = ((reals)half_ - FABS(u)) * per_blur;
    band.level = blurred_step(t, &density);
    band.half_ = density * per_blur;
    band.place = u > (reals)0 ? -band.half_ : band.half_;
    band.blur = -t * band.half_;
    return band;
}

static inline blob_model model_at(reals x, reals y, blob_shape shape, real cosine, real sine, real blur) {
    const reals u = cosine * x + sine * y, v = cosine * y - sine * x;
    const real per_blur = 1 / blur;
    const blob_band a = band_at(u, shape.size, per_blur), b = band_at(v, shape.size, per_blur);
    blob_model model;
#ifdef RATIO
    const real share = (real)(RATIO);
    const blob_band c = band_at(u, share * shape.size, per_blur), d = band_at(v, share * shape.size, per_blur);
    const reals left_c = b.level - d.level, left_d = a.level - c.level;
    model.level = a.level * d.level + c.level * left_c;
    const reals by_u = a.place * d.level + c.place * left_c, by_v = d.place * left_d + c.level * b.place;
    model.row[2] = a.half_ * d.level + share * c.half_ * left_c + share * d.half_ * left_d + c.level * b.half_;
    model.row[4] = a.blur * d.level + c.blur * left_c + d.blur * left_d + c.level * b.blur;
#else
    model.level = a.level * b.level;
    const reals by_u = a.place * b.level, by_v = a.level * b.place;
    model.row[2] = a.half_ * b.level + a.level * b.half_;
    model.row[4] = a.blur * b.level + a.level * b.blur;
#endif
    model.row[0] = sine * by_v - cosine * by_u;
    model.row[1] = -sine * by_u - cosine * by_v;
    model.row[3] = by_u * v - by_v * u;
    return model;
}
#endif

#endif
