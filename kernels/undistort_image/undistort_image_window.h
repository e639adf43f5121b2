// Sixteen neighbouring output pixels at once, all of whose taps lie within the image. A lens is smooth, so these lie in
// a window of a few rows and at most 32 samples across: whole rows of it are loaded, and a permutation in registers
// picks each pixel's taps. Only pixels scattered more widely take a load per tap.
#ifndef UNDISTORT_IMAGE_WINDOW_H
#define UNDISTORT_IMAGE_WINDOW_H

// How far the pixels lie apart, their left taps alone.
#define NARROW 0     // 16 samples
#define WIDE 1       // 32 samples
#define SCATTERED 2  // anywhere

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

// Compilers know this as one instruction, but only where the indices are made in the same straight stretch of code:
// unlike shuffle(), which PoCL takes apart.
INLINED float16 permuted(float16 v, int16 at) {
    return (float16)(v[at.s0], v[at.s1], v[at.s2], v[at.s3], v[at.s4], v[at.s5], v[at.s6], v[at.s7], v[at.s8],
                     v[at.s9], v[at.sa], v[at.sb], v[at.sc], v[at.sd], v[at.se], v[at.sf]);
}

INLINED float16 gathered(global const CODE *from, int16 at) {
    return (float16)(from[at.s0], from[at.s1], from[at.s2], from[at.s3], from[at.s4], from[at.s5], from[at.s6],
                     from[at.s7], from[at.s8], from[at.s9], from[at.sa], from[at.sb], from[at.sc], from[at.sd],
                     from[at.se], from[at.sf]);
}

INLINED float16 pick(const int spread, global const CODE *from, int16 place) {
    if (spread == SCATTERED) return gathered(from, place);
    const float16 low = permuted(load_codes(from), place & 15);
    return spread == WIDE ? (place > 15 ? permuted(load_codes(from + 16), place & 15) : low) : low;
}

// The weighted sum along a row of the window.
INLINED float16 line_of(const int spread, global const CODE *from, int16 place, Across w) {
#ifdef BICUBIC
    return w.before * pick(spread, from - CHANNELS, place) + w.at * pick(spread, from, place) +
           w.after * pick(spread, from + CHANNELS, place) + w.last * pick(spread, from + 2 * CHANNELS, place);
#else
    const float16 left = pick(spread, from, place);
    return left + w * (pick(spread, from + CHANNELS, place) - left);
#endif
}

INLINED float16 lines_of(const int spread, global const CODE *from, size_t pitch, int16 place, Across w, float16 part) {
#ifdef BICUBIC
    const CubicWeights16 y = cubic_weights16(part);
    return y.before * line_of(spread, from - pitch, place, w) + y.at * line_of(spread, from, place, w) +
           y.after * line_of(spread, from + pitch, place, w) + y.last * line_of(spread, from + 2 * pitch, place, w);
#else
    const float16 upper = line_of(spread, from, place, w);
    return upper + part * (line_of(spread, from + pitch, place, w) - upper);
#endif
}

INLINED void store_codes(float16 value, global CODE *to) {
#ifdef LARGEST
#ifdef BICUBIC
    value = value > 0 ? value : (float16)0;
    value = value < LARGEST ? value : (float16)LARGEST;
#endif
    const codes made = CONVERT_CODES(as_int16(value + TO_WHOLE) & (int)LARGEST);
#else
    const codes made = value;
#endif
#ifdef PAST_CACHES
    // A line that is written whole need not be read first.
    if (aligned_to(sizeof(codes), to)) {
        __builtin_nontemporal_store(made, (global codes *)to);
        return;
    }
#endif
    *(global codes_at *)to = made;
}

// Sixteen samples: places (x, y) from `from` on, within the window but for rounding. `bands` is the number of row gaps
// that they fall into; `channel` of each sample.
INLINED void sixteen(const int spread, const int flat, global const CODE *from, size_t pitch, float16 x, float16 y,
                     int bands, int16 channel, global CODE *to) {
    const int16 last = (spread == NARROW ? 16 / CHANNELS : (33 - CHANNELS) / CHANNELS) - 1, before = convert_int16(x);
    const int16 column = spread == SCATTERED ? before : (before < last ? before : last);
    const Across w = WEIGHTS(x - convert_float16(column));
    const int16 place = CHANNELS * column + channel;
    const int16 below = convert_int16(y);
    if (spread == SCATTERED) {
        store_codes(lines_of(spread, from, pitch, (int)pitch * below + place, w, y - convert_float16(below)), to);
        return;
    }
    if (flat) {
        store_codes(lines_of(spread, from, pitch, place, w, y), to);
        return;
    }
    float16 made = 0;
    const int16 band_of = below < bands - 1 ? below : (int16)(bands - 1);
    for (int band = 0; band < bands; band++, from += pitch) {
        // The others look at the window's first sample, so that the indices are made anew for each band.
        const int16 here = band_of == band;
        made = here ? lines_of(spread, from, pitch, place & here, w, y - band) : made;
    }
    store_codes(made, to);
}

// What sixteen pixels show. Three channels take three vectors, whose windows begin `starts` pixels behind `from`.
INLINED void window(const int spread, const int flat, global const CODE *from, size_t pitch, float16 x, float16 y,
                    int bands, int3 starts, global CODE *to) {
#if CHANNELS == 3
    const int16 lanes = (int16)(0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0);
    const int16 later = (int16)(1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1);
    const int16 latest = (int16)(2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2);
    const float16 first = x.s0001112223334445 - starts.x, second = x.s55666777888999aa - starts.y;
    const float16 third = x.sabbbcccdddeeefff - starts.z;
    sixteen(spread, flat, from + 3 * starts.x, pitch, first, y.s0001112223334445, bands, lanes, to);
    sixteen(spread, flat, from + 3 * starts.y, pitch, second, y.s55666777888999aa, bands, later, to + 16);
    sixteen(spread, flat, from + 3 * starts.z, pitch, third, y.sabbbcccdddeeefff, bands, latest, to + 32);
#else
    sixteen(spread, flat, from, pitch, x, y, bands, 0, to);
#endif
}

#endif
