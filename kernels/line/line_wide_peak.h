// Strongest samples of WIDE profiles at once (every method but the centroid), and the windowed centroid of 16 of them.
//
// Down the columns the walk keeps two numbers per profile: the largest sample, and the number of the block of rows
// where it first occurred. Then groups of 16 profiles are read again in the few rows around their peaks; together,
// unless the peaks lie far apart.
#ifndef LINE_WIDE_PEAK_H
#define LINE_WIDE_PEAK_H

#include "line/line_wide.h"
#include "line/line_window.h"

typedef struct {
    wides level;
    wide_steps block;  // number of the block in which the level first occurred
#if CODE_BITS == 32
    wides poison;  // 0, or NaN after a sample that is not finite: x * 0 is NaN for infinity and NaN
#endif
} WidePeak;

static inline void clear_peak(WidePeak *peak) {
    peak->level = (wides)DARKEST;
    peak->block = 0;
#if CODE_BITS == 32
    peak->poison = 0;
#endif
}

// Largest sample of one block, and a test for samples that are not finite.
typedef struct {
    wides level;
#if CODE_BITS == 32
    wides poison;
#endif
} BlockPeak;

static inline void find_step(BlockPeak *block, wides x) {
    block->level = x > block->level ? x : block->level;
#if CODE_BITS == 32
    block->poison += x * 0;
#endif
}

// Search a block of `steps` samples in every lane: the first at `at`, the next ones `stride` elements further.
static inline void find_steps(WidePeak *peak, global const CODE *at, int stride, int steps, int number, Ahead *ahead) {
    BlockPeak block;
    block.level = (wides)DARKEST;
#if CODE_BITS == 32
    block.poison = peak->poison;
#endif
    int k = 0;
    for (; k + 4 <= steps; k += 4) {
        find_step(&block, wide_load(at));
        find_step(&block, wide_load(at + stride));
        find_step(&block, wide_load(at + 2 * (long)stride));
        find_step(&block, wide_load(at + 3 * (long)stride));
        at += 4 * (long)stride;
        prefetch_lines(ahead);
    }
    for (; k < steps; k++, at += stride) find_step(&block, wide_load(at));
    peak->block = block.level > peak->level ? (wide_steps)number : peak->block;
    peak->level = block.level > peak->level ? block.level : peak->level;
#if CODE_BITS == 32
    peak->poison = block.poison;
#endif
}

#define NO_INDEX (1 << 24)  // larger than any index

#ifndef ALONG_ROWS

// The rows begin <= row < end.
typedef struct {
    int begin, end;
} Span;

// Span of rows from the first to the last row of the lanes that are found, with a margin before and after.
static inline Span span_of(ints rows, ints found, int before, int after, int length) {
    Span span;
    span.begin = max(lowest_lane(choose_ints(found, rows, NO_INDEX)) - before, 0);
    span.end = min(highest(choose_ints(found, rows, -NO_INDEX)) + after + 1, length);
    return span;
}

// Rows of the span above which the lanes are processed one by one.
#define SPAN_LIMIT (4 * WINDOW + 64)

// Integer types of a row index and of the sums over a window: 16 bits where they suffice. Bytes and RADIUS <= 15: the
// total is at most 31 * 255 = 7905, the moment at most 255 * (1 + ... + 15) = 30600 < 2^15.
#if CODE_BITS == 8 && RADIUS <= 15
typedef short16 indices;
typedef short16 sums16;
typedef ushort16 unsigned_indices;
#define to_indices convert_short16
#define to_sums convert_short16
#define as_unsigned as_ushort16
// The product v * offset^2 is at most 255 * 15^2 = 57375 < 2^16: as an unsigned number it fits 16 bits.
typedef uint16 squares16;
#define to_squares(product) convert_uint16(as_ushort16(product))
#else
typedef int16 indices;
typedef uint16 unsigned_indices;
#define to_indices convert_int16
#define as_unsigned as_uint16
#if CODE_BITS == 32
typedef real16 sums16;
#define to_sums convert_real16
typedef real16 squares16;
#define to_squares
#else
typedef int16 sums16;
#define to_sums convert_int16
// The products of 16-bit samples and squares of offsets exceed 32 bits.
typedef real16 squares16;
#define to_squares(product) (to_reals(v) * to_reals(offset * offset))
#endif
#endif

// First row of the span whose sample equals the level, in every lane.
static inline ints first_row(const Profiles *profiles, codes level, Span span) {
    indices at = (indices)span.begin;
    for (int k = span.end - 1; k >= span.begin; k--) {
        at = to_indices(sample_of(profiles, k) == level) ? (indices)k : at;
    }
    return convert_int16(at);
}

// The same for lanes whose peaks lie far apart: each lane searches a separate block of `tall` rows.
static inline ints first_row_apart(const Profiles *profiles, codes level, ints block, int tall) {
    int first[LANES];
    CODE levels[LANES];
    *(ints_at *)first = block * tall;
    *(codes_at *)levels = level;
    for (int lane = 0; lane < LANES; lane++) {
        const int end = min(first[lane] + tall, profiles->length) - 1;
        global const CODE *profile = profiles->first + lane;
        while (first[lane] < end && profile[(long)first[lane] * profiles->stride] != levels[lane]) first[lane]++;
    }
    return *(const ints_at *)first;
}

// Windowed centroid of all lanes over one span of rows. A mask selects the rows of the window of each lane. A signed
// offset o is in the window where o + RADIUS <= 2 * RADIUS as unsigned numbers. Also count the flat top: the first
// offset past it is the smallest unsigned offset whose sample differs from the peak (negative offsets are large
// unsigned numbers; an equal sample has all bits set by the OR with its mask).
//
// Under NOISE the loop also accumulates the moments m2, n0, n1 and n2 of centroid_variance(). The second
// moment of the light exceeds 16 bits.
static inline Place span_centroid(const Profiles *profiles, const Peak *peak, Span span, ints *top,
                                  constant LineTable *table) {
    const indices at = to_indices(peak->at);
    sums16 total = 0, moment = 0;
    indices offset = (indices)span.begin - at;
    unsigned_indices past = as_unsigned((indices)-1);  // first offset past the flat top; -1: none yet
#ifdef NOISE
    indices lit_count = 0, lit_moment = 0, lit_square = 0;
    squares16 square = 0;
#endif
    for (int k = span.begin; k < span.end; k++) {
        const codes x = sample_of(profiles, k);
        const indices inside = as_unsigned(offset + (indices)RADIUS) <= (unsigned_indices)(2 * RADIUS);
#if CODE_BITS == 32
        const sums16 v = choose_reals(inside, over_threshold(x, profiles->threshold), 0);
#else
        const sums16 v = to_sums(x > (codes)profiles->threshold ? x - (codes)profiles->threshold : (codes)0) & inside;
#endif
        total += v;
        // One expression: the compiler contracts it to a fused multiply-add.
        moment += v * to_sums(offset);
#ifdef NOISE
        const indices lit = to_indices(v > (sums16)0);
        lit_count -= lit;
        lit_moment += lit & offset;
        lit_square += lit & (offset * offset);
        square += to_squares(v * to_sums(offset) * to_sums(offset));
#endif
        const unsigned_indices other = as_unsigned(offset | to_indices(x == peak->level));
        past = other < past ? other : past;
        offset += (indices)1;
    }
    *top = convert_int16(past < as_unsigned(offset) ? past : as_unsigned(offset));
    Place place;
    place.total = to_reals(total);
    place.at = to_reals(moment) / place.total;
    place.flags = 0;
#ifdef NOISE
    place.variance = centroid_variance(place.at, place.total, to_reals(moment), to_reals(square), to_reals(lit_count),
                                       to_reals(lit_moment), to_reals(lit_square), table);
#endif
    return place;
}

// Windowed centroid of all lanes over their common span; twice where a flat top moves a peak to its middle.
static inline Place centroid_together(const Profiles *profiles, Peak *peak, constant LineTable *table) {
    ints top;
    const Span span = span_of(peak->at, peak->found, RADIUS, RADIUS, profiles->length);
    const Place place = span_centroid(profiles, peak, span, &peak->top, table);
    if (!centre_top(profiles, peak)) return place;
    const Span settled = span_of(peak->at, peak->found, RADIUS, RADIUS, profiles->length);
    return span_centroid(profiles, peak, settled, &top, table);
}

#else

// Index of the first sample of the row that equals the level. It lies in the earliest of the blocks of WIDE samples in
// which the level occurred.
static inline int locate_in_row(global const CODE *row, CODE level, const WidePeak *peak) {
    int16 block = NO_INDEX, lane = NO_INDEX;
    for (int i = 0; i < QUARTERS; i++) {
        const ints here = int_mask(((const codes *)&peak->level)[i] == (codes)level);
        block = min(block, choose_ints(here, convert_int16(((const step_lanes16 *)&peak->block)[i]), NO_INDEX));
    }
    const int first = lowest_lane(block) * WIDE;
    for (int i = 0; i < QUARTERS; i++) {
        const ints here = int_mask(*(global const codes_at *)(row + first + 16 * i) == (codes)level);
        lane = min(lane, choose_ints(here, LANE_NUMBERS + 16 * i, NO_INDEX));
    }
    // A row of NaN and -infinity only may have no sample that equals the level.
    return first + min(lowest_lane(lane), WIDE - 1);
}

// Find the largest sample of a row, its index, and whether a sample is not finite.
static inline void find_in_row(global const CODE *row, int length, int *at, CODE *level, int *not_finite_mask,
                               Ahead *ahead) {
    WidePeak peak;
    clear_peak(&peak);
    const int blocks = length / WIDE;
    for (int block = 0; block < blocks; block++) {
        const wides x = wide_load(row + block * WIDE);
        if ((block & 3) == 0) prefetch_lines(ahead);
        peak.block = x > peak.level ? (wide_steps)block : peak.block;
        peak.level = x > peak.level ? x : peak.level;
#if CODE_BITS == 32
        peak.poison += x * 0;
#endif
    }
    codes levels = ((const codes *)&peak.level)[0];
    for (int i = 1; i < QUARTERS; i++) levels = higher_of(((const codes *)&peak.level)[i], levels);
    const CODE highest = highest_level(levels);
    *at = locate_in_row(row, highest, &peak);
    *level = highest;
    *not_finite_mask = 0;
#if CODE_BITS == 32
    *not_finite_mask = any(not_finite_lanes(to_reals(peak.poison))) ? -1 : 0;
#endif
    for (int k = blocks * WIDE; k < length; k++) {
        const CODE x = row[k];
        *at = x > *level ? k : *at;
        *level = x > *level ? x : *level;
#if CODE_BITS == 32
        *not_finite_mask |= -not_finite(x);
#endif
    }
}

#endif
#endif
