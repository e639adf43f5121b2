// Work-group variant of regrid.cl: some neighbouring lines per work-group, in tiles of one sample per work-item.
//
// The samples of a line have an order: a later sample replaces the value of a cell, unless the cell has a higher surface,
// and a line is folded where it has decreased below its largest previous coordinate. A tile keeps this order:
//   (1) Item: one sample. A scan over the items of the line gives each good sample the last good sample before it and
//       the furthest coordinate up to it.
//   (2) Item: the range of coordinates that its sample concerns: the segment from the last good sample, if the two are
//       joined, and the cells that it folds. Scans give the maximum of the upper ends up to each sample and the minimum of
//       the lower ends from it on. Both ascend along the line.
//   (3) Item: cells, a tile apart. The samples that concern a cell lie between two places, which two binary searches in
//       the scans find: before the first place no range reaches up to the cell, behind the last place all ranges begin
//       beyond it. The item applies these samples in their order. Without folds these are one or two samples.
// Each cell belongs to one item in all tiles: items share no cell, and nothing is atomic.
//
// Folds: after the furthest coordinate F so far, the samples that are at least fold_tolerance behind it mark the cells
// from the lowest of them, `back`, up to F. A sample that does not reach below `back` has nothing to mark, which the first
// sample of a tile knows from the tile before. Otherwise one sample that is too far ahead would make all later tiles
// visit the cells up to it.
//
// A cell beyond all cells of the tiles before has no value yet: it is not read, and it is written for the first time.
// In the usual case every sample is read once and every cell is written once.
//
// Accesses: neighbouring items load neighbouring samples (samples are adjacent) or samples of neighbouring lines (lines are
// adjacent), and store cells in the same way.
#ifndef LINE_GROUP_H
#define LINE_GROUP_H

#define MAX_LINES 16             // MAX_LINES in regrid.py
#define ROOM (GROUP + MAX_LINES) // one more place for each line: the last good sample of the tiles before
#define NO_PLACE (-1)

// First and last cell whose centre lies in [low, high]; no cell if first > last.
static inline int first_cell(real low, int cells) {
    const real kept = low < 0 ? 0 : low < cells ? low : cells;
    const int cell = (int)kept;
    return cell < kept ? cell + 1 : cell;
}
static inline int last_cell(real high, int cells) { return high < 0 ? -1 : high < cells ? (int)high : cells - 1; }

static inline int is_joined(real length, real rise, constant RegridTable *grid) {
    return !(fabs(length) > grid->max_gap || fabs(rise) > grid->max_step);
}

// Samples of a tile. A line has places 0 to n, at line * (n + 1) + place: place 0 is the last good sample of the tiles
// before, the others are the samples of the tile. Coordinates are in cells; all but `at` are times the sense, so that they
// ascend along the line.
typedef struct {
    real at[ROOM], height[ROOM], intensity[ROOM];
#ifdef WITH_OTHER
    real other[ROOM];
#endif
#ifdef WITH_SIGMA
    real sigma[ROOM];
#endif
    real furthest[ROOM]; // furthest coordinate up to a sample
    real top[ROOM];      // upper end of the cells that a sample folds; -infinity: it folds nothing
    real most[ROOM];     // largest upper end of the ranges up to a sample
    real least[ROOM];    // smallest lower end of the ranges from a sample on
    real back[ROOM];     // lowest of the samples from here on that fold, behind the furthest of the line; 0: before the tile
    short last[ROOM];    // place of the last good sample up to here, or NO_PLACE
    uchar flags[ROOM];
} line_tile;

// The item's place in the tile, as a sample and as the first of its cells.
typedef struct {
    int places;         // samples of a line in a tile
    int line, place;    // of the sample: in the group, in the line
    int slot;           // of the sample in the arrays of line_tile
    int cell_line, own; // line of the cells, and first of them
} group_item;

static inline group_item place_item(constant RegridCounts *count) {
    const int item = get_local_id(0), items = get_local_size(0), lines = count->lines_per_group;
    group_item here;
    here.places = items / lines;
    const int adjacent_samples = count->sample_pitch == 1, adjacent_cells = count->out_cell_pitch == 1;
    here.line = adjacent_samples ? item / here.places : item % lines;
    here.place = 1 + (adjacent_samples ? item % here.places : item / lines);
    here.slot = here.line * (here.places + 1) + here.place;
    here.cell_line = adjacent_cells ? item / here.places : item % lines;
    here.own = adjacent_cells ? item % here.places : item / lines;
    return here;
}

// (1) Load the sample of this item; return whether it is good.
static inline int load_sample(const line_inputs *in, const group_item *here, ulong line, uint sample,
                              local line_tile *tile, constant RegridCounts *count, constant RegridTable *grid) {
    int is_good = 0;
    if (line < count->lines && sample < count->samples) {
        const ulong i = line * count->line_pitch + (ulong)sample * count->sample_pitch;
        const real at = (in->along[i] - grid->origin) * grid->per_metre, height = in->height[i];
        const uint status = in->given[i];
        tile->at[here->slot] = at, tile->height[here->slot] = height;
        tile->flags[here->slot] = (uchar)(status & STATUS_INFORMS), tile->intensity[here->slot] = in->intensity[i];
#ifdef WITH_OTHER
        tile->other[here->slot] = in->other[i];
#endif
#ifdef WITH_SIGMA
        tile->sigma[here->slot] = in->sigma[i];
#endif
        is_good = !((status & ~STATUS_INFORMS) || not_finite(at) || not_finite(height));
    }
    const int is_first = here->place == 1;
    const real reached = is_good ? grid->sense * tile->at[here->slot] : -INFINITY;
    tile->furthest[here->slot] = is_first ? lane_max(tile->furthest[here->slot - 1], reached) : reached;
    tile->last[here->slot] = is_good ? here->place : is_first ? tile->last[here->slot - 1] : NO_PLACE;
    return is_good;
}

INLINE void scan_samples(const group_item *here, local line_tile *tile) {
    for (int step = 1; step < here->places; step *= 2) {
        const int from = here->place > step ? here->slot - step : here->slot;
        barrier(CLK_LOCAL_MEM_FENCE);
        const real furthest = tile->furthest[from];
        const short last = tile->last[from];
        barrier(CLK_LOCAL_MEM_FENCE);
        tile->furthest[here->slot] = lane_max(tile->furthest[here->slot], furthest);
        tile->last[here->slot] = max(tile->last[here->slot], last);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// (2) Range of the sample of this item.
static inline void place_range(const group_item *here, int is_good, local line_tile *tile, constant RegridTable *grid) {
    const int first = here->slot - here->place, before = tile->last[here->slot - 1];
    real low = INFINITY, high = -INFINITY, top = -INFINITY, back = INFINITY;
    if (is_good && before != NO_PLACE) {
        const real was_at = tile->at[first + before], at = tile->at[here->slot];
        const real from = grid->sense * was_at, reached = grid->sense * at;
        if (is_joined(at - was_at, tile->height[here->slot] - tile->height[first + before], grid))
            low = lane_min(from, reached), high = lane_max(from, reached);
        const real furthest = tile->furthest[here->slot - 1];
        const real end = furthest > tile->furthest[first] ? furthest : tile->back[first];
        if (reached <= furthest - grid->fold_tolerance && reached <= end) {
            top = end, low = lane_min(low, reached), high = lane_max(high, end);
            if (furthest == tile->furthest[first + here->places]) back = reached;
        }
    }
    tile->top[here->slot] = top, tile->back[here->slot] = back;
    tile->most[here->slot] = high, tile->least[here->slot] = low;
}

INLINE void scan_ranges(const group_item *here, local line_tile *tile) {
    for (int step = 1; step < here->places; step *= 2) {
        const int below = here->place > step ? here->slot - step : here->slot;
        const int above = here->place + step <= here->places ? here->slot + step : here->slot;
        barrier(CLK_LOCAL_MEM_FENCE);
        const real most = tile->most[below], least = tile->least[above], back = tile->back[above];
        barrier(CLK_LOCAL_MEM_FENCE);
        tile->most[here->slot] = lane_max(tile->most[here->slot], most);
        tile->least[here->slot] = lane_min(tile->least[here->slot], least);
        tile->back[here->slot] = lane_min(tile->back[here->slot], back);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Number of values below a level, or (inclusive) not above it; the values ascend.
static inline int count_below(local const real *values, int count, real level, int inclusive) {
    int low = 0, high = count;
    while (low < high) {
        const int middle = (low + high) / 2;
        const int is_below = inclusive ? values[middle] <= level : values[middle] < level;
        low = is_below ? middle + 1 : low;
        high = is_below ? high : middle;
    }
    return low;
}

static inline int covers(real low, real high, int cell, int cells) {
    return first_cell(low, cells) <= cell && cell <= last_cell(high, cells);
}

typedef struct {
    real height, part; // part: fraction of the way between the samples
    uint status;
    int place; // second sample of the segment that gave the value; 0: no segment of this tile
} cell_value;

// (3) Apply the samples of the tile to a cell, in their order. `first`: slot of the line's place 0.
static inline void apply_samples(local const line_tile *tile, int first, int places, int cell, cell_value *value,
                                 constant RegridCounts *count, constant RegridTable *grid) {
    const real level = grid->sense * cell;
    const int cells = count->cells, begin = count_below(tile->most + first + 1, places, level, 0) + 1;
    const int end = count_below(tile->least + first + 1, places, level, 1);
    for (int place = begin; place <= end; place++) {
        const int before = tile->last[first + place - 1];
        if (tile->last[first + place] != place || before == NO_PLACE) continue;
        const real was_at = tile->at[first + before], at = tile->at[first + place];
        const real was_height = tile->height[first + before], length = at - was_at;
        const real rise = tile->height[first + place] - was_height;
        if (is_joined(length, rise, grid) && covers(length < 0 ? at : was_at, length < 0 ? was_at : at, cell, cells)) {
            const real part = length == 0 ? 0 : (cell - was_at) / length;
            const real height = was_height + part * rise;
            if (value->status & STATUS_NO_DATA || !(value->height > height + grid->max_step)) {
                value->height = height, value->part = part, value->place = place;
                value->status = tile->flags[first + before] | tile->flags[first + place] |
                                (value->status & STATUS_NOT_INVERTIBLE);
            }
        }
        const real top = tile->top[first + place], turned = grid->sense * top;
        if (top > -INFINITY && covers(turned < at ? turned : at, turned < at ? at : turned, cell, cells))
            value->status |= STATUS_NOT_INVERTIBLE;
    }
}

static inline void store_empty(const line_outputs *out, ulong i, uint status) {
    out->height[i] = REAL_NAN, out->intensity[i] = REAL_NAN, out->status[i] = (uchar)status;
#ifdef WITH_OTHER
    out->other[i] = REAL_NAN;
#endif
#ifdef WITH_SIGMA
    out->sigma[i] = REAL_NAN;
#endif
}

// Store a value that lies between the samples in the slots `before` and `now`.
static inline void store_value(const line_outputs *out, ulong i, const cell_value *value, local const line_tile *tile,
                               int before, int now) {
    out->height[i] = value->height, out->status[i] = (uchar)value->status;
    out->intensity[i] = value_between(tile->intensity[before], tile->intensity[now], value->part);
#ifdef WITH_OTHER
    out->other[i] = value_between(tile->other[before], tile->other[now], value->part);
#endif
#ifdef WITH_SIGMA
    out->sigma[i] = sigma_between(tile->sigma[before], tile->sigma[now], value->part);
#endif
}

// (3) Apply the tile to the cells of this item. Cells are counted along the line; `fresh` is the first cell behind the
// cells of the tiles before. Return the first cell behind the cells of this tile, too.
static inline int fill_cells(const line_outputs *out, const group_item *here, ulong line, int fresh,
                             local const line_tile *tile, constant RegridCounts *count, constant RegridTable *grid) {
    const int places = here->places, first = here->cell_line * (places + 1), cells = count->cells;
    const int ascends = grid->sense > 0;
    const real low = tile->least[first + 1], high = tile->most[first + places];
    const int nearest = ascends ? first_cell(low, cells) : cells - 1 - last_cell(-low, cells);
    const int last = ascends ? last_cell(high, cells) : cells - 1 - first_cell(-high, cells);
    const int start = min(nearest, fresh), skipped = (start - here->own + places - 1) / places;
    for (int n = here->own + skipped * places; n <= last; n += places) {
        const int cell = ascends ? n : cells - 1 - n;
        const ulong i = line * count->out_line_pitch + (ulong)cell * count->out_cell_pitch;
        const uint old = n >= fresh ? STATUS_NO_DATA : out->status[i];
        if (count->drop_folded && (old & STATUS_NOT_INVERTIBLE)) continue;
        cell_value value = {old & STATUS_NO_DATA ? REAL_NAN : out->height[i], 0, old, 0};
        apply_samples(tile, first, places, cell, &value, count, grid);
        if (count->drop_folded && (value.status & STATUS_NOT_INVERTIBLE)) {
            store_empty(out, i, STATUS_NOT_INVERTIBLE);
        } else if (value.place) {
            store_value(out, i, &value, tile, first + tile->last[first + value.place - 1], first + value.place);
        } else if (n >= fresh) {
            store_empty(out, i, value.status);
        } else if (value.status != old) {
            out->status[i] = (uchar)value.status;
        }
    }
    return max(fresh, last + 1);
}

// Move the last good sample of a line to place 0. The item of place 1 does it, behind a barrier: until then other items
// read the tile, and behind it they load the next one.
INLINE void carry_sample(const group_item *here, local line_tile *tile) {
    const int first = here->slot - here->place, last = tile->last[first + here->places], from = first + max(last, 0);
    const real furthest = tile->furthest[first + here->places], back = tile->back[first + 1];
    const real end = furthest > tile->furthest[first] ? furthest : tile->back[first];
    const real at = tile->at[from], height = tile->height[from], intensity = tile->intensity[from];
    const uchar flags = tile->flags[from];
#ifdef WITH_OTHER
    const real other = tile->other[from];
#endif
#ifdef WITH_SIGMA
    const real sigma = tile->sigma[from];
#endif
    barrier(CLK_LOCAL_MEM_FENCE);
    if (here->place != 1 || last == NO_PLACE) return;
    tile->at[first] = at, tile->height[first] = height, tile->intensity[first] = intensity, tile->flags[first] = flags;
#ifdef WITH_OTHER
    tile->other[first] = other;
#endif
#ifdef WITH_SIGMA
    tile->sigma[first] = sigma;
#endif
    tile->furthest[first] = furthest, tile->back[first] = lane_min(end, back), tile->last[first] = 0;
}

INLINE void resample_lines(const line_inputs *in, const line_outputs *out, local line_tile *tile,
                           constant RegridCounts *count, constant RegridTable *grid) {
    const group_item here = place_item(count);
    const ulong first_line = (ulong)get_group_id(0) * count->lines_per_group, line = first_line + here.cell_line;
    if (here.place == 1) {
        const int first = here.slot - 1;
        tile->furthest[first] = -INFINITY, tile->back[first] = INFINITY, tile->last[first] = NO_PLACE;
    }
    int fresh = 0;
    for (uint begin = 0; begin < count->samples; begin += here.places) {
        const uint sample = begin + here.place - 1;
        const int is_good = load_sample(in, &here, first_line + here.line, sample, tile, count, grid);
        scan_samples(&here, tile);
        place_range(&here, is_good, tile, grid);
        scan_ranges(&here, tile);
        fresh = fill_cells(out, &here, line, fresh, tile, count, grid);
        carry_sample(&here, tile);
    }
    const int cells = count->cells;
    for (int n = here.own; n < cells; n += here.places)
        if (n >= fresh && line < count->lines) {
            const int cell = grid->sense > 0 ? n : cells - 1 - n;
            store_empty(out, line * count->out_line_pitch + (ulong)cell * count->out_cell_pitch, STATUS_NO_DATA);
        }
}

#endif
