// Samples of 16 rulers at once, one in each lane (ruler.h, under STRIP).
//
// Places are fixed-point numbers of RULER_BITS binary places, from a pixel of the ruler's own: their fraction is the
// mantissa of a number from 1 to 2. The pixels about a sample are inserted into vectors one pair after the other, those
// of the last four lanes by way of integer registers, which have nothing else to do.
#ifndef RULER_LANES_H
#define RULER_LANES_H

#if WIDTH < 8
#define RULER_LINES WIDTH
#else
#define RULER_LINES 8
#endif
#define RULER_STRIDE 2 // samples
#define RULER_BATCH (RULER_STRIDE * RULER_LINES)
#define RULER_ONE (1 << RULER_BITS)

// Of the sample in lane k and the next one.
#define RULER_FIRST(k) ((uint)at[(k) / 2])
#define RULER_SECOND(k) ((uint)(at[(k) / 2] >> 32))
#ifdef CODE_float
typedef reals ruler_levels;
#define RULER_REAL(levels) (levels)
typedef ulong ruler_two __attribute__((aligned(4)));
#else
typedef masks ruler_levels;
#define RULER_REAL(levels) LANED(convert_real)(levels)
#ifdef CODE_uchar
typedef ushort ruler_two __attribute__((aligned(1)));
#else
typedef uint ruler_two __attribute__((aligned(2)));
#endif
#endif
#define RULER_TWO(row, pixel) (*(global const ruler_two *)((row) + (pixel)))

// The grey levels about a sample: a and b above, c and d below.
#ifdef CODE_uchar
#define RULER_BOTH(pixel) RULER_TWO(above, pixel), RULER_TWO(below, pixel)
#define RULER_INSERTED(k) \
    as_ulong2((ushort8)(RULER_BOTH(RULER_FIRST(k)), RULER_BOTH(RULER_SECOND(k)), \
                        RULER_BOTH(RULER_FIRST(k + 2)), RULER_BOTH(RULER_SECOND(k + 2))))
#define RULER_WORD(pixel) (RULER_TWO(above, pixel) | (uint)RULER_TWO(below, pixel) << 16)
#define RULER_SHIFTED(k) (RULER_WORD(RULER_FIRST(k)) | (ulong)RULER_WORD(RULER_SECOND(k)) << 32)
inline void ruler_fetch(global const CODE *above, global const CODE *below, private const ulong *at, ruler_levels *a,
                        ruler_levels *b, ruler_levels *c, ruler_levels *d) {
    const ulong2 last = (ulong2)(RULER_SHIFTED(12), RULER_SHIFTED(14));
    const uint16 four = as_uint16((ulong8)(RULER_INSERTED(0), RULER_INSERTED(4), RULER_INSERTED(8), last));
    *a = as_int16(four & 0xff);
    *b = as_int16(four >> 8 & 0xff);
    *c = as_int16(four >> 16 & 0xff);
    *d = as_int16(four >> 24);
}
#else
#define RULER_FOUR(row, k) \
    RULER_TWO(row, RULER_FIRST(k)), RULER_TWO(row, RULER_SECOND(k)), RULER_TWO(row, RULER_FIRST(k + 2)), \
        RULER_TWO(row, RULER_SECOND(k + 2))
inline void ruler_row(global const CODE *row, private const ulong *at, ruler_levels *left, ruler_levels *right) {
#ifdef CODE_ushort
    const uint16 two = (uint16)(RULER_FOUR(row, 0), RULER_FOUR(row, 4), RULER_FOUR(row, 8), RULER_FOUR(row, 12));
    *left = as_int16(two & 0xffff);
    *right = as_int16(two >> 16);
#else
    const float16 low = as_float16((ulong8)(RULER_FOUR(row, 0), RULER_FOUR(row, 4)));
    const float16 high = as_float16((ulong8)(RULER_FOUR(row, 8), RULER_FOUR(row, 12)));
    *left = (float16)(low.even, high.even);
    *right = (float16)(low.odd, high.odd);
#endif
}
inline void ruler_fetch(global const CODE *above, global const CODE *below, private const ulong *at, ruler_levels *a,
                        ruler_levels *b, ruler_levels *c, ruler_levels *d) {
    ruler_row(above, at, a, b);
    ruler_row(below, at, c, d);
}
#endif

inline reals ruler_fraction(masks place) {
    return as_reals((place << (23 - RULER_BITS) & 0x7fffff) | 0x3f800000) - 1;
}

// The last place before the last neighbour, or so far away that no ruler reaches it.
inline masks ruler_end(masks last) {
    const int room = 1 << (30 - RULER_BITS);
    return ((last < room ? last + 1 : (masks)room) << RULER_BITS) - 1;
}

// Where the lines of a sample begin; all of them between a pixel and its last neighbour, whatever the rounding.
inline masks ruler_begin(reals from, masks last, masks across) {
    const masks span = across * (WIDTH - 1), most = ruler_end(last);
    const masks low = span < 0 ? -span : (masks)0, high = span < 0 ? most : most - span;
    masks place = LANED(convert_bits)(from * (real)RULER_ONE);
    place = place < low ? low : place;
    return place > high ? high : place;
}

// The places of a sample on some lines.
inline masks ruler_scatter(const ruler_place *place, int pitch, int sample, int line, int lines, constant real *model,
                           private reals *x, private reals *y, private uint16 *pixels) {
    masks flags = 0;
#if defined(LENS) || defined(CAMERA)
    const masks most_x = ruler_end(place->last_column), most_y = ruler_end(place->last_row);
    for (int j = 0; j < lines; j++) {
        reals from_x = place->x + sample * place->along_x + (line + j) * place->across_x;
        reals from_y = place->y + sample * place->along_y + (line + j) * place->across_y;
        flags |= ruler_distort(&from_x, &from_y, place, model);
        masks column = LANED(convert_bits)(from_x * (real)RULER_ONE), row = LANED(convert_bits)(from_y * (real)RULER_ONE);
        column = column < most_x ? column : most_x;
        row = row < most_y ? row : most_y;
#else
    // A little less than a pixel, so that lines across all of an image have room in it.
    const real less = RULER_ONE * (1 - (real)0x1p-20f);
    const masks across_x = LANED(convert_bits)(place->across_x * less);
    const masks across_y = LANED(convert_bits)(place->across_y * less);
    const reals from_x = place->x + sample * place->along_x, from_y = place->y + sample * place->along_y;
    masks column = ruler_begin(from_x, place->last_column, across_x) + line * across_x;
    masks row = ruler_begin(from_y, place->last_row, across_y) + line * across_y;
    for (int j = 0; j < lines; j++, column += across_x, row += across_y) {
#endif
        x[j] = ruler_fraction(column);
        y[j] = ruler_fraction(row);
        pixels[j] = as_uint16(place->pixel + (column >> RULER_BITS) + (row >> RULER_BITS) * pitch);
    }
    return flags;
}

// Adds RULER_LINES lines (or what is left of them) of RULER_STRIDE samples to the profile; returns what is wrong.
__attribute__((always_inline)) inline masks ruler_add(global const CODE *image, const ruler_place *place, int pitch,
                                                      int sample, int line, constant real *table,
                                                      constant real *model, private reals *profile) {
    const int lines = WIDTH % RULER_LINES ? min(RULER_LINES, WIDTH - line) : RULER_LINES;
    uint16 pixels[RULER_BATCH];
    reals x[RULER_BATCH], y[RULER_BATCH];
    masks flags = 0;
    for (int k = 0; k < RULER_STRIDE; k++)
        flags |= ruler_scatter(place, pitch, min(sample + k, LENGTH - 1), line, lines, model, x + k * lines,
                               y + k * lines, pixels + k * lines);
    global const CODE *below = image + pitch;
    int i = 0;
    for (int k = 0; k < RULER_STRIDE; k++) {
        ruler_levels whole = 0;
        reals rest = 0;
        for (int j = 0; j < lines; j++, i++) {
            ruler_levels a, b, c, d;
            ruler_fetch(image, below, (private const ulong *)(pixels + i), &a, &b, &c, &d);
            b -= a;
            d -= c + b;
            c -= a;
            const reals step_x = RULER_REAL(b), step_y = RULER_REAL(c) + x[i] * RULER_REAL(d);
#ifdef SATURATION
            flags |= ruler_judge(RULER_REAL(a) + (x[i] * step_x + y[i] * step_y), table);
#endif
            whole += a;
            rest += x[i] * step_x;
            rest += y[i] * step_y;
        }
        profile[sample + k] += RULER_REAL(whole) + rest;
    }
    return flags;
}
#endif
