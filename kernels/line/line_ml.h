// Maximum-likelihood fit of a Gaussian on a constant background to the samples of the window (METHOD_ML). A sample is
// the integral of the Gaussian over its pixel.
//
// Fisher scoring: iterated weighted least squares. The weight of a sample is one over the variance that the noise model
// gives at the current fit: read_variance + gain * level. The unknowns are the position, the logarithm of sigma, the
// amplitude and the background. The last two are divided by the amplitude, so that all columns of the design matrix
// have about the same size.
//
// Most lines are fitted faster, by the values at the middles of the pixels (line_point_fit.h).
#ifndef LINE_ML_H
#define LINE_ML_H

#include "line/line_point_fit.h"

#define ML_STEPS 12  // largest number of iterations
#define ML_UNKNOWNS 4
#define ML_SETTLED 1e-4f   // px: largest last step of a converged fit; the next step would be about its square
#define ML_DAMPING 1e-4f   // fraction of the diagonal added to it: if all light falls on one pixel, sigma and
                           // amplitude cannot be separated
#define ML_NARROWEST 0.15f  // px: smallest sigma; narrower lines fall on one or two pixels

// At a pixel edge, z sigmas from the position: exp(-z^2/2), and the fraction of the light before the edge minus 1/2.
typedef struct {
    reals slope, integral;
} Edge;

// erf by Abramowitz and Stegun 7.1.26, largest error 1.5e-7; it shares its exponential with the slope.
static inline Edge edge_at(reals z) {
    const reals size = fabs(z) * (real)0.70710678118654752, t = 1 / (1 + (real)0.3275911 * size);
    Edge edge;
    edge.slope = exp(-size * size);
    const reals late = (real)1.421413741 + t * ((real)-1.453152027 + t * (real)1.061405429);
    const reals tail = t * ((real)0.254829592 + t * ((real)-0.284496736 + t * late));
    const reals half_erf = (1 - tail * edge.slope) / 2;
    edge.integral = z < 0 ? -half_erf : half_erf;
    return edge;
}

// Start values from the light v above a quarter of the amplitude. This level is subtracted, so that a sample that crosses
// it does not move the position by a jump. With c = sqrt(2 ln 4), a Gaussian keeps a total of v of amplitude sigma times
// F = sqrt(2 pi) erf(c / sqrt(2)) - 2 c / 4 = 1.4336, and a variance of v of sigma^2 times 1 - c^3 / (6 F) = 0.46327.
// Sigma follows from the variance under `by_variance`, where noise of the peak does not move it, else from the total and
// the peak, which suits narrow lines.
static inline Gaussian first_guess(const reals *samples, codes level, int by_variance) {
    Gaussian guess;
    guess.background = (samples[0] + samples[2 * RADIUS]) / 2;
    const reals height = fmax(to_reals(level) - guess.background, (reals)1e-6f);
    const reals least = guess.background + height / 4;
    reals total = 0, moment = 0, square = 0;
    for (int k = -RADIUS; k <= RADIUS; k++) {
        const reals v = lane_max(samples[k + RADIUS] - least, (reals)0);
        total += v;
        moment += v * (real)k;
        square += v * (real)(k * k);
    }
    const reals per_total = reciprocal(total);
    guess.position = moment * per_total;
    const reals variance = square * per_total - guess.position * guess.position;
    const reals by_peak = total * reciprocal(height * (real)1.4336);
    const reals sigma = by_variance ? sqrt(variance * (real)(1 / 0.46327)) : by_peak;
    guess.sigma = clamp(sigma, (reals)0.3f, (reals)RADIUS);
    guess.amplitude = by_variance ? total * reciprocal(guess.sigma * (real)1.4336) : height;
    return guess;
}

typedef struct {
    reals matrix[ML_UNKNOWNS * (ML_UNKNOWNS + 1) / 2];  // lower triangle, row by row
    reals right[ML_UNKNOWNS];
} Normal;

// Normal equations at a fit; `dark_variance` is the variance of a sample without light.
static inline Normal normal_equations(const CODE *window, Gaussian at, CODE saturation, real dark_variance,
                                      constant LineTable *table) {
    Normal normal;
    for (int i = 0; i < ML_UNKNOWNS * (ML_UNKNOWNS + 1) / 2; i++) normal.matrix[i] = 0;
    for (int i = 0; i < ML_UNKNOWNS; i++) normal.right[i] = 0;
    const reals scale = at.sigma * (real)2.5066282746310002, per_sigma = 1 / at.sigma;
    reals z = ((real)-RADIUS - (real)0.5 - at.position) * per_sigma;
    Edge left = edge_at(z);
    for (int k = -RADIUS; k <= RADIUS; k++) {
        const reals z_right = z + per_sigma;
        const Edge right = edge_at(z_right);
        const reals light = scale * (right.integral - left.integral);
        const reals by_place = left.slope - right.slope;
        const reals by_sigma = light - at.sigma * (z_right * right.slope - z * left.slope);
        const reals column[ML_UNKNOWNS] = {by_place, by_sigma, light, (reals)1};
        const reals model = at.background + at.amplitude * light;
        const codes level = window_level(window, k + RADIUS);
        const reals variance = dark_variance + table->gain * fmax(model, (reals)0);
        const reals trust = at.amplitude * at.amplitude / fmax(variance, (reals)1e-12f);
        const reals weight = choose_reals(int_mask(level >= (codes)saturation), 0, trust);
        const reals residual = (to_reals(level) - model) / at.amplitude * weight;
        for (int i = 0, n = 0; i < ML_UNKNOWNS; i++) {
            normal.right[i] += column[i] * residual;
            for (int j = 0; j <= i; j++) normal.matrix[n++] += column[i] * column[j] * weight;
        }
        z = z_right;
        left = right;
    }
    return normal;
}

// Cholesky factorisation L L' of the normal equations, with damping. L replaces the matrix, and L^-1 times the right
// side replaces the right side.
static inline void factorise(Normal *normal) {
    reals *a = normal->matrix, *x = normal->right;
    for (int i = 0; i < ML_UNKNOWNS; i++) {
        reals *row = a + i * (i + 1) / 2;
        for (int j = 0; j <= i; j++) {
            const reals *other = a + j * (j + 1) / 2;
            reals sum = i == j ? row[j] * (1 + (real)ML_DAMPING) : row[j];
            for (int k = 0; k < j; k++) sum -= row[k] * other[k];
            row[j] = i == j ? sqrt(fmax(sum, (reals)1e-20f)) : sum / other[j];
        }
        for (int k = 0; k < i; k++) x[i] -= row[k] * x[k];
        x[i] /= row[i];
    }
}

// Solve the normal equations; the solution replaces the right side.
static inline void solve(Normal *normal) {
    factorise(normal);
    const reals *a = normal->matrix;
    reals *x = normal->right;
    for (int i = ML_UNKNOWNS - 1; i >= 0; i--) {
        for (int k = i + 1; k < ML_UNKNOWNS; k++) x[i] -= a[k * (k + 1) / 2 + i] * x[k];
        x[i] /= a[i * (i + 1) / 2 + i];
    }
}

#ifdef NOISE
// Variance of the position: element [0, 0] of the inverse of the normal equations L L', the squared length of the first
// column of the inverse of L. It replaces the right side.
static inline reals position_variance(Normal *normal) {
    reals *x = normal->right, variance = 0;
    for (int i = 0; i < ML_UNKNOWNS; i++) x[i] = i == 0 ? 1 : 0;
    factorise(normal);
    for (int i = 0; i < ML_UNKNOWNS; i++) variance += x[i] * x[i];
    return variance;
}
#endif

// Take one step, limited to the range in which the linearisation holds. Return the larger movement of position and
// sigma: the position alone may rest by chance while the other unknowns still move.
static inline reals take_step(Gaussian *at, Normal *normal) {
    solve(normal);
    const reals *by = normal->right;
    const reals move = clamp(by[0], -at->sigma, at->sigma);
    at->background += at->amplitude * by[3];
    at->amplitude *= clamp(1 + by[2], (reals)0.5f, (reals)2);
    at->position += move;
    const reals factor = exp(clamp(by[1], (reals)-0.5f, (reals)0.5f));
    at->sigma = clamp(at->sigma * factor, (reals)ML_NARROWEST, (reals)(2 * RADIUS));
    return fmax(fabs(move), fabs(by[1]) * at->sigma);
}

// Fit the lanes of `wanted` to samples integrated over pixels, from the start values `at`. Converged lanes are not
// changed any more, so that a reading does not depend on its neighbours. Return the lanes that are fitted.
static inline ints fit_integrals(const CODE *window, Gaussian *at, ints wanted, CODE saturation,
                                 constant LineTable *table) {
    reals moved = 1;
    ints moving = wanted;
    for (int n = 0; n < ML_STEPS && any_int_lane(moving); n++) {
        Normal normal = normal_equations(window, *at, saturation, table->read_variance, table);
        Gaussian next = *at;
        const reals by = take_step(&next, &normal);
        *at = choose_gaussian(moving, next, *at);
        moved = choose_reals(moving, by, moved);
        moving &= ~int_mask(moved <= ML_SETTLED);
    }
    return int_mask(moved <= 100 * ML_SETTLED) & int_mask(fabs(at->position) <= RADIUS);
}

// Fit every lane: first with the values at the pixels' middles (line_point_fit.h), then the other lanes with integrals.
// Where no fit converges inside the window, the position is the centroid of the window, with AMBIGUOUS.
static inline Place fit_gaussian(const CODE *window, const Profiles *profiles, const Peak *peak,
                                 constant LineTable *table) {
    reals samples[2 * RADIUS + 1];
    for (int k = 0; k <= 2 * RADIUS; k++) samples[k] = to_reals(window_level(window, k));
    const SampleNoise noise = {table->read_variance, table->gain, (real)profiles->saturation};
    Gaussian at = first_guess(samples, peak->level, 1);
    ints settled = fit_points(samples, &at, peak->found, noise);
    const ints others = peak->found & ~settled;
    if (any_lane(to_masks(others))) {
        Gaussian integrals = first_guess(samples, peak->level, 0);
        settled |= others & fit_integrals(window, &integrals, others, profiles->saturation, table);
        at = choose_gaussian(others, integrals, at);
    }
    Place place = window_centroid(window, RADIUS, profiles, peak, table);
    place.at = choose_reals(settled, at.position, place.at);
    place.flags = flag_where(~settled & peak->found, STATUS_AMBIGUOUS);
#ifdef NOISE
    // The Cramer-Rao bound at the fit, for the noise with quantisation.
    Normal normal = normal_equations(window, at, profiles->saturation, table->noise_variance, table);
    place.variance = nan_where(to_masks(~settled), position_variance(&normal));
#endif
    return place;
}

#endif
