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

// Grey level of the background, sampled beyond the edges of the fit.
static inline real background_of(global const CODE *image, int rows, int columns, real x, real y, blob_shape shape,
                          private const blob_edges *edges, private const real *weights, blob_layout layout, real blur) {
    const real cosine = cos(shape.angle), sine = sin(shape.angle), out = BEYOND * blur + (real)0.5f;
    real sum = 0, all = 0;
    for (int i = 0; i < SPOKES; i++) {
        const real nx = layout.nx[i], ny = layout.ny[i];
        const int column = (int)rint(x + edges->x[i] + out * (cosine * nx - sine * ny));
        const int row = (int)rint(y + edges->y[i] + out * (sine * nx + cosine * ny));
        const int inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows);
        const real level = convert_real(image[inside ? row * columns + column : 0]);
        const real weight = (inside && !not_finite(level)) ? weights[i] : 0;
        sum += weight > 0 ? weight * level : 0;
        all += weight;
    }
    return sum / all;
}

// Mark the parts of the contour whose edges disagree with the shape, as wide as the spacing of the rulers.
static inline void hide(blob_shape shape, private const real *weights, blob_layout layout, real spacing, real blur,
                 private blob_hidden *hidden) {
    const real cosine = cos(shape.angle), sine = sin(shape.angle);
    hidden->count = 0;
    hidden->half_width = spacing * shape.size;
    hidden->half_length = ABOUT_BLURS * blur + ABOUT + 1;
    for (int i = 0; i < SPOKES; i++) {
        if (weights[i] >= OWN) continue;
        const real bx = layout.bx[i], by = layout.by[i], nx = layout.nx[i], ny = layout.ny[i];
        hidden->x[hidden->count] = shape.size * (cosine * bx - sine * by);
        hidden->y[hidden->count] = shape.size * (sine * bx + cosine * by);
        hidden->nx[hidden->count] = cosine * nx - sine * ny;
        hidden->ny[hidden->count++] = sine * nx + cosine * ny;
    }
}

// Centroid of the grey levels over the background of a ring around the fiducial, relative to (x, y). Return 0 if the ring
// leaves the image.
static inline int gravity_of(global const CODE *image, int rows, int columns, real x, real y, real reach, private real *to_x,
                      private real *to_y) {
    const real outer = reach + RING;
    if (!(x - outer >= 0 && y - outer >= 0 && x + outer <= columns - 1 && y + outer <= rows - 1)) return 0;
    const int left = (int)(x - outer), right = (int)(x + outer), top = (int)(y - outer), bottom = (int)(y + outer);
    // Subtract one grey level first: sums of differences keep more digits.
    const reals level = (reals)convert_real(image[(int)y * columns + (int)x]);
    reals area = 0, sum = 0, sum_x = 0, sum_y = 0, at_x = 0, at_y = 0, about = 0, sum_about = 0;
    for (int row = top; row <= bottom; row++) {
        const reals dy = (reals)(row - y);
        for (int column = left; column <= right; column += LANES) {
            const int from = min(column, columns - LANES);
            const reals place = (reals)(real)from + COUNTED, dx = place - (reals)x, square = dx * dx + dy * dy;
            const masks fresh = mask_of(place >= (reals)(real)column);
            const masks in = fresh & mask_of(square <= (reals)(reach * reach));
            const masks ring = fresh & ~in & mask_of(square <= (reals)(outer * outer));
            const reals grey = PIXELS(image + row * columns + from) - level, mine = kept_where(in, grey);
            area += kept_where(in, (reals)1);
            at_x += kept_where(in, dx);
            at_y += kept_where(in, dy);
            sum += mine;
            sum_x += mine * dx;
            sum_y += mine * dy;
            about += kept_where(ring, (reals)1);
            sum_about += kept_where(ring, grey);
        }
    }
    const real background = sum_of(sum_about) / sum_of(about), per = 1 / (sum_of(sum) - background * sum_of(area));
    *to_x = (sum_of(sum_x) - background * sum_of(at_x)) * per;
    *to_y = (sum_of(sum_y) - background * sum_of(at_y)) * per;
    return !not_finite(*to_x + *to_y) && fabs(*to_x) <= reach && fabs(*to_y) <= reach;
}

#endif
