// Source positions from a packed map (PackedMap in image_map.py).
//
// A run is 16 output pixels of a row. Its source positions (column, row) are two cubics relative to an integer origin:
// column(t) = c0 + t (c1 + t (c2 + t c3)), t the pixel's index less RUN_MIDDLE. Relative to the origin they are exact
// to 1e-6 px in single precision. Runs that cubics do not fit have 16 stored positions.
//
// heads:  (rows, runs) int4: column and row of the origin [px]; kind of the run (bits 0-7), number of bands (8-12), and
//         starts of the windows of three vectors (13-18, 19-24, 25-30); status of a blank run, or index into points.
// curves: (rows, runs) float8: coefficients c0 to c3 of column and row.
// points: (n, RUN) float2: stored positions relative to the origin [px].
#ifndef UNDISTORT_IMAGE_MAP_H
#define UNDISTORT_IMAGE_MAP_H
#include "undistort_image/undistort_image_run.h"

// Fields of a head, and kinds of runs.
#define HEAD_KIND(head) ((head).z & 255)
#define HEAD_BANDS(head) ((head).z >> 8 & 31)
#define HEAD_STARTS(head) (((head).zzz >> (int3)(13, 19, 25)) & 63)
#define RUN_POINTS 0  // stored positions, pixel by pixel
#define RUN_BLANK 1   // no pixel has a source
#define RUN_WINDOW 2
#define RUN_WIDE_WINDOW 3
#define RUN_BANDED_WINDOW 4
#define RUN_WIDE_BANDED_WINDOW 5
#define RUN_SCATTERED 6  // stored positions, all taps inside the image

// Cubics of the runs with a window.
#define RUN_MIDDLE 7.5f
#define CUBIC(curve, t) ((curve).s0 + (t) * ((curve).s1 + (t) * ((curve).s2 + (t) * (curve).s3)))

#ifdef VECTOR_VARIANT
// Compute a run whose positions are cubics and whose taps lie in a window.
INLINED void mapped_window(const int span, const int single_band, global const CODE *image, global CODE *made,
                           int4 head, float8 curve, constant int *size) {
    const float16 t = (float16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15) - RUN_MIDDLE;
    const size_t pitch = (size_t)size[SOURCE_COLUMNS] * CHANNELS;
    interpolate_window(span, single_band, image + head.y * pitch + head.x * CHANNELS, pitch,
                       CUBIC(curve.lo, t), CUBIC(curve.hi, t), HEAD_BANDS(head), HEAD_STARTS(head), made);
}

// Compute a run with stored positions.
static inline void stored_run(global const CODE *image, global CODE *made, global uchar *status, int4 head, int lanes,
                              global const float2 *points, constant int *size, float fill) {
    global const float16 *places = (global const float16 *)(points + (size_t)RUN * head.w);
    const float16 x = (float16)(places[0].even, places[1].even), y = (float16)(places[0].odd, places[1].odd);
    const size_t pitch = (size_t)size[SOURCE_COLUMNS] * CHANNELS;
    if (HEAD_KIND(head) == RUN_SCATTERED)
        interpolate_window(SCATTERED, 1, image + head.y * pitch + head.x * CHANNELS, pitch, x, y, 0, 0, made);
    else
        each_pixel(image, made, status, head.x, head.y, lanes, x, y, size, fill);
}

// Compute all runs of a row.
static inline void mapped_row(global const CODE *image, global CODE *made, global uchar *status,
                              global const int4 *heads, global const float8 *curves, global const float2 *points,
                              constant int *size, float fill) {
    const int columns = size[MADE_COLUMNS], lanes = min(RUN, columns), runs = RUNS(columns);
    for (int run = 0; run < runs; run++) {
        const int4 head = heads[run];
        const int start = RUN_START(run, columns);
        global CODE *to = made + start * CHANNELS;
        switch (HEAD_KIND(head)) {
        case RUN_WINDOW: mapped_window(NARROW, 1, image, to, head, curves[run], size); break;
        case RUN_WIDE_WINDOW: mapped_window(WIDE, 1, image, to, head, curves[run], size); break;
        case RUN_BANDED_WINDOW: mapped_window(NARROW, 0, image, to, head, curves[run], size); break;
        case RUN_WIDE_BANDED_WINDOW: mapped_window(WIDE, 0, image, to, head, curves[run], size); break;
        case RUN_BLANK:
            for (int lane = 0; lane < lanes; lane++) {
                blank(head.w, fill, CHANNELS, to + lane * CHANNELS);
                if (status) status[start + lane] = head.w;
            }
            break;
        default:
            stored_run(image, to, status ? status + start : 0, head, lanes, points, size, fill);
        }
    }
}
#else
// Compute `count` channels of one pixel, from those that `image` and `made` point to on; return its status.
static inline uchar mapped_pixel(global const CODE *image, global CODE *made, int count, int column, int row,
                                 global const int4 *heads, global const float8 *curves, global const float2 *points,
                                 constant int *size, float fill) {
    const int columns = size[MADE_COLUMNS], run = column / RUN, lane = column - RUN_START(run, columns);
    const size_t index = (size_t)row * RUNS(columns) + run;
    const int4 head = heads[index];
    if (HEAD_KIND(head) == RUN_BLANK) return blank(head.w, fill, count, made);
    float2 place;
    if (HEAD_KIND(head) == RUN_POINTS || HEAD_KIND(head) == RUN_SCATTERED) {
        place = points[(size_t)RUN * head.w + lane];
    } else {
        const float8 curve = curves[index];
        const float t = lane - RUN_MIDDLE;
        place = (float2)(CUBIC(curve.lo, t), CUBIC(curve.hi, t));
    }
    return sample(image, head.x, head.y, place.x, place.y, size, fill, count, made);
}
#endif

#endif
