// Sampling of 16 rulers at once, one in each lane (ruler.h, vector variant).
//
// Positions are fixed-point numbers with RULER_BITS fractional bits, relative to the ruler's pixel. Shifted into the
// mantissa of a float in [1, 2), the fraction needs no conversion. Pixels are loaded one by one: measured faster than the
// processor's gather instructions.
#ifndef RULER_LANES_H
#define RULER_LANES_H

#define RULER_ONE (1 << RULER_BITS)

// Of the sample in lane k and the next one.
#define RULER_FIRST(k) ((uint)at[(k) / 2])
#define RULER_SECOND(k) ((uint)(at[(k) / 2] >> 32))
#ifdef CODE_float
typedef reals ruler_levels;
#define RULER_REAL(levels) (levels)
#else
typedef masks ruler_levels;
#define RULER_REAL(levels) LANED(convert_real)(levels)
#endif

// The grey levels about a sample: a and b above, c and d below. Integers are loaded as 32-bit words. For 8-bit pixels a
// word holds two bytes more than needed: the extra bytes follow the pixels of the upper row and precede the pixels of
// the lower row, so that no byte is outside the image.
#ifdef CODE_float
#define RULER_FOUR(row, k) \
    vload2(0, (row) + RULER_FIRST(k)), vload2(0, (row) + RULER_SECOND(k)), vload2(0, (row) + RULER_FIRST(k + 2)), \
        vload2(0, (row) + RULER_SECOND(k + 2))
static inline void ruler_row(global const CODE *row, private const ulong *at, ruler_levels *left, ruler_levels *right) {
    const float16 low = (float16)(RULER_FOUR(row, 0), RULER_FOUR(row, 4));
    const float16 high = (float16)(RULER_FOUR(row, 8), RULER_FOUR(row, 12));
    *left = (float16)(low.even, high.even);
    *right = (float16)(low.odd, high.odd);
}
static inline void ruler_fetch(global const CODE *above, global const CODE *below, private const ulong *at, ruler_levels *a,
                        ruler_levels *b, ruler_levels *c, ruler_levels *d) {
    ruler_row(above, at, a, b);
    ruler_row(below, at, c, d);
}
#else
#ifdef POCL_DEVICE_ADDRESS_BITS // makes gathers of them otherwise, which take longer
#define RULER_ONE_BY_ONE volatile
#else
#define RULER_ONE_BY_ONE
#endif
typedef RULER_ONE_BY_ONE uint ruler_bits __attribute__((aligned(sizeof(CODE))));
#define RULER_WORD(pixel) (*(global const ruler_bits *)(row + (pixel)))
#define RULER_FOUR(k) \
    RULER_WORD(RULER_FIRST(k)), RULER_WORD(RULER_SECOND(k)), RULER_WORD(RULER_FIRST(k + 2)), \
        RULER_WORD(RULER_SECOND(k + 2))
static inline masks ruler_row(global const CODE *row, private const ulong *at) {
    return as_int16((uint16)(RULER_FOUR(0), RULER_FOUR(4), RULER_FOUR(8), RULER_FOUR(12)));
}
static inline void ruler_fetch(global const CODE *above, global const CODE *below, private const ulong *at, ruler_levels *a,
                        ruler_levels *b, ruler_levels *c, ruler_levels *d) {
#ifdef CODE_uchar
    const masks first = ruler_row(above, at), second = ruler_row(below - 2, at);
    *a = first & 0xff;
    *b = first >> 8 & 0xff;
    *c = second >> 16 & 0xff;
    *d = second >> 24 & 0xff;
#else
    const masks first = ruler_row(above, at), second = ruler_row(below, at);
    *a = first & 0xffff;
    *b = first >> 16 & 0xffff;
    *c = second & 0xffff;
    *d = second >> 16 & 0xffff;
#endif
}
#endif

static inline reals ruler_fraction(masks place) {
    return as_reals((place << (23 - RULER_BITS) & 0x7fffff) | 0x3f800000) - 1;
}

// Largest position with a neighbour; clamped to the range of the fixed-point numbers, which no ruler exceeds.
static inline masks ruler_end(masks last) {
    const int room = 1 << (30 - RULER_BITS);
    return ((last < room ? last + 1 : (masks)room) << RULER_BITS) - 1;
}

// Position of the first line of a sample, clamped so that all lines lie inside the image in spite of rounding.
static inline masks ruler_begin(reals from, masks last, masks across) {
    const masks span = across * (WIDTH - 1), most = ruler_end(last);
    const masks low = span < 0 ? -span : (masks)0, high = span < 0 ? most : most - span;
    masks place = LANED(convert_bits)(from * (real)RULER_ONE);
    place = place < low ? low : place;
    return place > high ? high : place;
}

// Number of a sample, its position on the current line, and the step to the next line.
typedef struct {
    masks column, row, across_x, across_y;
    reals sample;
} ruler_walk;

// Start at sample `sample` of each lane's part of a ruler; behind the last sample of the ruler the last one is repeated.
static inline void ruler_start(ruler_walk *walk, const ruler_place *place, int sample) {
    const reals number = place->first_sample + (real)sample;
    walk->sample = number < place->last_sample ? number : place->last_sample;
#if !defined(LENS) && !defined(CAMERA)
    // Slightly less than a pixel, so that rounding cannot push lines over the border of an image that they span.
    const real less = RULER_ONE * (1 - (real)0x1p-20f);
    walk->across_x = LANED(convert_bits)(place->across_x * less);
    walk->across_y = LANED(convert_bits)(place->across_y * less);
    const reals x = place->x + walk->sample * place->along_x, y = place->y + walk->sample * place->along_y;
    walk->column = ruler_begin(x, place->last_column, walk->across_x);
    walk->row = ruler_begin(y, place->last_row, walk->across_y);
#endif
}

// Advance to the next line.
static inline void ruler_step(ruler_walk *walk) {
    walk->column += walk->across_x;
    walk->row += walk->across_y;
}

// Store fractions and pixel of the sample on the current line and advance to the next line; return flags.
static inline masks ruler_next(ruler_walk *walk, const ruler_place *place, int pitch, int line, constant real *model,
                               private reals *x, private reals *y, private uint16 *pixel) {
    masks flags = 0;
#if defined(LENS) || defined(CAMERA)
    reals from_x = place->x + walk->sample * place->along_x + line * place->across_x;
    reals from_y = place->y + walk->sample * place->along_y + line * place->across_y;
    flags = ruler_distort(&from_x, &from_y, place, model);
    const masks most_x = ruler_end(place->last_column), most_y = ruler_end(place->last_row);
    walk->column = LANED(convert_bits)(from_x * (real)RULER_ONE);
    walk->row = LANED(convert_bits)(from_y * (real)RULER_ONE);
    walk->column = walk->column < most_x ? walk->column : most_x;
    walk->row = walk->row < most_y ? walk->row : most_y;
#endif
    *x = ruler_fraction(walk->column);
    *y = ruler_fraction(walk->row);
    *pixel = as_uint16(place->pixel + (walk->column >> RULER_BITS) + (walk->row >> RULER_BITS) * pitch);
#if !defined(LENS) && !defined(CAMERA)
    ruler_step(walk);
#endif
    return flags;
}

// Positions are computed RULER_AHEAD samples before their pixels are blended, so that no store is forwarded to a load of
// another size: a load of elements of a vector, or of a vector of elements.
#if defined(CODE_uchar) && defined(POCL_DEVICE_ADDRESS_BITS)
// 8-bit pixels on PoCL, where patches (ruler_patches.h) do not serve: scalar code packs the 2 x 2 pixels of a sample in a
// word and stores it, one sample before words are blended as a vector. Both work side by side: a third less time than with
// vectors into which loads insert pixels. (On Intel's runtime the insertions take less time.)
#define RULER_PACKED
#define RULER_AHEAD 2
typedef volatile ushort ruler_two __attribute__((aligned(1)));
static inline uint ruler_two_pixels(global const uchar *at) { return *(global const ruler_two *)at; }

// Not inlined, all vector registers would be saved around the call.
static inline __attribute__((always_inline)) void ruler_pack(global const uchar *above, global const uchar *below,
                                                             private const uint16 *pixels, private masks *words) {
    private const ulong *at = (private const ulong *)pixels;
    private uint *to = (private uint *)words;
    _Pragma("unroll") for (int k = 0; k < LANES; k += 2) {
        const uint one = RULER_FIRST(k), two = RULER_SECOND(k);
        to[k] = ruler_two_pixels(above + one) | ruler_two_pixels(below + one) << 16;
        to[k + 1] = ruler_two_pixels(above + two) | ruler_two_pixels(below + two) << 16;
    }
}
static inline void ruler_unpack(masks words, ruler_levels *a, ruler_levels *b, ruler_levels *c, ruler_levels *d) {
    *a = words & 0xff;
    *b = words >> 8 & 0xff;
    *c = words >> 16 & 0xff;
    *d = words >> 24 & 0xff;
}
#else
#define RULER_AHEAD 1
#endif
#define RULER_SLOTS (2 * RULER_AHEAD) // samples whose fractions are kept, a power of two

// Sum `length` samples of each lane over the lines; return flags.
static inline __attribute__((always_inline)) masks ruler_sums(global const CODE *image, const ruler_place *place, int pitch,
                                                       int length, constant real *table, constant real *model,
                                                       private reals *profile) {
    uint16 pixels[2 * WIDTH];
    reals x[RULER_SLOTS * WIDTH], y[RULER_SLOTS * WIDTH];
    masks flags = 0;
    ruler_walk walk;
    for (int i = 0; i < RULER_AHEAD; i++) {
        ruler_start(&walk, place, i);
        for (int k = i * WIDTH; k < (i + 1) * WIDTH; k++)
            flags |= ruler_next(&walk, place, pitch, k - i * WIDTH, model, x + k, y + k, pixels + k);
    }
    global const CODE *below = image + pitch;
#ifdef RULER_PACKED
    masks words[2 * WIDTH];
    for (int j = 0; j < WIDTH; j++) ruler_pack(image, below, pixels + j, words + j);
#endif
    for (int i = 0; i < length; i++) {
        const int now = i % 2 * WIDTH, after = WIDTH - now, ahead = (i + RULER_AHEAD) % 2 * WIDTH;
        const int slot = i % RULER_SLOTS * WIDTH, next_slot = (i + RULER_AHEAD) % RULER_SLOTS * WIDTH;
        ruler_start(&walk, place, i + RULER_AHEAD);
        ruler_levels whole = 0;
        reals rest = 0;
        for (int j = 0; j < WIDTH; j++) {
            ruler_levels a, b, c, d;
#ifdef RULER_PACKED
            ruler_pack(image, below, pixels + after + j, words + after + j);
            ruler_unpack(words[now + j], &a, &b, &c, &d);
#else
            ruler_fetch(image, below, (private const ulong *)(pixels + now + j), &a, &b, &c, &d);
#endif
            flags |= ruler_next(&walk, place, pitch, j, model, x + next_slot + j, y + next_slot + j, pixels + ahead + j);
            b -= a;
            d -= c + b;
            c -= a;
            const reals part_x = x[slot + j], part_y = y[slot + j];
            const reals step_x = RULER_REAL(b), step_y = RULER_REAL(c) + part_x * RULER_REAL(d);
#ifdef SATURATION
            flags |= ruler_sample_flags(RULER_REAL(a) + (part_x * step_x + part_y * step_y), table);
#endif
            whole += a;
            rest += part_x * step_x;
            rest += part_y * step_y;
        }
        profile[i] = RULER_REAL(whole) + rest;
        flags |= ruler_sum_flags(profile[i]);
    }
    return flags;
}

// Samples of a single line share too few pixels.
#if defined(CODE_uchar) && WIDTH > 1 && !defined(LENS) && !defined(CAMERA)
#include "ruler/ruler_patches.h"
#endif
#endif
