// Sixteen neighbouring output pixels at once: a lens is smooth, so what they show lies in a window of a few rows and at
// most 32 samples across. Whole rows of the window are loaded, and a permutation in registers picks each pixel's taps:
// no load per tap.
#ifndef UNDISTORT_IMAGE_WINDOW_H
#define UNDISTORT_IMAGE_WINDOW_H

#define NARROW (16 / CHANNELS)            // pixels across, left taps only
#define WIDE ((32 - CHANNELS + 1) / CHANNELS)

typedef CODE16 codes;
typedef CODE16 codes_at __attribute__((aligned(sizeof(CODE))));

#define INLINED __attribute__((always_inline)) inline

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

INLINED float16 pick(const int wide, global const CODE *from, int16 at, int16 high) {
    const float16 low = permuted(load_codes(from), at);
    return wide ? (high ? permuted(load_codes(from + 16), at) : low) : low;
}

// The weighted sum along a row of the window.
INLINED float16 line_of(const int wide, global const CODE *from, int16 at, int16 high, Across w) {
#ifdef BICUBIC
    return w.before * pick(wide, from - CHANNELS, at, high) + w.at * pick(wide, from, at, high) +
           w.after * pick(wide, from + CHANNELS, at, high) + w.last * pick(wide, from + 2 * CHANNELS, at, high);
#else
    const float16 left = pick(wide, from, at, high);
    return left + w * (pick(wide, from + CHANNELS, at, high) - left);
#endif
}

INLINED float16 lines_of(const int wide, global const CODE *from, size_t pitch, int16 place, Across w, float16 part) {
    const int16 at = place & 15, high = place > 15;
#ifdef BICUBIC
    const CubicWeights16 y = cubic_weights16(part);
    return y.before * line_of(wide, from - pitch, at, high, w) + y.at * line_of(wide, from, at, high, w) +
           y.after * line_of(wide, from + pitch, at, high, w) + y.last * line_of(wide, from + 2 * pitch, at, high, w);
#else
    const float16 upper = line_of(wide, from, at, high, w);
    return upper + part * (line_of(wide, from + pitch, at, high, w) - upper);
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

// Sixteen samples of a window: places (x, y) from `from` on, within the window but for rounding. `bands` is the number
// of row gaps that they fall into; `channel` of each sample.
INLINED void sixteen(const int wide, const int flat, global const CODE *from, size_t pitch, float16 x, float16 y,
                     int bands, int16 channel, global CODE *to) {
    const int16 last = (wide ? WIDE : NARROW) - 1;
    const int16 whole = convert_int16(x), column = whole < last ? whole : last;
    const Across w = WEIGHTS(x - convert_float16(column));
    const int16 place = CHANNELS * column + channel;
    if (flat) {
        store_codes(lines_of(wide, from, pitch, place, w, y), to);
        return;
    }
    float16 made = 0;
    const int16 below = convert_int16(y), band_of = below < bands - 1 ? below : (int16)(bands - 1);
    for (int band = 0; band < bands; band++, from += pitch) {
        // The others look at the window's first sample, so that the indices are made anew for each band.
        const int16 here = band_of == band;
        made = here ? lines_of(wide, from, pitch, place & here, w, y - band) : made;
    }
    store_codes(made, to);
}

// What sixteen pixels show. Three channels take three vectors, whose windows begin `starts` pixels behind `from`.
INLINED void window(const int wide, const int flat, global const CODE *from, size_t pitch, float16 x, float16 y,
                    int bands, int3 starts, global CODE *to) {
#if CHANNELS == 3
    const int16 lanes = (int16)(0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0);
    const int16 later = (int16)(1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1);
    const int16 latest = (int16)(2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2);
    sixteen(wide, flat, from + 3 * starts.x, pitch, x.s0001112223334445 - starts.x, y.s0001112223334445, bands, lanes,
            to);
    sixteen(wide, flat, from + 3 * starts.y, pitch, x.s55666777888999aa - starts.y, y.s55666777888999aa, bands, later,
            to + 16);
    sixteen(wide, flat, from + 3 * starts.z, pitch, x.sabbbcccdddeeefff - starts.z, y.sabbbcccdddeeefff, bands, latest,
            to + 32);
#else
    sixteen(wide, flat, from, pitch, x, y, bands, 0, to);
#endif
}

#endif
