// The strongest samples of wide groups of profiles, and the centre of gravity in the window about them.
//
// Down the columns the walk keeps, of every profile, the strongest sample and the block of rows that it first stood in;
// 16 profiles at a time are then looked at again in the few rows that matter, unless their peaks lie far apart.
#ifndef LINE_WIDE_PEAK_H
#define LINE_WIDE_PEAK_H

#include "line/line_wide.h"
#include "line/line_window.h"

typedef struct {
    wides level;
    wide_steps block;  // number of the block of rows that the level first stood in
#if CODE_BITS == 32
    wides lost;
#endif
} WidePeak;

inline void clear_peak(WidePeak *peak) {
    peak->level = (wides)DARKEST;
    peak->block = 0;
#if CODE_BITS == 32
    peak->lost = 0;
#endif
}

inline void find_steps(WidePeak *peak, global const CODE *at, int stride, int steps, int block, Ahead *ahead) {
    wides level = (wides)DARKEST;
#if CODE_BITS == 32
    wides lost = peak->lost;
#define STEP_LOST(x) lost += x * 0;
#else
#define STEP_LOST(x)
#endif
#define FIND_STEP                                                                                                      \
    {                                                                                                                  \
        const wides x = wide_load(at);                                                                                 \
        at += stride;                                                                                                  \
        level = x > level ? x : level;                                                                                 \
        STEP_LOST(x)                                                                                                   \
    }
    int k = 0;
    for (; k + 4 <= steps; k += 4) {
        FIND_STEP FIND_STEP FIND_STEP FIND_STEP fetch_lines(ahead);
    }
    for (; k < steps; k++) FIND_STEP
    peak->block = level > peak->level ? (wide_steps)block : peak->block;
    peak->level = level > peak->level ? level : peak->level;
#if CODE_BITS == 32
    peak->lost = lost;
#endif
}

#define NO_INDEX (1 << 24)

#ifndef ALONG_ROWS

// Rows begin <= row < end.
typedef struct {
    int begin, end;
} Span;

// From the first to the last of the lanes' rows that are found, and a margin either side.
inline Span span_of(ints rows, ints found, int before, int after, int length) {
    Span span;
    span.begin = max(lowest(choose_ints(found, rows, NO_INDEX)) - before, 0);
    span.end = min(highest(choose_ints(found, rows, -NO_INDEX)) + after + 1, length);
    return span;
}

// Peaks further apart than this are worked on lane by lane.
#define SPAN_LIMIT (4 * WINDOW + 64)

// Narrow where it suffices: a row's index, and sums over the window.
#if CODE_BITS == 8 && RADIUS <= 15
typedef short16 indices;
typedef short16 sums16;
typedef ushort16 unsigned_indices;
#define to_indices convert_short16
#define to_sums convert_short16
#define as_unsigned as_ushort16
#else
typedef int16 indices;
typedef uint16 unsigned_indices;
#define to_indices convert_int16
#define as_unsigned as_uint16
#if CODE_BITS == 32
typedef real16 sums16;
#define to_sums convert_real16
#else
typedef int16 sums16;
#define to_sums convert_int16
#endif
#endif

// The first row in the span whose sample is the level.
inline ints locate(const Profiles *profiles, codes level, Span span) {
    indices at = (indices)span.begin;
    for (int k = span.end - 1; k >= span.begin; k--) {
        at = to_indices(sample_of(profiles, k) == level) ? (indices)k : at;
    }
    return convert_int16(at);
}

// The same for lanes whose peaks lie far apart: each one in its own block.
inline ints locate_apart(const Profiles *profiles, codes level, ints block, int tall) {
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

// Centre of gravity of all lanes over one span, every lane by a mask in its own window.
inline Place span_gravity(const Profiles *profiles, const Peak *peak, Span span, ints *top) {
    const indices at = to_indices(peak->at);
    sums16 total = 0, moment = 0;
    indices offset = (indices)span.begin - at;
    unsigned_indices past = as_unsigned((indices)-1);  // the first offset past the flat top; unsigned, none before it is
    for (int k = span.begin; k < span.end; k++) {
        const codes x = sample_of(profiles, k);
        const indices inside = as_unsigned(offset + (indices)RADIUS) <= (unsigned_indices)(2 * RADIUS);
#if CODE_BITS == 32
        const sums16 v = choose_reals(inside, over_threshold(x, profiles->threshold), 0);
#else
        const sums16 v = to_sums(x > (codes)profiles->threshold ? x - (codes)profiles->threshold : (codes)0) & inside;
#endif
        total += v;
        moment += v * to_sums(offset);
        const unsigned_indices other = as_unsigned(offset | to_indices(x == peak->level));
        past = other < past ? other : past;
        offset += (indices)1;
    }
    *top = convert_int16(past < as_unsigned(offset) ? past : as_unsigned(offset));
    Place place;
    place.total = to_reals(total);
    place.at = to_reals(moment) / place.total;
    place.flags = 0;
    return place;
}

inline Place gravity_together(const Profiles *profiles, Peak *peak) {
    ints top;
    const Span span = span_of(peak->at, peak->found, RADIUS, RADIUS, profiles->length);
    const Place place = span_gravity(profiles, peak, span, &peak->top);
    if (!centre_top(profiles, peak)) return place;
    const Span settled = span_of(peak->at, peak->found, RADIUS, RADIUS, profiles->length);
    return span_gravity(profiles, peak, settled, &top);
}

#else

// Index of the row's first sample that has the peak's level, which first stood in one of the blocks of WIDE samples.
inline int locate_in_row(global const CODE *row, CODE level, const WidePeak *peak) {
    int16 block = NO_INDEX, lane = NO_INDEX;
    for (int i = 0; i < QUARTERS; i++) {
        const ints here = CODE_MASK(((const codes *)&peak->level)[i] == (codes)level);
        block = min(block, choose_ints(here, convert_int16(((const step_lanes16 *)&peak->block)[i]), NO_INDEX));
    }
    const int first = lowest(block) * WIDE;
    for (int i = 0; i < QUARTERS; i++) {
        const ints here = CODE_MASK(*(global const codes_at *)(row + first + 16 * i) == (codes)level);
        lane = min(lane, choose_ints(here, lane_numbers + 16 * i, NO_INDEX));
    }
    // A row of nothing but NaN and -infinity may hold no sample of the level.
    return first + min(lowest(lane), WIDE - 1);
}

inline void find_in_row(global const CODE *row, int length, int *at, CODE *level, int *lost, Ahead *ahead) {
    WidePeak peak;
    clear_peak(&peak);
    const int blocks = length / WIDE;
    for (int block = 0; block < blocks; block++) {
        const wides x = wide_load(row + block * WIDE);
        if ((block & 3) == 0) fetch_lines(ahead);
        peak.block = x > peak.level ? (wide_steps)block : peak.block;
        peak.level = x > peak.level ? x : peak.level;
#if CODE_BITS == 32
        peak.lost += x * 0;
#endif
    }
    codes levels = ((const codes *)&peak.level)[0];
    for (int i = 1; i < QUARTERS; i++) levels = higher_of(((const codes *)&peak.level)[i], levels);
    const CODE highest = highest_level(levels);
    *at = locate_in_row(row, highest, &peak);
    *level = highest;
    *lost = 0;
#if CODE_BITS == 32
    *lost = any(not_finite_lanes(to_reals(peak.lost))) ? -1 : 0;
#endif
    for (int k = blocks * WIDE; k < length; k++) {
        const CODE x = row[k];
        *at = x > *level ? k : *at;
        *level = x > *level ? x : *level;
#if CODE_BITS == 32
        *lost |= -not_finite(x);
#endif
    }
}

#endif
#endif
