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
#define RULER_LARGEST 1e37f  // of sums over lines: gradients of them are numbers
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

// Where a ruler lies: the first sample of its first line, relative to a pixel near it, which keeps the digits.
typedef struct {
    global const CODE *pixel;
    real x, y, cosine, sine;
    int last_column, last_row;  // that have a neighbour, from the pixel on
} ruler_place;

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

// Splits (x, y) from the place's pixel into a pixel that has neighbours, and what is left.
inline masks ruler_split(const ruler_place *place, int pitch, reals *x, reals *y) {
    masks column = LANED(convert_bits)(*x), row = LANED(convert_bits)(*y);
    column = column > (masks)place->last_column ? (masks)place->last_column : column;
    row = row > (masks)place->last_row ? (masks)place->last_row : row;
    *x -= LANED(convert_real)(column);
    *y -= LANED(convert_real)(row);
    return row * pitch + column;
}

inline reals ruler_between(reals a, reals b, reals c, reals d, reals x, reals y) {
    a += x * (b - a);
    c += x * (d - c);
    return a + y * (c - a);
}

// Where sample `index` of a line lies; returns what is wrong with it.
inline masks ruler_at(const ruler_place *place, reals index, int line, constant real *table, constant real *model,
                      reals *x, reals *y) {
    const real across = line / table[RULER_STEP];
    *x = place->x - across * place->sine + index * place->cosine;
    *y = place->y + across * place->cosine + index * place->sine;
#if defined(LENS) || defined(CAMERA)
    return ruler_distort(x, y, place, model);
#else
    return 0;
#endif
}

// What is wrong with a sample itself, and with a sum of them.
inline masks ruler_judge(reals sample, constant real *table) {
#ifdef SATURATION
    return mask_of(sample >= table[RULER_SATURATION]) & STATUS_SATURATED;
#else
    return 0;
#endif
}

inline masks ruler_judge_sum(reals sum) {
#ifdef CODE_float
    return mask_of((LANED(not_finite)(sum) | (fabs(sum) > (real)RULER_LARGEST)) != 0) & STATUS_NOT_FINITE;
#else
    return 0;
#endif
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

// The four pixels about a sample, fetched one sample after the other and unpacked 16 at a time: a vector made of single
// loads takes longer.
#define RULER_SAMPLES (16 * RULER_VECTORS)
#ifdef CODE_uchar
typedef uint ruler_part;
#define RULER_PARTS 1
inline void ruler_fetch(global const CODE *pixel, int pitch, private ruler_part *to) {
    to[0] = as_ushort(vload2(0, pixel)) | (uint)as_ushort(vload2(0, pixel + pitch)) << 16;
}
inline void ruler_unpack(private const ruler_part *from, reals *a, reals *b, reals *c, reals *d) {
    const uint16 four = *(private const uint16 *)from;
    *a = convert_real16(as_int16(four & 0xff));
    *b = convert_real16(as_int16(four >> 8 & 0xff));
    *c = convert_real16(as_int16(four >> 16 & 0xff));
    *d = convert_real16(as_int16(four >> 24));
}
#elif defined(CODE_ushort)
typedef uint ruler_part;
#define RULER_PARTS 2
inline void ruler_fetch(global const CODE *pixel, int pitch, private ruler_part *to) {
    to[0] = as_uint(vload2(0, pixel));
    to[RULER_SAMPLES] = as_uint(vload2(0, pixel + pitch));
}
inline void ruler_unpack(private const ruler_part *from, reals *a, reals *b, reals *c, reals *d) {
    const uint16 above = *(private const uint16 *)from, below = *(private const uint16 *)(from + RULER_SAMPLES);
    *a = convert_real16(as_int16(above & 0xffff));
    *b = convert_real16(as_int16(above >> 16));
    *c = convert_real16(as_int16(below & 0xffff));
    *d = convert_real16(as_int16(below >> 16));
}
#else
typedef float ruler_part;
#define RULER_PARTS 4
inline void ruler_fetch(global const CODE *pixel, int pitch, private ruler_part *to) {
    to[0] = pixel[0];
    to[RULER_SAMPLES] = pixel[1];
    to[2 * RULER_SAMPLES] = pixel[pitch];
    to[3 * RULER_SAMPLES] = pixel[pitch + 1];
}
inline void ruler_unpack(private const ruler_part *from, reals *a, reals *b, reals *c, reals *d) {
    *a = *(private const reals *)from;
    *b = *(private const reals *)(from + RULER_SAMPLES);
    *c = *(private const reals *)(from + 2 * RULER_SAMPLES);
    *d = *(private const reals *)(from + 3 * RULER_SAMPLES);
}
#endif

// Adds a line to the profile; returns what is wrong with it.
__attribute__((always_inline)) inline masks ruler_add(const ruler_place *place, int pitch, int line,
                                                      constant real *table, constant real *model,
                                                      private reals *profile) {
    const reals lanes = (reals)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    uint16 pixels[RULER_VECTORS], parts[RULER_VECTORS * RULER_PARTS];
    reals x[RULER_VECTORS], y[RULER_VECTORS];
    masks flags = 0;
    for (int v = 0; v < RULER_VECTORS; v++) {
        reals index = lanes + 16 * v;
#if LENGTH % 16
        index = index > (real)(LENGTH - 1) ? (reals)(LENGTH - 1) : index;
#endif
        flags |= ruler_at(place, index, line, table, model, x + v, y + v);
        pixels[v] = as_uint16(ruler_split(place, pitch, x + v, y + v));
    }
#pragma clang loop vectorize(disable) unroll_count(4)
    for (int i = 0; i < RULER_SAMPLES; i++)
        ruler_fetch(place->pixel + ((private const uint *)pixels)[i], pitch, (private ruler_part *)parts + i);
    for (int v = 0; v < RULER_VECTORS; v++) {
        reals a, b, c, d;
        ruler_unpack((private const ruler_part *)(parts + v), &a, &b, &c, &d);
        const reals sample = ruler_between(a, b, c, d, x[v], y[v]);
        flags |= ruler_judge(sample, table);
        profile[v] += sample;
    }
    return flags;
}

// Whole rulers: fills edges[MOST].
inline void ruler_measure(global const CODE *image, int rows, int columns, real4 ruler, constant real *table,
                          constant real *model, private ruler_edge *edges) {
    ruler_place place;
    uint status = ruler_lay(image, rows, columns, ruler, table, &place);
    reals profile[RULER_PADDED / 16], slopes[RULER_CHUNKS];
    uint chunks = 0;
    if (!status) {
        masks flags = 0;
        for (int v = 0; v < RULER_PADDED / 16; v++) profile[v] = 0;
        for (int line = 0; line < WIDTH; line++) flags |= ruler_add(&place, columns, line, table, model, profile);
#ifdef CODE_float
        for (int v = 0; v < RULER_VECTORS; v++) flags |= ruler_judge_sum(profile[v]);
#endif
#if defined(SATURATION) || defined(CODE_float) || defined(LENS) || defined(CAMERA)
        status = ruler_any(flags);
#endif
        for (int chunk = 0; chunk < RULER_CHUNKS; chunk++) {
            slopes[chunk] = ruler_slope((private const real *)(profile + chunk), table);
            chunks |= (uint)any_lane(RULER_STRENGTH(slopes[chunk]) >= table[RULER_THRESHOLD]) << chunk;
        }
    }
    if (status & RULER_USELESS) {
        for (int k = 0; k < MOST; k++) edges[k] = ruler_nothing(status);
    } else {
        ruler_find((private const real *)slopes, chunks, status, table, edges);
    }
}
#else
inline real ruler_sum(const ruler_place *place, int pitch, int i, constant real *table, constant real *model,
                      int *flags) {
    real sum = 0;
    for (int line = 0; line < WIDTH; line++) {
        real x, y;
        *flags |= ruler_at(place, i, line, table, model, &x, &y);
        global const CODE *pixel = place->pixel + ruler_split(place, pitch, &x, &y);
        const real sample = ruler_between(pixel[0], pixel[1], pixel[pitch], pixel[pitch + 1], x, y);
        *flags |= ruler_judge(sample, table);
        sum += sample;
    }
    *flags |= ruler_judge_sum(sum);
    return sum;
}

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
