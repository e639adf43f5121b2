// Source positions from the camera model, computed for every pixel (FROM_MODEL).
//
// The model moves an ideal pixel (column, row) to its measured position in the source image: camera_distort
// (common/camera.h) or lens_distort (common/lens.h).
#ifndef UNDISTORT_IMAGE_MODEL_H
#define UNDISTORT_IMAGE_MODEL_H
#include "undistort_image/undistort_image_run.h"

// Move ideal pixels to their measured positions; return the mask of pixels without one.
static inline masks distort_pixels(reals *column, reals *row, constant real *model) {
#ifdef CAMERA
    return LANED(camera_distort)(column, row, model);
#else
    return LANED(lens_distort)(column, row, model);
#endif
}

#ifdef VECTOR_VARIANT
// Limits of a window: largest distance between adjacent source positions [px], so that 16 of them fit 32 samples, and
// largest number of bands (intervals between adjacent source rows).
#define MAX_STEP (CHANNELS == 3 ? (real)1.6 : (real)2)
#define MAX_BANDS 8

// Compute a run of 16 pixels: by a window if all its taps fit one inside the image, otherwise pixel by pixel.
static inline void computed_run(global const CODE *image, global CODE *made, global uchar *status, int row, int run,
                                constant real *model, constant int *size, float fill) {
    const int columns = size[MADE_COLUMNS], start = RUN_START(run, columns);
    const int16 lanes = (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    reals x = convert_real16(lanes + (start + size[FIRST_COLUMN])), y = (reals)(real)(row + size[FIRST_ROW]);
    const masks folded = distort_pixels(&x, &y, model);
    const int left = floor_pixel(x.s0), top = floor_pixel(fmin(y.s0, y.sf));
    x -= left;
    y -= top;
    const reals step = x.s123456789abcdeff - x;
    // Number of intervals between adjacent source columns (gaps) and rows (bands) that contain the run.
    const int gaps = floor_pixel(x.sf) + 1, bands = floor_pixel(fmax(y.s0, y.sf)) + 1;
    const masks fits_window = mask_of(step >= 0) & mask_of(step <= MAX_STEP) & mask_of(y >= 0) & mask_of(y <= bands);
    const int3 starts = (int3)(0, floor_pixel(x.s5), floor_pixel(x.sa)) * (CHANNELS / 3);
    const int wide = gaps * CHANNELS > 16;
    const size_t pitch = (size_t)size[SOURCE_COLUMNS] * CHANNELS;
    const int right = left + gaps - 1 + TAPS_AFTER, bottom = top + bands - 1 + TAPS_AFTER;
    const size_t loaded = bottom * pitch + (left + starts.z + TAPS_AFTER) * CHANNELS + (wide ? 32 : 16);
    const int inside = left >= TAPS_BEFORE && top >= TAPS_BEFORE && right < size[SOURCE_COLUMNS] &&
                       bottom < size[SOURCE_ROWS] && loaded <= pitch * size[SOURCE_ROWS];
    made += start * CHANNELS;
    if (columns < RUN || !inside || bands > MAX_BANDS || any_lane(folded | ~fits_window)) {
        each_pixel(image, made, status ? status + start : 0, left, top, min(columns, RUN),
                   convert_float16(nan_where(folded, x)), convert_float16(nan_where(folded, y)), size, fill);
        return;
    }
    image += top * pitch + left * CHANNELS;
    if (wide) interpolate_window(WIDE, 0, image, pitch, convert_float16(x), convert_float16(y), bands, starts, made);
    else interpolate_window(NARROW, 0, image, pitch, convert_float16(x), convert_float16(y), bands, starts, made);
}
#else
// Compute `count` channels of one pixel, from those that `image` and `made` point to on; return its status.
static inline uchar computed_pixel(global const CODE *image, global CODE *made, int count, int column, int row,
                                   constant real *model, constant int *size, float fill) {
    real x = column + size[FIRST_COLUMN], y = row + size[FIRST_ROW];
    if (distort_pixels(&x, &y, model)) return blank(size[MISSING], fill, count, made);
    const int left = floor_pixel(x), top = floor_pixel(y);
    return sample(image, left, top, (float)(x - left), (float)(y - top), size, fill, count, made);
}
#endif

#endif
