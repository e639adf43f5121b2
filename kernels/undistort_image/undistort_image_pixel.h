// One output pixel at a position of the source image: taps, border policy, rounding. Both kernel variants use it; the
// vector variant only for runs that do not fit a window.
#ifndef UNDISTORT_IMAGE_PIXEL_H
#define UNDISTORT_IMAGE_PIXEL_H

// Indices into the table `size` (int32) of UndistortImage.
#define SOURCE_COLUMNS 0
#define SOURCE_ROWS 1
#define MADE_COLUMNS 2
#define MADE_ROWS 3
#define FIRST_COLUMN 4  // origin of the output in the ideal image
#define FIRST_ROW 5
#define MISSING 6  // status of a pixel without a source position

// Positions are clamped to this magnitude [px]: 2^24, the range in which a float holds every integer.
#define FARTHEST 16777216.0f

#ifdef BICUBIC
#define TAPS_BEFORE 1
#define TAPS_AFTER 2
// Cubic convolution (Keys, 1981) with a = SLOPE, the slope of the kernel at 1, as in OpenCV. Weights of the four taps
// for the fraction part = t: a t (1 - t)^2, 1 + t^2 ((a + 2) t - (a + 3)), the rest, a (1 - t) t^2. The third weight is
// one less the others, so that the sum is 1 up to rounding. A macro, because C has no functions of a generic type: one text
// gives the weights of a scalar here, and of 16 lanes in undistort_image_window.h.
#define SLOPE (-0.75f)
#define DEFINE_CUBIC(Weights, floats, weights_of)                    \
    typedef struct {                                                 \
        floats before, at, after, last;                              \
    } Weights;                                                       \
    static inline Weights weights_of(floats part) {                  \
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

// 1.5 * 2^23. The sum of it and a float of magnitude below 2^22 has a unit in the last place of 1: the addition rounds
// to the nearest integer (half to even), and the low bits of the sum's pattern are this integer.
#define TO_WHOLE 12582912.0f

#ifdef MAX_CODE
static inline CODE to_code(float value) {
    value = value > 0 ? value : 0;
    value = value < MAX_CODE ? value : MAX_CODE;
    return (CODE)as_int(value + TO_WHOLE);
}
#else
static inline CODE to_code(float value) { return value; }
#endif

// Return the index of a tap inside the image by the border policy: mirrored or clamped.
// tap handles BORDER_CONSTANT.
static inline int border_index(int place, int size) {
#ifdef BORDER_REFLECT
    const int period = max(2 * (size - 1), 1), folded = abs(place) % period;
    return min(folded, period - folded);
#else
    return clamp(place, 0, size - 1);
#endif
}

// Return the value of a tap.
static inline float tap(global const CODE *image, int column, int row, constant int *size, float fill) {
    const int columns = size[SOURCE_COLUMNS], rows = size[SOURCE_ROWS];
#ifdef BORDER_CONSTANT
    if (column < 0 || column >= columns || row < 0 || row >= rows) return fill;
#endif
    return image[((size_t)border_index(row, rows) * columns + border_index(column, columns)) * CHANNELS];
}

// Interpolate along a row. left + part (right - left) returns exactly the value of a constant image.
#ifdef BICUBIC
static inline float along_row(global const CODE *image, int column, int row, CubicWeights w, constant int *size,
                              float fill) {
    return w.before * tap(image, column - 1, row, size, fill) + w.at * tap(image, column, row, size, fill) +
           w.after * tap(image, column + 1, row, size, fill) + w.last * tap(image, column + 2, row, size, fill);
}
#else
static inline float along_row(global const CODE *image, int column, int row, float part, constant int *size,
                              float fill) {
    const float left = tap(image, column, row, size, fill), right = tap(image, column + 1, row, size, fill);
    return left + part * (right - left);
}
#endif

// Interpolate at (column + part_x, row + part_y), parts 0 to 1.
static inline float interpolate(global const CODE *image, int column, int row, float part_x, float part_y,
                                constant int *size, float fill) {
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

// Write the fill value to `count` channels of a pixel without a source; return the given status.
static inline uchar blank(uchar status, float fill, int count, global CODE *made) {
    for (int channel = 0; channel < count; channel++) made[channel] = to_code(fill);
    return status;
}

// Return whether all taps of one axis lie outside the image.
static inline int all_taps_outside(int place, int size) {
    return place + TAPS_AFTER < 0 || place - TAPS_BEFORE >= size;
}

// Return floor(place) as an integer, clamped to +-FARTHEST. Clamping makes the conversion defined for every number; a
// NaN gives a bound. The comparison replaces floor(), which PoCL compiles to slow code for scalars.
static inline int floor_pixel(real place) {
    const real clamped = fmin(fmax(place, (real)-FARTHEST), (real)FARTHEST);
    const int whole = (int)clamped;
    return whole - (clamped < whole);
}

// Write `count` channels, from those that `image` and `made` point to on, of the pixel at the source position (column + x,
// row + y). Return its status: NO_DATA for a position more than half a pixel beyond the centres of the outermost pixels,
// size[MISSING] for a position that is not finite.
static inline uchar sample(global const CODE *image, int column, int row, float x, float y, constant int *size,
                           float fill, int count, global CODE *made) {
    if ((as_int(x) & 0x7f800000) == 0x7f800000 || (as_int(y) & 0x7f800000) == 0x7f800000)
        return blank(size[MISSING], fill, count, made);
    const int columns = size[SOURCE_COLUMNS], rows = size[SOURCE_ROWS];
    const uchar status = x < -0.5f - column || x > columns - 0.5f - column || y < -0.5f - row || y > rows - 0.5f - row
                             ? STATUS_NO_DATA
                             : STATUS_OK;
#ifdef BORDER_MASK
    if (status) return blank(status, fill, count, made);
#endif
    const int whole_x = floor_pixel(x), whole_y = floor_pixel(y);
    column += whole_x;
    row += whole_y;
#ifdef BORDER_CONSTANT
    if (all_taps_outside(column, columns) || all_taps_outside(row, rows)) return blank(status, fill, count, made);
#endif
    for (int channel = 0; channel < count; channel++)
        made[channel] = to_code(interpolate(image + channel, column, row, x - whole_x, y - whole_y, size, fill));
    return status;
}

#endif
