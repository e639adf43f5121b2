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
// Build options: INPUT (float or double), REAL_IS_DOUBLE, WITH_OTHER, WITH_SIGMA, GROUP (most work-items of a group).
// Variants: CPU runtimes, without GROUP: one work-item per line, which takes the samples in their order. GPUs, with
//          GROUP: a work-group per line or per some neighbouring lines (line_group.h). The results are bit-equal.
#include "common/real.h"
#include "common/status.h"

// A sample with only these flags keeps its value.
#define STATUS_INFORMS (STATUS_SATURATED | STATUS_AMBIGUOUS | STATUS_NOT_INVERTIBLE)

// Sizes: RegridCounts in regrid.py. Pitches are in elements.
typedef struct {
    uint samples, line_pitch, sample_pitch, cells, out_line_pitch, out_cell_pitch;
    uint drop_folded; // whether NOT_INVERTIBLE cells have no value
    uint lines;
    uint lines_per_group; // lines of a work-group, with GROUP
} RegridCounts;

// Grid: RegridTable in regrid.py.
typedef struct {
    real origin, per_metre; // cell = (along - origin) per_metre
    real sense;             // 1 or -1: the direction in which the samples advance, in cells
    real max_gap;           // [cells]
    real max_step;          // [m]
    real fold_tolerance;    // [cells]
} RegridTable;

// First and last cell whose centre lies in [low, high]; no cell if first > last. Casts instead of ceil, floor and fmax:
// these library functions take longer on PoCL than the rest of the kernel.
static inline int first_cell(real low, int cells) {
    const real kept = low < 0 ? 0 : low < cells ? low : cells;
    const int cell = (int)kept;
    return cell < kept ? cell + 1 : cell;
}
static inline int last_cell(real high, int cells) { return high < 0 ? -1 : high < cells ? (int)high : cells - 1; }

static inline int is_joined(real length, real rise, constant RegridTable *grid) {
    return !(fabs(length) > grid->max_gap || fabs(rise) > grid->max_step);
}

// Value at the fraction `part` of the way between two samples, and its standard deviation.
static inline real value_between(real before, real now, real part) { return before + part * (now - before); }
static inline real sigma_between(real before, real now, real part) {
    const real of_before = (1 - part) * before, of_now = part * now;
    return sqrt(of_before * of_before + of_now * of_now);
}

#ifdef GROUP
#include "regrid/line_group.h"
#else
typedef struct {
    real at, height, intensity, other, sigma;  // at: coordinate [cells]
    uint status;
} Sample;

// Fill the cells between two neighbouring good samples by the straight line through them, if they are joined.
//
// The output arrays are separate parameters: in a struct of pointers they would lose `restrict`, which makes the kernel
// a third slower on PoCL.
static inline void fill_between(Sample before, Sample now, global real *restrict out_height,
                                global real *restrict out_intensity, global real *restrict out_sigma,
                                global real *restrict out_other, global uchar *restrict out_status, ulong out,
                                constant RegridCounts *count, constant RegridTable *grid) {
    const real length = now.at - before.at, rise = now.height - before.height;
    if (!is_joined(length, rise, grid)) return;
    const uint found = (before.status | now.status) & STATUS_INFORMS;
    const int cells = count->cells, last = last_cell(length < 0 ? before.at : now.at, cells);
    for (int cell = first_cell(length < 0 ? now.at : before.at, cells); cell <= last; ++cell) {
        const ulong i = out + (ulong)cell * count->out_cell_pitch;
        const uint old = out_status[i];
        const real part = length == 0 ? 0 : (cell - before.at) / length;
        const real height = before.height + part * rise;
        // A cell that has a value keeps the higher surface; within max_step the later value replaces it.
        if (!(old & STATUS_NO_DATA) && out_height[i] > height + grid->max_step) continue;
        out_height[i] = height;
        out_intensity[i] = value_between(before.intensity, now.intensity, part);
#ifdef WITH_OTHER
        out_other[i] = value_between(before.other, now.other, part);
#endif
#ifdef WITH_SIGMA
        out_sigma[i] = sigma_between(before.sigma, now.sigma, part);
#endif
        out_status[i] = (uchar)(found | (old & STATUS_NOT_INVERTIBLE));
    }
}

static inline void mark_folded(real from, real to, global uchar *restrict out_status, ulong out,
                               constant RegridCounts *count) {
    const int cells = count->cells, last = last_cell(from < to ? to : from, cells);
    for (int cell = first_cell(from < to ? from : to, cells); cell <= last; ++cell)
        out_status[out + (ulong)cell * count->out_cell_pitch] |= STATUS_NOT_INVERTIBLE;
}

// Remove the values of all cells (only = 0), or of the cells with the flag `only`, and set their status.
static inline void clear_cells(global real *restrict out_height, global real *restrict out_intensity,
                               global real *restrict out_sigma, global real *restrict out_other,
                               global uchar *restrict out_status, ulong out, constant RegridCounts *count, uint only,
                               uchar status) {
    for (uint cell = 0; cell < count->cells; ++cell) {
        const ulong i = out + (ulong)cell * count->out_cell_pitch;
        if (only && !(out_status[i] & only)) continue;
        out_height[i] = REAL_NAN;
        out_intensity[i] = REAL_NAN;
#ifdef WITH_OTHER
        out_other[i] = REAL_NAN;
#endif
#ifdef WITH_SIGMA
        out_sigma[i] = REAL_NAN;
#endif
        out_status[i] = status;
    }
}
#endif

kernel void resample(global const INPUT *restrict along, global const INPUT *restrict height,
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
#ifdef GROUP
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
    local line_tile tile;
    resample_lines(&in, &out, &tile, count, grid);
#else
    const ulong line = get_global_id(0);
    const ulong in = line * count->line_pitch, out = line * count->out_line_pitch;
    const real sense = grid->sense, tolerance = grid->fold_tolerance;
    clear_cells(out_height, out_intensity, out_sigma, out_other, out_status, out, count, 0, STATUS_NO_DATA);

    Sample before;
    int started = 0;
    real furthest = 0, back = 0;  // furthest coordinate reached, and lowest coordinate since then
    for (uint sample = 0; sample < count->samples; ++sample) {
        const ulong i = in + (ulong)sample * count->sample_pitch;
        Sample now = {(along[i] - grid->origin) * grid->per_metre, height[i], intensity[i], 0, 0, given[i]};
#ifdef WITH_OTHER
        now.other = other[i];
#endif
#ifdef WITH_SIGMA
        now.sigma = sigma[i];
#endif
        if ((now.status & ~STATUS_INFORMS) || not_finite(now.at) || not_finite(now.height)) continue;
        const real reached = sense * now.at;
        if (started)
            fill_between(before, now, out_height, out_intensity, out_sigma, out_other, out_status, out, count, grid);
        if (!started || reached > furthest) {
            furthest = back = reached;
        } else if (reached <= furthest - tolerance && reached <= back) {
            mark_folded(sense * reached, sense * back, out_status, out, count);
            back = reached;
        }
        before = now;
        started = 1;
    }
    if (count->drop_folded)
        clear_cells(out_height, out_intensity, out_sigma, out_other, out_status, out, count, STATUS_NOT_INVERTIBLE,
                    STATUS_NOT_INVERTIBLE);
#endif
}
