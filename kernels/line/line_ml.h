// The most likely Gaussian on a flat background in the window, each sample the light of its whole pixel.
//
// Fisher scoring: steps of least squares, each sample weighted by one over the variance that the model gives it. The
// unknowns are the place, the logarithm of sigma, the amplitude and the background, the latter two in parts of the
// amplitude, so that all columns of the design are of one size.
#ifndef LINE_ML_H
#define LINE_ML_H

#include "line/line_window.h"

#define ML_STEPS 12
#define ML_UNKNOWNS 4
#define ML_SETTLED 1e-4f   // pixels that the last step may still move; a further one would move their square
#define ML_DAMPING 1e-4f   // of the diagonal: sigma and amplitude are one unknown where all light falls on one pixel
#define ML_NARROWEST 0.15f

typedef struct {
    reals place, sigma, amplitude, background;
} Gaussian;

// At a pixel's edge, z sigmas from the place: exp(-z^2/2), and the share of the light before it less a half.
typedef struct {
    reals slope, integral;
} Edge;

// Abramowitz and Stegun 7.1.26, which shares its exponential with the slope: 1.5e-7 at worst.
inline Edge edge_at(reals z) {
    const reals size = fabs(z) * (real)0.70710678118654752, t = 1 / (1 + (real)0.3275911 * size);
    Edge edge;
    edge.slope = exp(-size * size);
    const reals late = (real)1.421413741 + t * ((real)-1.453152027 + t * (real)1.061405429);
    const reals tail = t * ((real)0.254829592 + t * ((real)-0.284496736 + t * late));
    const reals half_erf = (1 - tail * edge.slope) / 2;
    edge.integral = z < 0 ? -half_erf : half_erf;
    return edge;
}

// First guess: background from the ends of the window, the rest from the samples above a quarter of the amplitude,
// which hold 90.4 % of a Gaussian's light.
inline Gaussian first_guess(const CODE *window, codes level) {
    Gaussian guess;
    guess.background = (to_reals(window_level(window, 0)) + to_reals(window_level(window, 2 * RADIUS))) / 2;
    guess.amplitude = fmax(to_reals(level) - guess.background, (reals)1e-6f);
    reals total = 0, moment = 0;
    for (int k = -RADIUS; k <= RADIUS; k++) {
        const reals over = to_reals(window_level(window, k + RADIUS)) - guess.background;
        const reals v = choose_reals(REAL_MASK(over > guess.amplitude / 4), over, 0);
        total += v;
        moment += v * (real)k;
    }
    guess.place = moment / total;
    guess.sigma = clamp(total / (guess.amplitude * (real)2.266), (reals)0.3f, (reals)RADIUS);
    return guess;
}

typedef struct {
    reals matrix[ML_UNKNOWNS * (ML_UNKNOWNS + 1) / 2];  // lower triangle, row by row
    reals right[ML_UNKNOWNS];
} Normal;

inline Normal normal_equations(const CODE *window, Gaussian at, CODE saturation, constant real *noise) {
    Normal normal;
    for (int i = 0; i < ML_UNKNOWNS * (ML_UNKNOWNS + 1) / 2; i++) normal.matrix[i] = 0;
    for (int i = 0; i < ML_UNKNOWNS; i++) normal.right[i] = 0;
    const reals scale = at.sigma * (real)2.5066282746310002, per_sigma = 1 / at.sigma;
    reals z = ((real)-RADIUS - (real)0.5 - at.place) * per_sigma;
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
        const reals variance = noise[0] + noise[1] * fmax(model, (reals)0);
        const reals trust = at.amplitude * at.amplitude / fmax(variance, (reals)1e-12f);
        const reals weight = choose_reals(CODE_MASK(level >= (codes)saturation), 0, trust);
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

// Cholesky's way; leaves the solution on the right side.
inline void solve(Normal *normal) {
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
    for (int i = ML_UNKNOWNS - 1; i >= 0; i--) {
        for (int k = i + 1; k < ML_UNKNOWNS; k++) x[i] -= a[k * (k + 1) / 2 + i] * x[k];
        x[i] /= a[i * (i + 1) / 2 + i];
    }
}

// A step no longer than the first order holds for; returns how far place or sigma move: the place alone may rest by
// chance while the others have yet to settle.
inline reals step(Gaussian *at, Normal *normal) {
    solve(normal);
    const reals *by = normal->right;
    const reals move = clamp(by[0], -at->sigma, at->sigma);
    at->background += at->amplitude * by[3];
    at->amplitude *= clamp(1 + by[2], (reals)0.5f, (reals)2);
    at->place += move;
    const reals growth = exp(clamp(by[1], (reals)-0.5f, (reals)0.5f));
    at->sigma = clamp(at->sigma * growth, (reals)ML_NARROWEST, (reals)(2 * RADIUS));
    return fmax(fabs(move), fabs(by[1]) * at->sigma);
}

inline Gaussian choose_gaussian(ints mask, Gaussian yes, Gaussian no) {
    const Gaussian chosen = {choose_reals(mask, yes.place, no.place), choose_reals(mask, yes.sigma, no.sigma),
                             choose_reals(mask, yes.amplitude, no.amplitude),
                             choose_reals(mask, yes.background, no.background)};
    return chosen;
}

// Where the fit does not settle inside the window, the centre of gravity stands in. Lanes that have settled rest, so
// that a reading does not depend on its neighbours.
inline Place likeliest_place(const CODE *window, const Profiles *profiles, const Peak *peak, constant real *noise) {
    Gaussian at = first_guess(window, peak->level);
    reals moved = 1;
    ints moving = peak->found;
    for (int n = 0; n < ML_STEPS && any_lane(moving); n++) {
        Normal normal = normal_equations(window, at, profiles->saturation, noise);
        Gaussian next = at;
        const reals by = step(&next, &normal);
        at = choose_gaussian(moving, next, at);
        moved = choose_reals(moving, by, moved);
        moving &= ~REAL_MASK(moved <= ML_SETTLED);
    }
    Place place = window_gravity(window, RADIUS, profiles, peak);
    const ints settled = REAL_MASK(moved <= 100 * ML_SETTLED) & REAL_MASK(fabs(at.place) <= RADIUS);
    place.at = choose_reals(settled, at.place, place.at);
    place.flags = flag_where(~settled & peak->found, STATUS_AMBIGUOUS);
    return place;
}

#endif
