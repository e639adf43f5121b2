// Flat-field correction: image = gain * (frame - offset), per pixel.
//
// Inputs:  frames (count,) INPUT: frames of `pixels` pixels each, one after the other [digits of the camera]
//          offset, gain (pixels,) real: dark frame [digits], and gain of each pixel
// Outputs: image (count,) real [digits]; NaN where the frame is not finite
//          status (count,) uchar: SATURATED where the frame reaches `saturation`, NOT_FINITE
// Build options: INPUT (uchar, ushort, float or double), REAL_IS_DOUBLE
// Work:    a work-item corrects `each` consecutive samples: many on a CPU, one on a GPU.

#include "common/real.h"
#include "common/status.h"

kernel void scale_offset(global const INPUT *restrict frames, global real *restrict image,
                         global uchar *restrict status, global const real *restrict offset,
                         global const real *restrict gain, ulong pixels, ulong count, ulong each, real saturation)
{
    const ulong first = get_global_id(0) * each, end = min(first + each, count);
    for (ulong i = first; i < end; i++) {
        const real value = (real)frames[i];
        const int bad = not_finite(value);
        image[i] = bad ? REAL_NAN : gain[i % pixels] * (value - offset[i % pixels]);
        status[i] = bad ? STATUS_NOT_FINITE : value >= saturation ? STATUS_SATURATED : STATUS_OK;
    }
}
