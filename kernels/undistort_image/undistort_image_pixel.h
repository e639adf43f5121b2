// One pixel at a place of the source image: taps, border, rounding. Every walk uses it where nothing better fits.
#ifndef UNDISTORT_IMAGE_PIXEL_H
#define UNDISTORT_IMAGE_PIXEL_H

// Whole numbers, as UndistortImage packs them.
#define SOURCE_COLUMNS 0
#define SOURCE_ROWS 1
#define MADE_COLUMNS 2
#define MADE_ROWS 3
#define FIRST_COLUMN 4  // of the output, in the ideal image
#define FIRST_ROW 5
#define MISSING 6  // status of a pixel that has no place at all

// Places farther away than this are moved to it: a whole number that a float holds.
#define FARTHEST 16777216.0f

#ifdef BICUBIC
#define TAPS_BEFORE 1
#define TAPS_AFTER 2
// OpenCV's cubic kernel, by its slope at 1.
#define SLOPE (-0.75f)
#define DEFINE_CUBIC(Weights, floats, weights_of)                    \
    typedef struct {                                                 \
        floats before, at, after, last;                              \
    } Weights;                                                       \
    inline Weights weights_of(floats part) {                         \
        const floats rest = 1 - part;                                \
        Weights w;                                                   \
        w.before = SLOPE * part * rest * rest;                       \
        w.at = 1 + part * part * ((SLOPE + 2) * part - (SLOPE + 3)); \
        w.last = SLOPE * rest * part * part;                         \
        w.after = 1 - w.before - w.at - w.last;                      \
        return w;                                                    \
    }
DEFINE_CUBIC(CubicWeights, float, cubic_weights)
#else
#define TAPS_BEFORE 0
#define TAPS_AFTER 1
#endif

// A float of 24 bits with this on top has its whole part, rounded half to even, in its lowest bits.
#define TO_WHOLE 12582912.0f

#ifdef LARGEST
static inline CODE to_code(float value) {
    value = value > 0 ? value : 0;
    value = value < LARGEST ? value : LARGEST;
    return (CODE)as_int(value + TO_WHOLE);
}
#else
static inline CODE to_code(float value) { return value; }
#endif

// The place of a tap within the image, by the border's policy. (BORDER_CONSTANT asks before.)
static inline int settled(int place, int size) {
#ifdef BORDER_REFLECT
    const int period = max(2 * (size - 1), 1), folded = abs(place) % period;
    return min(folded, period - folded);
#else
    return clamp(place, 0, size - 1);
#endif
}

static inline float tap(global const CODE *image, int column, int row, constant int *size, float fill) {
    const int columns = size[SOURCE_COLUMNS], rows = size[SOURCE_ROWS];
#ifdef BORDER_CONSTANT
    if (column < 0 || column >= columns || row < 0 || row >= rows) return fill;
#endif
    return image[((size_t)settled(row, rows) * columns + settled(column, columns)) * CHANNELS];
}

// A weighted sum along a row. The difference of neighbours keeps a constant image constant.
#ifdef BICUBIC
static inline float along_row(global const CODE *image, int column, int row, CubicWeights w, constant int *size, float fill) {
    return w.before * tap(image, column - 1, row, size, fill) + w.at * tap(image, column, row, size, fill) +
           w.after * tap(image, column + 1, row, size, fill) + w.last * tap(image, column + 2, row, size, fill);
}
#else
static inline float along_row(global const CODE *image, int column, int row, float part, constant int *size, float fill) {
    const float left = tap(image, column, row, size, fill), right = tap(image, column + 1, row, size, fill);
    return left + part * (right - left);
}
#endif

static inline float at_place(global const CODE *image, int column, int row, float part_x, float part_y, constant int *size,
                      float fill) {
#ifdef BICUBIC
    const CubicWeights x = cubic_weights(part_x), y = cubic_weights(part_y);
    return y.before * along_row(image, column, row - 1, x, size, fill) +
           y.at * along_row(image, column, row, x, size, fill) +
           y.after * along_row(image, column, row + 1, x, size, fill) +
           y.last * along_row(image, column, row + 2, x, size, fill);
#else
    const float upper = along_row(image, column, row, part_x, size, fill);
    return upper + part_y * (along_row(image, column, row + 1, part_x, size, fill) - upper);
#endif
}

static inline uchar blank(uchar status, float fill, global CODE *made) {
    for (int channel = 0; channel < CHANNELS; channel++) made[channel] = to_code(fill);
    return status;
}

// Whether no tap lies in the image.
static inline int beyond(int place, int size) { return place + TAPS_AFTER < 0 || place - TAPS_BEFORE >= size; }

// The pixel that a place counts from: within what a float holds, also where the place is none. (PoCL takes floor() of
// a scalar apart.)
static inline int pixel_before(real place) {
    const real held = fmin(fmax(place, (real)-FARTHEST), (real)FARTHEST);
    const int whole = (int)held;
    return whole - (held < whole);
}

// Writes the pixel seen at (column + x, row + y), and returns its status. Past the image's outermost half pixels lies
// no source.
static inline uchar sample(global const CODE *image, int column, int row, float x, float y, constant int *size, float fill,
                    global CODE *made) {
    if ((as_int(x) & 0x7f800000) == 0x7f800000 || (as_int(y) & 0x7f800000) == 0x7f800000)
        return blank(size[MISSING], fill, made);
    const int columns = size[SOURCE_COLUMNS], rows = size[SOURCE_ROWS];
    const uchar status = x < -0.5f - column || x > columns - 0.5f - column || y < -0.5f - row || y > rows - 0.5f - row
                             ? STATUS_NO_DATA
                             : STATUS_OK;
#ifdef BORDER_MASK
    if (status) return blank(status, fill, made);
#endif
    const int whole_x = pixel_before(x), whole_y = pixel_before(y);
    column += whole_x;
    row += whole_y;
#ifdef BORDER_CONSTANT
    if (beyond(column, columns) || beyond(row, rows)) return blank(status, fill, made);
#endif
    for (int channel = 0; channel < CHANNELS; channel++)
        made[channel] = to_code(at_place(image + channel, column, row, x - whole_x, y - whole_y, size, fill));
    return status;
}

#endif
