// Grey levels of a fiducial: background, parts of the contour that something else hides, centroid.
//
// Options: as in blob.cl.
#ifndef BLOB_GREY_H
#define BLOB_GREY_H
#include "blob/blob_edges.h"
#include "blob/blob_match.h"

#define RING (real)2              // width of the background ring for the centroid [px]
#define BEYOND (real)2.5f         // distance of background samples from an edge, in blurs
#define OWN (real)0.5f            // smallest weight of an edge that belongs to the fiducial

// Return the grey level of the background, sampled beyond the edges of the fit.
INLINE real background_of(global const CODE *image, int rows, int columns, real x, real y, blob_shape shape,
                          GROUP_SPACE const blob_edges *edges, GROUP_SPACE const real *weights, blob_layout layout,
                          real blur, GROUP_SPACE blob_room *room) {
    const real cosine = cosine_of(shape), sine = sine_of(shape), out = BEYOND * blur + (real)0.5f;
    reals sums[2];
    EACH_PART(part) {
        real sum = 0, all = 0;
        for (int i = part; i < SPOKES; i += PARTS) {
            const real nx = layout.nx[i], ny = layout.ny[i];
            const int column = (int)rint(x + edges->x[i] + out * (cosine * nx - sine * ny));
            const int row = (int)rint(y + edges->y[i] + out * (sine * nx + cosine * ny));
            const int inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows);
            const real level = convert_real(image[inside ? row * columns + column : 0]);
            const real weight = (inside && !not_finite(level)) ? weights[i] : 0;
            sum += weight > 0 ? weight * level : 0;
            all += weight;
        }
        sums[0] = (reals)sum, sums[1] = (reals)all;
        group_put(sums, 2, part, room->sums);
    }
    GROUP_SPACE const reals *totals = group_total(sums, 2, room->sums);
    return FIRST(totals[0]) / FIRST(totals[1]);
}

// Mark the parts of the contour whose edges disagree with the shape, as wide as the spacing of the rulers.
static inline void hide(blob_shape shape, GROUP_SPACE const real *weights, blob_layout layout, real spacing, real blur,
                        GROUP_SPACE blob_hidden *hidden) {
    const real cosine = cosine_of(shape), sine = sine_of(shape);
    int count = 0;
    for (int i = 0; i < SPOKES; i++) {
        if (weights[i] >= OWN) continue;
        const real bx = layout.bx[i], by = layout.by[i], nx = layout.nx[i], ny = layout.ny[i];
        hidden->x[count] = shape.size * (cosine * bx - sine * by);
        hidden->y[count] = shape.size * (sine * bx + cosine * by);
        hidden->nx[count] = cosine * nx - sine * ny;
        hidden->ny[count++] = sine * nx + cosine * ny;
    }
    hidden->count = count;
    hidden->half_width = spacing * shape.size;
    hidden->half_length = ABOUT_BLURS * blur + ABOUT + 1;
}

// Sums over the pixels of the disc, and over the ring around it (number of pixels, grey levels).
#define AREA 0
#define AT_X 1
#define AT_Y 2
#define GREY 3
#define GREY_X 4
#define GREY_Y 5
#define ABOUT_AREA 6
#define ABOUT_GREY 7
#define GRAVITY_SUMS 8

// Centroid of the grey levels over the background of a ring around the fiducial, relative to (x, y). Return 0 if the ring
// leaves the image, and unless `is_wanted`.
INLINE int gravity_of(global const CODE *image, int rows, int columns, real x, real y, real reach, int is_wanted,
                      GROUP_SPACE blob_room *room, private real *to_x, private real *to_y) {
    const real outer = reach + RING;
    const int inside = is_wanted && x - outer >= 0 && y - outer >= 0 && x + outer <= columns - 1 && y + outer <= rows - 1;
    const int left = inside ? (int)(x - outer) : 0, right = inside ? (int)(x + outer) : -1;
    const int top = inside ? (int)(y - outer) : 0, bottom = inside ? (int)(y + outer) : -1;
    // Subtract one grey level first: sums of differences keep more digits.
    const reals level = (reals)convert_real(image[inside ? (int)y * columns + (int)x : 0]);
    reals sums[GRAVITY_SUMS];
    EACH_PART(part) {
        for (int k = 0; k < GRAVITY_SUMS; k++) sums[k] = 0;
        for (int row = top + PART_ROW(part); row <= bottom; row += PART_ROWS) {
            const reals dy = (reals)(row - y);
            for (int column = left + PART_COLUMN(part); column <= right; column += LANES * PART_COLUMNS) {
                const int from = min(column, columns - LANES);
                const reals place = (reals)(real)from + COUNTED, dx = place - (reals)x, square = dx * dx + dy * dy;
                const masks fresh = mask_of(place >= (reals)(real)column);
                const masks in = fresh & mask_of(square <= (reals)(reach * reach));
                const masks ring = fresh & ~in & mask_of(square <= (reals)(outer * outer));
                const reals grey = PIXELS(image + row * columns + from) - level, mine = kept_where(in, grey);
                sums[AREA] += kept_where(in, (reals)1);
                sums[AT_X] += kept_where(in, dx);
                sums[AT_Y] += kept_where(in, dy);
                sums[GREY] += mine;
                sums[GREY_X] += mine * dx;
                sums[GREY_Y] += mine * dy;
                sums[ABOUT_AREA] += kept_where(ring, (reals)1);
                sums[ABOUT_GREY] += kept_where(ring, grey);
            }
        }
        for (int k = 0; k < GRAVITY_SUMS; k++) sums[k] = (reals)sum_of(sums[k]);
        group_put(sums, GRAVITY_SUMS, part, room->sums);
    }
    GROUP_SPACE const reals *totals = group_total(sums, GRAVITY_SUMS, room->sums);
    const real area = FIRST(totals[AREA]), grey = FIRST(totals[GREY]);
    const real background = FIRST(totals[ABOUT_GREY]) / FIRST(totals[ABOUT_AREA]), per = 1 / (grey - background * area);
    *to_x = (FIRST(totals[GREY_X]) - background * FIRST(totals[AT_X])) * per;
    *to_y = (FIRST(totals[GREY_Y]) - background * FIRST(totals[AT_Y])) * per;
    return inside && !not_finite(*to_x + *to_y) && fabs(*to_x) <= reach && fabs(*to_y) <= reach;
}

#endif
