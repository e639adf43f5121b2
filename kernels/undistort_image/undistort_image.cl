// Undistortion of images: each output pixel is interpolated at its source position in the measured image.
//
// made(row, column) = sum over taps of w_x w_y image(tap), bilinear or bicubic (undistort_image_pixel.h). The source
// positions are read from a packed map (undistort_image_map.h), or with FROM_MODEL computed from the camera model.
//
// Inputs:  image (frames, source rows, source columns[, CHANNELS]), type CODE.
// Outputs: made (frames, made rows, made columns[, CHANNELS]), type CODE; status (made rows, made columns), the
//          same for all frames.
// Tables:  heads (made rows, runs), curves (made rows, runs), points (n, RUN) of the packed map, or model: the table of
//          the lens or camera model; size (7,) int32: sizes, origin of the output and status of missing pixels; fill:
//          value of pixels without a source.
// Options: CODE, MAX_CODE (largest value of an integer CODE), CHANNELS (1 or 3, interleaved), BICUBIC (otherwise
//          bilinear), QUAD (unsigned integer of four samples: work-item variant of bilinear integer images),
//          BORDER_MASK, BORDER_CONSTANT, BORDER_REPLICATE or BORDER_REFLECT, FROM_MODEL, LENS or CAMERA,
//          PAST_CACHES.
// Variants: vector: a work-item per row and frame, in runs of 16 pixels; work-item: four neighbouring samples per
//          item under QUAD (undistort_image_quad.h), one pixel under FROM_MODEL, otherwise one sample.
#include "common/camera.h"
#include "common/lanes.h"
#include "common/lens.h"
#include "common/status.h"
#include "undistort_image/undistort_image_pixel.h"
#ifdef VECTOR_VARIANT
#include "undistort_image/undistort_image_window.h"
#endif
#ifdef FROM_MODEL
#include "undistort_image/undistort_image_model.h"
#else
#include "undistort_image/undistort_image_map.h"
#endif

#ifdef VECTOR_VARIANT
// One work-item per row of a frame, since the last two runs of a row overlap. vec_type_hint keeps compilers from
// vectorising the kernel across work-items, which takes half a minute of compilation.
kernel __attribute__((vec_type_hint(float16))) __attribute__((reqd_work_group_size(1, 1, 1)))
void undistort(global const CODE *image, global CODE *made, global uchar *status, global const int4 *heads,
               global const float8 *curves, global const float2 *points, constant real *model, constant int *size,
               const float fill) {
    const int row = get_global_id(0), columns = size[MADE_COLUMNS];
    const size_t frame = get_global_id(1);
    image += frame * size[SOURCE_ROWS] * size[SOURCE_COLUMNS] * CHANNELS;
    made += (frame * size[MADE_ROWS] + row) * columns * CHANNELS;
    status = frame ? 0 : status + (size_t)row * columns;
    // The status is OK except where a run changes it.
    for (int column = 0; status && column < columns; column++) status[column] = STATUS_OK;
#ifdef FROM_MODEL
    for (int run = 0; run < RUNS(columns); run++) computed_run(image, made, status, row, run, model, size, fill);
#else
    const size_t first = (size_t)row * RUNS(columns);
    mapped_row(image, made, status, heads + first, curves + first, points, size, fill);
#endif
}
#else
#ifdef QUAD
#include "undistort_image/undistort_image_quad.h"
#define SAMPLES 4
#elif defined(FROM_MODEL)
#define SAMPLES CHANNELS
#else
#define SAMPLES 1
#endif

// SAMPLES neighbouring samples of a row per work-item. With one sample per work-item, a warp reads adjacent samples for each
// tap; with a pixel of three channels per work-item it would read every third one. Source positions from the camera model
// cost more than requests: without QUAD, a work-item computes a whole pixel. With QUAD and three channels, it computes the
// positions of the two pixels to which its four samples belong: 1.5 times as many positions as pixels.
kernel void undistort(global const CODE *image, global CODE *made, global uchar *status, global const int4 *heads,
                      global const float8 *curves, global const float2 *points, constant real *model,
                      constant int *size, const float fill) {
    const int begin = (int)get_global_id(0) * SAMPLES, row = get_global_id(1);
    const int columns = size[MADE_COLUMNS], width = columns * CHANNELS;
    const size_t frame = get_global_id(2);
    if (begin >= width || row >= size[MADE_ROWS]) return;
    const size_t samples = (size_t)size[SOURCE_ROWS] * size[SOURCE_COLUMNS] * CHANNELS, first = frame * samples;
    made += (frame * size[MADE_ROWS] + row) * width;
    status += (size_t)row * columns;
#ifdef QUAD
    if (begin + SAMPLES <= width) {
        const int column = begin / CHANNELS, channel = begin - column * CHANNELS;
        QuadPlaces places;
        QUAD quad;
#ifdef FROM_MODEL
        const int found = quad_places(column, row, model, size, &places);
#else
        const int found = quad_places(column, row, heads, curves, points, size, &places);
#endif
        if (found && interpolated_quad(image, first, get_global_size(2) * samples, channel, &places, size, &quad)) {
            store_quad(quad, made + begin);
            if (frame == 0) store_good_quad(status + column, channel);
            return;
        }
    }
#endif
    const int end = min(begin + SAMPLES, width);
    for (int at = begin, count; at < end; at += count) {
        const int column = at / CHANNELS, channel = at - column * CHANNELS;
        count = min(CHANNELS - channel, end - at);
#ifdef FROM_MODEL
        const uchar found = computed_pixel(image + first + channel, made + at, count, column, row, model, size, fill);
#else
        const uchar found = mapped_pixel(image + first + channel, made + at, count, column, row, heads, curves, points,
                                         size, fill);
#endif
        if (frame == 0 && channel == 0) status[column] = found;
    }
}
#endif
