// Refinement of a fiducial by its grey levels: robust least squares of the pixels against a blurred shape on a plane
// background, starting at the shape fitted to its edges. The contour is sampled at pixel centres without interpolation;
// each contour pixel contributes one residual.
//
// Options: ROUND, FREEDOMS as in blob.cl; RATIO: inner over outer size of a ring or a cross; else a disc or a square.
#ifndef BLOB_MATCH_H
#define BLOB_MATCH_H
#include "blob/blob_model.h"

// Grey levels of a fiducial: background at its centre, contrast over the background; blur of its edges [px].
typedef struct {
    real background, contrast, blur;
} blob_grey;

#define UNKNOWNS (FREEDOMS + 5) // shape; blur, contrast, background and its two slopes
#define UNKNOWN_CELLS (UNKNOWNS * (UNKNOWNS + 1) / 2)
#define MATCH_STEPS 3          // iterations
#define MATCHED (real)0.05f    // a step below this fraction of the blur ends the iteration
#define MATCH_FURTHEST (real)1 // largest distance from the shape fitted to the edges [px]
#define MATCH_SHARE (real)0.1f // largest residual of an inlier: this fraction of the contrast ...
#define MATCH_NOISES (real)4   // ... plus this multiple of the noise
#define MATCH_OWN (real)0.7f   // smallest fraction of inlier pixels
#define SHARPEST (real)0.3f    // smallest blur [px]: a sharper edge is undersampled
#define ABOUT_BLURS (real)5    // width of the background around the fiducial: this multiple of the blur ...
#define ABOUT (real)2          // ... plus this width [px]

// Parts of the contour that belong to something else: their edges disagree with the shape. Relative to the centre.
typedef struct {
    real x[SPOKES], y[SPOKES], nx[SPOKES], ny[SPOKES];
    real half_width, half_length;
    int count;
} blob_hidden;

static inline masks hidden_at(private const blob_hidden *hidden, reals dx, reals dy) {
    masks in = 0;
    for (int i = 0; i < hidden->count; i++) {
        const reals x = dx - (reals)hidden->x[i], y = dy - (reals)hidden->y[i];
        const reals nx = (reals)hidden->nx[i], ny = (reals)hidden->ny[i];
        in |= mask_of(FABS(x * nx + y * ny) < (reals)hidden->half_length) &
              mask_of(FABS(x * ny - y * nx) < (reals)hidden->half_width);
    }
    return in;
}

#ifdef VECTOR_VARIANT
#define PIXELS(from) LANED(convert_real)(vload16(0, from))
#define COUNTED (reals)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#else
#define PIXELS(from) convert_real(*(from))
#define COUNTED (reals)0
#endif

typedef struct {
    reals matrix[UNKNOWN_CELLS], right[UNKNOWNS], squares, weights, count, pixels;
} match_sums;

// Accumulate the normal equations of the pixels of the fiducial and its background around (x, y), in units of the contrast.
static inline void match_summed(global const CODE *image, int rows, int columns, real x, real y, blob_shape shape,
                         blob_grey grey, real slope_x, real slope_y, real scale, real reach,
                         private const blob_hidden *hidden, private match_sums *sums) {
    const real cosine = cos(shape.angle), sine = sin(shape.angle), per_scale = 1 / scale, per_size = 1 / shape.size;
    const real per_contrast = 1 / grey.contrast;
    const int top = max((int)ceil(y - reach), 0), bottom = min((int)(y + reach), rows - 1);
    for (int i = 0; i < UNKNOWN_CELLS; i++) sums->matrix[i] = 0;
    for (int i = 0; i < UNKNOWNS; i++) sums->right[i] = 0;
    sums->squares = sums->weights = sums->count = sums->pixels = 0;
    for (int row = top; row <= bottom; row++) {
        const real dy = row - y, half_chord = sqrt(fmax(reach * reach - dy * dy, (real)0));
        const int left = max((int)ceil(x - half_chord), 0), right = min((int)(x + half_chord), columns - 1);
        for (int column = left; column <= right; column += LANES) {
            const int from = min(column, columns - LANES);
            const reals place = (reals)(real)from + COUNTED, dx = place - (reals)x;
            masks in = mask_of(place >= (reals)(real)column) & mask_of(FABS(dx) <= (reals)half_chord);
            if (hidden->count) in &= ~hidden_at(hidden, dx, (reals)dy);
            const blob_model model = model_at(dx, (reals)dy, shape, cosine, sine, grey.blur);
            const reals pixel = (PIXELS(image + row * columns + from) - (reals)grey.background) * (reals)per_contrast;
            reals equation[UNKNOWNS];
            for (int i = 0; i < FREEDOMS + 1; i++) equation[i] = model.row[i];
            equation[FREEDOMS + 1] = model.level;
            equation[FREEDOMS + 2] = 1;
            equation[FREEDOMS + 3] = dx * per_size;
            equation[FREEDOMS + 4] = (reals)(dy * per_size);
            reals residual =
                pixel - model.level - slope_x * equation[FREEDOMS + 3] - slope_y * equation[FREEDOMS + 4];
#ifdef CODE_float
            in &= ~LANED(not_finite)(residual);
#endif
            residual = kept_where(in, residual);
            const reals weight = kept_where(in, loss_weight(residual * (reals)per_scale));
#pragma unroll
            for (int i = 0; i < UNKNOWNS; i++) {
                const reals weighted = weight * equation[i];
                sums->right[i] += weighted * residual;
#pragma unroll
                for (int j = 0; j <= i; j++) sums->matrix[CELL(i, j)] += weighted * equation[j];
            }
            sums->pixels += kept_where(in, (reals)1);
            sums->squares += weight * residual * residual;
            sums->weights += weight;
            sums->count += kept_where(mask_of(weight > (reals)0), (reals)1);
        }
    }
}

// Fit the shape to the grey levels; return 0 if the fit fails or moves too far. `covariance`: from the residuals.
static inline int match(global const CODE *image, int rows, int columns, real x, real y, real noise, real extent,
                 private const blob_hidden *hidden, private blob_shape *shape, private blob_grey *grey,
                 real covariance[FREEDOMS][FREEDOMS]) {
    const blob_shape first = *shape;
    const real reach = extent * first.size + ABOUT_BLURS * grey->blur + ABOUT;
    real slope_x = 0, slope_y = 0;
    for (int step = 0; step < MATCH_STEPS; step++) {
        match_sums sums;
        reals moved[UNKNOWNS];
        const real contrast = grey->contrast, scale = (MATCH_SHARE + MATCH_NOISES * noise / fabs(contrast)) / TUNING;
        match_summed(image, rows, columns, x + shape->x, y + shape->y, *shape, *grey, slope_x / contrast,
                     slope_y / contrast, scale, reach, hidden, &sums);
        for (int i = 0; i < UNKNOWN_CELLS; i++) sums.matrix[i] = (reals)sum_of(sums.matrix[i]);
        for (int i = 0; i < UNKNOWNS; i++) sums.right[i] = (reals)sum_of(sums.right[i]);
        if (any_lane(factored_of(UNKNOWNS, sums.matrix))) return 0;
        solved_of(UNKNOWNS, sums.matrix, sums.right, moved);
        const real dx = FIRST(moved[0]), dy = FIRST(moved[1]), ds = FIRST(moved[2]);
        const real db = FIRST(moved[FREEDOMS]);
        real less = 0, da = 0;
        for (int i = 0; i < UNKNOWNS; i++) less += FIRST(moved[i]) * FIRST(sums.right[i]);
        shape->x += dx;
        shape->y += dy;
        shape->size += ds;
#ifndef ROUND
        da = FIRST(moved[3]) * first.size;
        shape->angle += FIRST(moved[3]);
#endif
        grey->blur = fmax(grey->blur + db, SHARPEST);
        grey->contrast += contrast * FIRST(moved[FREEDOMS + 1]);
        grey->background += contrast * FIRST(moved[FREEDOMS + 2]);
        slope_x += contrast * FIRST(moved[FREEDOMS + 3]);
        slope_y += contrast * FIRST(moved[FREEDOMS + 4]);
        const real off = dx * dx + dy * dy + ds * ds + da * da + db * db;
        if (off > MATCHED * MATCHED * grey->blur * grey->blur && step < MATCH_STEPS - 1) continue;
        const real count = sum_of(sums.count), free = count - UNKNOWNS;
        const real variance = fmax(sum_of(sums.squares) - less, (real)0) / sum_of(sums.weights) * count / free;
        for (int i = 0; i < FREEDOMS; i++) {
            reals unit[UNKNOWNS], column[UNKNOWNS];
            for (int k = 0; k < UNKNOWNS; k++) unit[k] = (reals)(real)(i == k);
            solved_of(UNKNOWNS, sums.matrix, unit, column);
            for (int k = 0; k < FREEDOMS; k++) covariance[i][k] = variance * FIRST(column[k]);
        }
        const real off_x = shape->x - first.x, off_y = shape->y - first.y, off_size = shape->size - first.size;
        const real away = off_x * off_x + off_y * off_y + off_size * off_size;
        return free > 0 && count >= MATCH_OWN * sum_of(sums.pixels) && away <= MATCH_FURTHEST * MATCH_FURTHEST;
    }
    return 0;
}
#endif
