// Images as an ideal camera would show them: each output pixel is interpolated at its place in the measured image.
// CODE is the pixels' type, LARGEST its largest value where it is a whole number, CHANNELS of them lie side by side.
// BICUBIC or bilinear; BORDER_MASK, BORDER_CONSTANT, BORDER_REPLICATE or BORDER_REFLECT.
//
// Places come from a map in runs of 16 pixels (image_map.py), or under COMPUTED from the camera model.
#include "common/camera.h"
#include "common/lanes.h"
#include "common/lens.h"
#include "common/status.h"
#include "undistort_image/undistort_image_pixel.h"
#ifdef VECTOR_VARIANT
#include "undistort_image/undistort_image_window.h"
#endif
#ifdef COMPUTED
#include "undistort_image/undistort_image_model.h"
#else
#include "undistort_image/undistort_image_map.h"
#endif

#ifdef VECTOR_VARIANT
// One work-item per row of a frame: its runs may overlap. The hint keeps compilers from looking for more vectors, which
// takes them half a minute.
kernel __attribute__((vec_type_hint(float16))) __attribute__((reqd_work_group_size(1, 1, 1)))
void undistort(global const CODE *image, global CODE *made, global uchar *status, global const int4 *heads,
               global const float8 *curves, global const float2 *points, constant real *model, constant int *size,
               const float fill) {
    const int row = get_global_id(0), columns = size[MADE_COLUMNS];
    const size_t frame = get_global_id(1);
    image += frame * size[SOURCE_ROWS] * size[SOURCE_COLUMNS] * CHANNELS;
    made += (frame * size[MADE_ROWS] + row) * columns * CHANNELS;
    status = frame ? 0 : status + (size_t)row * columns;
    // All is well but where a run says otherwise.
    for (int column = 0; status && column < columns; column++) status[column] = STATUS_OK;
#ifdef COMPUTED
    for (int run = 0; run < RUNS(columns); run++) computed_run(image, made, status, row, run, model, size, fill);
#else
    const size_t first = (size_t)row * RUNS(columns);
    mapped_row(image, made, status, heads + first, curves + first, points, size, fill);
#endif
}
#else
// One work-item per pixel.
kernel void undistort(global const CODE *image, global CODE *made, global uchar *status, global const int4 *heads,
                      global const float8 *curves, global const float2 *points, constant real *model,
                      constant int *size, const float fill) {
    const int column = get_global_id(0), row = get_global_id(1), columns = size[MADE_COLUMNS];
    const size_t frame = get_global_id(2), pixel = (size_t)row * columns + column;
    if (column >= columns || row >= size[MADE_ROWS]) return;
    image += frame * size[SOURCE_ROWS] * size[SOURCE_COLUMNS] * CHANNELS;
    made += (frame * size[MADE_ROWS] * columns + pixel) * CHANNELS;
#ifdef COMPUTED
    const uchar found = computed_pixel(image, made, column, row, model, size, fill);
#else
    const uchar found = mapped_pixel(image, made, column, row, heads, curves, points, size, fill);
#endif
    if (frame == 0) status[pixel] = found;
}
#endif
