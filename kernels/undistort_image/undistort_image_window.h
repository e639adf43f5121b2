// Sixteen adjacent output pixels at once, with all taps inside the image.
//
// A lens is smooth: the source positions of 16 adjacent pixels lie in a window of a few rows and at most 32 samples per
// row. Each row of the window is loaded as one or two vectors, and a permutation in registers selects the taps of each
// pixel. This replaces 16 scalar loads for each tap. Positions that are spread widely (SCATTERED) take these loads.
#ifndef UNDISTORT_IMAGE_WINDOW_H
#define UNDISTORT_IMAGE_WINDOW_H

// Span of the pixels' left taps in a row.
#define NARROW 0     // 16 samples
#define WIDE 1       // 32 samples
#define SCATTERED 2  // any

typedef CODE16 codes;
typedef CODE16 codes_at __attribute__((aligned(sizeof(CODE))));

#define INLINED static inline __attribute__((always_inline))

#ifdef BICUBIC
DEFINE_CUBIC(CubicWeights16, float16, cubic_weights16)
typedef CubicWeights16 Across;
#define WEIGHTS cubic_weights16
#else
typedef float16 Across;
#define WEIGHTS
#endif

INLINED float16 load_codes(global const CODE *from) { return convert_float16(*(global const codes_at *)from); }

// Permute a vector: element i is v[at[i]]. Compilers emit one permutation instruction if the indices are computed in
// the same basic block. PoCL splits shuffle() into scalar moves.
INLINED float16 permuted(float16 v, int16 at) {
    return (float16)(v[at.s0], v[at.s1], v[at.s2], v[at.s3], v[at.s4], v[at.s5], v[at.s6], v[at.s7], v[at.s8],
                     v[at.s9], v[at.sa], v[at.sb], v[at.sc], v[at.sd], v[at.se], v[at.sf]);
}

// Load 16 samples at any offsets.
INLINED float16 gathered(global const CODE *from, int16 at) {
    return (float16)(from[at.s0], from[at.s1], from[at.s2], from[at.s3], from[at.s4], from[at.s5], from[at.s6],
                     from[at.s7], from[at.s8], from[at.s9], from[at.sa], from[at.sb], from[at.sc], from[at.sd],
                     from[at.se], from[at.sf]);
}

// Load the samples at offsets `place` of one row of the window: 0 to 15 (NARROW), 0 to 31 (WIDE) or any (SCATTERED).
INLINED float16 load_taps(const int span, global const CODE *from, int16 place) {
    if (span == SCATTERED) return gathered(from, place);
    const float16 low = permuted(load_codes(from), place & 15);
    return span == WIDE ? (place > 15 ? permuted(load_codes(from + 16), place & 15) : low) : low;
}

// Interpolate along one row of the window.
INLINED float16 row_sum(const int span, global const CODE *from, int16 place, Across w) {
#ifdef BICUBIC
    return w.before * load_taps(span, from - CHANNELS, place) + w.at * load_taps(span, from, place) +
           w.after * load_taps(span, from + CHANNELS, place) + w.last * load_taps(span, from + 2 * CHANNELS, place);
#else
    const float16 left = load_taps(span, from, place);
    return left + w * (load_taps(span, from + CHANNELS, place) - left);
#endif
}

// Interpolate across the rows of the window; `part` is the fraction between rows.
INLINED float16 weighted_sum(const int span, global const CODE *from, size_t pitch, int16 place, Across w,
                             float16 part) {
#ifdef BICUBIC
    const CubicWeights16 y = cubic_weights16(part);
    return y.before * row_sum(span, from - pitch, place, w) + y.at * row_sum(span, from, place, w) +
           y.after * row_sum(span, from + pitch, place, w) + y.last * row_sum(span, from + 2 * pitch, place, w);
#else
    const float16 upper = row_sum(span, from, place, w);
    return upper + part * (row_sum(span, from + pitch, place, w) - upper);
#endif
}

// Round, clamp and store 16 samples. Only bicubic results can exceed the range of the type.
INLINED void store_codes(float16 value, global CODE *to) {
#ifdef MAX_CODE
#ifdef BICUBIC
    value = value > 0 ? value : (float16)0;
    value = value < MAX_CODE ? value : (float16)MAX_CODE;
#endif
    const codes made = CONVERT_CODES(as_int16(value + TO_WHOLE) & (int)MAX_CODE);
#else
    const codes made = value;
#endif
#ifdef PAST_CACHES
    // A non-temporal store of whole cache lines does not read them first.
    if (aligned_to(sizeof(codes), to)) {
        __builtin_nontemporal_store(made, (global codes *)to);
        return;
    }
#endif
    *(global codes_at *)to = made;
}

// Interpolate sixteen samples at positions (x, y) relative to `from`, and store them.
//
// `bands` is the number of intervals between adjacent rows that contain the positions; `single_band`: there is one
// band. `channel` is the channel of each sample. Rounding can place a position just beyond the window: its column is
// clamped to the last one, and the fraction is then about 1.
INLINED void interpolate_samples(const int span, const int single_band, global const CODE *from, size_t pitch,
                                 float16 x, float16 y, int bands, int16 channel, global CODE *to) {
    const int16 last = (span == NARROW ? 16 / CHANNELS : (33 - CHANNELS) / CHANNELS) - 1, before = convert_int16(x);
    const int16 column = span == SCATTERED ? before : (before < last ? before : last);
    const Across w = WEIGHTS(x - convert_float16(column));
    const int16 place = CHANNELS * column + channel;
    const int16 below = convert_int16(y);
    if (span == SCATTERED) {
        store_codes(weighted_sum(span, from, pitch, (int)pitch * below + place, w, y - convert_float16(below)), to);
        return;
    }
    if (single_band) {
        store_codes(weighted_sum(span, from, pitch, place, w, y), to);
        return;
    }
    float16 made = 0;
    const int16 band_of = below < bands - 1 ? below : (int16)(bands - 1);
    for (int band = 0; band < bands; band++, from += pitch) {
        // Indices of lanes outside the band are set to 0: the indices then depend on the band and are computed in the
        // loop, as the permutation instruction requires.
        const int16 here = band_of == band;
        made = here ? weighted_sum(span, from, pitch, place & here, w, y - band) : made;
    }
    store_codes(made, to);
}

// Compute sixteen pixels. With three channels these are 48 samples in three vectors, each with a separate window that
// starts `starts` pixels after `from`.
INLINED void interpolate_window(const int span, const int single_band, global const CODE *from, size_t pitch, float16 x,
                                float16 y, int bands, int3 starts, global CODE *to) {
#if CHANNELS == 3
    const int16 lanes = (int16)(0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0);
    const int16 later = (int16)(1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1);
    const int16 latest = (int16)(2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2);
    const float16 first = x.s0001112223334445 - starts.x, second = x.s55666777888999aa - starts.y;
    const float16 third = x.sabbbcccdddeeefff - starts.z;
    interpolate_samples(span, single_band, from + 3 * starts.x, pitch, first, y.s0001112223334445, bands, lanes, to);
    interpolate_samples(span, single_band, from + 3 * starts.y, pitch, second, y.s55666777888999aa, bands, later,
                        to + 16);
    interpolate_samples(span, single_band, from + 3 * starts.z, pitch, third, y.sabbbcccdddeeefff, bands, latest,
                        to + 32);
#else
    interpolate_samples(span, single_band, from, pitch, x, y, bands, 0, to);
#endif
}

#endif
