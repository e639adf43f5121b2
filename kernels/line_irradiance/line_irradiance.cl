// Irradiance of receivers from all lit segments, without occlusion: closed form for every pair.
//
// Inputs:  receivers (count, 6), position [m] and normal of any length, type INPUT.
// Outputs: irradiance (count,) [W/m2], NaN where not finite; status (count,) flags.
// Tables:  frames that segments share (one direction, surfaces of one normal): `rows` (frames, 12) in place, position to
//          length along the line, height above the surface and distance aside; `axes` (frames, 9) in real, normal to the
//          same axes; `firsts` (frames + 1,) first segment of each frame, the first `alone` frames having one segment;
//          `starts` (segments, 4) shift from the frame to the segment, and its length; `lines` (segments, 3) length,
//          its square, exitance / (2 pi). `middle`: subtracted from positions first.
// Options: INPUT, REAL_IS_DOUBLE, DOUBLE_POSITIONS or TWO_FLOAT_POSITIONS (see common/places.h).
// Variants: vector: 16 receivers in a vector, `each` receivers per work-item; work-item: one receiver per item.
//
// A receiver is transformed into a frame once and shifted to each of its segments: most of the arithmetic is shared.
#include "line_irradiance/line_irradiance.h"
#include "common/status.h"

#include "common/places.h"

#define FEW 16 // terms summed in single precision before they are added in `place`

// Columns of the receivers: of the type of positions, or with two floats the numbers as they are.
#define COLUMN_TYPE input_numbers
#ifdef TWO_FLOAT_POSITIONS
#define CONVERT_COLUMN LANED(convert_real)
#else
#define CONVERT_COLUMN LANED(convert_place)
#endif
#include "common/six_columns.h"

static inline reals turned(reals x, reals y, reals z, global const real *row) { return x * row[0] + y * row[1] + z * row[2]; }

AS_IT_IS kernel void line_irradiance(global const INPUT *restrict receivers, global real *restrict irradiance,
                                     global uchar *restrict status, constant place *restrict middle,
                                     global const place *restrict rows, global const real *restrict axes,
                                     global const uint *restrict firsts, global const place *restrict starts,
                                     global const real *restrict lines, const uint alone, const uint frames,
                                     const ulong count, const ulong each) {
    const sample_range own = samples_of_item(each, count);
    for (ulong next = own.begin; next < own.end; next += LANES) {
        const ulong i = whole_vector(next, count);
        COLUMN_TYPE columns[6];
        load_columns(receivers + 6 * i, columns);
        const places x = input_minus(columns[0], middle[0]), y = input_minus(columns[1], middle[1]);
        const places z = input_minus(columns[2], middle[2]);
        // Scale normals of any length before squaring: no overflow, no underflow.
        const COLUMN_TYPE ax = fabs(columns[3]), ay = fabs(columns[4]), az = fabs(columns[5]);
        const COLUMN_TYPE two = ax > ay ? ax : ay, scale = (COLUMN_TYPE)1 / (two > az ? two : az);
        const reals nx = input_reals(columns[3] * scale), ny = input_reals(columns[4] * scale);
        const reals nz = input_reals(columns[5] * scale);
        const reals per = (real)1 / sqrt(nx * nx + ny * ny + nz * nz);
        const reals normal_x = nx * per, normal_y = ny * per, normal_z = nz * per;
        places sum = convert_places((reals)0);
        uint k = 0;
        while (k < alone) {
            // At most FEW terms are summed in `real`, then added in `place`: rounding does not grow with the count.
            reals few = (reals)0;
            for (const uint to = min(k + FEW, alone); k < to; k++) {
                global const place *row = rows + 12 * k;
                global const real *axis = axes + 9 * k, *line = lines + 3 * k;
                const reals height = convert_to_reals(place_dot(x, y, z, row + 4));
                // Most pairs do not face each other: skip them.
                if (!any_compared(mask_of(height > (reals)0))) continue;
                const places tau = place_dot(x, y, z, row);
                const reals aside = convert_to_reals(place_dot(x, y, z, row + 8));
                const reals by_u = turned(normal_x, normal_y, normal_z, axis);
                const reals foot = turned(normal_x, normal_y, normal_z, axis + 3) * height +
                                   turned(normal_x, normal_y, normal_z, axis + 6) * aside;
                // The far end is computed in `place` as well: it may be close to the receiver.
                const reals light = LANED(end_factor)(convert_to_reals(tau), real_of_sum(tau, starts[4 * k + 3]), (reals)line[0],
                                                      (reals)line[1], height, aside, by_u, foot);
                few += line[2] * light;
            }
            sum = place_plus_real(sum, few);
        }
        for (uint frame = alone; frame < frames; frame++) {
            global const place *row = rows + 12 * frame;
            global const real *axis = axes + 9 * frame;
            const places before = place_dot(x, y, z, row), above = place_dot(x, y, z, row + 4);
            const places beside = place_dot(x, y, z, row + 8);
            const reals by_u = turned(normal_x, normal_y, normal_z, axis);
            const reals by_n = turned(normal_x, normal_y, normal_z, axis + 3);
            const reals by_w = turned(normal_x, normal_y, normal_z, axis + 6);
            const uint last = firsts[frame + 1];
            while (k < last) {
                reals few = (reals)0;
                for (const uint to = min(k + FEW, last); k < to; k++) {
                    global const place *start = starts + 4 * k;
                    global const real *line = lines + 3 * k;
                    const reals height = real_of_sum(above, start[1]);
                    if (!any_compared(mask_of(height > (reals)0))) continue;
                    const places tau = place_plus(before, start[0]);
                    const reals aside = real_of_sum(beside, start[2]), foot = by_n * height + by_w * aside;
                    const reals light = LANED(end_factor)(convert_to_reals(tau), real_of_sum(tau, start[3]), (reals)line[0],
                                                          (reals)line[1], height, aside, by_u, foot);
                    few += line[2] * light;
                }
                sum = place_plus_real(sum, few);
            }
        }
        reals result = convert_to_reals(sum);
        const masks bad = mask_of(LANED(not_finite)(convert_to_reals(x))) | mask_of(LANED(not_finite)(convert_to_reals(y))) |
                          mask_of(LANED(not_finite)(convert_to_reals(z))) | mask_of(LANED(not_finite)(normal_x)) |
                          mask_of(LANED(not_finite)(normal_y)) | mask_of(LANED(not_finite)(normal_z)) |
                          mask_of(LANED(not_finite)(result));
        result = nan_where(bad, result);
        store_reals(result, irradiance + i);
        store_bytes(convert_bytes(bad & (masks)STATUS_NOT_FINITE), status + i);
    }
}
