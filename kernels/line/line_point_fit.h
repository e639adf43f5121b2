// Fast maximum-likelihood fit of a Gaussian line for lines of usual width (METHOD_ML).
//
// The Gaussian integrated over pixels is replaced by its value at the middle of the pixel, with the variance sigma^2 +
// 1/12 (the variance of a pixel's width). The two differ by a fourth cumulant of -1/120 px^4, an even function about
// the line. Largest difference of the position of 3000 lines with sigma = 1.6 px, measured: 1.4e-5 px with a peak of 180
// grey levels and noise of 3, 4.5e-5 px with shot noise of 9 at the peak, 7.8e-5 px with a peak of 60 and noise of 4; a
// tenth of these for sigma = 3 px.
//
// The model at sample k is m_k = b + a g_k with g_k = exp(-z_k^2 / 2), z_k = (k - p) / sigma. From sample to sample
// g changes by a factor that itself changes by a constant factor,
//     g_(k+1) = g_k r_k,   r_(k+1) = r_k exp(-1/sigma^2),
// so that no exponential and no error function is computed in the loop. The first step is Fisher scoring as in
// line_ml.h; the next ones are Newton's method, with the second derivatives of m and the derivative of the weights.
// Newton's method converges quadratically also with noise, so that one such step usually is enough.
//
// Other lanes are left to fit_integrals(): narrow and very wide lines, lines far from the peak, fits
// that do not converge in POINT_STEPS.
#ifndef LINE_POINT_FIT_H
#define LINE_POINT_FIT_H

#include "line/line_window.h"

#define POINT_STEPS 4           // largest number of Newton steps
#define POINT_SETTLED 5e-5f     // px: largest estimate of the error that the last step leaves
#define POINT_LARGEST 1         // largest sum of the relative changes of a step
#define POINT_NARROWEST 1.626f  // px: smallest root of sigma^2 + 1/12, for sigma = 1.6
#define POINT_WIDEST 12         // px: the rounding errors of r move the position by about sigma^2 times 1e-7
#define POINT_FARTHEST 1.5f     // px: largest distance of the line from the peak
#define POINT_DETERMINED 1e-3f  // smallest determinant of a pair of unknowns over the product of its diagonal

typedef struct {
    reals position, sigma, amplitude, background;  // position relative to the middle of the window
} Gaussian;

// Sums over the samples of the window, with the weights w = 1 / variance and the residuals r = y - m:
// the normal equations for the columns g z, g z^2, g, 1 (g0 .. g4: sums of w g^2 z^n; h0 .. h2: sums of w g z^n; h: sum
// of w), and e0 .. e4: sums of w r g z^n; e: sum of w r.
typedef struct {
    reals g0, g1, g2, g3, g4, h0, h1, h2, h, e0, e1, e2, e3, e4, e;
} PointSums;

// 1 / x. rough_reciprocal: 14 correct bits. reciprocal: one Newton step more, error at most 2 ulp. Intel's runtime takes
// about 60 cycles for a division of 16 lanes, several times as long as these.
#if defined(VECTOR_VARIANT) && defined(__AVX512F__) && !defined(REAL_IS_DOUBLE) && \
    __has_builtin(__builtin_ia32_rcp14ps512_mask)
static inline reals rough_reciprocal(reals x) { return __builtin_ia32_rcp14ps512_mask(x, x, (ushort)0xffff); }
static inline reals reciprocal(reals x) {
    const reals rough = rough_reciprocal(x);
    return rough * (2 - x * rough);
}
#else
static inline reals rough_reciprocal(reals x) { return 1 / x; }
static inline reals reciprocal(reals x) { return 1 / x; }
#endif

// exp(x) for |x| <= 1: the even and odd terms of the series up to x^10.
typedef struct {
    reals even, odd;
} ExpParts;

static inline ExpParts exp_parts(reals x) {
    const reals s = x * x;
    const ExpParts parts = {
        1 + s * ((real)(1.0 / 2) + s * ((real)(1.0 / 24) + s * ((real)(1.0 / 720) + s * ((real)(1.0 / 40320) +
            s * (real)(1.0 / 3628800))))),
        x * (1 + s * ((real)(1.0 / 6) + s * ((real)(1.0 / 120) + s * ((real)(1.0 / 5040) + s * (real)(1.0 / 362880)))))};
    return parts;
}

static inline reals small_exp(reals x) {
    const ExpParts parts = exp_parts(x);
    return parts.even + parts.odd;
}

// Noise of the samples, and the level from which on a sample is saturated.
typedef struct {
    real dark_variance, gain, saturation;
} SampleNoise;

// Add one sample. Under `second` the weights of the matrix include the derivative of 1 / variance, and e3 and e4 are
// summed.
static inline void add_point(PointSums *sums, reals y, reals g, reals z, const Gaussian *at, SampleNoise noise,
                             int second) {
    const reals model = at->background + at->amplitude * g;
    const reals variance = noise.dark_variance + noise.gain * lane_max(model, (reals)0);
    const reals w = choose_reals(int_mask(y >= (reals)noise.saturation), 0, rough_reciprocal(variance));
    const reals residual = w * (y - model);
    const reals weight = second ? w + noise.gain * w * residual : w;
    const reals wg = weight * g, wgz = wg * z, wgzz = wgz * z, gz = g * z, gzz = gz * z;
    sums->h += weight;
    sums->h0 += wg;
    sums->h1 += wgz;
    sums->h2 += wgzz;
    sums->g0 += wg * g;
    sums->g1 += wgz * g;
    sums->g2 += wgz * gz;
    sums->g3 += wgzz * gz;
    sums->g4 += wgzz * gzz;
    sums->e += residual;
    sums->e0 += residual * g;
    sums->e1 += residual * gz;
    sums->e2 += residual * gzz;
    if (second) {
        const reals gz3 = gzz * z;
        sums->e3 += residual * gz3;
        sums->e4 += residual * (gz3 * z);
    }
}

static inline PointSums point_sums(const reals *samples, const Gaussian *at, SampleNoise noise, int second) {
    PointSums sums;
    sums.g0 = sums.g1 = sums.g2 = sums.g3 = sums.g4 = sums.h0 = sums.h1 = sums.h2 = sums.h = 0;
    sums.e0 = sums.e1 = sums.e2 = sums.e3 = sums.e4 = sums.e = 0;
    const reals per_sigma = reciprocal(at->sigma), middle = -at->position * per_sigma;
    const reals half_step = small_exp(per_sigma * per_sigma * (real)-0.5), ratio = half_step * half_step;
    const ExpParts tilt = exp_parts(middle * per_sigma);
    const reals top = small_exp(middle * middle * (real)-0.5);
    reals g = top, z = middle, r = half_step * (tilt.even - tilt.odd);
    for (int k = 0; k <= RADIUS; k++) {
        add_point(&sums, samples[RADIUS + k], g, z, at, noise, second);
        g *= r;
        r *= ratio;
        z += per_sigma;
    }
    g = top;
    z = middle;
    r = half_step * (tilt.even + tilt.odd);
    for (int k = 1; k <= RADIUS; k++) {
        g *= r;
        r *= ratio;
        z -= per_sigma;
        add_point(&sums, samples[RADIUS - k], g, z, at, noise, second);
    }
    return sums;
}

// Movement of the position [px] by a step, and the sum of the relative changes of all unknowns; NaN where the equations
// do not determine the step.
typedef struct {
    reals move, change;
} PointStep;

// Take one step.
//
// The unknowns are a dp / sigma, a dlog(sigma), da and db, whose columns are g z, g z^2, g and 1. In these unknowns
// the second derivatives of m are g/a times z^2 - 1 (p, p), z^3 - 2 z (p, s), z^4 - 2 z^2 (s, s), z (p, a), z^2 (s, a).
// The pair (a, b) is eliminated first, so that a step takes two divisions for 4 unknowns.
static inline PointStep point_step(Gaussian *at, const PointSums *n, int second) {
    const reals per_amplitude = reciprocal(at->amplitude), per_a = second ? per_amplitude : 0;
    const reals m00 = n->g2 - per_a * (n->e2 - n->e0), m01 = n->g3 - per_a * (n->e3 - 2 * n->e1);
    const reals m11 = n->g4 - per_a * (n->e4 - 2 * n->e2);
    const reals m02 = n->g1 - per_a * n->e1, m12 = n->g2 - per_a * n->e2;
    const reals determinant = n->g0 * n->h - n->h0 * n->h0, per = reciprocal(determinant);
    const reals t02 = (m02 * n->h - n->h1 * n->h0) * per, t03 = (n->h1 * n->g0 - m02 * n->h0) * per;
    const reals t12 = (m12 * n->h - n->h2 * n->h0) * per, t13 = (n->h2 * n->g0 - m12 * n->h0) * per;
    const reals s00 = m00 - t02 * m02 - t03 * n->h1, s01 = m01 - t02 * m12 - t03 * n->h2;
    const reals s11 = m11 - t12 * m12 - t13 * n->h2;
    const reals r0 = n->e1 - t02 * n->e0 - t03 * n->e, r1 = n->e2 - t12 * n->e0 - t13 * n->e;
    const reals rest = s00 * s11 - s01 * s01, per_rest = reciprocal(rest);
    const reals x0 = (r0 * s11 - r1 * s01) * per_rest, x1 = (r1 * s00 - r0 * s01) * per_rest;
    const reals r2 = n->e0 - m02 * x0 - m12 * x1, r3 = n->e - n->h1 * x0 - n->h2 * x1;
    const reals x2 = (r2 * n->h - r3 * n->h0) * per, x3 = (r3 * n->g0 - r2 * n->h0) * per;
    const ints determined = int_mask(determinant > n->g0 * n->h * (real)POINT_DETERMINED) & int_mask(s00 > 0) &
                            int_mask(rest > s00 * s11 * (real)POINT_DETERMINED);
    const reals move = x0 * per_amplitude * at->sigma, growth = x1 * per_amplitude;
    const reals change = fabs(x0 * per_amplitude) + fabs(growth) + fabs(x2 * per_amplitude);
    at->position += move;
    // The first terms of exp(growth): the fit does not accept larger steps.
    at->sigma *= 1 + growth * (1 + growth * (real)0.5);
    at->amplitude += x2;
    at->background += x3;
    const PointStep step = {fabs(move), nan_where(to_masks(~determined), change)};
    return step;
}

static inline Gaussian choose_gaussian(ints mask, Gaussian yes, Gaussian no) {
    const Gaussian chosen = {choose_reals(mask, yes.position, no.position), choose_reals(mask, yes.sigma, no.sigma),
                             choose_reals(mask, yes.amplitude, no.amplitude),
                             choose_reals(mask, yes.background, no.background)};
    return chosen;
}

// Lanes with a width, a position and an amplitude for which this fit is accurate.
static inline ints in_range(const Gaussian *at) {
    return int_mask(at->sigma >= (real)POINT_NARROWEST) & int_mask(at->sigma <= (real)min(RADIUS, POINT_WIDEST)) &
           int_mask(fabs(at->position) <= (real)POINT_FARTHEST) & int_mask(at->amplitude > 0);
}

// Fit the lanes of `wanted` from the start values `at`, whose sigma is that of the samples and thus contains the variance
// of a pixel's width. Return the lanes that are fitted. A lane that has converged is not changed any more: its reading
// does not depend on the other lanes. Under NOISE, sigma and amplitude are converted from the sampled Gaussian to the
// Gaussian integrated over pixels: sigma is smaller, amplitude larger, and their product is the same.
static inline ints fit_points(const reals *samples, Gaussian *at, ints wanted, SampleNoise noise) {
    ints moving = wanted & in_range(at);
    ints settled = 0;
    if (!any_lane(to_masks(moving))) return settled;
    PointSums sums = point_sums(samples, at, noise, 0);
    PointStep step = point_step(at, &sums, 0);
    moving &= int_mask(step.change <= (real)POINT_LARGEST) & in_range(at);
    for (int n = 0; n < POINT_STEPS && any_lane(to_masks(moving)); n++) {
        sums = point_sums(samples, at, noise, 1);
        Gaussian next = *at;
        step = point_step(&next, &sums, 1);
        *at = choose_gaussian(moving, next, *at);
        moving &= int_mask(step.change <= (real)POINT_LARGEST) & in_range(at);
        const ints now = moving & int_mask(step.move * step.change <= (real)POINT_SETTLED);
        settled |= now;
        moving &= ~now;
    }
#ifdef NOISE
    const reals sampled = at->sigma;
    at->sigma = sqrt(lane_max(sampled * sampled - (real)(1.0 / 12), (reals)1));
    at->amplitude *= sampled / at->sigma;
#endif
    return settled;
}

#endif
