// Position sensitive device: a pair of currents -> position, total, status, predicted noise.
//
// The currents divide inversely to the distances from the electrodes: u = (L/2)(right - left)/(right + left).
// Inputs are pairs (left, right) side by side, or under PLANAR all left values before all right ones. CODE is their
// type; AMPERE brings it to amperes. WITH_... say which outputs exist, in the order of the arguments.
#include "lanes.h"
#include "sheet.h"
#include "status.h"

// The parameters, as PsdReadout packs them.
#define HALF_LENGTH 0   // L/2 times the correction for the load resistors [m]
#define LIMIT 1         // what |right - left| / total is at the strip's ends, load resistors considered
#define MINIMUM 2       // of the total [A]
#define SATURATION 3    // of either channel, dark level included [A]
#define AMPERE 4        // per unit of the input
#define DARK_LEFT 5     // [A]
#define DARK_RIGHT 6    // [A]
#define RIGHT_GAIN 7    // brings the right channel to the left one's gain
#define INDEPENDENT 8   // noise of each channel, squared [A^2]
#define OPPOSED 9       // noise that leaves one electrode and enters the other, squared [A^2]
#define COMMON 10       // variance of the place times the total: a spot of finitely many electrons [m^2 A]

#ifdef STRIP
#define SAMPLES_PER_STRIP 4096
typedef CODE16 codes_at __attribute__((aligned(sizeof(CODE))));
#ifdef REAL_IS_DOUBLE
#define to_reals convert_double16
#else
#define to_reals convert_float16
#endif
#else
typedef CODE codes_at;
#define to_reals (real)
#endif

inline reals load(global const CODE *codes) { return to_reals(*(global const codes_at *)codes); }

inline void load_pair(global const CODE *currents, int sample, int samples, reals *left, reals *right) {
#if defined(PLANAR)
    *left = load(currents + sample);
    *right = load(currents + samples + sample);
#elif defined(STRIP)
    const reals low = load(currents + 2 * sample), high = load(currents + 2 * sample + LANES);
    *left = (reals)(low.even, high.even);
    *right = (reals)(low.odd, high.odd);
#else
    *left = load(currents + 2 * sample);
    *right = load(currents + 2 * sample + 1);
#endif
}

#ifdef LINEARITY
// The strip's own correction at place u, linear between knots that divide the strip evenly.
inline real correction(real u, int strip, global const real *table, int knots, real half_length) {
    const real place = (u / half_length + 1) * (knots - 1) / 2;
    const int knot = clamp((int)place, 0, knots - 2);
    global const real *at = table + strip * knots + knot;
    return at[0] + (place - knot) * (at[1] - at[0]);
}

inline reals corrected(reals u, int sample, int strips, global const real *table, int knots, real half_length) {
#ifdef STRIP
    real lane[LANES];
    vstore16(u, 0, lane);
    for (int k = 0; k < LANES; k++) lane[k] += correction(lane[k], (sample + k) % strips, table, knots, half_length);
    return vload16(0, lane);
#else
    return u + correction(u, sample % strips, table, knots, half_length);
#endif
}
#endif

#ifdef WITH_SHEET
// The strips' numbers are the sheet's other sensor coordinate.
inline reals strip_numbers(int sample, int strips) {
#ifdef STRIP
    const int16 at = sample + (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    return LANED(convert_real)(at % strips);
#else
    return (real)(sample % strips);
#endif
}
#endif

#ifdef WITH_SIGMA
// Standard deviation of the place: independent noise grows towards the ends, opposed noise acts alike everywhere,
// common noise (the electrons of one spot divide together) leaves only the spot's own width.
inline reals sigma_of(reals balance, reals total, constant real *p) {
    const reals spread = p[INDEPENDENT] * (1 + balance * balance) / 2 + p[OPPOSED];
    return sqrt(4 * p[HALF_LENGTH] * p[HALF_LENGTH] * spread / (total * total) + p[COMMON] / total);
}
#endif

// Reads the sample(s) at `sample` and writes what is asked for there.
inline void read_out(global const CODE *currents, global real *position, global real *total, global uchar *status,
                     global real *sigma, global real *g, global real *h, constant real *p, int samples, int sample,
                     global const real *table, int strips, int knots, constant real *sheet) {
    reals left, right;
    load_pair(currents, sample, samples, &left, &right);
    left *= p[AMPERE];
    right *= p[AMPERE];
    const masks saturated = mask_of(left >= p[SATURATION]) | mask_of(right >= p[SATURATION]);
    left -= p[DARK_LEFT];
    right = (right - p[DARK_RIGHT]) * p[RIGHT_GAIN];
    const reals sum = left + right, difference = right - left;
    const masks wrong = LANED(not_finite)(sum);  // infinite minus infinite is NaN: the sum tells for both channels
    const masks dark = mask_of(sum <= p[MINIMUM]) & ~wrong;
    const masks outside = mask_of(fabs(difference) > p[LIMIT] * sum) & ~dark & ~wrong;
    const masks untrusted = saturated | wrong | dark | outside;
    const reals balance = difference / sum;
    masks flags = (wrong & STATUS_NOT_FINITE) | (dark & STATUS_DARK) | (saturated & STATUS_SATURATED) |
                  (outside & STATUS_OUT_OF_RANGE);
    reals u = p[HALF_LENGTH] * balance;
#ifdef LINEARITY
    u = corrected(zero_where(untrusted, u), sample, strips, table, knots, p[HALF_LENGTH] * p[LIMIT]);
#endif
    u = nan_where(untrusted, u);
#ifdef WITH_POSITION
    store_reals(u, position + sample);
#endif
#ifdef WITH_TOTAL
    store_reals(sum, total + sample);
#endif
#ifdef WITH_SIGMA
    store_reals(nan_where(untrusted, sigma_of(balance, sum, p)), sigma + sample);
#endif
#ifdef WITH_SHEET
    reals at_g, at_h;
    const bytes lost = LANED(sheet_point)(u, strip_numbers(sample, strips), sheet, &at_g, &at_h);
    // The sheet sees NaN where the reading was untrusted: the reason is the reading's own.
    flags |= LANED(convert_bits)(lost) & ~untrusted;
    store_reals(at_g, g + sample);
    store_reals(at_h, h + sample);
#endif
#ifdef WITH_STATUS
    store_bytes(convert_bytes(flags), status + sample);
#endif
}

kernel void psd_readout(global const CODE *currents, global real *position, global real *total, global uchar *status,
                        global real *sigma, global real *g, global real *h, constant real *p, int samples,
                        global const real *table, int strips, int knots, constant real *sheet) {
#ifdef STRIP
    // The last strip takes the remainder too, and its last vector overlaps the one before: no sample is left over,
    // and no other work-item writes there.
    const int first = get_global_id(0) * SAMPLES_PER_STRIP;
    const int end = get_global_id(0) + 1 == get_global_size(0) ? samples : first + SAMPLES_PER_STRIP;
    for (int sample = first; sample < end; sample += LANES)
        read_out(currents, position, total, status, sigma, g, h, p, samples, min(sample, end - LANES), table, strips,
                 knots, sheet);
#else
    const int sample = get_global_id(0);
    read_out(currents, position, total, status, sigma, g, h, p, samples, sample, table, strips, knots, sheet);
#endif
}
