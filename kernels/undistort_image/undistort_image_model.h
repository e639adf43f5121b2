// Places from the camera model itself.
#ifndef UNDISTORT_IMAGE_MODEL_H
#define UNDISTORT_IMAGE_MODEL_H
#include "undistort_image/undistort_image_run.h"

// Moves ideal pixels to their measured place; returns where they have none.
static inline masks measured(reals *column, reals *row, constant real *model) {
#ifdef CAMERA
    return LANED(camera_distort)(column, row, model);
#else
    return LANED(lens_distort)(column, row, model);
#endif
}

#ifdef VECTOR_VARIANT
// How far a window's pixels may lie apart, and how many gaps between rows they may fall into.
#define STEEPEST (CHANNELS == 3 ? (real)1.6 : (real)2)
#define MOST_BANDS 8

static inline void computed_run(global const CODE *image, global CODE *made, global uchar *status, int row, int run,
                         constant real *model, constant int *size, float fill) {
    const int columns = size[MADE_COLUMNS], start = RUN_START(run, columns);
    const int16 lanes = (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    reals x = convert_real16(lanes + (start + size[FIRST_COLUMN])), y = (reals)(real)(row + size[FIRST_ROW]);
    const masks folded = measured(&x, &y, model);
    const int left = pixel_before(x.s0), top = pixel_before(fmin(y.s0, y.sf));
    x -= left;
    y -= top;
    const reals step = x.s123456789abcdeff - x;
    // Gaps between pixels that the run falls into, across and down.
    const int gaps = pixel_before(x.sf) + 1, bands = pixel_before(fmax(y.s0, y.sf)) + 1;
    const masks steady = mask_of(step >= 0) & mask_of(step <= STEEPEST) & mask_of(y >= 0) & mask_of(y <= bands);
    const int3 starts = (int3)(0, pixel_before(x.s5), pixel_before(x.sa)) * (CHANNELS / 3);
    const int wide = gaps * CHANNELS > 16;
    const size_t pitch = (size_t)size[SOURCE_COLUMNS] * CHANNELS;
    const int right = left + gaps - 1 + TAPS_AFTER, bottom = top + bands - 1 + TAPS_AFTER;
    const size_t loaded = bottom * pitch + (left + starts.z + TAPS_AFTER) * CHANNELS + (wide ? 32 : 16);
    const int inside = left >= TAPS_BEFORE && top >= TAPS_BEFORE && right < size[SOURCE_COLUMNS] &&
                       bottom < size[SOURCE_ROWS] && loaded <= pitch * size[SOURCE_ROWS];
    made += start * CHANNELS;
    if (columns < RUN || !inside || bands > MOST_BANDS || any_lane(folded | ~steady)) {
        each_pixel(image, made, status ? status + start : 0, left, top, min(columns, RUN),
                   convert_float16(nan_where(folded, x)), convert_float16(nan_where(folded, y)), size, fill);
        return;
    }
    image += top * pitch + left * CHANNELS;
    if (wide) window(WIDE, 0, image, pitch, convert_float16(x), convert_float16(y), bands, starts, made);
    else window(NARROW, 0, image, pitch, convert_float16(x), convert_float16(y), bands, starts, made);
}
#else
static inline uchar computed_pixel(global const CODE *image, global CODE *made, int column, int row, constant real *model,
                            constant int *size, float fill) {
    real x = column + size[FIRST_COLUMN], y = row + size[FIRST_ROW];
    if (measured(&x, &y, model)) return blank(size[MISSING], fill, made);
    const int left = pixel_before(x), top = pixel_before(y);
    return sample(image, left, top, (float)(x - left), (float)(y - top), size, fill, made);
}
#endif

#endif
