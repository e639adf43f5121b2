// The walks of the wide shape: a strip of columns, or sixteen rows. Included by line.cl, whose finish_... they call.
#ifndef LINE_STRIP_H
#define LINE_STRIP_H

#define MAX_STRIP 1024  // columns whose sums stay in the first cache
#define MAX_GROUPS (MAX_STRIP / WIDE)

// Group of WIDE columns: the last one moves back to end with the frame, and does some columns twice.
inline int group_start(int begin, int group, int columns) { return min(begin + group * WIDE, columns - WIDE); }

// The rows from a given one on, in the columns of a strip.
inline Ahead ahead_of(global const CODE *at, int width, int columns) {
    const Ahead ahead = {at, at + width, columns - width, width};
    return ahead;
}

#ifdef METHOD_CENTROID

#ifndef ALONG_ROWS
inline void read_strip(const Profiles *frame, int begin, int end, constant real *p, const Outputs *to, ulong first) {
    WideSums sums[MAX_GROUPS];
    const int columns = frame->stride, groups = (end - begin + WIDE - 1) / WIDE;
    for (int i = 0; i < groups; i++) clear_sums(&sums[i]);
    for (int row = 0; row < frame->length; row += STEPS) {
        global const CODE *at = frame->first + (long)row * columns;
        const int steps = min(STEPS, frame->length - row);
        Ahead ahead = ahead_of(at + (long)BLOCKS_AHEAD * STEPS * columns + begin, groups * WIDE, columns);
        for (int i = 0; i < groups; i++) {
            add_steps(&sums[i], at + group_start(begin, i, columns), columns, steps, row, frame->threshold, &ahead);
        }
    }
    for (int i = 0; i < groups * QUARTERS; i++) {
        const int sample = group_start(begin, i / QUARTERS, columns) + i % QUARTERS * 16;
        const Gravity gravity = wide_gravity(&sums[i / QUARTERS], i % QUARTERS);
        Profiles profiles = *frame;
        profiles.first += sample;
        finish_whole(&profiles, &gravity, p, to, first + sample, sample);
    }
}

#else

// Sums along one row, lane by lane in steps of WIDE samples, then over the lanes and the rest of the row.
inline void read_row(global const CODE *row, int length, CODE threshold, RowSums *sums, Ahead *ahead) {
    WideSums wide;
    clear_sums(&wide);
    const int blocks = length / WIDE;
    for (int block = 0; block < blocks; block += STEPS) {
        add_steps(&wide, row + block * WIDE, WIDE, min(STEPS, blocks - block), block, threshold, ahead);
    }
    sum_lanes(&wide, sums);
    for (int k = blocks * WIDE; k < length; k++) add_sample(sums, row[k], k, threshold);
}

inline void read_rows(const Profiles *profiles, constant real *p, const Outputs *to, ulong first, int sample) {
    RowSums rows[LANES];
    for (int i = 0; i < LANES; i++) {
        global const CODE *row = profiles->first + (long)i * profiles->lane_stride;
        global const CODE *later = row + (long)BLOCKS_AHEAD * LANES * profiles->lane_stride;
        Ahead ahead = ahead_of(later, profiles->length, profiles->length);
        read_row(row, profiles->length, profiles->threshold, &rows[i], &ahead);
    }
    const Gravity gravity = row_gravity(rows);
    finish_whole(profiles, &gravity, p, to, first, sample);
}
#endif

#else

#ifndef ALONG_ROWS

// Sixteen columns of which the peaks' levels and blocks are known.
inline void finish_group(const Profiles *profiles, const WidePeak *wide, int i, int tall, constant real *p,
                         const Outputs *to, ulong first, int sample) {
    Peak peak;
    peak.level = ((const codes *)&wide->level)[i];
    peak.found = ~dark_lanes(profiles, peak.level);
    peak.lost = 0;
#if CODE_BITS == 32
    peak.lost = not_finite_lanes(to_reals(wide->lost));
#endif
    const ints block = convert_int16(((const step_lanes16 *)&wide->block)[i]);
    Span span = span_of(block * tall, peak.found, 0, tall - 1, profiles->length);
    const int together = span.end - span.begin <= SPAN_LIMIT + tall;
    Place place;
    if (!any(peak.found)) {
        peak.at = 0;
        peak.top = 1;
        place.at = place.total = 0;
        place.flags = 0;
    } else {
        peak.at = together ? locate(profiles, peak.level, span) : locate_apart(profiles, peak.level, block, tall);
#ifdef METHOD_WINDOWED
        place = together ? gravity_together(profiles, &peak) : place_apart(profiles, &peak, p);
#else
        place = place_apart(profiles, &peak, p);
#endif
    }
    finish_peak(profiles, &peak, &place, p, to, first, sample);
}

inline void read_strip(const Profiles *frame, int begin, int end, constant real *p, const Outputs *to, ulong first) {
    WidePeak peaks[MAX_GROUPS];
    const int columns = frame->stride, groups = (end - begin + WIDE - 1) / WIDE;
    // A block's number fits a byte: blocks of taller frames have more rows.
    const int tall = STEPS * (frame->length / (255 * STEPS) + 1);
    for (int i = 0; i < groups; i++) clear_peak(&peaks[i]);
    for (int row = 0; row < frame->length; row += tall) {
        global const CODE *at = frame->first + (long)row * columns;
        const int steps = min(tall, frame->length - row);
        Ahead ahead = ahead_of(at + (long)BLOCKS_AHEAD * tall * columns + begin, groups * WIDE, columns);
        for (int i = 0; i < groups; i++) {
            find_steps(&peaks[i], at + group_start(begin, i, columns), columns, steps, row / tall, &ahead);
        }
    }
    for (int i = 0; i < groups * QUARTERS; i++) {
        const int sample = group_start(begin, i / QUARTERS, columns) + i % QUARTERS * 16;
        Profiles profiles = *frame;
        profiles.first += sample;
        finish_group(&profiles, &peaks[i / QUARTERS], i % QUARTERS, tall, p, to, first + sample, sample);
    }
}

#else

inline void read_rows(const Profiles *profiles, constant real *p, const Outputs *to, ulong first, int sample) {
    int at[LANES], lost[LANES];
    CODE level[LANES];
    for (int i = 0; i < LANES; i++) {
        global const CODE *row = profiles->first + (long)i * profiles->lane_stride;
        global const CODE *later = row + (long)BLOCKS_AHEAD * LANES * profiles->lane_stride;
        Ahead ahead = ahead_of(later, profiles->length, profiles->length);
        find_in_row(row, profiles->length, &at[i], &level[i], &lost[i], &ahead);
    }
    Peak peak;
    peak.at = *(const ints_at *)at;
    peak.level = *(const codes_at *)level;
    peak.lost = *(const ints_at *)lost;
    peak.found = ~dark_lanes(profiles, peak.level);
    const Place place = place_apart(profiles, &peak, p);
    finish_peak(profiles, &peak, &place, p, to, first, sample);
}

#endif
#endif
#endif
