// Rulers: short lines of samples in an image, along which edges are looked for. A ruler (x, y, cos, sin) has LENGTH
// samples along its direction, each the sum over WIDTH lines a pixel apart, bilinear between pixels. Its gradient is
// taken with the derivative of a Gaussian (TAPS either side), an edge is a peak of that.
//
//     STRIP      one work-item takes a ruler, 16 samples at a time (for CPU runtimes)
//     else       a work-group of RULER_GROUP items takes a ruler, its arrays are local
//     CODE       type of the pixels, CODE_uchar, CODE_ushort or CODE_float
//     RISING, FALLING     what edges count, of pairs the first one; neither: both
//     PAIRS      an edge is a pair of opposite edges: a stripe
//     CHOOSE_STRONGEST, CHOOSE_FIRST, CHOOSE_LAST, CHOOSE_ALL (up to MOST)
//     SATURATION, AMBIGUITY, CURVED     what else is looked at
//     LENS or CAMERA      rulers are straight in the undistorted image, the image is as measured
//
// The table is RulerEdges._packed in ruler.py.
#ifndef RULER_H
#define RULER_H
#include "camera.h"
#include "lens.h"
#include "status.h"

#define RULER_THRESHOLD 0   // least gradient of an edge, of sums over the lines
#define RULER_SATURATION 1  // of a sample
#define RULER_NOISE 2       // standard deviation of half the difference of the gradients beside a peak
#define RULER_SMOOTHING 3   // variance of the smoothing [samples^2]
#define RULER_AMBIGUITY 4
#define RULER_NEAREST 5     // edges of a pair [samples]
#define RULER_FARTHEST 6
#define RULER_BEND 7        // 1 / (2 radius) of the edge [1/px]
#define RULER_ACROSS 8      // variance of the lines about the middle one [px^2]
#define RULER_STEP 9        // [px]
#define RULER_PER_LINE 10   // 1 / WIDTH
#define RULER_TAPS 11

#define RULER_SLOPES (LENGTH - 2 * TAPS)
#define RULER_CHUNKS ((RULER_SLOPES + 15) / 16)
#define RULER_VECTORS ((LENGTH + 15) / 16)
// Of the arrays: what the last chunk of gradients reads.
#define RULER_PADDED (16 * RULER_VECTORS + 16 * ((2 * TAPS + 15) / 16))
#define RULER_MIDDLE ((real)0.5f * (LENGTH - 1))
#define RULER_ROOT_TWO_PI 2.5066282746310002f

#ifdef STRIP
#define RULER_SPACE private
#else
#define RULER_SPACE local
#endif

typedef struct {
    real position, amplitude, width, sigma, spacing;
    uint status;
} ruler_edge;

#ifdef STRIP
#define RULER_EACH(load) \
    load(0), load(1), load(2), load(3), load(4), load(5), load(6), load(7), load(8), load(9), load(a), load(b), \
        load(c), load(d), load(e), load(f)
#endif
// Two neighbours in a row, of every lane.
#if defined(STRIP) && !defined(CODE_float)
#ifdef CODE_uchar
typedef ushort16 ruler_pairs;
#define RULER_PAIR(k) as_ushort(vload2(0, from + at.s##k))
#define RULER_BITS 8
#else
typedef uint16 ruler_pairs;
#define RULER_PAIR(k) as_uint(vload2(0, from + at.s##k))
#define RULER_BITS 16
#endif
inline void ruler_pixels(global const CODE *from, masks at, reals *left, reals *right) {
    const int16 pairs = convert_int16((ruler_pairs)(RULER_EACH(RULER_PAIR)));
    *left = convert_real16(pairs & ((1 << RULER_BITS) - 1));
    *right = convert_real16(as_int16(as_uint16(pairs) >> RULER_BITS));
}
#elif defined(STRIP)
#define RULER_LEFT(k) from[at.s##k]
#define RULER_RIGHT(k) from[at.s##k + 1]
inline void ruler_pixels(global const CODE *from, masks at, reals *left, reals *right) {
    *left = (reals)(RULER_EACH(RULER_LEFT));
    *right = (reals)(RULER_EACH(RULER_RIGHT));
}
#else
inline void ruler_pixels(global const CODE *from, masks at, reals *left, reals *right) {
    *left = from[at];
    *right = from[at + 1];
}
#endif

// Where a ruler lies: the first sample of its first line, relative to a pixel near it, which keeps the digits.
typedef struct {
    global const CODE *pixel;
    real x, y, cosine, sine;
    int last_column, last_row;  // that have a neighbour, from the pixel on
} ruler_place;

// Bilinear samples at (x, y) from the place's pixel.
inline reals ruler_sample(const ruler_place *place, int pitch, reals x, reals y) {
    masks column = LANED(convert_bits)(x), row = LANED(convert_bits)(y);
    column = column > (masks)place->last_column ? (masks)place->last_column : column;
    row = row > (masks)place->last_row ? (masks)place->last_row : row;
    x -= LANED(convert_real)(column);
    y -= LANED(convert_real)(row);
    const masks at = row * pitch + column;
    reals a, b, c, d;
    ruler_pixels(place->pixel, at, &a, &b);
    ruler_pixels(place->pixel + pitch, at, &c, &d);
    a += x * (b - a);
    c += x * (d - c);
    return a + y * (c - a);
}

inline uint ruler_lay(global const CODE *image, int rows, int columns, real4 ruler, constant real *table,
                      ruler_place *place) {
    const real step = table[RULER_STEP], half_length = RULER_MIDDLE * step, half_width = (real)0.5f * (WIDTH - 1);
    const real cosine = ruler.z, sine = ruler.w;
    const real along_x = half_length * cosine, along_y = half_length * sine;
    const real across_x = -half_width * sine, across_y = half_width * cosine;
    place->cosine = cosine * step;
    place->sine = sine * step;
    if (not_finite(ruler.x) | not_finite(ruler.y) | not_finite(cosine) | not_finite(sine)) return STATUS_NOT_FINITE;
#if defined(LENS) || defined(CAMERA)
    place->pixel = image;
    place->x = ruler.x - along_x - across_x;
    place->y = ruler.y - along_y - across_y;
    place->last_column = columns - 2;
    place->last_row = rows - 2;
#else
    const real reach_x = fabs(along_x) + fabs(across_x), reach_y = fabs(along_y) + fabs(across_y);
    const real low_x = ruler.x - reach_x, low_y = ruler.y - reach_y;
    if (!(low_x >= 0 & low_y >= 0 & ruler.x + reach_x <= columns - 1 & ruler.y + reach_y <= rows - 1))
        return STATUS_OUT_OF_RANGE;
    const int column = min((int)low_x, columns - 2), row = min((int)low_y, rows - 2);
    place->pixel = image + ((long)row * columns + column);
    place->x = ruler.x - column - along_x - across_x;
    place->y = ruler.y - row - along_y - across_y;
    place->last_column = columns - 2 - column;
    place->last_row = rows - 2 - row;
#endif
    return 0;
}

// Takes (x, y) to the measured image; returns the flags of lanes that have no place in it, which it leaves at 0, 0.
#if defined(LENS) || defined(CAMERA)
inline masks ruler_distort(reals *x, reals *y, const ruler_place *place, constant real *model) {
#ifdef CAMERA
    const masks folded = LANED(camera_distort)(x, y, model);
#else
    const masks folded = LANED(lens_distort)(x, y, model);
#endif
    const masks inside = mask_of(*x >= 0) & mask_of(*y >= 0) & mask_of(*x <= (real)(place->last_column + 1)) &
                         mask_of(*y <= (real)(place->last_row + 1));
    *x = zero_where(~inside, *x);
    *y = zero_where(~inside, *y);
    return (folded & STATUS_FOLDED) | (~inside & STATUS_OUT_OF_RANGE);
}
#endif

// Sums over the lines at the samples `index`, and what is wrong with them.
__attribute__((always_inline)) inline reals ruler_sum(const ruler_place *place, int pitch, reals index,
                                                      constant real *table, constant real *model, masks *flags) {
    const reals along_x = place->x + index * place->cosine, along_y = place->y + index * place->sine;
    const real per_step = 1 / table[RULER_STEP];
    const real across_x = -place->sine * per_step, across_y = place->cosine * per_step;
    reals sum = 0;
#ifdef SATURATION
    reals top = 0;
#endif
    for (int line = 0; line < WIDTH; line++) {
        reals x = along_x + line * across_x, y = along_y + line * across_y;
#if defined(LENS) || defined(CAMERA)
        *flags |= ruler_distort(&x, &y, place, model);
#endif
        const reals sample = ruler_sample(place, pitch, x, y);
        sum += sample;
#ifdef SATURATION
        top = sample > top ? sample : top;
#endif
    }
#ifdef SATURATION
    *flags |= mask_of(top >= table[RULER_SATURATION]) & STATUS_SATURATED;
#endif
#ifdef CODE_float
    *flags |= mask_of(LANED(not_finite)(sum)) & STATUS_NOT_FINITE;
#endif
    return sum;
}

inline reals ruler_slope(RULER_SPACE const real *profile, constant real *table) {
    reals slope = 0;
    for (int k = 1; k <= TAPS; k++) {
        const reals ahead = *(RULER_SPACE const reals_at *)(profile + TAPS + k);
        const reals behind = *(RULER_SPACE const reals_at *)(profile + TAPS - k);
        slope += table[RULER_TAPS + k - 1] * (ahead - behind);
    }
    return slope;
}

// How much of an edge of the wanted polarity a gradient is; of pairs the polarity is looked at later.
#if defined(RISING) && !defined(PAIRS)
#define RULER_STRENGTH(slope) (slope)
#elif defined(FALLING) && !defined(PAIRS)
#define RULER_STRENGTH(slope) (-(slope))
#else
#define RULER_STRENGTH(slope) fabs(slope)
#endif

// The edge at the peak i of the gradient: a parabola through the logarithms of the gradients there, which is exact
// for a Gaussian. Positions are in samples from the first gradient.
inline ruler_edge ruler_refine(RULER_SPACE const real *slopes, int i, constant real *table) {
    const real sign = slopes[i] < 0 ? -1 : 1, here = fabs(slopes[i]), per = sign / here;
    // A neighbour of other sign is far below the peak: noise.
    const real before = log(fmax(slopes[i - 1] * per, (real)1e-6f));
    const real after = log(fmax(slopes[i + 1] * per, (real)1e-6f));
    const real curvature = -(before + after), tilt = (real)0.5f * (after - before), shift = tilt / curvature;
    const real variance = 1 / curvature;
    ruler_edge edge;
    edge.position = i + shift;
    edge.amplitude = sign * here * exp((real)0.5f * tilt * shift) * (real)RULER_ROOT_TWO_PI * sqrt(variance) *
                     table[RULER_PER_LINE];
    edge.width = sqrt(fmax(variance - table[RULER_SMOOTHING], (real)0)) * table[RULER_STEP];
    edge.sigma = table[RULER_NOISE] * variance / here * table[RULER_STEP];
    edge.spacing = REAL_NAN;
    edge.status = 0;
    return edge;
}

// In pixels from the middle; an edge that bends about a point ahead is seen ahead of where it is, by the variances
// of the blur and of the lines over twice the radius.
inline ruler_edge ruler_edge_at(RULER_SPACE const real *slopes, int i, constant real *table) {
    ruler_edge edge = ruler_refine(slopes, i, table);
    edge.position = (edge.position + TAPS - RULER_MIDDLE) * table[RULER_STEP];
#ifdef CURVED
    edge.position -= table[RULER_BEND] * (edge.width * edge.width + table[RULER_ACROSS]);
#endif
    return edge;
}

inline ruler_edge ruler_pair_at(RULER_SPACE const real *slopes, int first, int second, constant real *table) {
    ruler_edge edge = ruler_edge_at(slopes, first, table);
    const ruler_edge other = ruler_edge_at(slopes, second, table);
    edge.spacing = other.position - edge.position;
    edge.position = (real)0.5f * (edge.position + other.position);
    edge.amplitude = (real)0.5f * (edge.amplitude - other.amplitude);
    edge.width = (real)0.5f * (edge.width + other.width);
    edge.sigma = (real)0.5f * sqrt(edge.sigma * edge.sigma + other.sigma * other.sigma);
    return edge;
}

inline ruler_edge ruler_nothing(uint status) {
    const ruler_edge edge = {REAL_NAN, REAL_NAN, REAL_NAN, REAL_NAN, REAL_NAN, status};
    return edge;
}

#ifdef PAIRS
#define RULER_TAKEN(first, second) ruler_pair_at(slopes, first, second, table)
#else
#define RULER_TAKEN(first, second) ruler_edge_at(slopes, first, table)
#endif

// The edges among the gradients; bits of `chunks` say which 16 hold one over the threshold.
inline void ruler_find(RULER_SPACE const real *slopes, uint chunks, uint flags, constant real *table,
                       private ruler_edge *edges) {
    const real threshold = table[RULER_THRESHOLD];
    for (int k = 0; k < MOST; k++) edges[k] = ruler_nothing(flags | STATUS_DARK);
    int found = 0, first = 0, second = 0;
    real best = 0, rival = 0;
#ifdef PAIRS
    int other = -1;
#endif
    for (int chunk = 0; chunk < RULER_CHUNKS; chunk++) {
        if (!(chunks >> chunk & 1)) continue;
        const int end = min(16 * chunk + 16, RULER_SLOPES - 1);
        for (int i = max(16 * chunk, 1); i < end; i++) {
            real strength = RULER_STRENGTH(slopes[i]);
            if (!(strength >= threshold)) continue;
            if (!(strength > RULER_STRENGTH(slopes[i - 1]) & strength >= RULER_STRENGTH(slopes[i + 1]))) continue;
            int from = i;
#ifdef PAIRS
            from = other;
            other = i;
            if (from < 0) continue;
            const real gap = i - from;
            const int rises = slopes[from] > 0;
#if defined(RISING)
            if (!rises) continue;
#elif defined(FALLING)
            if (rises) continue;
#endif
            if (rises == (slopes[i] > 0) | gap < table[RULER_NEAREST] | gap > table[RULER_FARTHEST]) continue;
            strength = fmin(strength, fabs(slopes[from]));
#endif
#if defined(CHOOSE_ALL)
            if (found < MOST) {
                edges[found] = RULER_TAKEN(from, i);
                edges[found].status |= flags;
            } else {
                edges[MOST - 1].status |= STATUS_AMBIGUOUS;
            }
#elif defined(CHOOSE_FIRST)
            if (!found) {
                first = from;
                second = i;
            }
#elif defined(CHOOSE_LAST)
            first = from;
            second = i;
#else
            if (strength > best) {
                rival = best;
                best = strength;
                first = from;
                second = i;
            } else {
                rival = fmax(rival, strength);
            }
#endif
            found++;
        }
    }
#ifndef CHOOSE_ALL
    if (found) {
        edges[0] = RULER_TAKEN(first, second);
        edges[0].status |= flags;
    }
#endif
#ifdef AMBIGUITY
    if (found && rival >= table[RULER_AMBIGUITY] * best) edges[0].status |= STATUS_AMBIGUOUS;
#endif
    for (int k = 0; k < MOST; k++) {
        if (k < found && not_finite(edges[k].position + edges[k].amplitude + edges[k].sigma))
            edges[k] = ruler_nothing(flags | STATUS_NOT_FINITE);
    }
}

// What leaves no edge to look for.
#define RULER_USELESS (STATUS_NOT_FINITE | STATUS_OUT_OF_RANGE | STATUS_FOLDED)

#ifdef STRIP
inline uint ruler_any(masks flags) {
    const int8 half_of_it = flags.lo | flags.hi;
    const int4 quarter = half_of_it.lo | half_of_it.hi;
    return quarter.x | quarter.y | quarter.z | quarter.w;
}

// Whole rulers: fills edges[MOST].
inline void ruler_measure(global const CODE *image, int rows, int columns, real4 ruler, constant real *table,
                          constant real *model, private ruler_edge *edges) {
    ruler_place place;
    uint status = ruler_lay(image, rows, columns, ruler, table, &place);
    real profile[RULER_PADDED], slopes[16 * RULER_CHUNKS];
    uint chunks = 0;
    if (!status) {
        const reals lanes = (reals)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        masks flags = 0;
        for (int v = 0; v < RULER_VECTORS; v++) {
            reals index = lanes + 16 * v;
#if LENGTH % 16
            index = index > (real)(LENGTH - 1) ? (reals)(LENGTH - 1) : index;
#endif
            *(private reals_at *)(profile + 16 * v) = ruler_sum(&place, columns, index, table, model, &flags);
        }
        for (int i = 16 * RULER_VECTORS; i < RULER_PADDED; i += 16) *(private reals_at *)(profile + i) = 0;
#if defined(SATURATION) || defined(CODE_float) || defined(LENS) || defined(CAMERA)
        status = ruler_any(flags);
#endif
        for (int chunk = 0; chunk < RULER_CHUNKS; chunk++) {
            const reals slope = ruler_slope(profile + 16 * chunk, table);
            *(private reals_at *)(slopes + 16 * chunk) = slope;
            chunks |= (uint)any_lane(RULER_STRENGTH(slope) >= table[RULER_THRESHOLD]) << chunk;
        }
    }
    if (status & RULER_USELESS) {
        for (int k = 0; k < MOST; k++) edges[k] = ruler_nothing(status);
    } else {
        ruler_find(slopes, chunks, status, table, edges);
    }
}
#else
// The same by a work-group, in arrays of its own; edges[MOST] are for its first item.
inline void ruler_measure(global const CODE *image, int rows, int columns, real4 ruler, constant real *table,
                          constant real *model, local real *profile, local real *slopes, local uint *bits,
                          private ruler_edge *edges) {
    const int item = get_local_id(0);
    ruler_place place;
    const uint wrong = ruler_lay(image, rows, columns, ruler, table, &place);
    if (item == 0) {
        bits[0] = wrong;
        bits[1] = 0;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (!wrong) {
        int flags = 0;
        for (int i = item; i < LENGTH; i += RULER_GROUP)
            profile[i] = ruler_sum(&place, columns, i, table, model, &flags);
        if (flags) atomic_or(bits, (uint)flags);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (!wrong) {
        for (int i = item; i < RULER_SLOPES; i += RULER_GROUP) {
            slopes[i] = ruler_slope(profile + i, table);
            if (RULER_STRENGTH(slopes[i]) >= table[RULER_THRESHOLD]) atomic_or(bits + 1, 1u << (i / 16));
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item) return;
    if (bits[0] & RULER_USELESS) {
        for (int k = 0; k < MOST; k++) edges[k] = ruler_nothing(bits[0]);
    } else {
        ruler_find(slopes, bits[1], bits[0], table, edges);
    }
}
#endif
#endif
