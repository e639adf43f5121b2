// Normal random numbers by counter: pixel and frame in, one standard normal number out, without a state.
//
// Philox2x32-10 (Salmon, Moraes, Dror and Shaw, Parallel random numbers: as easy as 1, 2, 3, SC 2011) turns the counter
// (pixel, frame) and a key into two 32-bit numbers a, b. Box and Muller's transform makes of them
//
//     z = sqrt(-2 ln((a + 1/2) 2^-32)) cos(pi b 2^-31),   b as a signed number.
//
// Logarithm and cosine are polynomials: the same operations, and nearly the same bits, on every device and in both
// kernel variants. |z| is at most 6.8.
#ifndef NORMAL_NUMBERS_H
#define NORMAL_NUMBERS_H

#include "common/lanes.h"

#define PHILOX_ROUNDS 10
#define PHILOX_MULTIPLIER 0xD256D193u
#define PHILOX_WEYL 0x9E3779B9u

#ifdef VECTOR_VARIANT
#define to_ulongs convert_ulong16
#define low_words convert_uint16
#define as_signed as_int16
#define unsigned_reals convert_float16
typedef ulong16 ulongs;
#else
#define to_ulongs (ulong)
#define low_words (uint)
#define as_signed as_int
#define unsigned_reals (float)
typedef ulong ulongs;
#endif

// Ten rounds of Philox on the counters (*a, *b).
INLINE void philox(uints *a, uints *b, uint key) {
    _Pragma("unroll") for (int round = 0; round < PHILOX_ROUNDS; round++) {
        const ulongs product = to_ulongs(*a) * (ulong)PHILOX_MULTIPLIER;
        *a = low_words(product >> 32) ^ key ^ *b;
        *b = low_words(product);
        key += PHILOX_WEYL;
    }
}

// -2 ln((a + 1/2) 2^-32). The mantissa lies in [1/sqrt(2), sqrt(2)); ln(1 + t) = 2 artanh(t / (2 + t)), whose series in
// q = (t / (2 + t))^2 <= 0.0295 is exact to 3e-8 with four terms.
INLINE reals minus_two_logs(uints a) {
    const reals number = unsigned_reals(a) + 0.5f;
    const ints shifted = as_masks(number) - 0x3f3504f3;  // bits of sqrt(1/2)
    const ints exponent = shifted >> 23;
    const reals mantissa = as_reals((shifted & 0x007fffff) + 0x3f3504f3);
    const reals s = (mantissa - 1) / (mantissa + 1), q = s * s;
    const reals log_mantissa = s * (2 + q * (0.66666667f + q * (0.4f + q * 0.28571429f)));
    const reals minus_log = (reals)22.18070978f - to_reals(exponent) * 0.69314718f - log_mantissa;  // 32 ln 2
    return lane_max(2 * minus_log, (reals)0);
}

// cos(pi b 2^-31) = sin(pi y) with y = 1/2 - |b| 2^-31: Taylor's polynomial of degree 11, exact to 6e-8.
INLINE reals cosines(uints b) {
    const reals t = to_reals(as_signed(b)) * 4.656612873e-10f;
    const reals y = 0.5f - lane_max(t, -t), q = y * y;
    return y * (3.14159265f + q * (-5.16771278f + q * (2.55016404f + q * (-0.59926453f +
               q * (0.08214589f - q * 0.00737043f)))));
}

// One standard normal number for each pixel of a frame.
INLINE reals normal_numbers(uints pixel, uint frame, uint key) {
    uints a = pixel, b = frame;
    philox(&a, &b, key);
    return sqrt(minus_two_logs(a)) * cosines(b);
}

#endif
