// Images of a board under a camera: reflectance map, sub-poses of the exposure, and the noise of a CMOS sensor.
//
// A pixel at (dx, dy) from the image's centre sees the point of the map (in nodes of the map, rows towards +y)
//
//     u = (x - origin_x) per_cell + grow (cos(theta) m dx + sin(theta) dy)
//     v = (y - origin_y) per_cell + grow (sin(theta) m dx - cos(theta) dy)       grow: pixel / cell; m: -1 mirrored
//
// The map already holds the blur of the lens and the area of a pixel, so that bilinear interpolation of four nodes is
// the reflectance of the pixel; the mean over the sub-poses is the reflectance over the exposure. Then, with a sensor:
//
//     e     = electrons (reflectance + glare) gain[pixel] + dark          [e-]
//     n     = min(e + sqrt(e + dark_noise^2) z, full_well)                z: standard normal (normal_numbers.h)
//     level = dark_level + K (n (1 - bend n) + offset[pixel]), rounded and clamped to 0 to max_level.
//
// Inputs:  poses (frames, SUBPOSES, 3) POSE: x, y [m], theta [rad]; numbers (frames,) uint: counter of the noise.
// Outputs: image (frames, rows, columns) CODE.
// Tables:  map (map rows, map columns) ushort; placing (3,) POSE: origin_x, origin_y [m], per_cell [1/m]; table:
//          BoardImageTable; size: SIZE_... int32; gain, offset, glare (rows, columns) float; places (2, rows, columns)
//          float: dx, then dy, of the undistorted pixels; key: key of the noise.
// Options: CODE, POSE (and POSE_IS_DOUBLE), SUBPOSES, SENSOR, NOISE, GAIN, OFFSET, GLARE, PLACES, MIRRORED, BENT.
// Variants: vector: a work-item per row and frame, 16 pixels at a time, the last 16 moved back to the end of the row;
//          work-item: one pixel per item.
#ifdef POSE_IS_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#endif
#include "board_image/normal_numbers.h"

// Numbers of `size`.
#define SIZE_ROWS 0
#define SIZE_COLUMNS 1
#define SIZE_MAP_ROWS 2
#define SIZE_MAP_COLUMNS 3

// Positions beyond it [nodes] are moved to it: they lie outside every map, and the conversion to int stays defined.
#define FARTHEST 1000000

#ifdef VECTOR_VARIANT
#define CODES CODE16
#define to_codes CONVERT_CODES
#define EACH(expression)                                                                                              \
    (expression(s0), expression(s1), expression(s2), expression(s3), expression(s4), expression(s5), expression(s6), \
     expression(s7), expression(s8), expression(s9), expression(sa), expression(sb), expression(sc), expression(sd), \
     expression(se), expression(sf))
#else
#define CODES CODE
#define to_codes (CODE)
#endif
typedef CODES codes_at __attribute__((aligned(sizeof(CODE))));

// Board under one sub-pose: node below the image's centre, the fraction beyond it, and the step from pixel to pixel.
typedef struct {
    int u, v;
    float part_u, part_v;
    float along, across;
} Placed;

static inline Placed placed(global const POSE *pose, constant POSE *placing, float grow) {
    Placed board;
    // fmax() and fmin() replace NaN.
    const POSE far = FARTHEST;
    const POSE u = fmin(fmax((pose[0] - placing[0]) * placing[2], -far), far);
    const POSE v = fmin(fmax((pose[1] - placing[1]) * placing[2], -far), far);
    board.u = convert_int_rtn(u);
    board.v = convert_int_rtn(v);
    board.part_u = (float)(u - board.u);
    board.part_v = (float)(v - board.v);
    float cosine;
    const float sine = sincos((float)pose[2], &cosine);
    board.along = grow * cosine;
    board.across = grow * sine;
    return board;
}

#ifdef VECTOR_VARIANT
// Two neighbouring nodes are loaded as one number; it has the address of the first node.
typedef uint pair_at __attribute__((aligned(2)));
#define PAIR(lane) *(global const pair_at *)(map + at.lane)
INLINE uints load_pairs(global const ushort *map, ints at) { return (uints)EACH(PAIR); }
#else
INLINE uints load_pairs(global const ushort *map, ints at) { return map[at] | (uint)map[at + 1] << 16; }
#endif

INLINE reals along_pair(uints pair, reals part) {
    const reals left = to_reals(as_signed(pair & 0xffffu)), right = to_reals(as_signed(pair >> 16));
    return left + part * (right - left);
}

INLINE ints clamp_index(ints index, int last) {
    index = index > 0 ? index : (ints)0;
    return index < last ? index : (ints)last;
}

INLINE reals clamp_part(reals part) { return lane_min(lane_max(part, (reals)0), (reals)1); }

// Value of the map for pixels at (dx, dy) from the image's centre; beyond the map its border.
INLINE reals map_values(global const ushort *map, constant int *size, Placed board, reals dx, reals dy) {
#ifdef MIRRORED
    dx = -dx;
#endif
    const reals u = board.part_u + (board.along * dx + board.across * dy);
    const reals v = board.part_v + (board.across * dx - board.along * dy);
    const ints column = clamp_index(to_ints(floor(u)) + board.u, size[SIZE_MAP_COLUMNS] - 2);
    const ints row = clamp_index(to_ints(floor(v)) + board.v, size[SIZE_MAP_ROWS] - 2);
    const reals part_u = clamp_part(u - to_reals(column - board.u)), part_v = clamp_part(v - to_reals(row - board.v));
    // Host: a map has fewer than 2^31 nodes.
    const ints at = row * size[SIZE_MAP_COLUMNS] + column;
    const reals below = along_pair(load_pairs(map, at), part_u);
    const reals above = along_pair(load_pairs(map, at + size[SIZE_MAP_COLUMNS]), part_u);
    return below + part_v * (above - below);
}

#ifdef SENSOR
// Grey levels of pixels with mean electrons `e`.
INLINE CODES grey_levels(reals e, uints pixel, uint frame, uint key, constant float *table,
                         global const float *offset) {
#ifdef NOISE
    const reals variance = e + table[TABLE_DARK_VARIANCE];
    e += sqrt(lane_max(variance, (reals)0)) * normal_numbers(pixel, frame, key);
#endif
    e = lane_min(e, (reals)table[TABLE_FULL_WELL]);
#ifdef BENT
    e -= table[TABLE_BEND] * (e * e);
#endif
#ifdef OFFSET
    e += load_reals(offset);
#endif
    // Half a level more, so that the conversion, which truncates, rounds to nearest.
    const reals level = table[TABLE_DARK_LEVEL] + 0.5f + table[TABLE_GAIN] * e;
    return to_codes(to_ints(lane_min(lane_max(level, (reals)0), (reals)table[TABLE_MAX_LEVEL])));
}
#endif

// Compute the pixels from `column` of one row of a frame.
INLINE void pixels(const Placed *boards, global const ushort *map, constant int *size, constant float *table,
                   global const float *gain, global const float *offset, global const float *glare,
                   global const float *places, int row, int column, uint frame, uint key, global CODE *image) {
    const int first = row * size[SIZE_COLUMNS] + column;
#ifdef PLACES
    const reals dx = load_reals(places + first);
    const reals dy = load_reals(places + size[SIZE_ROWS] * size[SIZE_COLUMNS] + first);
#else
    const reals dx = to_reals(LANE_NUMBERS + column) - table[TABLE_CENTRE_X];
    const reals dy = (reals)((float)row - table[TABLE_CENTRE_Y]);
#endif
    reals seen = 0;
    for (int pose = 0; pose < SUBPOSES; pose++) seen += map_values(map, size, boards[pose], dx, dy);
    // To electrons, or to reflectance.
    seen *= table[TABLE_PER_VALUE];
#ifdef GLARE
    seen += table[TABLE_WHITE] * load_reals(glare + first);
#endif
#ifdef GAIN
    seen *= load_reals(gain + first);
#endif
#ifdef SENSOR
    const uints numbers = as_uints(LANE_NUMBERS + first);
    *(global codes_at *)(image + first) =
        grey_levels(seen + table[TABLE_DARK], numbers, frame, key, table, offset + first);
#else
    *(global codes_at *)(image + first) = seen;
#endif
}

kernel AS_IT_IS void board_image(global const POSE *poses, global const uint *numbers, global CODE *image,
                                 global const ushort *map, constant POSE *placing, constant float *table,
                                 constant int *size, global const float *gain, global const float *offset,
                                 global const float *glare, global const float *places, const uint key) {
#ifdef VECTOR_VARIANT
    const int row = get_global_id(0), frame = get_global_id(1);
#else
    const int column = get_global_id(0), row = get_global_id(1), frame = get_global_id(2);
    if (column >= size[SIZE_COLUMNS] || row >= size[SIZE_ROWS]) return;
#endif
    poses += frame * SUBPOSES * 3;
    image += (size_t)frame * size[SIZE_ROWS] * size[SIZE_COLUMNS];
    Placed boards[SUBPOSES];
    for (int pose = 0; pose < SUBPOSES; pose++) boards[pose] = placed(poses + 3 * pose, placing, table[TABLE_GROW]);
#ifdef VECTOR_VARIANT
    for (int next = 0; next < size[SIZE_COLUMNS]; next += LANES) {
        const int column = min(next, size[SIZE_COLUMNS] - LANES);
        pixels(boards, map, size, table, gain, offset, glare, places, row, column, numbers[frame], key, image);
    }
#else
    pixels(boards, map, size, table, gain, offset, glare, places, row, column, numbers[frame], key, image);
#endif
}
