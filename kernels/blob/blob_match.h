// Refinement of a fiducial by its grey levels: robust least squares of the pixels against a blurred shape on a plane
// background, starting at the shape fitted to its edges. The contour is sampled at pixel centres without interpolation;
// each contour pixel contributes one residual.
//
// Options: ROUND, FREEDOMS as in blob.cl; RATIO: inner over outer size of a ring or a cross; else a disc or a square.
#ifndef BLOB_MATCH_H
#define BLOB_MATCH_H
#include "blob/blob_edges.h"

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

static inline masks hidden_at(GROUP_SPACE const blob_hidden *hidden, reals dx, reals dy) {
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
typedef CODE16 codes_at __attribute__((aligned(sizeof(CODE)))); // PoCL's vload16 loads element by element
#define PIXELS(from) LANED(convert_real)(*(global const codes_at *)(from))
#define COUNTED (reals)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#else
#define PIXELS(from) convert_real(*(from))
#define COUNTED (reals)0
#endif

// A part of the pixels has every PART_ROWS-th row, and of it every PART_COLUMNS-th vector of LANES pixels: neighbouring
// items of a group load neighbouring pixels.
#ifdef IN_GROUP
#define PART_COLUMNS 16
#else
#define PART_COLUMNS 1
#endif
#define PART_ROWS (PARTS / PART_COLUMNS)
#define PART_ROW(part) ((part) / PART_COLUMNS)
#define PART_COLUMN(part) ((part) % PART_COLUMNS * LANES)

// Sums over the pixels: weighted normal equations (lower triangle, right side), weighted squares of the residuals, weights,
// number of pixels with a weight above 0, and of all pixels.
#define MATCH_RIGHT UNKNOWN_CELLS
#define MATCH_SQUARE (MATCH_RIGHT + UNKNOWNS)
#define MATCH_WEIGHT (MATCH_SQUARE + 1)
#define MATCH_COUNT (MATCH_SQUARE + 2)
#define MATCH_PIXELS (MATCH_SQUARE + 3)
#define MATCH_SUMS (MATCH_SQUARE + 4)

// Equations of a vector of pixels; a batch has up to MATCH_BATCH of them.
typedef struct {
    reals row[UNKNOWNS], residual, weight;
} match_equation;
#ifdef VECTOR_VARIANT
#define MATCH_BATCH 16
#define MATCH_SPLIT 3 // the products with the first three unknowns are half of the products

// Add the products with the unknowns `first` to `end` - 1 to the normal equations. A CPU has too few registers for the
// sums of all products, and would read and write each sum for each vector of pixels. Half of them stay in registers over
// a batch; the order of the additions to a sum is the same.
INLINE void match_added(private const match_equation *batch, int count, const int first, const int end,
                        private reals *sums) {
    reals held[MATCH_SQUARE];
#pragma unroll
    for (int i = first; i < UNKNOWNS; i++) {
        if (i < end) held[MATCH_RIGHT + i] = sums[MATCH_RIGHT + i];
#pragma unroll
        for (int j = first; j < end; j++)
            if (j <= i) held[CELL(i, j)] = sums[CELL(i, j)];
    }
    for (int n = 0; n < count; n++) {
        private const match_equation *const of = batch + n;
#pragma unroll
        for (int i = first; i < UNKNOWNS; i++) {
            const reals weighted = of->weight * of->row[i];
            if (i < end) held[MATCH_RIGHT + i] += weighted * of->residual;
#pragma unroll
            for (int j = first; j < end; j++)
                if (j <= i) held[CELL(i, j)] += weighted * of->row[j];
        }
    }
#pragma unroll
    for (int i = first; i < UNKNOWNS; i++) {
        if (i < end) sums[MATCH_RIGHT + i] = held[MATCH_RIGHT + i];
#pragma unroll
        for (int j = first; j < end; j++)
            if (j <= i) sums[CELL(i, j)] = held[CELL(i, j)];
    }
}

// Add the products of a batch. Inlined, constants of the caller's loops would take its registers.
CALLED void match_batch_added(private const match_equation *batch, int count, private reals *sums) {
    match_added(batch, count, 0, MATCH_SPLIT, sums);
    match_added(batch, count, MATCH_SPLIT, UNKNOWNS, sums);
}
#else
#define MATCH_BATCH 1

// Add the products of one vector of pixels.
CALLED void match_batch_added(private const match_equation *of, int count, private reals *sums) {
#pragma unroll
    for (int i = 0; i < UNKNOWNS; i++) {
        const reals weighted = of->weight * of->row[i];
        sums[MATCH_RIGHT + i] += weighted * of->residual;
#pragma unroll
        for (int j = 0; j <= i; j++) sums[CELL(i, j)] += weighted * of->row[j];
    }
}
#endif

// Return the smallest integer that is not less than x. (PoCL's ceil() takes 25 instructions.)
static inline int ceiling(real x) {
    const int whole = (int)x;
    return whole + (whole < x);
}

// Add up the normal equations of a part of the pixels of the fiducial and its background around (x, y), in units of the
// contrast.
static inline void match_summed(global const CODE *image, int rows, int columns, real x, real y, blob_shape shape,
                         blob_grey grey, real slope_x, real slope_y, real scale, real reach,
                         GROUP_SPACE const blob_hidden *hidden, int part, private reals *sums) {
    const real cosine = cosine_of(shape), sine = sine_of(shape), per_scale = 1 / scale, per_size = 1 / shape.size;
    const real per_contrast = 1 / grey.contrast;
    const int top = max(ceiling(y - reach), 0), bottom = min((int)(y + reach), rows - 1);
    match_equation batch[MATCH_BATCH];
    int count = 0;
    reals pixels = 0, squares = 0, weights = 0, used = 0;
    for (int i = 0; i < MATCH_SQUARE; i++) sums[i] = 0;
    for (int row = top + PART_ROW(part); row <= bottom; row += PART_ROWS) {
        const real dy = row - y, half_chord = sqrt(fmax(reach * reach - dy * dy, (real)0));
        const int left = max(ceiling(x - half_chord), 0), right = min((int)(x + half_chord), columns - 1);
        for (int column = left + PART_COLUMN(part); column <= right; column += LANES * PART_COLUMNS) {
            const int from = min(column, columns - LANES);
            const reals place = (reals)(real)from + COUNTED, dx = place - (reals)x;
            masks in = mask_of(place >= (reals)(real)column) & mask_of(FABS(dx) <= (reals)half_chord);
            if (hidden->count) in &= ~hidden_at(hidden, dx, (reals)dy);
            const blob_model model = model_at(dx, (reals)dy, shape, cosine, sine, grey.blur);
            const reals pixel = (PIXELS(image + row * columns + from) - (reals)grey.background) * (reals)per_contrast;
            private match_equation *const equation = batch + (MATCH_BATCH > 1 ? count : 0);
            count++;
            UNROLLED for (int i = 0; i < FREEDOMS + 1; i++) equation->row[i] = model.row[i];
            equation->row[FREEDOMS + 1] = model.level;
            equation->row[FREEDOMS + 2] = 1;
            equation->row[FREEDOMS + 3] = dx * per_size;
            equation->row[FREEDOMS + 4] = (reals)(dy * per_size);
            reals residual = pixel - model.level - slope_x * equation->row[FREEDOMS + 3] -
                             slope_y * equation->row[FREEDOMS + 4];
#ifdef CODE_float
            in &= ~LANED(not_finite)(residual);
#endif
            residual = kept_where(in, residual);
            const reals weight = kept_where(in, loss_weight(residual * (reals)per_scale));
            equation->residual = residual;
            equation->weight = weight;
            pixels += kept_where(in, (reals)1);
            squares += weight * residual * residual;
            weights += weight;
            used += kept_where(mask_of(weight > (reals)0), (reals)1);
            if (count < MATCH_BATCH) continue;
            match_batch_added(batch, count, sums);
            count = 0;
        }
    }
    if (count) match_batch_added(batch, count, sums);
    sums[MATCH_SQUARE] = squares, sums[MATCH_WEIGHT] = weights;
    sums[MATCH_COUNT] = used, sums[MATCH_PIXELS] = pixels;
}

// State of the match; in a group item 0 changes it.
typedef struct {
    blob_shape first, shape; // fitted to the edges; fitted to the grey levels
    blob_grey grey;
    real slope_x, slope_y;   // of the background
    real covariance[FREEDOMS][FREEDOMS]; // from the residuals
    int state;
} blob_match;
#define MATCH_RUNS 0
#define MATCH_ENDS 1  // with a shape
#define MATCH_FAILS 2 // the normal equations are singular, too few pixels agree, or the fiducial moved too far

// Factor the normal equations in place; return the lanes in which they are singular.
CALLED masks match_factored(private reals *sums) { return factored_of(UNKNOWNS, sums); }

CALLED void match_solved(private const reals *factor, private const reals *right, private reals *solution) {
    solved_of(UNKNOWNS, factor, right, solution);
}

// Do the Gauss-Newton step of the normal equations.
BETWEEN_BARRIERS void match_stepped(private blob_match *match, private reals *sums, int is_last) {
    reals moved[UNKNOWNS];
    const real contrast = match->grey.contrast;
    match->state = MATCH_FAILS;
    if (any_lane(match_factored(sums))) return;
    match_solved(sums, sums + MATCH_RIGHT, moved);
    const real dx = FIRST(moved[0]), dy = FIRST(moved[1]), ds = FIRST(moved[2]);
    const real db = FIRST(moved[FREEDOMS]);
    real less = 0, da = 0;
    for (int i = 0; i < UNKNOWNS; i++) less += FIRST(moved[i]) * FIRST(sums[MATCH_RIGHT + i]);
    match->shape.x += dx;
    match->shape.y += dy;
    match->shape.size += ds;
#ifndef ROUND
    da = FIRST(moved[3]) * match->first.size;
    match->shape.angle += FIRST(moved[3]);
#endif
    match->grey.blur = fmax(match->grey.blur + db, SHARPEST);
    match->grey.contrast += contrast * FIRST(moved[FREEDOMS + 1]);
    match->grey.background += contrast * FIRST(moved[FREEDOMS + 2]);
    match->slope_x += contrast * FIRST(moved[FREEDOMS + 3]);
    match->slope_y += contrast * FIRST(moved[FREEDOMS + 4]);
    const real off = dx * dx + dy * dy + ds * ds + da * da + db * db;
    if (off > MATCHED * MATCHED * match->grey.blur * match->grey.blur && !is_last) {
        match->state = MATCH_RUNS;
        return;
    }
    const real count = FIRST(sums[MATCH_COUNT]), free = count - UNKNOWNS;
    const real variance = fmax(FIRST(sums[MATCH_SQUARE]) - less, (real)0) / FIRST(sums[MATCH_WEIGHT]) * count / free;
    for (int i = 0; i < FREEDOMS; i++) {
        reals unit[UNKNOWNS], column[UNKNOWNS];
        for (int k = 0; k < UNKNOWNS; k++) unit[k] = (reals)(real)(i == k);
        match_solved(sums, unit, column);
        for (int k = 0; k < FREEDOMS; k++) match->covariance[i][k] = variance * FIRST(column[k]);
    }
    const real off_x = match->shape.x - match->first.x, off_y = match->shape.y - match->first.y;
    const real off_size = match->shape.size - match->first.size;
    const real away = off_x * off_x + off_y * off_y + off_size * off_size;
    if (free > 0 && count >= MATCH_OWN * FIRST(sums[MATCH_PIXELS]) && away <= MATCH_FURTHEST * MATCH_FURTHEST)
        match->state = MATCH_ENDS;
}

// Fit the shape to the grey levels. `match` holds the start, and gets the result.
INLINE void match_image(GROUP_SPACE blob_match *match, global const CODE *image, int rows, int columns, real x, real y,
                        real noise, real extent, GROUP_SPACE const blob_hidden *hidden, GROUP_SPACE blob_room *room) {
    const int is_wanted = match->state == MATCH_RUNS;
    const real reach = is_wanted ? extent * match->first.size + ABOUT_BLURS * match->grey.blur + ABOUT : -1;
    int step = 0;
    do {
        reals sums[MATCH_SUMS];
        const blob_shape shape = match->shape;
        const blob_grey grey = match->grey;
        const real contrast = grey.contrast, scale = (MATCH_SHARE + MATCH_NOISES * noise / fabs(contrast)) / TUNING;
        match_summed(image, rows, columns, x + shape.x, y + shape.y, shape, grey, match->slope_x / contrast,
                     match->slope_y / contrast, scale, reach, hidden, GROUP_ITEM, sums);
        for (int k = 0; k < MATCH_SUMS; k++) sums[k] = (reals)sum_of(sums[k]);
        group_add_up(sums, MATCH_SUMS, ROUND_SUMS, room->sums);
        if (GROUP_ITEM == 0 && match->state == MATCH_RUNS) {
            blob_match stepped = *match;
            match_stepped(&stepped, sums, step == MATCH_STEPS - 1);
            *match = stepped;
        }
        group_barrier();
    } while (++step < MATCH_STEPS && match->state == MATCH_RUNS);
}
#endif
