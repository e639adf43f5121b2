// Calipers (rulers): 1-D edge measurement along short lines of samples in an image.
//
// A ruler (x, y, cos, sin) has table[RULER_LENGTH] samples along its direction; each sample is the sum over WIDTH
// parallel lines one pixel apart, interpolated bilinearly. The gradient of the profile is its convolution with the
// derivative of a Gaussian (TAPS taps on either side). An edge is a local maximum of the gradient above the threshold.
//
// Variants: VECTOR_VARIANT: one work-item takes 16 rulers, one in each lane; else a work-group of RULER_GROUP items takes
//           RULERS_PER_GROUP rulers, with their arrays in local memory (ruler_group.h).
// Options:
//     CODE, and CODE_uchar, CODE_ushort or CODE_float   type of the pixels
//     RULER_CAPACITY     largest length that the arrays of samples hold
//     RULER_BITS         fractional bits of fixed-point positions (vector variant)
//     PAIRS              an edge is a pair of edges of opposite polarity: a stripe
//     PER_RULER (with PAIRS)   polarity and kind (single edge or pair) are given per ruler, see ruler_set_kind
//     CHOOSE_STRONGEST, CHOOSE_FIRST, CHOOSE_LAST, CHOOSE_ALL (up to MAX_EDGES edges)   edge selection
//     SATURATION, AMBIGUITY   flag saturated samples, and edges with a comparable second edge
//     CURVED             correct the position for a curved edge
//     LENS or CAMERA     rulers are straight in the undistorted image; pixels are read from the distorted image
//
#ifndef RULER_H
#define RULER_H
#include "common/camera.h"
#include "common/lens.h"
#include "common/status.h"

// Offsets in the parameter table (RULER_THRESHOLD, ..., RULER_TAPS) are build options: the fields of RulerTable in
// gpuvision/matching/features/ruler.py, with their units.

#define RULER_SLOPES_CAPACITY (RULER_CAPACITY - 2 * TAPS)
#define LANES_SHIFT 4 // LANES is 1 << LANES_SHIFT in the vector variant
#define RULER_MIDDLE(table) ((real)0.5f * ((table)[RULER_LENGTH] - 1))
#define RULER_SIGN ((bits)1 << (8 * sizeof(real) - 1)) // bit of the sign
#define RULER_LARGEST 1e37f  // largest sum over lines; gradients of larger ones could overflow
// Numbers of a ruler in memory: x, y, cos, sin, and with PER_RULER polarity, least and greatest spacing of a pair.
#ifdef PER_RULER
#define RULER_INPUTS 7
#else
#define RULER_INPUTS 4
#endif
// Flags of a ruler on which no edge can be measured.
#define RULER_USELESS (STATUS_NOT_FINITE | STATUS_OUT_OF_RANGE | STATUS_NOT_INVERTIBLE)

// Layout of a ruler. Positions are relative to a pixel near the ruler: small numbers keep more digits.
typedef struct {
    masks pixel;
    reals x, y;                               // first sample of the first line, from `pixel`
    reals along_x, along_y, across_x, across_y; // steps to the next sample and to the next line
    masks last_column, last_row;              // last column and row that have a right and a lower neighbour, from `pixel`
    reals polarity;             // sign of the (first) edge, 0: both
    masks sign_flip, sign_keep; // the strength of a gradient is (its bits ^ sign_flip) & sign_keep
#ifdef PER_RULER
    reals nearest, farthest; // least and greatest spacing of a pair [samples]
    masks is_pair;
#endif
#ifdef VECTOR_VARIANT
    reals first_sample, last_sample; // first sample of the part of the ruler in this lane, and last one of the ruler
#endif
} ruler_place;

#include "ruler/ruler_refine.h"

// Set the polarity of the (first) edge: -1, 0 (both) or 1. The strength of an edge of this polarity is the gradient, its
// negative or its absolute value: one operation with bits for all three. The polarity of a pair is checked later.
static inline void ruler_set_polarity(reals polarity, masks is_pair, ruler_place *place) {
    const masks both = is_pair | mask_of(polarity == 0);
    place->polarity = polarity;
    place->sign_flip = ~both & mask_of(polarity < 0) & (masks)RULER_SIGN;
    place->sign_keep = ~(both & (masks)RULER_SIGN);
}

// Compute the layout of rulers; return their flags. Flagged rulers get a valid place at the first pixel.
static inline masks ruler_layout(int rows, int columns, reals x, reals y, reals cosine, reals sine, constant real *table,
                       ruler_place *place) {
    const masks bad = mask_of((LANED(not_finite)(x) | LANED(not_finite)(y) | LANED(not_finite)(cosine) |
                               LANED(not_finite)(sine)) != 0);
    const real half_length = RULER_MIDDLE(table) * table[RULER_STEP], half_width = (real)0.5f * (WIDTH - 1);
    const reals start_x = half_length * cosine - half_width * sine;
    const reals start_y = half_length * sine + half_width * cosine;
#if defined(LENS) || defined(CAMERA)
    const masks away = bad;
    const masks column = 0, row = 0;
#else
    const reals reach_x = half_length * fabs(cosine) + half_width * fabs(sine);
    const reals reach_y = half_length * fabs(sine) + half_width * fabs(cosine);
    const reals low_x = x - reach_x, low_y = y - reach_y;
    const masks away = bad | ~(mask_of(low_x >= 0) & mask_of(low_y >= 0) & mask_of(x + reach_x <= (real)(columns - 1)) &
                               mask_of(y + reach_y <= (real)(rows - 1)));
    masks column = LANED(convert_bits)(zero_where(away, low_x)), row = LANED(convert_bits)(zero_where(away, low_y));
    column = column > (masks)(columns - 2) ? (masks)(columns - 2) : column;
    row = row > (masks)(rows - 2) ? (masks)(rows - 2) : row;
#endif
    place->pixel = row * columns + column;
    place->x = zero_where(away, x - LANED(convert_real)(column) - start_x);
    place->y = zero_where(away, y - LANED(convert_real)(row) - start_y);
    place->along_x = zero_where(away, cosine * table[RULER_STEP]);
    place->along_y = zero_where(away, sine * table[RULER_STEP]);
    place->across_x = zero_where(away, -sine);
    place->across_y = zero_where(away, cosine);
    place->last_column = (columns - 2) - column;
    place->last_row = (rows - 2) - row;
#ifdef VECTOR_VARIANT
    place->first_sample = 0;
    place->last_sample = table[RULER_LENGTH] - 1;
#endif
#ifdef PAIRS
    ruler_set_polarity(table[RULER_POLARITY], ~(masks)0, place);
#else
    ruler_set_polarity(table[RULER_POLARITY], (masks)0, place);
#endif
    return bad ? (masks)STATUS_NOT_FINITE : away & STATUS_OUT_OF_RANGE;
}

#ifdef PER_RULER
// Set the kind of each ruler: sign of the (first) edge; least and greatest spacing [px], 0 and 0 for a single edge.
static inline void ruler_set_kind(reals polarity, reals nearest, reals farthest, constant real *table, ruler_place *place) {
    place->is_pair = mask_of(farthest > 0);
    ruler_set_polarity(polarity, place->is_pair, place);
    place->sign_keep &= place->is_pair | mask_of(fabs(polarity) > 0); // a polarity of 0 or NaN: no edges
    place->nearest = ruler_nearest(nearest / table[RULER_STEP]);
    place->farthest = ruler_nearest(farthest / table[RULER_STEP]);
}
#endif

// Map (x, y) from the undistorted to the distorted image. Return the flags of lanes outside it; their position becomes 0.
#if defined(LENS) || defined(CAMERA)
static inline masks ruler_distort(reals *x, reals *y, const ruler_place *place, constant real *model) {
#ifdef CAMERA
    const masks folded = LANED(camera_distort)(x, y, model);
#else
    const masks folded = LANED(lens_distort)(x, y, model);
#endif
    const reals right = LANED(convert_real)(place->last_column + 1), bottom = LANED(convert_real)(place->last_row + 1);
    const masks inside = mask_of(*x >= 0) & mask_of(*y >= 0) & mask_of(*x <= right) & mask_of(*y <= bottom);
    *x = zero_where(~inside, *x);
    *y = zero_where(~inside, *y);
    return (folded & STATUS_NOT_INVERTIBLE) | (~inside & STATUS_OUT_OF_RANGE);
}
#endif

// Flags of a sample, and of a sum of samples.
static inline masks ruler_sample_flags(reals sample, constant real *table) {
#ifdef SATURATION
    return mask_of(sample >= table[RULER_SATURATION]) & STATUS_SATURATED;
#else
    return 0;
#endif
}

static inline masks ruler_sum_flags(reals sum) {
#ifdef CODE_float
    return mask_of((LANED(not_finite)(sum) | mask_of(fabs(sum) > (real)RULER_LARGEST)) != 0) & STATUS_NOT_FINITE;
#else
    return 0;
#endif
}

// Strength of an edge of the wanted polarity.
static inline reals ruler_strength(reals slope, private const ruler_place *place) {
    return as_reals((as_masks(slope) ^ place->sign_flip) & place->sign_keep);
}

// Whether a gradient of a strength is a local maximum and at least the threshold; `before`, `after`: of its neighbours.
static inline masks ruler_is_peak(reals strength, reals before, reals after, real threshold) {
    return mask_of(strength >= threshold) & mask_of(strength > before) & mask_of(strength >= after);
}

#ifdef PAIRS
// Whether a peak closes a pair of edges with the peak before it, `from`; with PER_RULER also whether its ruler looks for
// single edges. `strength` becomes that of the weaker edge of the pair.
static inline masks ruler_closes(ruler_peak from, masks has_from, ruler_peak peak, private const ruler_place *place,
                                 constant real *table, private reals *strength) {
    const reals gap = peak.at - from.at, weaker = fabs(from.here);
#ifdef PER_RULER
    const masks fits = has_from & mask_of(from.here * place->polarity > 0) & mask_of(peak.here * place->polarity < 0) &
                       mask_of(gap >= place->nearest) & mask_of(gap <= place->farthest);
    *strength = (place->is_pair & mask_of(weaker < *strength)) ? weaker : *strength;
    return ~place->is_pair | fits;
#else
    *strength = *strength < weaker ? *strength : weaker;
    return has_from & (mask_of(from.here > 0) ^ mask_of(peak.here > 0)) & mask_of(gap >= table[RULER_NEAREST]) &
           mask_of(gap <= table[RULER_FARTHEST]) & mask_of(from.here * place->polarity >= 0);
#endif
}
#endif

#ifdef VECTOR_VARIANT
// Gradient i of the profiles; computed when it is needed: no array of gradients.
static inline reals ruler_gradient(private const reals *profile, int i, constant real *table) {
    reals slope = 0;
    for (int k = 1; k <= TAPS; k++)
        slope += table[RULER_TAPS + k - 1] * (profile[i + TAPS + k] - profile[i + TAPS - k]);
    return slope;
}

// Find the edges along the profiles of 16 rulers. `flags`: flags of the rulers.
static inline void ruler_find(private const reals *values, private const ruler_place *place, masks flags, constant real *table,
                       private ruler_edge *edges) {
    const real threshold = table[RULER_THRESHOLD];
    masks found = 0, wins;
    reals best = 0, rival = 0;
    ruler_peak peak = {0, 0, 1, 0};
    ruler_peak first = peak, second = peak;
#ifdef CHOOSE_ALL
    masks count = 0;
    edges[0] = ruler_edge_at(peak, peak, place, table);
    for (int k = 1; k < MAX_EDGES; k++) edges[k] = edges[0];
#endif
#ifdef PAIRS
    ruler_peak other = peak;
    masks has_other = 0;
#endif
    peak.before = ruler_gradient(values, 0, table);
    peak.here = ruler_gradient(values, 1, table);
    const int slopes = (int)table[RULER_LENGTH] - 2 * TAPS;
    for (int i = 1; i < slopes - 1; i++) {
        peak.after = ruler_gradient(values, i + 1, table);
        peak.at = i;
        reals strength = ruler_strength(peak.here, place);
        const masks is_peak = ruler_is_peak(strength, ruler_strength(peak.before, place),
                                            ruler_strength(peak.after, place), threshold);
        if (any_compared(is_peak)) {
            masks candidate = is_peak;
#ifdef PAIRS
            candidate &= ruler_closes(other, has_other, peak, place, table, &strength);
            const ruler_peak from = other;
            other = ruler_either(is_peak, peak, other);
            has_other |= is_peak;
#else
            const ruler_peak from = peak;
#endif
#ifdef CHOOSE_ALL
            const ruler_edge edge = ruler_edge_at(from, peak, place, table);
            for (int k = 0; k < MAX_EDGES; k++) {
                wins = candidate & mask_of(count == k);
                edges[k].position = wins ? edge.position : edges[k].position;
                edges[k].amplitude = wins ? edge.amplitude : edges[k].amplitude;
                edges[k].width = wins ? edge.width : edges[k].width;
                edges[k].sigma = wins ? edge.sigma : edges[k].sigma;
                edges[k].spacing = wins ? edge.spacing : edges[k].spacing;
            }
            count -= candidate;
            edges[MAX_EDGES - 1].status |= mask_of(count > MAX_EDGES) & STATUS_AMBIGUOUS;
#else
#if defined(CHOOSE_FIRST)
            wins = candidate & ~found;
#elif defined(CHOOSE_LAST)
            wins = candidate;
#else
            wins = candidate & mask_of(strength > best);
#endif
#ifdef AMBIGUITY
            rival = wins ? best : ((candidate & mask_of(strength > rival)) ? strength : rival);
#endif
            best = wins ? strength : best;
            first = ruler_either(wins, from, first);
            second = ruler_either(wins, peak, second);
#endif
            found |= candidate;
        }
        peak.before = peak.here;
        peak.here = peak.after;
    }
#ifdef CHOOSE_ALL
    for (int k = 0; k < MAX_EDGES; k++) edges[k] = ruler_flagged(edges[k], mask_of(count > k), flags);
#else
    edges[0] = ruler_edge_at(first, second, place, table);
#ifdef AMBIGUITY
    edges[0].status |= mask_of(rival >= table[RULER_AMBIGUITY] * best) & STATUS_AMBIGUOUS;
#endif
    edges[0] = ruler_flagged(edges[0], found, flags);
#endif
}

#include "ruler/ruler_lanes.h"

// Join the samples and flags of rulers in parts: part p of ruler r, `samples` samples, is in lane (p << shift) + r.
static inline void ruler_join_parts(int shift, int samples, constant real *table, private reals *profile,
                                    private masks *flags) {
    private real *values = (private real *)profile;
    private bits *all = (private bits *)flags;
    const int parts = LANES >> shift, rulers = 1 << shift, length = (int)table[RULER_LENGTH];
    for (int lane = rulers; lane < LANES; lane++) all[lane & (rulers - 1)] |= all[lane];
    for (int part = 1; part < parts; part++)
        for (int i = 0; i < samples && part * samples + i < length; i++)
            for (int ruler = 0; ruler < rulers; ruler++)
                values[(part * samples + i) * LANES + ruler] = values[i * LANES + (part << shift) + ruler];
}

// Measure rulers of a given layout with its flags, one in each lane, or 2^shift rulers in parts of `samples` samples;
// fills edges[MAX_EDGES].
static inline void ruler_measure_placed(global const CODE *image, int rows, int columns,
                                        private const ruler_place *place, int shift, int samples, masks flags,
                                        constant real *table, constant real *model, private ruler_edge *edges) {
    reals profile[RULER_CAPACITY];
#ifdef RULER_PATCHES_H
    if (ruler_has_patches(place, rows, columns)) flags |= ruler_patch_sums(image, place, columns, samples, table, profile);
    else
#endif
        flags |= ruler_sums(image, place, columns, samples, table, model, profile);
    if (shift < LANES_SHIFT) ruler_join_parts(shift, samples, table, profile, &flags);
    ruler_find(profile, place, flags, table, edges);
}

// Measure 16 rulers, one in each lane; fills edges[MAX_EDGES].
static inline void ruler_measure_lanes(global const CODE *image, int rows, int columns, reals x, reals y, reals cosine,
                                reals sine, constant real *table, constant real *model, private ruler_edge *edges) {
    ruler_place place;
    const masks flags = ruler_layout(rows, columns, x, y, cosine, sine, table, &place);
    ruler_measure_placed(image, rows, columns, &place, LANES_SHIFT, (int)table[RULER_LENGTH], flags, table, model, edges);
}

// Measure up to 16 rulers in memory, `stride` numbers apart; lanes beyond `count` repeat the last ruler.
//
// Sampling takes most of the time. Up to 8 rulers are sampled in 2, 4, 8 or 16 equal parts side by side, which takes as
// much less time; the samples are the same.
static inline void ruler_measure(global const CODE *image, int rows, int columns, global const real *rulers, uint stride,
                          uint count, constant real *table, constant real *model, private ruler_edge *edges) {
    int shift = LANES_SHIFT;
    while (shift > 0 && count <= 1u << (shift - 1)) shift--;
    const uint in_part = (1u << shift) - 1; // bits of the number of a ruler in a part
    real given[RULER_INPUTS][LANES];
    for (uint lane = 0; lane < LANES; lane++)
        for (int k = 0; k < RULER_INPUTS; k++)
            given[k][lane] = rulers[stride * (ulong)min(lane & in_part, count - 1) + k];
    ruler_place place;
    const masks flags = ruler_layout(rows, columns, vload16(0, given[0]), vload16(0, given[1]), vload16(0, given[2]),
                                     vload16(0, given[3]), table, &place);
#ifdef PER_RULER
    ruler_set_kind(vload16(0, given[4]), vload16(0, given[5]), vload16(0, given[6]), table, &place);
#endif
    const int parts = LANES >> shift, samples = ((int)table[RULER_LENGTH] + parts - 1) / parts;
    place.first_sample = LANED(convert_real)((LANE_NUMBERS >> shift) * samples);
    ruler_measure_placed(image, rows, columns, &place, shift, samples, flags, table, model, edges);
}
#else
#include "ruler/ruler_group.h"
#endif
#endif
