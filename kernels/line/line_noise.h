// Variance of the centroid of a whole profile by the noise of its samples (METHOD_CENTROID, NOISE).
//
// The light of a line covers few samples. They are read again, outwards from the centroid until all light is found: the
// cost depends on the width of the line, not on the length of the profile. On a strip of columns the first samples of
// NOISE_GROUP times LANES neighbouring columns are read in one loop: fewer branches that the processor guesses wrong,
// and independent sums.
#ifndef LINE_NOISE_H
#define LINE_NOISE_H

#include "line/line_centroid.h"

#ifdef NOISE
// Fraction of the light at which the search for it ends. Integer samples sum to the total exactly. A float sample that
// exceeds the threshold by less than 4e-6 of the total counts as dark: the sums differ by rounding.
#if CODE_BITS == 32
#define NEARLY_ALL ((real)0.999996)
#else
#define NEARLY_ALL 1
#endif
#define NOISE_MARGIN 5  // samples on either side of the centroids that are read first: about the half width of a line
#define NOISE_STEP 4    // first growth of the range on either side, in samples; it doubles up to NOISE_ROWS

#if defined(VECTOR_VARIANT) && !defined(ALONG_ROWS)
#define NOISE_GROUP QUARTERS
#else
#define NOISE_GROUP 1
#endif

// Add the terms of the samples v of light at distances d from the centroid to the sum of lit_variance + gain v times
// d^2 over the samples above the threshold; the sum over the square of the total light is the variance of the centroid
// (centroid_variance() in line_window.h).
static inline reals add_noise(reals sum, reals v, reals d, constant LineTable *table) {
    const reals noise = table->lit_variance + table->gain * v;
    return sum + choose_reals(int_mask(v > 0), noise * d * d, 0);
}

// Divide the sum of the noise by the square of the total light.
static inline reals over_square(reals sum, const Centroid *centroid) {
#if CODE_BITS == 32
    return sum / centroid->total / centroid->total;  // a denormal total has no finite reciprocal
#else
    return sum * centroid->per_light * centroid->per_light;
#endif
}

#if defined(VECTOR_VARIANT) && defined(ALONG_ROWS)
// Sum of the noise of a row (add_noise), in vectors of 16 neighbouring samples: outwards from the centroid, until all
// light is found. The last vector of a row is moved back to end with the row; samples before it are not counted again.
static inline real row_noise(global const CODE *row, int length, CODE threshold, real position, real total,
                             constant LineTable *table) {
    const int middle = clamp((int)position / LANES * LANES, 0, length);
    int left = middle, right = middle;
    real found = 0;
    reals sum = 0;
    while (found < total * NEARLY_ALL && (left > 0 || right < length)) {
        reals light = 0;
        for (int side = 0; side < 2; side++) {
            const int begin = side ? left - LANES : right, at = clamp(begin, 0, length - LANES);
            const ints counts = int_mask(at + LANE_NUMBERS >= begin) & (ints)(begin >= 0 ? -1 : 0);
            const reals v = choose_reals(counts, over_threshold(*(global const codes_at *)(row + at), threshold), 0);
            sum = add_noise(sum, v, to_reals(LANE_NUMBERS) + (at - position), table);
            light += v;
        }
        found += sum_of(light);
        left = max(left - LANES, 0);
        right = min(right + LANES, length);
    }
    return sum_of(sum);
}

static inline void set_row_variances(Centroid *centroid, const Profiles *profiles,
                                     constant LineTable *table) {
    real position[LANES], total[LANES], noise[LANES];
    *(reals_at *)position = centroid->position;
    *(reals_at *)total = centroid->total;
    for (int i = 0; i < LANES; i++) {
        global const CODE *row = profiles->first + (long)i * profiles->lane_stride;
        noise[i] = row_noise(row, profiles->length, profiles->threshold, position[i], total[i], table);
    }
    centroid->variance = over_square(*(const reals_at *)noise, centroid);
}

#else

#define NOISE_ROWS 32  // most samples of a block

#if CODE_BITS == 32
// Sums of a block of samples: the noise (add_noise) and the light.
typedef struct {
    reals noise, light;
} NoiseSums;

static inline void clear_noise(NoiseSums *sums) { sums->noise = sums->light = 0; }

// Add sample k of every lane.
static inline void add_light(NoiseSums *sums, const Profiles *profiles, int k, const Centroid *centroid,
                             constant LineTable *table) {
    const reals v = over_threshold(sample_of(profiles, k), profiles->threshold);
    sums->noise = add_noise(sums->noise, v, (real)k - centroid->position, table);
    sums->light += v;
}

static inline reals noise_of(const NoiseSums *sums, const Centroid *centroid, int begin, int end,
                             constant LineTable *table) {
    return sums->noise;
}

static inline reals light_of(const NoiseSums *sums) { return sums->light; }
#else
// small_sums: type of the sum of the light of a block, and of the sums over the number of its lit samples. Bytes take
// 16 bits, half of the instructions: 32 * 255 < 2^16, and 32 * 33 * 34 / 6 < 2^16. The largest sum of a block, 65535 *
// 32 * 33 * 34 / 6, fits 31 bits.
#if defined(VECTOR_VARIANT) && CODE_BITS == 8
typedef ushort16 small_sums;
#define to_small_sums convert_ushort16
#define to_uints convert_uint16
#define to_signed convert_int16
#elif defined(VECTOR_VARIANT)
typedef uint16 small_sums;
#define to_small_sums convert_uint16
#define to_uints
#define to_signed as_int16
#else
typedef uint small_sums;
#define to_small_sums (uint)
#define to_uints
#define to_signed as_int
#endif

// Running sums of a block of samples (noise_of): of the light, and of the number of lit samples.
typedef struct {
    small_sums s, n, n_m, n_q;
    uints m, q;
} NoiseSums;

static inline void clear_noise(NoiseSums *sums) {
    sums->s = sums->n = sums->n_m = sums->n_q = 0;
    sums->m = sums->q = 0;
}

// Add sample k of every lane, without a multiplication.
static inline void add_light(NoiseSums *sums, const Profiles *profiles, int k, const Centroid *centroid,
                             constant LineTable *table) {
    const codes x = sample_of(profiles, k), threshold = profiles->threshold, none = 0, one = 1;
    const codes v = (x > threshold ? x : threshold) - threshold;
    sums->s += to_small_sums(v);
    sums->m += to_uints(sums->s);
    sums->q += sums->m;
    sums->n += to_small_sums(v > none ? one : none);
    sums->n_m += sums->n;
    sums->n_q += sums->n_m;
}

// Noise (add_noise) of the block begin <= k < end: the second moment about the centroid of the weights w_k,
// lit_variance for a lit sample plus gain times its light. With the distance j = end - k >= 1 of sample k from the end
// of the block, the running sums s += w, m += s, q += m end as
//     s = sum w,   m = sum j w,   q = sum j (j + 1) / 2 w,   so that sum j^2 w = 2 q - m,
// and about the centroid, a distance e from the end, sum (j - e)^2 w = e^2 s - 2 e m + 2 q - m. The sums are integers;
// the difference loses log2(e^2 / variance of the line) bits, 10 at most for a line that is 1 px wide.
static inline reals noise_of(const NoiseSums *sums, const Centroid *centroid, int begin, int end,
                             constant LineTable *table) {
    const reals lit = table->lit_variance, gain = table->gain, e = (real)end - centroid->position;
    const reals s = lit * to_reals(to_signed(sums->n)) + gain * to_reals(to_signed(sums->s));
    const reals m = lit * to_reals(to_signed(sums->n_m)) + gain * to_reals(as_ints(sums->m));
    const reals q = lit * to_reals(to_signed(sums->n_q)) + gain * to_reals(as_ints(sums->q));
    return e * (e * s - 2 * m) + (2 * q - m);
}

static inline reals light_of(const NoiseSums *sums) { return to_reals(to_signed(sums->s)); }
#endif

// First sample around the centroids of all lanes, and the number of samples around them.
static inline int first_around(const Centroid *centroid, int length, int *count) {
    // The position of a sum that overflows is not finite.
    const ints lit = int_mask(centroid->total > 0);
    const ints at = clamp(to_ints(centroid->position), (ints)0, (ints)(length - 1));
    const int low = lowest_lane(choose_ints(lit, at, length)), high = -lowest_lane(-choose_ints(lit, at, -1));
    *count = high - low + 2 * NOISE_MARGIN + 1;
    return low - NOISE_MARGIN;
}

// Add the samples begin <= k < end of every lane to the noise and to the light found.
static inline void add_block_noise(const Centroid *centroid, const Profiles *profiles, int begin, int end, reals *noise,
                                   reals *found, constant LineTable *table) {
    NoiseSums sums;
    clear_noise(&sums);
    for (int k = begin; k < end; k++) add_light(&sums, profiles, k, centroid, table);
    *noise += noise_of(&sums, centroid, begin, end, table);
    *found += light_of(&sums);
}

// Continue outwards from the samples first <= k < last until all light is found; return the noise.
static inline reals search_light(const Centroid *centroid, const Profiles *profiles, int first, int last, reals noise,
                                 reals found, constant LineTable *table) {
    int step = NOISE_STEP;
    while ((first > 0 || last < profiles->length) && any_lane(mask_of(found < centroid->total * NEARLY_ALL))) {
        const int begin = max(first - step, 0), end = min(last + step, profiles->length);
        add_block_noise(centroid, profiles, begin, first, &noise, &found, table);
        add_block_noise(centroid, profiles, last, end, &noise, &found, table);
        first = begin;
        last = end;
        step = min(2 * step, NOISE_ROWS);
    }
    return noise;
}

// Set the variances of the centroids of NOISE_GROUP times LANES neighbouring profiles.
static inline void set_variances(Centroid *centroids, const Profiles *profiles, constant LineTable *table) {
    Profiles part[NOISE_GROUP];
    NoiseSums sums[NOISE_GROUP];
    int first[NOISE_GROUP], rows = 0;
    for (int i = 0; i < NOISE_GROUP; i++) {
        int count;
        first[i] = first_around(&centroids[i], profiles->length, &count);
        rows = max(rows, count);
    }
    rows = min(rows, min(NOISE_ROWS, profiles->length));
    for (int i = 0; i < NOISE_GROUP; i++) {
        first[i] = clamp(first[i], 0, profiles->length - rows);
        part[i] = *profiles;
        part[i].first += (long)i * LANES * profiles->lane_stride;
        clear_noise(&sums[i]);
    }
    for (int k = 0; k < rows; k++) {
        _Pragma("unroll") for (int i = 0; i < NOISE_GROUP; i++) {
            add_light(&sums[i], &part[i], first[i] + k, &centroids[i], table);
        }
    }
    for (int i = 0; i < NOISE_GROUP; i++) {
        reals noise = noise_of(&sums[i], &centroids[i], first[i], first[i] + rows, table);
        const reals found = light_of(&sums[i]);
        if (any_lane(mask_of(found < centroids[i].total * NEARLY_ALL))) {
            noise = search_light(&centroids[i], &part[i], first[i], first[i] + rows, noise, found, table);
        }
        centroids[i].variance = over_square(noise, &centroids[i]);
    }
}
#endif
#endif
#endif
