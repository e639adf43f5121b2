// Vector variant of the line readout: a strip of columns (read_strip), or 16 rows under ALONG_ROWS (read_rows).
// Included by line.cl, whose finish_centroid and finish_peak write the readings.
#ifndef LINE_STRIP_H
#define LINE_STRIP_H

#define MAX_STRIP 1024  // columns whose sums fit the first-level cache (_STRIP in gpuvision/ranging/line_launch.py)
#define MAX_GROUPS (MAX_STRIP / WIDE)

// First column of a group of WIDE columns. The last group of a frame is moved back to end with the frame, and some
// columns are read twice.
static inline int group_start(int begin, int group, int columns) { return min(begin + group * WIDE, columns - WIDE); }

#ifndef ALONG_ROWS
// Intel's compiler takes minutes for a fit with this walk.
#if CODE_BITS == 8 && (defined(METHOD_CENTROID) || defined(METHOD_WINDOWED))
#define STRIP_BY_ROWS
// Largest of `steps` samples of each column of a whole strip, row by row: memory is read in sequence, and MAX_GROUPS
// vectors fit the registers. Where a frame lies in the second-level cache it takes half the time of group after group.
static inline void highest_of_strip(Highest *highest, global const CODE *at, int stride, int steps) {
    Highest kept[MAX_GROUPS];
    _Pragma("unroll") for (int i = 0; i < MAX_GROUPS; i++) kept[i] = darkest();
    for (int k = 0; k < steps; k++, at += stride) {
        _Pragma("unroll") for (int i = 0; i < MAX_GROUPS; i++) {
            prefetch_from_memory(at + i * WIDE + (long)STEPS * stride);
            raise_highest(&kept[i], wide_load(at + i * WIDE));
        }
    }
    _Pragma("unroll") for (int i = 0; i < MAX_GROUPS; i++) highest[i] = kept[i];
}
#endif

// Largest of `steps` samples, at most STEPS, of each column of a strip; `at` is the first row.
static inline void highest_of_block(Highest *highest, global const CODE *at, int begin, int groups, int columns,
                                    int steps) {
#ifdef STRIP_BY_ROWS
    if (begin + MAX_STRIP <= columns && groups == MAX_GROUPS) {
        highest_of_strip(highest, at + begin, columns, steps);
        return;
    }
#endif
    for (int i = 0; i < groups; i++) {
        highest[i] = highest_of_steps(at + group_start(begin, i, columns), columns, steps);
    }
}
#endif

// The 16 profiles of quarter i % QUARTERS of group i / QUARTERS in a strip; `sample` is the first one's column.
static inline Profiles profiles_of_quarter(const Profiles *frame, int begin, int i, int *sample) {
    Profiles profiles = *frame;
    *sample = group_start(begin, i / QUARTERS, frame->stride) + i % QUARTERS * 16;
    profiles.first += *sample;
    return profiles;
}

#ifdef METHOD_CENTROID
// Add a block of at most STEPS samples of every lane to the sums, see add_steps(). `highest`: its largest samples. Most
// blocks of a frame have no light: their sums are zero, and cost one instruction for each vector, not seven. The sums of
// a block with light come from the first-level cache; meanwhile the same lanes of the next block are fetched.
static inline void add_samples(WideSums *sums, const Highest *highest, global const CODE *at, int stride, int steps,
                               int first, CODE threshold) {
    raise_peak(sums, highest);
    if (!any_greater(highest->level, threshold)) return;
#if CODE_BITS == 8
    _Pragma("unroll") for (int k = STEPS; k < 2 * STEPS; k++) prefetch_line(at + (long)k * stride);
#endif
    add_steps(sums, at, stride, steps, first, threshold);
}
#endif

#if defined(METHOD_CENTROID) && !defined(ALONG_ROWS)
// Read the columns begin <= column < end, at most MAX_STRIP: blocks of STEPS rows outside, groups of WIDE columns
// inside.
static inline void read_strip(const Profiles *frame, int begin, int end, constant LineTable *table, const Outputs *to,
                              ulong first) {
    WideSums sums[MAX_GROUPS];
    Highest highest[MAX_GROUPS];
    const int columns = frame->stride, groups = (end - begin + WIDE - 1) / WIDE;
    for (int i = 0; i < groups; i++) clear_sums(&sums[i]);
    for (int row = 0; row < frame->length; row += STEPS) {
        global const CODE *at = frame->first + (long)row * columns;
        const int steps = min(STEPS, frame->length - row);
        highest_of_block(highest, at, begin, groups, columns, steps);
        for (int i = 0; i < groups; i++) {
            add_samples(&sums[i], &highest[i], at + group_start(begin, i, columns), columns, steps, row,
                        frame->threshold);
        }
    }
    for (int i = 0; i < groups; i++) {
        Centroid centroids[QUARTERS];
        _Pragma("unroll") for (int k = 0; k < QUARTERS; k++) centroids[k] = wide_centroid(&sums[i], k);
#ifdef NOISE
        int from;
        const Profiles group = profiles_of_quarter(frame, begin, i * QUARTERS, &from);
        set_variances(centroids, &group, table);
#endif
        _Pragma("unroll") for (int k = 0; k < QUARTERS; k++) {
            int sample;
            const Profiles profiles = profiles_of_quarter(frame, begin, i * QUARTERS + k, &sample);
            finish_centroid(&profiles, &centroids[k], table, to, first + sample, sample);
        }
    }
}

#elif defined(METHOD_CENTROID)
// Sum a row lane by lane in steps of WIDE samples, then combine the lanes and add the remainder of the row.
static inline void read_row(global const CODE *row, int length, CODE threshold, RowSums *sums) {
    WideSums wide;
    clear_sums(&wide);
    const int blocks = length / WIDE;
    for (int block = 0; block < blocks; block += STEPS) {
        const int steps = min(STEPS, blocks - block);
        global const CODE *at = row + block * WIDE;
        const Highest highest = highest_of_steps(at, WIDE, steps);
        add_samples(&wide, &highest, at, WIDE, steps, block, threshold);
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
        read_row(row, profiles->length, profiles->threshold, &rows[i]);
    }
    Centroid centroid = row_centroid(rows);
#ifdef NOISE
    set_row_variances(&centroid, profiles, table);
#endif
    finish_centroid(profiles, &centroid, table, to, first, sample);
}

#elif !defined(ALONG_ROWS)
// Finish the 16 columns of quarter i, given their peaks.
static inline void finish_quarter(const Profiles *profiles, const WidePeak *wide, int i, int tall,
                                  constant LineTable *table, const Outputs *to, ulong first, int sample) {
    Peak peak;
    peak.level = ((const codes *)&wide->highest.level)[i];
    peak.found = ~dark_lanes(profiles, peak.level);
    peak.not_finite = 0;
#if CODE_BITS == 32
    peak.not_finite = not_finite_lanes(to_reals(wide->highest.poison));
#endif
    const ints block = convert_int16(((const step_lanes16 *)&wide->block)[i]);
    peak.at = block * tall + convert_int16(((const step_lanes16 *)&wide->row)[i]);
    const Span span = span_of(peak.at, peak.found, 0, 0, profiles->length);
    const int together = span.end - span.begin <= span_limit(profiles);
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
    Highest highest[MAX_GROUPS];
    const int columns = frame->stride, groups = (end - begin + WIDE - 1) / WIDE;
    // The number of a block fits a byte, and so does a row of it: blocks of taller frames have more rows, 140 at most.
    const int tall = STEPS * (frame->length / (255 * STEPS) + 1);
    for (int i = 0; i < groups; i++) clear_peak(&peaks[i]);
    for (int row = 0; row < frame->length; row += STEPS) {
        global const CODE *at = frame->first + (long)row * columns;
        const int steps = min(STEPS, frame->length - row), number = row / tall;
        highest_of_block(highest, at, begin, groups, columns, steps);
        for (int i = 0; i < groups; i++) {
            find_steps(&peaks[i], &highest[i], at + group_start(begin, i, columns), columns, steps, number,
                       row - number * tall, frame->threshold);
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
        find_in_row(row, profiles->length, &at[i], &level[i], &not_finite_mask[i]);
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
