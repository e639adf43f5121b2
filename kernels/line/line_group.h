// Work-item variant of the line readout without CANDIDATES: a work-group reads PROFILES neighbouring profiles together.
// Included by line.cl, whose finish_centroid and finish_peak write the readings.
//
// SLICES work-items share a profile. Columns: a work-item reads PER columns at once, in every SLICES-th row; a warp reads
// parts of one or two rows that are 64 bytes wide, or 128 for float samples. ALONG_ROWS: a warp reads a row, PER samples
// for each work-item at once, and HELD rows one after the other. Each work-item keeps HELD parts (sums, or the largest
// sample), one for each of its profiles; the parts of a profile are joined in local memory, and one work-item finishes
// the profile. The joined result does not depend on the order of the parts, but for rounding of float sums: integer sums
// are exact, and of equally large samples the first one is the peak.
//
// Parts of double sums have 56 bytes: a group along rows reads 16 profiles, which takes 28 KiB of local memory.
//
// ITEM_PER_PROFILE, for narrow frames on CPU runtimes: a work-item reads a whole profile, sample by sample (SLICES and
// HELD are 1). The runtime computes neighbouring work-items as the elements of a vector.
//
// A group keeps its registers until its last work-item ends. The fit of METHOD_ML takes longer than the search, so that
// its groups have a work-item to finish each profile; along rows, 8 work-items then read 32 bytes of a row.
#ifndef LINE_GROUP_H
#define LINE_GROUP_H

// Work-items and profiles of a group: LineLaunch._group in gpuvision/ranging/line_launch.py has the same numbers.
#if defined(METHOD_ML) || defined(ITEM_PER_PROFILE)
#define GROUP 64
#define PROFILES 64
#else
#define GROUP 256
#if CODE_BITS == 8 && !defined(ALONG_ROWS)
#define PROFILES 64
#elif defined(METHOD_CENTROID) && CODE_BITS == 32 && defined(ALONG_ROWS) && defined(REAL_IS_DOUBLE)
#define PROFILES 16
#else
#define PROFILES 32
#endif
#endif
#ifdef ITEM_PER_PROFILE
#define PER 1  // samples of a load
#else
#define PER (32 / CODE_BITS)  // samples of a load of 4 bytes
#endif
#if defined(ALONG_ROWS) && !defined(ITEM_PER_PROFILE)
#define HELD (GROUP == 64 ? 8 : PROFILES / 8)
#define HELD_STEP (PROFILES / HELD)  // from one profile of a work-item to its next one
#else
#define HELD PER
#define HELD_STEP 1
#endif
#define SLICES (GROUP * HELD / PROFILES)

// Type of a sample in local memory: structs of 4-byte numbers have no gaps. Mesa 22.3 (rusticl) loses members of 1 and 2
// bytes where it copies a struct.
#if CODE_BITS == 32
typedef CODE kept_code;
#else
typedef uint kept_code;
#endif

// Part of a profile: the samples of one work-item.
#if defined(METHOD_CENTROID) && CODE_BITS == 32
typedef Sums Part;

static inline Part empty_part(void) { return zero_sums(); }

// Add a sample. The moment is summed to twice the precision: fma gives the rounding error of k v.
static inline void add_to_part(Part *part, CODE x, int k, CODE threshold) {
    const reals v = over_threshold(x, threshold);
    part->peak = x > part->peak ? x : part->peak;
    // Not x * 0, which Mesa's compiler replaces by 0 (22.3 and 25.0), also for infinite x.
    part->poison = nan_where(mask_of(not_finite(to_reals(x))), part->poison);
    part->width += x > threshold ? 1 : 0;
    const reals moment = fma((reals)k, v, part->poison);
    add_exactly(&part->total, &part->total_error, v);
    add_exactly(&part->moment, &part->moment_error, moment);
    part->moment_error += fma((reals)k, v, -moment);
}

static inline void join_parts(Part *part, const Part *other) {
    part->peak = other->peak > part->peak ? other->peak : part->peak;
    part->poison += other->poison;
    part->width += other->width;
    add_exactly(&part->total, &part->total_error, other->total);
    add_exactly(&part->moment, &part->moment_error, other->moment);
    part->total_error += other->total_error;
    part->moment_error += other->moment_error;
}

#elif defined(METHOD_CENTROID)
typedef struct {
    big moment;
    uint total, width;
    kept_code peak;
} Part;

static inline Part empty_part(void) {
    const Part part = {0, 0, 0, 0};
    return part;
}

static inline void add_to_part(Part *part, CODE x, int k, CODE threshold) {
    const uint v = x > threshold ? x - threshold : 0;
    part->total += v;
    part->moment += (big)v * k;
    part->width += v > 0;
    part->peak = max(part->peak, (kept_code)x);
}

static inline void join_parts(Part *part, const Part *other) {
    part->total += other->total;
    part->moment += other->moment;
    part->width += other->width;
    part->peak = max(part->peak, other->peak);
}

#else
typedef struct {
    int at;  // index of the largest sample, the first one of equal samples; 0 without a sample above DARKEST
    kept_code level;
#if CODE_BITS == 32
    int not_finite;
#endif
} Part;

static inline Part empty_part(void) {
    Part part;
    part.at = 0;
    part.level = DARKEST;
#if CODE_BITS == 32
    part.not_finite = 0;
#endif
    return part;
}

static inline void add_to_part(Part *part, CODE x, int k, CODE threshold) {
    part->at = x > part->level ? k : part->at;
    part->level = x > part->level ? x : part->level;
#if CODE_BITS == 32
    part->not_finite |= not_finite_codes(x);
#endif
}

static inline void join_parts(Part *part, const Part *other) {
    if (other->level > part->level || (other->level == part->level && other->at < part->at)) {
        part->at = other->at;
        part->level = other->level;
    }
#if CODE_BITS == 32
    part->not_finite |= other->not_finite;
#endif
}
#endif

// Place of a work-item in its group.
typedef struct {
    int slice;    // number of the slice
    int profile;  // its first profile, counted from the first profile of the group
} Seat;

static inline Seat seat_of_item(void) {
    const int item = get_local_id(0);
#ifdef ALONG_ROWS
    const Seat seat = {item % SLICES, item / SLICES};
#else
    const Seat seat = {item / (PROFILES / HELD), item % (PROFILES / HELD) * HELD};
#endif
    return seat;
}

// Whether all loads of PER samples are aligned: the same for all work-items.
static inline int has_aligned_rows(const Profiles *frame, int columns) {
    return (((size_t)frame->first | (size_t)columns * sizeof(CODE)) & 3) == 0;
}

// Load PER neighbouring samples of a row, the first `count` of them if the row ends before; the rest repeats the last.
static inline void load_row_part(global const CODE *at, int is_aligned, int count, CODE *x) {
#if PER == 1
    x[0] = *at;
#else
    if (is_aligned) {
        // Shifts, not the elements of a vector: LLVM takes a vector of which single elements are used apart into loads of
        // single elements. Samples are in the order of their addresses: GPUs and x86 are little-endian.
        const uint word = *(global const uint *)at;
        for (int i = 0; i < PER; i++) x[i] = (CODE)(word >> (CODE_BITS * i));
    } else {
        for (int i = 0; i < PER; i++) x[i] = at[min(i, count - 1)];
    }
#endif
}

// Place of number i of the HELD profiles of a work-item in arrays (SLICES, PROFILES) of local memory.
static inline int held_place(Seat seat, int i) { return seat.slice * PROFILES + seat.profile + i * HELD_STEP; }

// Read the samples of this work-item; store HELD parts, one for each of its profiles.
static inline void read_parts(const Profiles *frame, int samples, int begin, Seat seat, local Part *parts) {
    const int first = begin + seat.profile;
#ifdef ALONG_ROWS
    const int is_aligned = has_aligned_rows(frame, frame->length);
    for (int held = 0; held < HELD; held++) {
        Part part = empty_part();
        const int number = first + held * HELD_STEP, end = number < samples ? frame->length : 0;
        global const CODE *row = frame->first + (long)number * frame->lane_stride;
        _Pragma("unroll 4") for (int k = seat.slice * PER; k < end; k += SLICES * PER) {
            CODE x[PER];
            load_row_part(row + k, is_aligned, end - k, x);
            for (int i = 0; i < PER; i++) {
                if (k + i < end) add_to_part(&part, x[i], k + i, frame->threshold);
            }
        }
        parts[held_place(seat, held)] = part;
    }
#else
    Part part[HELD];
    for (int i = 0; i < HELD; i++) part[i] = empty_part();
    const int is_aligned = has_aligned_rows(frame, samples), end = first < samples ? frame->length : 0;
    global const CODE *at = frame->first + first;
    _Pragma("unroll 4") for (int k = seat.slice; k < end; k += SLICES) {
        CODE x[PER];
        load_row_part(at + (long)k * frame->stride, is_aligned, samples - first, x);
        for (int i = 0; i < HELD; i++) add_to_part(&part[i], x[i], k, frame->threshold);
    }
    for (int i = 0; i < HELD; i++) parts[held_place(seat, i)] = part[i];
#endif
}

// Join the parts of a profile of the group.
static inline Part joined_part(local const Part *parts, int profile) {
    Part whole = parts[profile];
    for (int slice = 1; slice < SLICES; slice++) {
        const Part other = parts[slice * PROFILES + profile];
        join_parts(&whole, &other);
    }
    return whole;
}

#ifdef METHOD_CENTROID
static inline void finish_part(const Part *part, const Profiles *profiles, constant LineTable *table,
                               const Outputs *to, ulong first, int sample) {
#if CODE_BITS == 32
    Centroid centroid = centroid_of(part);
#else
    Centroid centroid = centroid_of_integers(part->total, part->moment, part->width, part->peak);
#endif
#ifdef NOISE
    set_variances(&centroid, profiles, table);
#endif
    finish_centroid(profiles, &centroid, table, to, first + sample, sample);
}
#else
static inline Peak peak_of_part(const Part *part, const Profiles *profiles) {
    Peak peak;
    peak.at = part->at;
    peak.level = part->level;
#if CODE_BITS == 32
    peak.not_finite = part->not_finite;
#else
    peak.not_finite = 0;
#endif
    peak.found = ~dark_lanes(profiles, peak.level);
    return peak;
}
#endif

#ifdef AMBIGUITY
// Store the highest samples outside the windows around the peaks `at`, among the samples of this work-item.
static inline void read_outside(const Profiles *frame, int samples, int begin, Seat seat, local const int *at,
                                local kept_code *outside) {
    const int first = begin + seat.profile;
#ifdef ALONG_ROWS
    const int is_aligned = has_aligned_rows(frame, frame->length);
    for (int held = 0; held < HELD; held++) {
        CODE level = DARKEST;
        const int number = first + held * HELD_STEP, end = number < samples ? frame->length : 0;
        const int peak = at[seat.profile + held * HELD_STEP];
        global const CODE *row = frame->first + (long)number * frame->lane_stride;
        for (int k = seat.slice * PER; k < end; k += SLICES * PER) {
            CODE x[PER];
            load_row_part(row + k, is_aligned, end - k, x);
            for (int i = 0; i < PER; i++) {
                const int counts = k + i < end && (int)abs(k + i - peak) > RADIUS;
                level = counts && x[i] > level ? x[i] : level;
            }
        }
        outside[held_place(seat, held)] = level;
    }
#else
    CODE highest[HELD];
    for (int i = 0; i < HELD; i++) highest[i] = DARKEST;
    const int is_aligned = has_aligned_rows(frame, samples), end = first < samples ? frame->length : 0;
    global const CODE *from = frame->first + first;
    for (int k = seat.slice; k < end; k += SLICES) {
        CODE x[PER];
        load_row_part(from + (long)k * frame->stride, is_aligned, samples - first, x);
        for (int i = 0; i < HELD; i++) {
            const int counts = (int)abs(k - at[seat.profile + i]) > RADIUS;
            highest[i] = counts && x[i] > highest[i] ? x[i] : highest[i];
        }
    }
    for (int i = 0; i < HELD; i++) outside[held_place(seat, i)] = highest[i];
#endif
}
#endif

// Local memory of a group.
typedef struct {
    Part parts[SLICES * PROFILES];
#ifdef AMBIGUITY
    int at[PROFILES];  // peaks
    kept_code outside[SLICES * PROFILES];
#endif
} Shared;

// Read the profiles of this work-group. All work-items reach the barriers.
static inline void read_group(const Profiles *frame, int samples, constant LineTable *table, const Outputs *to,
                              ulong first, local Shared *shared) {
    const Seat seat = seat_of_item();
    const int begin = (int)get_group_id(0) * PROFILES, item = get_local_id(0), sample = begin + item;
    const int finishes = item < PROFILES && sample < samples;
    read_parts(frame, samples, begin, seat, shared->parts);
    barrier(CLK_LOCAL_MEM_FENCE);
    const Profiles profiles = profiles_from(frame, finishes ? sample : 0);
#if defined(METHOD_CENTROID)
    if (!finishes) return;
    const Part whole = joined_part(shared->parts, item);
    finish_part(&whole, &profiles, table, to, first, sample);
#else
    Peak peak;
    Place place;
    if (finishes) {
        const Part whole = joined_part(shared->parts, item);
        peak = peak_of_part(&whole, &profiles);
        place = place_in_window(&profiles, &peak, table);
    }
    CODE second = DARKEST;
#ifdef AMBIGUITY
    if (finishes) shared->at[item] = peak.at;
    barrier(CLK_LOCAL_MEM_FENCE);
    read_outside(frame, samples, begin, seat, shared->at, shared->outside);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int slice = 0; finishes && slice < SLICES; slice++) {
        second = higher_of(second, (CODE)shared->outside[slice * PROFILES + item]);
    }
#endif
    if (finishes) finish_peak(&profiles, &peak, &place, second, table, to, first + sample, sample);
#endif
}

#endif
