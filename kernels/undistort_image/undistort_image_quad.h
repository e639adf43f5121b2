// Work-item variant for integer images of one channel, bilinear (build option QUAD: an unsigned integer as large as four
// samples): a work-item computes a quad, four neighbouring pixels of a row.
//
// A lens is smooth: the taps of a quad lie in a few neighbouring samples of two or three rows. Two aligned loads of four
// samples hold eight samples of a row, and shifts select the taps. A warp so reads 128 neighbouring pixels with 6
// requests instead of 64, each of adjacent memory, and stores them with one. Quads whose taps do not fit this window, or
// lie beyond the border, are computed pixel by pixel.
#ifndef UNDISTORT_IMAGE_QUAD_H
#define UNDISTORT_IMAGE_QUAD_H

// Eight neighbouring samples of a row, from an aligned address on.
typedef struct {
    QUAD low, high;
} Window;

static inline float window_sample(Window window, int place) {
    const QUAD part = place < 4 ? window.low : window.high;
    return (CODE)(part >> (8 * (int)sizeof(CODE) * (place & 3)));
}

static inline int is_aligned_to_quad(global const void *to, size_t size) { return ((size_t)to & (size - 1)) == 0; }

#ifdef FROM_MODEL
// Compute the source positions (column + x, row + y) of a quad; return 0 if a pixel has none.
static inline int quad_places(int made_column, int made_row, constant real *model, constant int *size, int *column,
                              int *row, float *x, float *y) {
    masks folded = 0;
    _Pragma("unroll") for (int k = 0; k < 4; k++) {
        reals at_x = made_column + k + size[FIRST_COLUMN], at_y = made_row + size[FIRST_ROW];
        folded |= distort_pixels(&at_x, &at_y, model);
        if (k == 0) {
            *column = floor_pixel(at_x);
            *row = floor_pixel(at_y);
        }
        x[k] = (float)(at_x - *column);
        y[k] = (float)(at_y - *row);
    }
    return !folded;
}
#else
// Read the source positions (column + x, row + y) of a quad from the map; return 0 if a pixel has none. The pixels of a
// quad have one run, because a run has 16 pixels.
static inline int quad_places(int made_column, int made_row, global const int4 *heads, global const float8 *curves,
                              global const float2 *points, constant int *size, int *column, int *row, float *x,
                              float *y) {
    const int columns = size[MADE_COLUMNS], run = made_column / RUN, lane = made_column - RUN_START(run, columns);
    const size_t index = (size_t)made_row * RUNS(columns) + run;
    const int4 head = heads[index];
    *column = head.x;
    *row = head.y;
    if (HEAD_KIND(head) == RUN_BLANK) return 0;
    if (HEAD_KIND(head) == RUN_POINTS || HEAD_KIND(head) == RUN_SCATTERED) {
        _Pragma("unroll") for (int k = 0; k < 4; k++) {
            const float2 place = points[(size_t)RUN * head.w + lane + k];
            x[k] = place.x;
            y[k] = place.y;
        }
    } else {
        const float8 curve = curves[index];
        _Pragma("unroll") for (int k = 0; k < 4; k++) {
            const float t = lane + k - RUN_MIDDLE;
            x[k] = CUBIC(curve.lo, t);
            y[k] = CUBIC(curve.hi, t);
        }
    }
    return 1;
}
#endif

// Load the windows of three rows from the sample at (column, row) on; `offset`: its place in the window of each row. The
// last row repeats the one before it at the lower border. Return 0 if a window ends beyond the images.
static inline int load_windows(global const CODE *images, size_t first, size_t samples, int column, int row,
                               constant int *size, Window *window, int *offset) {
    const int columns = size[SOURCE_COLUMNS];
    if (!is_aligned_to_quad(images, sizeof(QUAD))) return 0;
    int fits = 1;
    _Pragma("unroll") for (int k = 0; k < 3; k++) {
        const size_t at = first + (size_t)min(row + k, size[SOURCE_ROWS] - 1) * columns + column;
        offset[k] = at & 3;
        fits &= at / 4 * 4 + 8 <= samples;
    }
    if (!fits) return 0;
    _Pragma("unroll") for (int k = 0; k < 3; k++) {
        const size_t at = first + (size_t)min(row + k, size[SOURCE_ROWS] - 1) * columns + column;
        global const QUAD *quads = (global const QUAD *)images + at / 4;
        window[k].low = quads[0];
        window[k].high = quads[1];
    }
    return 1;
}

// Interpolate the quad at the positions (column + x, row + y), of image number `first / (rows * columns)`. Return 0 if its
// taps do not fit the windows.
static inline int interpolated_quad(global const CODE *images, size_t first, size_t samples, int column, int row,
                                    const float *x, const float *y, constant int *size, QUAD *made) {
    int left[4], top[4], inside = 1, lowest = row + floor_pixel(y[0]);
    _Pragma("unroll") for (int k = 0; k < 4; k++) {
        left[k] = column + floor_pixel(x[k]);
        top[k] = row + floor_pixel(y[k]);
        lowest = min(lowest, top[k]);
        inside &= left[k] >= 0 && left[k] + 1 < size[SOURCE_COLUMNS] && top[k] >= 0 && top[k] + 1 < size[SOURCE_ROWS];
    }
    // 7: index of the last sample of a window; its first sample is up to 3 samples before the first tap.
    _Pragma("unroll") for (int k = 0; k < 4; k++) {
        inside &= left[k] >= left[0] && left[k] + 1 - left[0] <= 7 - 3 && top[k] - lowest <= 1;
    }
    Window window[3];
    int offset[3];
    if (!inside || !load_windows(images, first, samples, left[0], lowest, size, window, offset)) return 0;
    *made = 0;
    _Pragma("unroll") for (int k = 0; k < 4; k++) {
        const int later = top[k] > lowest, from = left[k] - left[0];
        const Window upper = later ? window[1] : window[0], lower = later ? window[2] : window[1];
        const int above = from + (later ? offset[1] : offset[0]), below = from + (later ? offset[2] : offset[1]);
        const float part_x = x[k] - (left[k] - column), part_y = y[k] - (top[k] - row);
        const float a = window_sample(upper, above), b = window_sample(upper, above + 1);
        const float c = window_sample(lower, below), d = window_sample(lower, below + 1);
        const float first_row = a + part_x * (b - a);
        const float value = first_row + part_y * (c + part_x * (d - c) - first_row);
        *made |= (QUAD)to_code(value) << (8 * (int)sizeof(CODE) * k);
    }
    return 1;
}

// Store a quad: as one number where its address is aligned.
static inline void store_quad(QUAD value, global CODE *to) {
    if (is_aligned_to_quad(to, sizeof(QUAD))) {
        *(global QUAD *)to = value;
    } else {
        for (int k = 0; k < 4; k++) to[k] = (CODE)(value >> (8 * (int)sizeof(CODE) * k));
    }
}

static inline void store_good_quad(global uchar *status) {
    if (is_aligned_to_quad(status, sizeof(uint))) {
        *(global uint *)status = STATUS_OK * 0x01010101u;
    } else {
        for (int k = 0; k < 4; k++) status[k] = STATUS_OK;
    }
}

#endif
