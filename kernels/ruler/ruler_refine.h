// Sub-pixel edge parameters from the peaks of the gradient (ruler.h).
#ifndef RULER_REFINE_H
#define RULER_REFINE_H

#define RULER_ROOT_TWO_PI 2.5066282746310002f
#define RULER_PI 3.1415926535897931f
#define RULER_HARMONICS 2
#define RULER_LEAST_BLUR 0.05f // smallest blur variance, as a fraction of the smoothing variance: noise on a sharp edge

typedef struct {
    reals position, amplitude, width, sigma, spacing;
    masks status;
} ruler_edge;

// A peak of the gradient: its index and value, and the values of its neighbours.
typedef struct {
    reals at, before, here, after;
} ruler_peak;

static inline ruler_peak ruler_either(masks first, ruler_peak one, ruler_peak other) {
    const ruler_peak either = {first ? one.at : other.at, first ? one.before : other.before,
                               first ? one.here : other.here, first ? one.after : other.after};
    return either;
}

// Round to integers, |x| < 2^22: 1.5 * 2^23 has no bits for fractions, so the sum is rounded and the difference is exact.
// (rint() of vectors is computed lane by lane on PoCL.)
static inline reals ruler_nearest(reals x) {
    const reals room = (reals)12582912.0f;
    return (x + room) - room;
}

// sin(2 pi x), error 0.001: a parabola per half period, corrected by its square.
static inline reals ruler_sine(reals x) {
    x -= ruler_nearest(x);
    const reals arch = 8 * x - 16 * x * fabs(x);
    return arch * ((reals)0.775f + (reals)0.225f * fabs(arch));
}

// Bias of an edge position from linear interpolation along one image axis [samples].
//
// A sample at fraction f beyond a pixel is the convolution of the edge with a kernel of variance f (1 - f) and third
// moment f (1 - f) (1 - 2 f). The bias is the displacement of the zero of the smoothed second derivative of a Gaussian
// edge; the moments enter by their Fourier series in f, of which the smoothing leaves RULER_HARMONICS terms.
//
//     phase           position of the edge on the middle line along the axis [px]
//     along, across   steps along the axis from sample to sample and from line to line [px]
//     at              position of the edge [samples]
//     edge            variance of the gradient's peak [samples^2]
static inline reals ruler_interpolation_bias(reals phase, reals along, reals across, reals at, reals edge, constant real *table) {
    const real smoothing = table[RULER_SMOOTHING], per_step = 1 / (table[RULER_STEP] * table[RULER_STEP]);
    const reals extra = edge - smoothing, least = (reals)(smoothing * RULER_LEAST_BLUR);
    const reals blur = extra > least ? extra : least, variance = smoothing + blur, common = smoothing * blur / variance;
    const reals share = along * per_step;
    reals pull = 0;
    for (int k = 1; k <= RULER_HARMONICS; k++) {
        const real pi_k = RULER_PI * k;
        const reals turns = k * along, whole = ruler_nearest(turns), rest = turns - whole;
        reals lines = WIDTH % 2;
        for (int j = 0; j < WIDTH / 2; j++)
            lines += 2 * ruler_sine(k * across * (j + (WIDTH % 2 ? (real)1 : (real)0.5f)) + (reals)0.25f);
        const reals omega = 2 * RULER_PI * rest, square = omega * omega, narrow = square * common;
        const reals even = omega * (1 + (narrow - 3) * common / smoothing);
        const reals odd = (3 + square * (variance - 6 * common) + narrow * narrow) * share / (pi_k * variance);
        pull += ruler_sine(k * phase - whole * at) * lines * exp((reals)-0.5f * narrow) * (even + odd) / (pi_k * pi_k);
    }
    return (reals)(0.5f * table[RULER_PER_LINE]) * share * share * pull;
}

// Edge parameters at a peak: a parabola through the logarithms of three gradients, which is exact for a Gaussian.
//
// A curved edge appears displaced towards its centre of curvature by (blur variance + variance of the lines) / (2 radius).
static inline ruler_edge ruler_refine(ruler_peak peak, private const ruler_place *place, constant real *table) {
    const reals size = fabs(peak.here), sign = peak.here < 0 ? (reals)-1 : (reals)1, per = 1 / peak.here;
    // A neighbour of opposite sign is noise: clamp its ratio.
    const reals before = log(fmax(peak.before * per, (reals)1e-6f));
    const reals after = log(fmax(peak.after * per, (reals)1e-6f));
    const reals variance = -1 / (before + after), tilt = (real)0.5f * (after - before), shift = tilt * variance;
    reals at = peak.at + shift + TAPS;
#if !defined(LENS) && !defined(CAMERA)
    const real middle = (real)0.5f * (WIDTH - 1);
    const reals x = place->x + middle * place->across_x + at * place->along_x;
    const reals y = place->y + middle * place->across_y + at * place->along_y;
    const reals pull = ruler_interpolation_bias(x, place->along_x, place->across_x, at, variance, table);
    at -= pull + ruler_interpolation_bias(y, place->along_y, place->across_y, at, variance, table);
#endif
    ruler_edge edge;
    edge.position = (at - RULER_MIDDLE(table)) * table[RULER_STEP];
    edge.amplitude = peak.here * exp((real)0.5f * tilt * shift) *
                     ((real)RULER_ROOT_TWO_PI * table[RULER_PER_LINE]) * sqrt(variance);
    edge.width = sqrt(fmax(variance - table[RULER_SMOOTHING], (reals)0)) * table[RULER_STEP];
    // Noise of the logarithms at the neighbours of the peak: the noise over the gradients there, exp(-1 / (2 variance))
    // of the peak.
    edge.sigma = table[RULER_NOISE] * table[RULER_STEP] * variance * exp((real)0.5f / variance) / size;
    edge.spacing = REAL_NAN;
    edge.status = 0;
#ifdef CURVED
    edge.position -= table[RULER_CURVATURE] * (edge.width * edge.width + table[RULER_ACROSS]);
#endif
    return edge;
}

static inline ruler_edge ruler_pair(ruler_peak first, ruler_peak second, private const ruler_place *place,
                             constant real *table) {
    ruler_edge edge = ruler_refine(first, place, table);
    const ruler_edge other = ruler_refine(second, place, table);
    edge.spacing = other.position - edge.position;
    edge.position = (real)0.5f * (edge.position + other.position);
    edge.amplitude = (real)0.5f * (edge.amplitude - other.amplitude);
    edge.width = (real)0.5f * (edge.width + other.width);
    edge.sigma = (real)0.5f * sqrt(edge.sigma * edge.sigma + other.sigma * other.sigma);
    return edge;
}

// Edge, or pair of edges, at a peak.
static inline ruler_edge ruler_edge_at(ruler_peak first, ruler_peak second, private const ruler_place *place,
                                       constant real *table) {
#ifdef PER_RULER
    const ruler_edge pair = ruler_pair(first, second, place, table), edge = ruler_refine(second, place, table);
    const masks is_pair = place->is_pair;
    const ruler_edge either = {is_pair ? pair.position : edge.position, is_pair ? pair.amplitude : edge.amplitude,
                               is_pair ? pair.width : edge.width, is_pair ? pair.sigma : edge.sigma,
                               is_pair ? pair.spacing : edge.spacing, 0};
    return either;
#elif defined(PAIRS)
    return ruler_pair(first, second, place, table);
#else
    return ruler_refine(second, place, table);
#endif
}

// Set the flags of an edge, and NaN where there is no edge.
static inline ruler_edge ruler_flagged(ruler_edge edge, masks there, masks flags) {
    const masks broken = there & mask_of(LANED(not_finite)(edge.position + edge.amplitude + edge.sigma) != 0);
    const masks useless = mask_of((flags & RULER_USELESS) != 0);
    const masks none = ~there | broken | useless;
    edge.position = nan_where(none, edge.position);
    edge.amplitude = nan_where(none, edge.amplitude);
    edge.width = nan_where(none, edge.width);
    edge.sigma = nan_where(none, edge.sigma);
    edge.spacing = nan_where(none, edge.spacing);
    const masks found = flags | (there ? edge.status : (masks)STATUS_LOW_SIGNAL) | (broken & STATUS_NOT_FINITE);
    edge.status = useless ? flags : found;
    return edge;
}
#endif
