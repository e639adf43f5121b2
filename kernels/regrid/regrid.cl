// Resampling of lines of points onto regular cells, by linear interpolation along the line. Regrid
// (gpuvision/ranging/regrid.py) runs it along the samples of every profile, and then along the profiles.
//
// A line has a coordinate `along`, a height, the intensity, and under CARRY the other coordinate. All are linear in the
// coordinate between two neighbouring good samples. Two samples are not joined if they are further apart than max_gap,
// or if their heights differ by more than max_step. Where the coordinate has decreased by at least fold_tolerance below
// the largest previous coordinate, all cells up to that point are NOT_INVERTIBLE: two surfaces share them.
//
// Inputs:  along, height, intensity  lines of INPUT [m, m, any];  given  status flags (uchar);  other INPUT [m], under
// CARRY
//          count       RegridCounts (uint);  grid  RegridTable (real)
// Outputs: out_height, out_intensity, out_other (under CARRY) real, NaN in cells without data; out_status uchar
// Build options: INPUT (float or double), REAL_IS_DOUBLE, CARRY.
// Work:    one work-item per line: the order of the samples decides where the line runs backwards. One variant.
#include "common/real.h"
#include "common/status.h"

// A sample with only these flags keeps its value.
#define STATUS_INFORMS (STATUS_SATURATED | STATUS_AMBIGUOUS | STATUS_NOT_INVERTIBLE)

// Offsets in `count` (uint): RegridCounts in regrid.py. Pitches are in elements.
#define COUNT_SAMPLES 0
#define COUNT_LINE_PITCH 1
#define COUNT_SAMPLE_PITCH 2
#define COUNT_CELLS 3
#define COUNT_OUT_LINE_PITCH 4
#define COUNT_OUT_CELL_PITCH 5
#define COUNT_DROP_FOLDED 6  // whether NOT_INVERTIBLE cells have no value

// Offsets in `grid` (real): RegridTable in regrid.py.
#define GRID_ORIGIN 0          // cell = (along - origin) per_metre
#define GRID_PER_METRE 1
#define GRID_SENSE 2           // 1 or -1: the direction in which the samples advance, in cells
#define GRID_MAX_GAP 3         // [cells]
#define GRID_MAX_STEP 4        // [m]
#define GRID_FOLD_TOLERANCE 5  // [cells]

typedef struct {
    real at, height, intensity, other;  // at: coordinate [cells]
    uint status;
} Sample;

// Parameter lists of the kernel and its functions, without and with the carried coordinate. Structs of pointers would
// lose `restrict`, which makes the kernel a third slower on PoCL.
#ifdef CARRY
#define LINES_IN                                                                                                       \
    global const INPUT *restrict along, global const INPUT *restrict height, global const INPUT *restrict intensity,   \
        global const uchar *restrict given, global const INPUT *restrict other
#define LINES_OUT                                                                                                      \
    global real *restrict out_height, global real *restrict out_intensity, global uchar *restrict out_status,          \
        global real *restrict out_other
#define OUT_ARRAYS out_height, out_intensity, out_status, out_other
#define OTHER_OF(i) other[i]
#define SET_OTHER(i, value) out_other[i] = value
#else
#define LINES_IN                                                                                                       \
    global const INPUT *restrict along, global const INPUT *restrict height, global const INPUT *restrict intensity,   \
        global const uchar *restrict given
#define LINES_OUT                                                                                                      \
    global real *restrict out_height, global real *restrict out_intensity, global uchar *restrict out_status
#define OUT_ARRAYS out_height, out_intensity, out_status
#define OTHER_OF(i) 0
#define SET_OTHER(i, value)
#endif

// First and last cell whose centre lies in [low, high]; no cell if first > last. Casts instead of ceil, floor and fmax:
// these library functions take longer on PoCL than the rest of the kernel.
static inline int first_cell(real low, int cells) {
    const real kept = low < 0 ? 0 : low < cells ? low : cells;
    const int cell = (int)kept;
    return cell < kept ? cell + 1 : cell;
}
static inline int last_cell(real high, int cells) { return high < 0 ? -1 : high < cells ? (int)high : cells - 1; }

// Fill the cells between two neighbouring good samples by the straight line through them, if they are joined.
static inline void fill_between(Sample before, Sample now, LINES_OUT, ulong out, constant uint *count,
                                constant real *grid) {
    const real length = now.at - before.at, rise = now.height - before.height;
    if (fabs(length) > grid[GRID_MAX_GAP] || fabs(rise) > grid[GRID_MAX_STEP]) return;
    const uint found = (before.status | now.status) & STATUS_INFORMS;
    const int cells = count[COUNT_CELLS], last = last_cell(length < 0 ? before.at : now.at, cells);
    for (int cell = first_cell(length < 0 ? now.at : before.at, cells); cell <= last; ++cell) {
        const ulong i = out + (ulong)cell * count[COUNT_OUT_CELL_PITCH];
        const uint old = out_status[i];
        const real part = length == 0 ? 0 : (cell - before.at) / length;
        const real height = before.height + part * rise;
        // A cell that has a value keeps the higher surface; within max_step the later value replaces it.
        if (!(old & STATUS_NO_DATA) && out_height[i] > height + grid[GRID_MAX_STEP]) continue;
        out_height[i] = height;
        out_intensity[i] = before.intensity + part * (now.intensity - before.intensity);
        SET_OTHER(i, before.other + part * (now.other - before.other));
        out_status[i] = (uchar)(found | (old & STATUS_NOT_INVERTIBLE));
    }
}

static inline void mark_folded(real from, real to, global uchar *restrict out_status, ulong out, constant uint *count) {
    const int cells = count[COUNT_CELLS], last = last_cell(from < to ? to : from, cells);
    for (int cell = first_cell(from < to ? from : to, cells); cell <= last; ++cell)
        out_status[out + (ulong)cell * count[COUNT_OUT_CELL_PITCH]] |= STATUS_NOT_INVERTIBLE;
}

// Remove the values of all cells (only = 0), or of the cells with the flag `only`, and set their status.
static inline void clear_cells(LINES_OUT, ulong out, constant uint *count, uint only, uchar status) {
    for (uint cell = 0; cell < count[COUNT_CELLS]; ++cell) {
        const ulong i = out + (ulong)cell * count[COUNT_OUT_CELL_PITCH];
        if (only && !(out_status[i] & only)) continue;
        out_height[i] = REAL_NAN;
        out_intensity[i] = REAL_NAN;
        SET_OTHER(i, REAL_NAN);
        out_status[i] = status;
    }
}

kernel void resample(LINES_IN, LINES_OUT, constant uint *count, constant real *grid) {
    const ulong line = get_global_id(0);
    const ulong in = line * count[COUNT_LINE_PITCH], out = line * count[COUNT_OUT_LINE_PITCH];
    const real sense = grid[GRID_SENSE], tolerance = grid[GRID_FOLD_TOLERANCE];
    clear_cells(OUT_ARRAYS, out, count, 0, STATUS_NO_DATA);

    Sample before;
    int started = 0;
    real furthest = 0, back = 0;  // furthest coordinate reached, and lowest coordinate since then
    for (uint sample = 0; sample < count[COUNT_SAMPLES]; ++sample) {
        const ulong i = in + (ulong)sample * count[COUNT_SAMPLE_PITCH];
        const Sample now = {(along[i] - grid[GRID_ORIGIN]) * grid[GRID_PER_METRE], height[i], intensity[i], OTHER_OF(i),
                            given[i]};
        if ((now.status & ~STATUS_INFORMS) || not_finite(now.at) || not_finite(now.height)) continue;
        const real reached = sense * now.at;
        if (started) fill_between(before, now, OUT_ARRAYS, out, count, grid);
        if (!started || reached > furthest) {
            furthest = back = reached;
        } else if (reached <= furthest - tolerance && reached <= back) {
            mark_folded(sense * reached, sense * back, out_status, out, count);
            back = reached;
        }
        before = now;
        started = 1;
    }
    if (count[COUNT_DROP_FOLDED]) clear_cells(OUT_ARRAYS, out, count, STATUS_NOT_INVERTIBLE, STATUS_NOT_INVERTIBLE);
}
