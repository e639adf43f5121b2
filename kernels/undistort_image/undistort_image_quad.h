// Work-item variant for bilinear integer images (build option QUAD: an unsigned integer as large as four samples): a
// work-item computes a quad, four neighbouring samples of a row. They are four pixels of one channel, or parts of two
// pixels of three interleaved channels.
//
// A lens is smooth: the taps of a quad lie in a few neighbouring samples of two rows, or of three rows where the source
// row changes within the quad. Aligned loads of four samples hold the taps of a row, and shifts select them. In
// this way a warp reads 128 neighbouring samples with 4 to 8 requests instead of 64, each of adjacent memory, and stores
// them with one.
// The later loads and the third row are read by the work-items that need them. Quads whose taps do not fit the windows, or
// lie beyond the border, are computed sample by sample.
#ifndef UNDISTORT_IMAGE_QUAD_H
#define UNDISTORT_IMAGE_QUAD_H

#if CHANNELS == 1
#define QUAD_PIXELS 4
#define WINDOW_SAMPLES 12  // four pixels at up to 2.3 source columns from pixel to pixel
#else
#define QUAD_PIXELS 2
#define WINDOW_SAMPLES 16  // two pixels that are up to 2 source columns apart, or 3 for the first channel
#endif

// Neighbouring samples of a row from an aligned address on; `offset`: place of the first tap among them.
typedef struct {
    QUAD first, second, third;
#if WINDOW_SAMPLES == 16
    QUAD fourth;
#endif
    int offset;
} Window;

static inline float window_sample(const Window *window, int place) {
    const int at = window->offset + place;
    QUAD part = at < 4 ? window->first : at < 8 ? window->second : window->third;
#if WINDOW_SAMPLES == 16
    part = at < 12 ? part : window->fourth;
#endif
    return (CODE)(part >> (8 * (int)sizeof(CODE) * (at & 3)));
}

static inline int is_aligned_to_quad(global const void *to, size_t size) { return ((size_t)to & (size - 1)) == 0; }

// Load the samples at, ..., at + last of the images into a window; `last` is at most WINDOW_SAMPLES - 4, because up to
// three samples lie before the first one. Two quads are loaded always: conditions cost more than loads.
static inline Window load_window(global const CODE *images, size_t at, int last) {
    global const QUAD *quads = (global const QUAD *)images + at / 4;
    Window window;
    window.offset = at & 3;
    const int end = window.offset + last;
    window.first = quads[0];
    window.second = quads[1];
    window.third = end >= 8 ? quads[2] : 0;
#if WINDOW_SAMPLES == 16
    window.fourth = end >= 12 ? quads[3] : 0;
#endif
    return window;
}

// Return whether `load_window` reads within the images of this number of samples. If so, it does for smaller `at`.
static inline int holds_window(size_t at, int last, size_t samples) {
    return (max((at + last) / 4, at / 4 + 1) + 1) * 4 <= samples;
}

// Source positions (left + part_x, top + part_y) of the pixels of a quad, parts 0 to 1.
typedef struct {
    int left[QUAD_PIXELS], top[QUAD_PIXELS];
    float part_x[QUAD_PIXELS], part_y[QUAD_PIXELS];
} QuadPlaces;

static inline void set_place(QuadPlaces *places, int k, int column, int row, float x, float y) {
    const int whole_x = floor_pixel(x), whole_y = floor_pixel(y);
    places->left[k] = column + whole_x;
    places->top[k] = row + whole_y;
    places->part_x[k] = x - whole_x;
    places->part_y[k] = y - whole_y;
}

#ifdef FROM_MODEL
// Compute the source positions of a quad's pixels, from (column, row) of the output on; return 0 if one has none.
static inline int quad_places(int column, int row, constant real *model, constant int *size, QuadPlaces *places) {
    masks folded = 0;
    int left = 0, top = 0;
    _Pragma("unroll") for (int k = 0; k < QUAD_PIXELS; k++) {
        reals x = column + k + size[FIRST_COLUMN], y = row + size[FIRST_ROW];
        folded |= distort_pixels(&x, &y, model);
        if (k == 0) {
            left = floor_pixel(x);
            top = floor_pixel(y);
        }
        set_place(places, k, left, top, (float)(x - left), (float)(y - top));
    }
    return !folded;
}
#else
// Read the source positions of a quad's pixels from the map, from (column, row) of the output on; return 0 if one has
// none. Four pixels of one channel have one run, because a run has 16 pixels; two pixels of three channels may have two.
static inline int quad_places(int column, int row, global const int4 *heads, global const float8 *curves,
                              global const float2 *points, constant int *size, QuadPlaces *places) {
    const int columns = size[MADE_COLUMNS];
    const size_t first = (size_t)row * RUNS(columns);
    int run = -1, has_all = 1;
    int4 head;
    float8 curve;
    _Pragma("unroll") for (int k = 0; k < QUAD_PIXELS; k++) {
        const int pixel = column + k;
        if (k == 0 || (CHANNELS > 1 && pixel / RUN != run)) {
            run = pixel / RUN;
            head = heads[first + run];
            curve = curves[first + run];
        }
        const int lane = pixel - RUN_START(run, columns), kind = HEAD_KIND(head);
        const float t = lane - RUN_MIDDLE;
        float2 place = (float2)(CUBIC(curve.lo, t), CUBIC(curve.hi, t));
        if (kind == RUN_POINTS || kind == RUN_SCATTERED) place = points[(size_t)RUN * head.w + lane];
        has_all &= kind != RUN_BLANK;
        set_place(places, k, head.x, head.y, place.x, place.y);
    }
    return has_all;
}
#endif

// Interpolate the quad from `channel` of its first pixel on, in the image that begins at sample `first` of the images.
// Return 0 if its taps do not fit the windows.
static inline int interpolated_quad(global const CODE *images, size_t first, size_t samples, int channel,
                                    const QuadPlaces *places, constant int *size, QUAD *made) {
    const int columns = size[SOURCE_COLUMNS], rows = size[SOURCE_ROWS], left = places->left[0];
    int lowest = places->top[0], highest = lowest, farthest = left, inside = 1;
    _Pragma("unroll") for (int k = 0; k < QUAD_PIXELS; k++) {
        const int at = places->left[k], top = places->top[k];
        lowest = min(lowest, top);
        highest = max(highest, top);
        farthest = max(farthest, at);
        inside &= at >= max(left, 0) && at + 1 < columns && top >= 0 && top + 1 < rows;
    }
    // Last tap from the first pixel's first channel on. The first pixel's own last tap is its third channel, 2 + 3.
    const int last = max((farthest - left + 1) * CHANNELS + (CHANNELS == 1 ? 0 : channel), CHANNELS == 1 ? 1 : 5);
    if (!inside || highest - lowest > 1 || last > WINDOW_SAMPLES - 4 || !is_aligned_to_quad(images, sizeof(QUAD)))
        return 0;
    const size_t pitch = (size_t)columns * CHANNELS, at = first + lowest * pitch + left * CHANNELS;
    const int has_third = highest > lowest;
    if (!holds_window(at + (has_third ? 2 : 1) * pitch, last, samples)) return 0;
    const Window upper = load_window(images, at, last), middle = load_window(images, at + pitch, last);
    Window lower = middle;
    if (has_third) lower = load_window(images, at + 2 * pitch, last);
    *made = 0;
    _Pragma("unroll") for (int k = 0; k < 4; k++) {
        // Of three channels, the first pixel has the samples before CHANNELS, the second pixel the others.
        const int next = CHANNELS > 1 && channel + k >= CHANNELS, pixel = CHANNELS == 1 ? k : 0;
        const int column = next ? places->left[1] : places->left[pixel];
        const int later = (next ? places->top[1] : places->top[pixel]) > lowest;
        const float part_x = next ? places->part_x[1] : places->part_x[pixel];
        const float part_y = next ? places->part_y[1] : places->part_y[pixel];
        const int from = (column - left) * CHANNELS + (CHANNELS == 1 ? 0 : channel + k - (next ? CHANNELS : 0));
        const Window above = later ? middle : upper, below = later ? lower : middle;
        const float a = window_sample(&above, from), b = window_sample(&above, from + CHANNELS);
        const float c = window_sample(&below, from), d = window_sample(&below, from + CHANNELS);
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

// Store the status of the pixels whose first channel is in a quad of which all pixels have a source.
static inline void store_good_quad(global uchar *status, int channel) {
#if CHANNELS == 1
    if (is_aligned_to_quad(status, sizeof(uint))) {
        *(global uint *)status = STATUS_OK * 0x01010101u;
        return;
    }
#endif
    for (int k = 0; k < QUAD_PIXELS; k++)
        if (CHANNELS == 1 || k > 0 || channel == 0) status[k] = STATUS_OK;
}

#endif
