// Places from a map, as image_map.py packs it in runs.
#ifndef UNDISTORT_IMAGE_MAP_H
#define UNDISTORT_IMAGE_MAP_H
#include "undistort_image/undistort_image_run.h"

// Heads: column and row that the run's places count from; what to do, the number of bands, and where the windows of
// three vectors begin, in bits; a number.
#define HEAD_WHAT(head) ((head).z & 255)
#define HEAD_BANDS(head) ((head).z >> 8 & 31)
#define HEAD_STARTS(head) (((head).zzz >> (int3)(13, 19, 25)) & 63)
#define RUN_POINTS 0  // each pixel by itself: the head's number says which 16 of the points are its places
#define RUN_BLANK 1   // no source: the head's number is the status
#define RUN_WINDOW 2
#define RUN_WIDE_WINDOW 3
#define RUN_BANDED_WINDOW 4
#define RUN_WIDE_BANDED_WINDOW 5
#define RUN_SCATTERED 6  // as RUN_POINTS, where all taps lie within the image

// Column and row of the other runs are cubics over the run.
#define RUN_MIDDLE 7.5f
#define CUBIC(curve, t) ((curve).s0 + (t) * ((curve).s1 + (t) * ((curve).s2 + (t) * (curve).s3)))

#ifdef VECTOR_VARIANT
INLINED void in_window(const int spread, const int flat, global const CODE *image, global CODE *made, int4 head,
                       float8 curve, constant int *size) {
    const float16 t = (float16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15) - RUN_MIDDLE;
    const size_t pitch = (size_t)size[SOURCE_COLUMNS] * CHANNELS;
    window(spread, flat, image + head.y * pitch + head.x * CHANNELS, pitch, CUBIC(curve.lo, t), CUBIC(curve.hi, t),
           HEAD_BANDS(head), HEAD_STARTS(head), made);
}

static inline void at_points(global const CODE *image, global CODE *made, global uchar *status, int4 head, int lanes,
                      global const float2 *points, constant int *size, float fill) {
    global const float16 *places = (global const float16 *)(points + (size_t)RUN * head.w);
    const float16 x = (float16)(places[0].even, places[1].even), y = (float16)(places[0].odd, places[1].odd);
    const size_t pitch = (size_t)size[SOURCE_COLUMNS] * CHANNELS;
    if (HEAD_WHAT(head) == RUN_SCATTERED)
        window(SCATTERED, 1, image + head.y * pitch + head.x * CHANNELS, pitch, x, y, 0, 0, made);
    else
        each_pixel(image, made, status, head.x, head.y, lanes, x, y, size, fill);
}

// Does a row's runs.
static inline void mapped_row(global const CODE *image, global CODE *made, global uchar *status, global const int4 *heads,
                       global const float8 *curves, global const float2 *points, constant int *size, float fill) {
    const int columns = size[MADE_COLUMNS], lanes = min(RUN, columns), runs = RUNS(columns);
    for (int run = 0; run < runs; run++) {
        const int4 head = heads[run];
        const int start = RUN_START(run, columns);
        global CODE *to = made + start * CHANNELS;
        switch (HEAD_WHAT(head)) {
        case RUN_WINDOW: in_window(NARROW, 1, image, to, head, curves[run], size); break;
        case RUN_WIDE_WINDOW: in_window(WIDE, 1, image, to, head, curves[run], size); break;
        case RUN_BANDED_WINDOW: in_window(NARROW, 0, image, to, head, curves[run], size); break;
        case RUN_WIDE_BANDED_WINDOW: in_window(WIDE, 0, image, to, head, curves[run], size); break;
        case RUN_BLANK:
            for (int lane = 0; lane < lanes; lane++) {
                blank(head.w, fill, to + lane * CHANNELS);
                if (status) status[start + lane] = head.w;
            }
            break;
        default:
            at_points(image, to, status ? status + start : 0, head, lanes, points, size, fill);
        }
    }
}
#else
static inline uchar mapped_pixel(global const CODE *image, global CODE *made, int column, int row, global const int4 *heads,
                          global const float8 *curves, global const float2 *points, constant int *size, float fill) {
    const int columns = size[MADE_COLUMNS], run = column / RUN, lane = column - RUN_START(run, columns);
    const size_t index = (size_t)row * RUNS(columns) + run;
    const int4 head = heads[index];
    if (HEAD_WHAT(head) == RUN_BLANK) return blank(head.w, fill, made);
    float2 place;
    if (HEAD_WHAT(head) == RUN_POINTS || HEAD_WHAT(head) == RUN_SCATTERED) {
        place = points[(size_t)RUN * head.w + lane];
    } else {
        const float8 curve = curves[index];
        const float t = lane - RUN_MIDDLE;
        place = (float2)(CUBIC(curve.lo, t), CUBIC(curve.hi, t));
    }
    return sample(image, head.x, head.y, place.x, place.y, size, fill, made);
}
#endif

#endif
