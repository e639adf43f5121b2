// Rulers: short lines of samples in an image, along which edges are looked for. A ruler (x, y, cos, sin) has LENGTH
// samples along its direction, each the sum over WIDTH lines a pixel apart, bilinear between pixels. Its gradient is
// taken with the derivative of a Gaussian (TAPS either side), an edge is a peak of that.
//
//     VECTOR_VARIANT      one work-item takes 16 rulers at a time, one in each lane (for CPU runtimes)
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
#include "common/camera.h"
#include "common/lens.h"
#include "common/status.h"

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
#define RULER_MIDDLE ((real)0.5f * (LENGTH - 1))
#define RULER_LARGEST 1e37f  // of sums over lines: gradients of them are numbers
// What leaves no edge to look for.
#define RULER_USELESS (STATUS_NOT_FINITE | STATUS_OUT_OF_RANGE | STATUS_NOT_INVERTIBLE)

// Where a ruler lies: the first sample of its first line, relative to a pixel near it, which keeps the digits.
typedef struct {
    masks pixel;
    reals x, y, along_x, along_y, across_x, across_y;  // of the next sample, and of the next line
    masks last_column, last_row;                       // that have a neighbour, from the pixel on
} ruler_place;

// Lays rulers out; returns what is wrong with them. Those get a place all the same, where there is something to read.
static inline masks ruler_lay(int rows, int columns, reals x, reals y, reals cosine, reals sine, constant real *table,
                       ruler_place *place) {
    const masks bad = mask_of((LANED(not_finite)(x) | LANED(not_finite)(y) | LANED(not_finite)(cosine) |
                               LANED(not_finite)(sine)) != 0);
    const real half_length = RULER_MIDDLE * table[RULER_STEP], half_width = (real)0.5f * (WIDTH - 1);
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
    return bad ? (masks)STATUS_NOT_FINITE : away & STATUS_OUT_OF_RANGE;
}

// Takes (x, y) to the measured image; returns the flags of lanes that have no place in it, which it leaves at 0, 0.
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

// What is wrong with a sample itself, and with a sum of them.
static inline masks ruler_judge(reals sample, constant real *table) {
#ifdef SATURATION
    return mask_of(sample >= table[RULER_SATURATION]) & STATUS_SATURATED;
#else
    return 0;
#endif
}

static inline masks ruler_judge_sum(reals sum) {
#ifdef CODE_float
    return mask_of((LANED(not_finite)(sum) | mask_of(fabs(sum) > (real)RULER_LARGEST)) != 0) & STATUS_NOT_FINITE;
#else
    return 0;
#endif
}

// How much of an edge of the wanted polarity a gradient is; of pairs the polarity is looked at later.
#if defined(RISING) && !defined(PAIRS)
#define RULER_STRENGTH(slope) (slope)
#elif defined(FALLING) && !defined(PAIRS)
#define RULER_STRENGTH(slope) (-(slope))
#else
#define RULER_STRENGTH(slope) fabs(slope)
#endif

#include "ruler/ruler_refine.h"

#ifdef VECTOR_VARIANT
static inline reals ruler_slope(private const reals *profile, int i, constant real *table) {
    reals slope = 0;
    for (int k = 1; k <= TAPS; k++)
        slope += table[RULER_TAPS + k - 1] * (profile[i + TAPS + k] - profile[i + TAPS - k]);
    return slope;
}
#define RULER_SPACE private
#if __has_builtin(__builtin_reduce_or)
#define RULER_ANY(mask) (__builtin_reduce_or(mask) != 0)
#else
#define RULER_ANY(mask) any_lane(mask)
#endif
#define RULER_SLOPE(i) ruler_slope(values, i, table)
#else
static inline real ruler_slope(local const real *profile, int i, constant real *table) {
    real slope = 0;
    for (int k = 1; k <= TAPS; k++)
        slope += table[RULER_TAPS + k - 1] * (profile[i + TAPS + k] - profile[i + TAPS - k]);
    return slope;
}
#define RULER_SPACE local
#define RULER_ANY(mask) (mask)
#define RULER_SLOPE(i) values[i]
#endif

// The edges along profiles (in lanes) or gradients (of one ruler); what is wrong with the rulers themselves is in
// `flags`.
static inline void ruler_find(RULER_SPACE const reals *values, const ruler_place *place, masks flags, constant real *table,
                       private ruler_edge *edges) {
    const real threshold = table[RULER_THRESHOLD];
    masks found = 0, wins;
    reals best = 0, rival = 0;
    ruler_peak peak = {0, 0, 1, 0};
    ruler_peak first = peak, second = peak;
#ifdef CHOOSE_ALL
    masks count = 0;
    edges[0] = RULER_TAKEN(peak, peak);
    for (int k = 1; k < MOST; k++) edges[k] = edges[0];
#endif
#ifdef PAIRS
    ruler_peak other = peak;
    masks has_other = 0;
#endif
    peak.before = RULER_SLOPE(0);
    peak.here = RULER_SLOPE(1);
    for (int i = 1; i < RULER_SLOPES - 1; i++) {
        peak.after = RULER_SLOPE(i + 1);
        peak.at = i;
        reals strength = RULER_STRENGTH(peak.here);
        const masks is_peak = mask_of(strength >= threshold) & mask_of(strength > RULER_STRENGTH(peak.before)) &
                              mask_of(strength >= RULER_STRENGTH(peak.after));
        if (RULER_ANY(is_peak)) {
            masks candidate = is_peak;
#ifdef PAIRS
            const reals gap = peak.at - other.at;
            candidate &= has_other & (mask_of(other.here > 0) ^ mask_of(peak.here > 0)) &
                         mask_of(gap >= table[RULER_NEAREST]) & mask_of(gap <= table[RULER_FARTHEST]);
#if defined(RISING)
            candidate &= mask_of(other.here > 0);
#elif defined(FALLING)
            candidate &= mask_of(other.here < 0);
#endif
            const reals weaker = fabs(other.here);
            strength = strength < weaker ? strength : weaker;
            const ruler_peak from = other;
            other = ruler_either(is_peak, peak, other);
            has_other |= is_peak;
#else
            const ruler_peak from = peak;
#endif
#ifdef CHOOSE_ALL
            const ruler_edge edge = RULER_TAKEN(from, peak);
            for (int k = 0; k < MOST; k++) {
                wins = candidate & mask_of(count == k);
                edges[k].position = wins ? edge.position : edges[k].position;
                edges[k].amplitude = wins ? edge.amplitude : edges[k].amplitude;
                edges[k].width = wins ? edge.width : edges[k].width;
                edges[k].sigma = wins ? edge.sigma : edges[k].sigma;
                edges[k].spacing = wins ? edge.spacing : edges[k].spacing;
            }
            count -= candidate;
            edges[MOST - 1].status |= mask_of(count > MOST) & STATUS_AMBIGUOUS;
#else
#if defined(CHOOSE_FIRST)
            wins = candidate & ~found;
#elif defined(CHOOSE_LAST)
            wins = candidate;
#else
            wins = candidate & mask_of(strength > best);
#endif
#ifdef AMBIGUITY
            rival = wins ? best : (candidate & mask_of(strength > rival) ? strength : rival);
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
    for (int k = 0; k < MOST; k++) edges[k] = ruler_marked(edges[k], mask_of(count > k), flags);
#else
    edges[0] = RULER_TAKEN(first, second);
#ifdef AMBIGUITY
    edges[0].status |= mask_of(rival >= table[RULER_AMBIGUITY] * best) & STATUS_AMBIGUOUS;
#endif
    edges[0] = ruler_marked(edges[0], found, flags);
#endif
}

#ifdef VECTOR_VARIANT
#include "ruler/ruler_lanes.h"

// 16 rulers, one in each lane: fills edges[MOST].
static inline void ruler_measure_lanes(global const CODE *image, int rows, int columns, reals x, reals y, reals cosine,
                                reals sine, constant real *table, constant real *model, private ruler_edge *edges) {
    ruler_place place;
    masks flags = ruler_lay(rows, columns, x, y, cosine, sine, table, &place);
    reals profile[LENGTH];
    flags |= ruler_sums(image, &place, columns, table, model, profile);
    ruler_find(profile, &place, flags, table, edges);
}

// 16 rulers from the one given on, `stride` numbers apart. There are `count`; lanes past them do the last one again.
static inline void ruler_measure(global const CODE *image, int rows, int columns, global const real *rulers, uint stride,
                          uint count, constant real *table, constant real *model, private ruler_edge *edges) {
    real given[4][LANES];
    for (uint lane = 0; lane < LANES; lane++) {
        const real4 one = vload4(0, rulers + stride * (ulong)min(lane, count - 1));
        given[0][lane] = one.x;
        given[1][lane] = one.y;
        given[2][lane] = one.z;
        given[3][lane] = one.w;
    }
    ruler_measure_lanes(image, rows, columns, vload16(0, given[0]), vload16(0, given[1]), vload16(0, given[2]),
                        vload16(0, given[3]), table, model, edges);
}
#else
// Splits (x, y) from the place's pixel into a pixel that has neighbours, and what is left.
static inline masks ruler_split(const ruler_place *place, int pitch, reals *x, reals *y) {
    masks column = LANED(convert_bits)(*x), row = LANED(convert_bits)(*y);
    column = column < place->last_column ? column : place->last_column;
    row = row < place->last_row ? row : place->last_row;
    *x -= LANED(convert_real)(column);
    *y -= LANED(convert_real)(row);
    return place->pixel + row * pitch + column;
}

static inline reals ruler_between(reals a, reals b, reals c, reals d, reals x, reals y) {
    a += x * (b - a);
    c += x * (d - c);
    return a + y * (c - a);
}

static inline real ruler_sum(global const CODE *image, const ruler_place *place, int pitch, int i, constant real *table,
                      constant real *model, int *flags) {
    real sum = 0;
    for (int line = 0; line < WIDTH; line++) {
        real x = place->x + i * place->along_x + line * place->across_x;
        real y = place->y + i * place->along_y + line * place->across_y;
#if defined(LENS) || defined(CAMERA)
        *flags |= ruler_distort(&x, &y, place, model);
#endif
        global const CODE *pixel = image + ruler_split(place, pitch, &x, &y);
        const real sample = ruler_between(pixel[0], pixel[1], pixel[pitch], pixel[pitch + 1], x, y);
        *flags |= ruler_judge(sample, table);
        sum += sample;
    }
    *flags |= ruler_judge_sum(sum);
    return sum;
}

// One ruler by a work-group, in arrays of its own; edges[MOST] are for its first item.
static inline void ruler_measure(global const CODE *image, int rows, int columns, real4 ruler, constant real *table,
                          constant real *model, local real *profile, local real *slopes, local int *shared_flags,
                          private ruler_edge *edges) {
    const int item = get_local_id(0);
    ruler_place place;
    int flags = ruler_lay(rows, columns, ruler.x, ruler.y, ruler.z, ruler.w, table, &place);
    if (item == 0) *shared_flags = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int i = item; i < LENGTH; i += RULER_GROUP)
        profile[i] = ruler_sum(image, &place, columns, i, table, model, &flags);
    if (flags) atomic_or(shared_flags, flags);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int i = item; i < RULER_SLOPES; i += RULER_GROUP) slopes[i] = ruler_slope(profile, i, table);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item == 0) ruler_find(slopes, &place, *shared_flags, table, edges);
}
#endif
#endif
