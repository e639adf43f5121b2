// Resampling of lines of points onto regular cells, by linear interpolation along the line. Regrid
// (gpuvision/ranging/regrid.py) runs it along the samples of every profile, and then along the profiles.
//
// A line has a coordinate `along`, a height, the intensity, and under WITH_OTHER the other coordinate. All are linear in the
// coordinate between two neighbouring good samples. Under WITH_SIGMA the standard deviation of the height follows: the
// errors of two samples are independent, so that between a and b, at the fraction t, it is
// sqrt((1 - t)^2 sigma_a^2 + t^2 sigma_b^2). Two samples are not joined if they are further apart than max_gap,
// or if their heights differ by more than max_step. Where the coordinate has decreased by at least fold_tolerance below
// the largest previous coordinate, all cells up to that point are NOT_INVERTIBLE: two surfaces share them.
//
// Inputs:  along, height, intensity  lines of INPUT [m, m, any];  given  status flags (uchar);  other  INPUT [m], under
//          WITH_OTHER;  sigma  INPUT [m], under WITH_SIGMA: standard deviation of the height
//          count       RegridCounts (uint);  grid  RegridTable (real)
// Outputs: out_height, out_intensity, out_sigma (null without WITH_SIGMA), out_other (null without WITH_OTHER)  real, NaN
//          in cells without data; out_status  uchar
// Build options: INPUT (float or double), REAL_IS_DOUBLE, WITH_OTHER, WITH_SIGMA; INPUT16, for the vector variant; GROUP
//          (most work-items of a group), for the other variant.
// Variants: vector: a work-item per LANES neighbouring lines (line_lanes.h); work-item: a work-group per line or per some
//          neighbouring lines (line_group.h). The results are bit-equal.
#include "common/lanes.h"
#include "common/status.h"

// A sample with only these flags keeps its value.
#define STATUS_INFORMS (STATUS_SATURATED | STATUS_AMBIGUOUS | STATUS_NOT_INVERTIBLE)

// Sizes: RegridCounts in regrid.py. Pitches are in elements.
typedef struct {
    uint samples, line_pitch, sample_pitch, cells, out_line_pitch, out_cell_pitch;
    uint drop_folded; // whether NOT_INVERTIBLE cells have no value
    uint lines;
    uint lines_per_group; // work-item variant: lines of a work-group
    // Vector variant: pitches of tiles of LANES samples and of sets of LANES lines, and lines of the outputs, which may be
    // padded to whole sets.
    uint tile_pitch, out_set_pitch, out_lines;
} RegridCounts;

// Grid: RegridTable in regrid.py.
typedef struct {
    real origin, per_metre; // cell = (along - origin) per_metre
    real sense;             // 1 or -1: the direction in which the samples advance, in cells
    real max_gap;           // [cells]
    real max_step;          // [m]
    real fold_tolerance;    // [cells]
} RegridTable;

// Arrays of the kernel.
typedef struct {
    global const INPUT *along, *height, *intensity;
    global const uchar *given;
#ifdef WITH_OTHER
    global const INPUT *other;
#endif
#ifdef WITH_SIGMA
    global const INPUT *sigma;
#endif
} line_inputs;

typedef struct {
    global real *height, *intensity;
    global uchar *status;
    global real *sigma, *other;
} line_outputs;

// Value at the fraction `part` of the way between two samples, and its standard deviation.
INLINE reals value_between(reals before, reals now, reals part) { return before + part * (now - before); }
INLINE reals sigma_between(reals before, reals now, reals part) {
    const reals of_before = (1 - part) * before, of_now = part * now;
    return sqrt(of_before * of_before + of_now * of_now);
}

#ifdef VECTOR_VARIANT
#include "regrid/line_lanes.h"
#else
#include "regrid/line_group.h"
#endif

AS_IT_IS kernel void resample(global const INPUT *restrict along, global const INPUT *restrict height,
                     global const INPUT *restrict intensity, global const uchar *restrict given,
#ifdef WITH_OTHER
                     global const INPUT *restrict other,
#endif
#ifdef WITH_SIGMA
                     global const INPUT *restrict sigma,
#endif
                     global real *restrict out_height, global real *restrict out_intensity,
                     global uchar *restrict out_status, global real *restrict out_sigma,
                     global real *restrict out_other, constant RegridCounts *count, constant RegridTable *grid) {
    const line_inputs in = {along,
                            height,
                            intensity,
                            given,
#ifdef WITH_OTHER
                            other,
#endif
#ifdef WITH_SIGMA
                            sigma,
#endif
    };
    const line_outputs out = {out_height, out_intensity, out_status, out_sigma, out_other};
#ifdef VECTOR_VARIANT
    resample_lines(&in, &out, get_global_id(0) * LANES, count, grid);
#else
    local line_tile tile;
    resample_lines(&in, &out, &tile, count, grid);
#endif
}
