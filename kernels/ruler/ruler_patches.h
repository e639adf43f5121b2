// Sampling of 16 rulers at once from 8-bit images, one in each lane: four samples read one patch of 4 x 4 pixels.
//
// A sample interpolates between 2 x 2 pixels. Two adjacent samples on two adjacent lines are less than 2 px apart along
// both axes of the image, so that their pixels lie in a patch of 4 x 4: four loads of words of 4 pixels replace eight
// loads of 2 pixels. Comparisons choose the two rows of a sample, a shift moves its pixels to the low bytes. Positions,
// interpolation and order of the sums are those of ruler_sums: the results are the same bit by bit.
//
// A pass of the loop blends two samples, loads the patches of the next two, and places the two after those: scalar loads
// and stores work beside the vector units, and no store is forwarded to a load of another size.
#ifndef RULER_PATCHES_H
#define RULER_PATCHES_H

#define PATCH 4                   // rows and columns of a patch [px]
#define PATCHES ((WIDTH + 1) / 2) // patches of two samples on all lines
#define PATCH_SLOTS 4             // pairs of samples whose patches are kept, a power of two
#define LINES_OF(k) (2 * (k) + 1 < WIDTH ? 2 : 1) // lines of patch k
// Largest distance of samples of a patch along an axis [px]: below 2 by more than rounding.
#define PATCH_SPAN 1.9f
#define PATCH_INLINE static inline __attribute__((always_inline)) // calls would save all vector registers

// First pixel of a patch, and positions [sample][line] in the patch, fixed-point numbers.
typedef struct {
    masks column[2][2], row[2][2];
    uint16 pixel;
} ruler_patch;

// Rows of a patch: words of PATCH pixels.
typedef struct {
    masks row[PATCH];
} ruler_pixels;

// Return whether patches hold the samples of all rulers and fit into the image.
static inline int ruler_has_patches(private const ruler_place *place, int rows, int columns) {
    const reals x = fabs(place->along_x) + fabs(place->across_x), y = fabs(place->along_y) + fabs(place->across_y);
    return rows >= PATCH && columns >= PATCH && !any_compared(mask_of(fmax(x, y) > (reals)PATCH_SPAN));
}

// Return the first row or column of a patch with the positions of two samples on `lines` lines. `last`: last row or
// column with a neighbour; the patch ends at the neighbour at the latest.
static inline masks ruler_patch_from(masks one, masks two, masks across, int lines, masks last) {
    const masks least = (one < two ? one : two) + (lines > 1 && across < 0 ? across : (masks)0);
    const masks from = least >> RULER_BITS, most = last + (2 - PATCH);
    return from < most ? from : most;
}

// Place a patch of two samples, and advance their walks to the lines of the next patch.
PATCH_INLINE void ruler_place_patch(private const ruler_place *place, int pitch, int lines, private ruler_walk *walks,
                                    private ruler_patch *patch) {
    const masks column =
        ruler_patch_from(walks[0].column, walks[1].column, walks[0].across_x, lines, place->last_column);
    const masks row = ruler_patch_from(walks[0].row, walks[1].row, walks[0].across_y, lines, place->last_row);
    patch->pixel = as_uint16(place->pixel + column + row * pitch);
    _Pragma("unroll") for (int line = 0; line < 2; line++) {
        _Pragma("unroll") for (int i = 0; i < 2; i++) {
            patch->column[i][line] = walks[i].column - (column << RULER_BITS);
            patch->row[i][line] = walks[i].row - (row << RULER_BITS);
            ruler_step(walks + i);
        }
    }
}

// Load a patch of each ruler. `volatile`: PoCL makes gathers of the loads otherwise, which take longer.
typedef volatile uint ruler_four __attribute__((aligned(1)));
static inline uint ruler_four_pixels(global const uchar *at) { return *(global const ruler_four *)at; }
PATCH_INLINE void ruler_load_patch(global const uchar *image, int pitch, private const ruler_patch *patch,
                                   private ruler_pixels *pixels) {
    private const uint *at = (private const uint *)&patch->pixel;
    private uint *to = (private uint *)pixels->row;
    global const uchar *second = image + pitch, *third = second + pitch, *fourth = third + pitch;
    _Pragma("unroll") for (int lane = 0; lane < LANES; lane++) {
        to[lane] = ruler_four_pixels(image + at[lane]);
        to[lane + LANES] = ruler_four_pixels(second + at[lane]);
        to[lane + 2 * LANES] = ruler_four_pixels(third + at[lane]);
        to[lane + 3 * LANES] = ruler_four_pixels(fourth + at[lane]);
    }
}

// Add a sample at a position in its patch to the sums: its upper left pixel to `whole`, the rest to `rest`.
PATCH_INLINE masks ruler_blend(masks column, masks row, private const masks *rows, constant real *table,
                               private masks *whole, private reals *rest) {
    const masks second = row >= RULER_ONE, third = row >= 2 * RULER_ONE;
    const masks bits_before = column >> (RULER_BITS - 3) & 0x18; // 8 bits for each pixel before the position
    const masks above = (third ? rows[2] : (second ? rows[1] : rows[0])) >> bits_before;
    const masks below = (third ? rows[3] : (second ? rows[2] : rows[1])) >> bits_before;
    const masks a = above & 0xff, b = (above >> 8 & 0xff) - a, c = below & 0xff, d = (below >> 8 & 0xff) - (c + b);
    const reals x = ruler_fraction(column), y = ruler_fraction(row);
    const reals step_x = to_reals(b), step_y = to_reals(c - a) + x * to_reals(d);
    *whole += a;
    *rest += x * step_x;
    *rest += y * step_y;
#ifdef SATURATION
    return ruler_sample_flags(to_reals(a) + (x * step_x + y * step_y), table);
#else
    return 0;
#endif
}

// Start the walks of samples i and i + 1.
static inline void ruler_start_pair(private ruler_walk *walks, private const ruler_place *place, int i) {
    ruler_start(walks, place, i);
    ruler_start(walks + 1, place, i + 1);
}

// Sum `length` samples of each lane over the lines; return flags. Of an odd number of samples one more is computed.
PATCH_INLINE masks ruler_patch_sums(global const uchar *image, private const ruler_place *place, int pitch, int length,
                                    constant real *table, private reals *profile) {
    ruler_patch patches[PATCH_SLOTS][PATCHES];
    ruler_pixels pixels[2][PATCHES];
    ruler_walk walks[2];
    masks flags = 0;
    for (int pair = 0; pair < 2; pair++) {
        ruler_start_pair(walks, place, 2 * pair);
        for (int k = 0; k < PATCHES; k++) ruler_place_patch(place, pitch, LINES_OF(k), walks, patches[pair] + k);
    }
    for (int k = 0; k < PATCHES; k++) ruler_load_patch(image, pitch, patches[0] + k, pixels[0] + k);
    for (int pair = 0; 2 * pair < length; pair++) {
        private const ruler_patch *now = patches[pair % PATCH_SLOTS], *next = patches[(pair + 1) % PATCH_SLOTS];
        private ruler_patch *after = patches[(pair + 2) % PATCH_SLOTS];
        private ruler_pixels *loaded = pixels[pair % 2], *loading = pixels[(pair + 1) % 2];
        masks whole[2] = {0, 0};
        reals rest[2] = {0, 0};
        ruler_start_pair(walks, place, 2 * pair + 4);
        for (int k = 0; k < PATCHES; k++) {
            ruler_load_patch(image, pitch, next + k, loading + k);
            ruler_place_patch(place, pitch, LINES_OF(k), walks, after + k);
            for (int line = 0; line < LINES_OF(k); line++)
                _Pragma("unroll") for (int i = 0; i < 2; i++)
                    flags |= ruler_blend(now[k].column[i][line], now[k].row[i][line], loaded[k].row, table, whole + i,
                                         rest + i);
        }
        profile[2 * pair] = to_reals(whole[0]) + rest[0];
        profile[2 * pair + 1] = to_reals(whole[1]) + rest[1];
    }
    return flags;
}
#endif
