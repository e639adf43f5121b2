// Vector variant of regrid.cl: LANES neighbouring lines per work-item, side by side, each in the order of its samples.
//
// The segments of the lanes end at different cells. The work-item visits the cells that one of the segments covers, one
// after the other, and a mask selects the lanes that receive a value there: neighbouring lines of a smooth surface have a
// sample near the same cell, and the cells of neighbouring lines are adjacent in memory, so that loads and stores are whole
// vectors. Where heights step, the segments lie apart; cells between them are skipped.
//
// Where the samples of a line are adjacent, tiles of LANES x LANES samples are transposed in registers. The last lines and
// samples, other samples, and cells that are adjacent along a line, are loaded and stored one by one.
//
// The first pass stores sets of LANES lines one after the other, each as (cells, LANES): the work-item writes memory from
// beginning to end, and the second pass reads a tile of it as LANES vectors in a row.
#ifndef LINE_LANES_H
#define LINE_LANES_H

typedef INPUT16 input_at __attribute__((aligned(sizeof(INPUT))));

// Lines of the work-item: their places in the inputs and outputs; pitches of lines, samples and tiles of LANES samples;
// numbers of lanes that are loaded and stored, and the mask of the lanes that are loaded.
typedef struct {
    ulong in, out, in_pitch, sample_pitch, tile_pitch, out_pitch;
    int used, stored;
    ints mask;
} line_set;

// Samples or values of the lanes. at: coordinate [cells].
typedef struct {
    reals at, height, intensity, other, sigma;
    ints status;
} lane_samples;

// LANES samples of each line.
typedef struct {
    reals along[LANES], height[LANES], intensity[LANES], other[LANES], sigma[LANES];
    bytes status[LANES];
} lane_tile;

// ---- loads and stores --------------------------------------------------------------------------------------------------

// PoCL keeps the rows in memory unless the loops over them are unrolled, which takes a third longer. Intel's compiler takes
// twice as long where the rounds are unrolled too.
#define UNROLLED _Pragma("unroll")

// Transpose LANES vectors: four times, interleave the first half of them with the second half. This moves the bits of an
// element's place (row, lane) around by one, and four times swaps row and lane.
#define INTERLEAVE_HALVES(type, a, b)                                                                               \
    ((type)(a.s0, b.s0, a.s1, b.s1, a.s2, b.s2, a.s3, b.s3, a.s4, b.s4, a.s5, b.s5, a.s6, b.s6, a.s7, b.s7))
#define DEFINE_TRANSPOSE(name, type)                                                                                \
    INLINE void name(type *rows) {                                                                                  \
        for (int round = 0; round < 4; round++) {                                                                   \
            type next[LANES];                                                                                       \
            UNROLLED for (int n = 0; n < LANES / 2; n++) {                                                          \
                next[2 * n] = INTERLEAVE_HALVES(type, rows[n].lo, rows[n + LANES / 2].lo);                          \
                next[2 * n + 1] = INTERLEAVE_HALVES(type, rows[n].hi, rows[n + LANES / 2].hi);                      \
            }                                                                                                       \
            UNROLLED for (int n = 0; n < LANES; n++) rows[n] = next[n];                                             \
        }                                                                                                           \
    }
DEFINE_TRANSPOSE(transpose_reals, reals)
DEFINE_TRANSPOSE(transpose_bytes, bytes)

static inline void prefetch_place(global const void *at) {
#if __has_builtin(__builtin_prefetch)
    __builtin_prefetch((const void *)(ulong)at, 0, 3);
#endif
}

// Load `count` samples of each line, LANES at most, and prefetch the next tile: hardware does not prefetch as many lines
// as there are here. Lanes without a line get zeros.
#define DEFINE_LOAD(name, element, vector_at, vector, convert, transpose)                                           \
    INLINE void name(global const element *from, const line_set *lines, uint count, vector *to) {                   \
        const ulong line = lines->in_pitch;                                                                         \
        if (lines->sample_pitch == 1 && lines->used == LANES && count == LANES) {                                   \
            for (int n = 0; n < LANES; n++) {                                                                       \
                to[n] = convert(*(global const vector_at *)(from + n * line));                                      \
                prefetch_place(from + n * line + lines->tile_pitch);                                                \
            }                                                                                                       \
            transpose(to);                                                                                          \
            return;                                                                                                 \
        }                                                                                                           \
        for (uint k = 0; k < count; k++) {                                                                          \
            element each[LANES] = {0};                                                                              \
            for (int n = 0; n < lines->used; n++) each[n] = from[k * lines->sample_pitch + n * line];               \
            to[k] = convert(*(const vector_at *)each);                                                              \
        }                                                                                                           \
    }
DEFINE_LOAD(load_inputs, INPUT, input_at, reals, convert_real16, transpose_reals)
DEFINE_LOAD(load_flags, uchar, bytes_at, bytes, , transpose_bytes)

// Load `count` samples of each line, from sample number `first`, a multiple of LANES, on.
INLINE void load_tile(const line_inputs *in, uint first, uint count, const line_set *lines, lane_tile *tile) {
    const ulong i = lines->in + (ulong)(first / LANES) * lines->tile_pitch;
    load_inputs(in->along + i, lines, count, tile->along);
    load_inputs(in->height + i, lines, count, tile->height);
    load_inputs(in->intensity + i, lines, count, tile->intensity);
#ifdef WITH_OTHER
    load_inputs(in->other + i, lines, count, tile->other);
#endif
#ifdef WITH_SIGMA
    load_inputs(in->sigma + i, lines, count, tile->sigma);
#endif
    load_flags(in->given + i, lines, count, tile->status);
}

// Load or store the values of the lanes at a cell.
INLINE reals load_cell(global const real *from, const line_set *lines) {
    if (lines->out_pitch == 1 && lines->stored == LANES) return load_reals(from);
    real each[LANES] = {0};
    for (int n = 0; n < lines->stored; n++) each[n] = from[n * lines->out_pitch];
    return load_private(each);
}
INLINE void store_cell(reals value, global real *to, const line_set *lines) {
    if (lines->out_pitch == 1 && lines->stored == LANES) {
        *(global reals_at *)to = value;
        return;
    }
    real each[LANES];
    store_private(value, each);
    for (int n = 0; n < lines->stored; n++) to[n * lines->out_pitch] = each[n];
}
INLINE ints load_status(global const uchar *from, const line_set *lines) {
    uchar each[LANES] = {0};
    if (lines->out_pitch == 1 && lines->stored == LANES) return to_ints(*(global const bytes_at *)from);
    for (int n = 0; n < lines->stored; n++) each[n] = from[n * lines->out_pitch];
    return to_ints(*(const bytes_at *)each);
}
INLINE void store_status(ints status, global uchar *to, const line_set *lines) {
    uchar each[LANES];
    if (lines->out_pitch == 1 && lines->stored == LANES) {
        *(global bytes_at *)to = convert_bytes(status);
        return;
    }
    *(bytes_at *)each = convert_bytes(status);
    for (int n = 0; n < lines->stored; n++) to[n * lines->out_pitch] = each[n];
}

// ---- cells -------------------------------------------------------------------------------------------------------------

// Replace values of a cell in the lanes of a mask.
INLINE void replace_values(reals value, ints mask, global real *to, const line_set *lines) {
    store_cell(choose_reals(mask, value, load_cell(to, lines)), to, lines);
}

// Remove the values of a cell in the lanes of a mask.
INLINE void clear_cell(const line_outputs *out, ulong i, ints mask, const line_set *lines) {
    const reals none = (reals)REAL_NAN;
    replace_values(none, mask, out->height + i, lines);
    replace_values(none, mask, out->intensity + i, lines);
#ifdef WITH_OTHER
    replace_values(none, mask, out->other + i, lines);
#endif
#ifdef WITH_SIGMA
    replace_values(none, mask, out->sigma + i, lines);
#endif
}

// Prepare the cells [from, to), counted along the lines: no values, NO_DATA. It happens when the lines reach them, so that
// they are in the caches when they are filled. Return the number of prepared cells.
INLINE int prepare_cells(const line_outputs *out, const line_set *lines, int from, int to, constant RegridCounts *count,
                         constant RegridTable *grid) {
    const reals none = (reals)REAL_NAN;
    const int ascends = grid->sense > 0, last = (int)count->cells - 1;
    for (int n = from; n < to; n++) {
        const ulong i = lines->out + (ulong)(ascends ? n : last - n) * count->out_cell_pitch;
        store_cell(none, out->height + i, lines);
        store_cell(none, out->intensity + i, lines);
#ifdef WITH_OTHER
        store_cell(none, out->other + i, lines);
#endif
#ifdef WITH_SIGMA
        store_cell(none, out->sigma + i, lines);
#endif
        store_status((ints)STATUS_NO_DATA, out->status + i, lines);
    }
    return max(from, to);
}

// First and last cell whose centre lies in [low, high]; no cell if first > last.
INLINE ints first_cells(reals low, int cells) {
    const reals most = (reals)(real)cells, kept = low < 0 ? (reals)0 : low < most ? low : most;
    const ints cell = to_ints(kept);
    return cell - int_mask(to_reals(cell) < kept);
}
INLINE ints last_cells(reals high, int cells) {
    const reals most = (reals)(real)cells, kept = high < 0 ? (reals)-1 : high < most ? high : most;
    return min(to_ints(kept), (ints)(cells - 1));
}

// Cells of the lanes: [first, last] each, and the range of all lanes; empty lanes have first = INT_MAX and last = -1.
typedef struct {
    ints first, last;
    int begin, end;
} cell_ranges;

INLINE cell_ranges ranges_between(reals from, reals to, ints mask, int cells) {
    cell_ranges made;
    const ints first = first_cells(from < to ? from : to, cells), last = last_cells(from < to ? to : from, cells);
    mask &= int_mask(first <= last);
    made.first = choose_ints(mask, first, (ints)INT_MAX);
    made.last = choose_ints(mask, last, (ints)-1);
    made.begin = lowest_lane(made.first);
    made.end = -1 - lowest_lane(-1 - made.last);
    return made;
}

// Return the first cell behind `cell` that a lane covers, or one beyond the end.
INLINE int next_cell(const cell_ranges *ranges, int cell) {
    const ints next = max(ranges->first, (ints)(cell + 1));
    return lowest_lane(choose_ints(int_mask(next <= ranges->last), next, (ints)INT_MAX));
}

// Mask of the lanes whose range covers a cell.
INLINE ints covered(const cell_ranges *ranges, int cell) {
    return int_mask(ranges->first <= (ints)cell) & int_mask(ranges->last >= (ints)cell);
}

// Return the number of cells, counted along the lines, up to the end of a range.
INLINE int cells_up_to(const cell_ranges *ranges, constant RegridCounts *count, constant RegridTable *grid) {
    return grid->sense > 0 ? ranges->end + 1 : (int)count->cells - ranges->begin;
}

// State of the lanes along their lines: the last good sample, whether there is one, the furthest coordinate reached, and
// the lowest coordinate since then; and the number of prepared cells.
typedef struct {
    lane_samples before;
    ints started;
    reals furthest, back;
    int prepared;
} line_progress;

// Fill the cells between two neighbouring good samples by the straight line through them, in the lanes of a mask that are
// joined.
INLINE void fill_between(line_progress *done, const lane_samples *now, ints mask, const line_outputs *out,
                         const line_set *lines, constant RegridCounts *count, constant RegridTable *grid) {
    const lane_samples *before = &done->before;
    const reals length = now->at - before->at, rise = now->height - before->height;
    const ints far = int_mask(fabs(length) > grid->max_gap) | int_mask(fabs(rise) > grid->max_step);
    const cell_ranges ranges = ranges_between(before->at, now->at, mask & ~far, count->cells);
    done->prepared = prepare_cells(out, lines, done->prepared, cells_up_to(&ranges, count, grid), count, grid);
    const ints found = (before->status | now->status) & STATUS_INFORMS;
    for (int cell = ranges.begin; cell <= ranges.end; cell++) {
        ints here = covered(&ranges, cell);
        if (!any_int_lane(here)) {
            cell = next_cell(&ranges, cell) - 1;
            continue;
        }
        const ulong i = lines->out + (ulong)cell * count->out_cell_pitch;
        const ints old = load_status(out->status + i, lines);
        const reals old_height = load_cell(out->height + i, lines);
        const reals part = length == 0 ? (reals)0 : ((real)cell - before->at) / length;
        const reals height = before->height + part * rise;
        // A cell that has a value keeps the higher surface; within max_step the later value replaces it.
        here &= ~(int_mask((old & STATUS_NO_DATA) == 0) & int_mask(old_height > height + grid->max_step));
        store_cell(choose_reals(here, height, old_height), out->height + i, lines);
        replace_values(value_between(before->intensity, now->intensity, part), here, out->intensity + i, lines);
#ifdef WITH_OTHER
        replace_values(value_between(before->other, now->other, part), here, out->other + i, lines);
#endif
#ifdef WITH_SIGMA
        replace_values(sigma_between(before->sigma, now->sigma, part), here, out->sigma + i, lines);
#endif
        const ints status = choose_ints(here, found | (old & STATUS_NOT_INVERTIBLE), old);
        store_status(status, out->status + i, lines);
    }
}

// Mark the cells from the furthest coordinate back to the one reached as NOT_INVERTIBLE, in the lanes of a mask.
INLINE void mark_folded(line_progress *done, reals reached, ints mask, const line_outputs *out, const line_set *lines,
                        constant RegridCounts *count, constant RegridTable *grid) {
    const cell_ranges ranges = ranges_between(grid->sense * reached, grid->sense * done->back, mask, count->cells);
    done->prepared = prepare_cells(out, lines, done->prepared, cells_up_to(&ranges, count, grid), count, grid);
    for (int cell = ranges.begin; cell <= ranges.end; cell = next_cell(&ranges, cell)) {
        global uchar *status = out->status + lines->out + (ulong)cell * count->out_cell_pitch;
        const ints mark = flag_where(covered(&ranges, cell), STATUS_NOT_INVERTIBLE);
        store_status(load_status(status, lines) | mark, status, lines);
    }
}

// Remove the values of the NOT_INVERTIBLE cells, and their other flags.
INLINE void drop_folded_cells(const line_outputs *out, const line_set *lines, constant RegridCounts *count) {
    for (uint cell = 0; cell < count->cells; cell++) {
        const ulong i = lines->out + (ulong)cell * count->out_cell_pitch;
        const ints status = load_status(out->status + i, lines);
        const ints folded = int_mask((status & STATUS_NOT_INVERTIBLE) != 0);
        if (!any_int_lane(folded)) continue;
        clear_cell(out, i, folded, lines);
        store_status(choose_ints(folded, (ints)STATUS_NOT_INVERTIBLE, status), out->status + i, lines);
    }
}

// ---- lines -------------------------------------------------------------------------------------------------------------

INLINE lane_samples sample_of(const lane_tile *tile, uint k, constant RegridTable *grid) {
    lane_samples now;
    now.at = (tile->along[k] - grid->origin) * grid->per_metre;
    now.height = tile->height[k];
    now.intensity = tile->intensity[k];
#ifdef WITH_OTHER
    now.other = tile->other[k];
#endif
#ifdef WITH_SIGMA
    now.sigma = tile->sigma[k];
#endif
    now.status = to_ints(tile->status[k]);
    return now;
}

INLINE lane_samples chosen_samples(ints mask, const lane_samples *yes, const lane_samples *no) {
    lane_samples made;
    made.at = choose_reals(mask, yes->at, no->at);
    made.height = choose_reals(mask, yes->height, no->height);
    made.intensity = choose_reals(mask, yes->intensity, no->intensity);
#ifdef WITH_OTHER
    made.other = choose_reals(mask, yes->other, no->other);
#endif
#ifdef WITH_SIGMA
    made.sigma = choose_reals(mask, yes->sigma, no->sigma);
#endif
    made.status = choose_ints(mask, yes->status, no->status);
    return made;
}

// Apply the next sample of each line.
INLINE void add_samples(const lane_samples *now, line_progress *done, const line_outputs *out, const line_set *lines,
                        constant RegridCounts *count, constant RegridTable *grid) {
    const ints bad = int_mask((now->status & ~STATUS_INFORMS) != 0) | not_finite_lanes(now->at) |
                     not_finite_lanes(now->height);
    const ints good = lines->mask & ~bad;
    const reals reached = grid->sense * now->at;
    fill_between(done, now, good & done->started, out, lines, count, grid);
    const ints ahead = good & (~done->started | int_mask(reached > done->furthest));
    const ints folds = good & ~ahead & int_mask(reached <= done->furthest - grid->fold_tolerance) &
                       int_mask(reached <= done->back);
    if (any_int_lane(folds)) mark_folded(done, reached, folds, out, lines, count, grid);
    done->furthest = choose_reals(ahead, reached, done->furthest);
    done->back = choose_reals(ahead | folds, reached, done->back);
    done->before = chosen_samples(good, now, &done->before);
    done->started |= good;
}

INLINE void resample_lines(const line_inputs *in, const line_outputs *out, ulong line, constant RegridCounts *count,
                           constant RegridTable *grid) {
    const int used = (int)min(count->lines - line, (ulong)LANES);
    const line_set lines = {
        .in = line * count->line_pitch,
        .out = line / LANES * count->out_set_pitch,
        .in_pitch = count->line_pitch,
        .sample_pitch = count->sample_pitch,
        .tile_pitch = count->tile_pitch,
        .out_pitch = count->out_line_pitch,
        .used = used,
        .stored = (int)min(count->out_lines - line, (ulong)LANES),
        .mask = int_mask(LANE_NUMBERS < used),
    };
    line_progress done = {0};
    for (uint first = 0; first < count->samples; first += LANES) {
        const uint next = min(count->samples - first, (uint)LANES);
        lane_tile tile;
        load_tile(in, first, next, &lines, &tile);
        for (uint k = 0; k < next; k++) {
            const lane_samples now = sample_of(&tile, k, grid);
            add_samples(&now, &done, out, &lines, count, grid);
        }
    }
    prepare_cells(out, &lines, done.prepared, (int)count->cells, count, grid);
    if (count->drop_folded) drop_folded_cells(out, &lines, count);
}

#endif
