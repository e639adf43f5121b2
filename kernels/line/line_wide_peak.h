// Strongest samples of WIDE profiles at once (every method but the centroid), and the windowed centroid of 16 of them.
//
// Down the columns the walk keeps for each profile the largest sample, the block of rows where it first occurred, and
// its row in the block: the row in a frame exceeds a byte. Then groups of 16 profiles are read again in the few rows
// around their peaks; together, unless the peaks lie far apart.
#ifndef LINE_WIDE_PEAK_H
#define LINE_WIDE_PEAK_H

#include "line/line_wide.h"
#include "line/line_window.h"

typedef struct {
    Highest highest;
    wide_steps block;  // number of the block in which the level first occurred
#ifndef ALONG_ROWS
    wide_steps row;  // its row in the block
#endif
} WidePeak;

static inline void clear_peak(WidePeak *peak) {
    peak->highest = darkest();
    peak->block = 0;
#ifndef ALONG_ROWS
    peak->row = 0;
#endif
}

#ifndef ALONG_ROWS
// Add `steps` samples of every lane, of which `highest` are the largest: the first at `at`, the next ones `stride`
// elements further. They are the samples `first`, first + 1, ... of block `number`. They are read again, now for the
// row, where a lane has its largest sample so far, above the threshold: in few blocks of a frame.
static inline void find_steps(WidePeak *peak, const Highest *highest, global const CODE *at, int stride, int steps,
                              int number, int first, CODE threshold) {
    const wides limit = threshold, before = peak->highest.level;
    raise_highest(&peak->highest, highest->level);
#if CODE_BITS == 32
    peak->highest.poison += highest->poison;
#endif
    if (!any_greater(peak->highest.level, before > limit ? before : limit)) return;
    wides level = before;
    wide_steps row = peak->row, index = (wide_steps)first;
    for (int k = 0; k < steps; k++, at += stride, index += (wide_steps)1) {
        const wides x = wide_load(at);
        row = x > level ? index : row;
        level = x > level ? x : level;
    }
    peak->row = row;
    peak->block = level > before ? (wide_steps)number : peak->block;
}
#endif

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
static inline int span_limit(const Profiles *profiles) { return 4 * window_length(profiles) + 64; }

// Integer types of a row index and of the sums over a window: 16 bits where they suffice. Bytes and MAX_RADIUS <= 15: the
// total is at most 31 * 255 = 7905, the moment at most 255 * (1 + ... + 15) = 30600 < 2^15.
#if CODE_BITS == 8 && MAX_RADIUS <= 15
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

// Windowed centroid of all lanes over one span of rows. A mask selects the rows of the window of each lane. A signed
// offset o is in the window where o + radius <= 2 radius as unsigned numbers. Also count the flat top: the first
// offset past it is the smallest unsigned offset whose sample differs from the peak (negative offsets are large
// unsigned numbers; an equal sample has all bits set by the OR with its mask).
//
// Under NOISE the loop also accumulates the moments m2, n0, n1 and n2 of centroid_variance(). The second
// moment of the light exceeds 16 bits.
static inline Place span_centroid(const Profiles *profiles, const Peak *peak, Span span, ints *top,
                                  constant LineTable *table) {
    const indices at = to_indices(peak->at), radius = (indices)radius_of(profiles);
    sums16 total = 0, moment = 0;
    indices offset = (indices)span.begin - at;
    unsigned_indices past = as_unsigned((indices)-1);  // first offset past the flat top; -1: none yet
#ifdef NOISE
    indices lit_count = 0, lit_moment = 0, lit_square = 0;
    squares16 square = 0;
#endif
    for (int k = span.begin; k < span.end; k++) {
        const codes x = sample_of(profiles, k);
        const indices inside = as_unsigned(offset + radius) <= as_unsigned(radius + radius);
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
    const Span span = span_of(peak->at, peak->found, radius_of(profiles), radius_of(profiles), profiles->length);
    const Place place = span_centroid(profiles, peak, span, &peak->top, table);
    if (!centre_top(profiles, peak)) return place;
    const Span settled = span_of(peak->at, peak->found, radius_of(profiles), radius_of(profiles), profiles->length);
    return span_centroid(profiles, peak, settled, &top, table);
}

#else

// Index of the first sample of the row that equals the level. It lies in the earliest of the blocks of WIDE samples in
// which the level occurred.
static inline int locate_in_row(global const CODE *row, CODE level, const WidePeak *peak) {
    int16 block = NO_INDEX, lane = NO_INDEX;
    for (int i = 0; i < QUARTERS; i++) {
        const ints here = int_mask(((const codes *)&peak->highest.level)[i] == (codes)level);
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
static inline void find_in_row(global const CODE *row, int length, int *at, CODE *level, int *not_finite_mask) {
    WidePeak peak;
    clear_peak(&peak);
    const int blocks = length / WIDE;
    for (int block = 0; block < blocks; block++) {
        const wides x = wide_load(row + block * WIDE);
        peak.block = x > peak.highest.level ? (wide_steps)block : peak.block;
        raise_highest(&peak.highest, x);
    }
    codes levels = ((const codes *)&peak.highest.level)[0];
    for (int i = 1; i < QUARTERS; i++) levels = higher_of(((const codes *)&peak.highest.level)[i], levels);
    const CODE highest = highest_level(levels);
    *at = locate_in_row(row, highest, &peak);
    *level = highest;
    *not_finite_mask = 0;
#if CODE_BITS == 32
    *not_finite_mask = any(not_finite_lanes(to_reals(peak.highest.poison))) ? -1 : 0;
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
