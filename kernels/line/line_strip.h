// Vector variant of the line readout: a strip of columns (read_strip), or 16 rows under ALONG_ROWS (read_rows).
// Included by line.cl, whose finish_centroid and finish_peak write the readings.
#ifndef LINE_STRIP_H
#define LINE_STRIP_H

#define MAX_STRIP 1024  // columns whose sums fit the first-level cache (_STRIP in gpuvision/ranging/line.py)
#define MAX_GROUPS (MAX_STRIP / WIDE)

// First column of a group of WIDE columns. The last group of a frame is moved back to end with the frame, and some
// columns are read twice.
static inline int group_start(int begin, int group, int columns) { return min(begin + group * WIDE, columns - WIDE); }

// Prefetch the rows from `at` on, `width` columns of each.
static inline Ahead prefetch_from(global const CODE *at, int width, int columns) {
    const Ahead ahead = {at, at + width, columns - width, width};
    return ahead;
}

// The 16 profiles of quarter i % QUARTERS of group i / QUARTERS in a strip; `sample` is the first one's column.
static inline Profiles profiles_of_quarter(const Profiles *frame, int begin, int i, int *sample) {
    Profiles profiles = *frame;
    *sample = group_start(begin, i / QUARTERS, frame->stride) + i % QUARTERS * 16;
    profiles.first += *sample;
    return profiles;
}

#if defined(METHOD_CENTROID) && !defined(ALONG_ROWS)
// Read the columns begin <= column < end, at most MAX_STRIP: blocks of STEPS rows outside, groups of WIDE columns
// inside.
static inline void read_strip(const Profiles *frame, int begin, int end, constant LineTable *table, const Outputs *to,
                              ulong first) {
    WideSums sums[MAX_GROUPS];
    const int columns = frame->stride, groups = (end - begin + WIDE - 1) / WIDE;
    for (int i = 0; i < groups; i++) clear_sums(&sums[i]);
    for (int row = 0; row < frame->length; row += STEPS) {
        global const CODE *at = frame->first + (long)row * columns;
        const int steps = min(STEPS, frame->length - row);
        Ahead ahead = prefetch_from(at + (long)BLOCKS_AHEAD * STEPS * columns + begin, groups * WIDE, columns);
        for (int i = 0; i < groups; i++) {
            add_steps(&sums[i], at + group_start(begin, i, columns), columns, steps, row, frame->threshold, &ahead);
        }
    }
    for (int i = 0; i < groups; i++) {
        Centroid centroids[QUARTERS];
        for (int k = 0; k < QUARTERS; k++) centroids[k] = wide_centroid(&sums[i], k);
#ifdef NOISE
        int from;
        const Profiles group = profiles_of_quarter(frame, begin, i * QUARTERS, &from);
        set_variances(centroids, &group, table);
#endif
        for (int k = 0; k < QUARTERS; k++) {
            int sample;
            const Profiles profiles = profiles_of_quarter(frame, begin, i * QUARTERS + k, &sample);
            finish_centroid(&profiles, &centroids[k], table, to, first + sample, sample);
        }
    }
}

#elif defined(METHOD_CENTROID)
// Sum a row lane by lane in steps of WIDE samples, then combine the lanes and add the remainder of the row.
static inline void read_row(global const CODE *row, int length, CODE threshold, RowSums *sums, Ahead *ahead) {
    WideSums wide;
    clear_sums(&wide);
    const int blocks = length / WIDE;
    for (int block = 0; block < blocks; block += STEPS) {
        add_steps(&wide, row + block * WIDE, WIDE, min(STEPS, blocks - block), block, threshold, ahead);
    }
    sum_lanes(&wide, sums);
    for (int k = blocks * WIDE; k < length; k++) add_sample(sums, row[k], k, threshold);
}

// Read 16 rows.
static inline void read_rows(const Profiles *profiles, constant LineTable *table, const Outputs *to, ulong first,
                             int sample) {
    RowSums rows[LANES];
    for (int i = 0; i < LANES; i++) {
        global const CODE *row = profiles->first + (long)i * profiles->lane_stride;
        global const CODE *later = row + (long)BLOCKS_AHEAD * LANES * profiles->lane_stride;
        Ahead ahead = prefetch_from(later, profiles->length, profiles->length);
        read_row(row, profiles->length, profiles->threshold, &rows[i], &ahead);
    }
    Centroid centroid = row_centroid(rows);
#ifdef NOISE
    set_row_variances(&centroid, profiles, table);
#endif
    finish_centroid(profiles, &centroid, table, to, first, sample);
}

#elif !defined(ALONG_ROWS)
// Finish the 16 columns of quarter i, given the level and the block of their peaks.
static inline void finish_quarter(const Profiles *profiles, const WidePeak *wide, int i, int tall,
                                  constant LineTable *table, const Outputs *to, ulong first, int sample) {
    Peak peak;
    peak.level = ((const codes *)&wide->level)[i];
    peak.found = ~dark_lanes(profiles, peak.level);
    peak.not_finite = 0;
#if CODE_BITS == 32
    peak.not_finite = not_finite_lanes(to_reals(wide->poison));
#endif
    const ints block = convert_int16(((const step_lanes16 *)&wide->block)[i]);
    Span span = span_of(block * tall, peak.found, 0, tall - 1, profiles->length);
    const int together = span.end - span.begin <= SPAN_LIMIT + tall;
    Place place;
    if (!any_int_lane(peak.found)) {
        peak.at = 0;
        peak.top = 1;
        place.at = place.total = 0;
        place.flags = 0;
#ifdef NOISE
        place.variance = 0;
#endif
    } else {
        peak.at = together ? first_row(profiles, peak.level, span) : first_row_apart(profiles, peak.level, block, tall);
#ifdef METHOD_WINDOWED
        place = together ? centroid_together(profiles, &peak, table) : place_in_window(profiles, &peak, table);
#else
        place = place_in_window(profiles, &peak, table);
#endif
    }
    finish_peak(profiles, &peak, &place, highest_outside(profiles, peak.at), table, to, first, sample);
}

// Read the columns begin <= column < end, at most MAX_STRIP.
static inline void read_strip(const Profiles *frame, int begin, int end, constant LineTable *table, const Outputs *to,
                              ulong first) {
    WidePeak peaks[MAX_GROUPS];
    const int columns = frame->stride, groups = (end - begin + WIDE - 1) / WIDE;
    // The number of a block fits a byte: blocks of taller frames have more rows.
    const int tall = STEPS * (frame->length / (255 * STEPS) + 1);
    for (int i = 0; i < groups; i++) clear_peak(&peaks[i]);
    for (int row = 0; row < frame->length; row += tall) {
        global const CODE *at = frame->first + (long)row * columns;
        const int steps = min(tall, frame->length - row);
        Ahead ahead = prefetch_from(at + (long)BLOCKS_AHEAD * tall * columns + begin, groups * WIDE, columns);
        for (int i = 0; i < groups; i++) {
            find_steps(&peaks[i], at + group_start(begin, i, columns), columns, steps, row / tall, &ahead);
        }
    }
    for (int i = 0; i < groups * QUARTERS; i++) {
        int sample;
        const Profiles profiles = profiles_of_quarter(frame, begin, i, &sample);
        finish_quarter(&profiles, &peaks[i / QUARTERS], i % QUARTERS, tall, table, to, first + sample, sample);
    }
}

#else
// Read 16 rows.
static inline void read_rows(const Profiles *profiles, constant LineTable *table, const Outputs *to, ulong first,
                             int sample) {
    int at[LANES], not_finite_mask[LANES];
    CODE level[LANES];
    for (int i = 0; i < LANES; i++) {
        global const CODE *row = profiles->first + (long)i * profiles->lane_stride;
        global const CODE *later = row + (long)BLOCKS_AHEAD * LANES * profiles->lane_stride;
        Ahead ahead = prefetch_from(later, profiles->length, profiles->length);
        find_in_row(row, profiles->length, &at[i], &level[i], &not_finite_mask[i], &ahead);
    }
    Peak peak;
    peak.at = *(const ints_at *)at;
    peak.level = *(const codes_at *)level;
    peak.not_finite = *(const ints_at *)not_finite_mask;
    peak.found = ~dark_lanes(profiles, peak.level);
    const Place place = place_in_window(profiles, &peak, table);
    finish_peak(profiles, &peak, &place, highest_outside(profiles, peak.at), table, to, first, sample);
}
#endif
#endif
