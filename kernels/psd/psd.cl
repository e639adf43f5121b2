// Position sensitive device: a pair of currents -> position, total, status, predicted noise.
//
// The currents divide inversely to the distances from the electrodes: u = (L/2)(right - left)/(right + left).
// Inputs are pairs (left, right) side by side, or under PLANAR all left values before all right ones. CODE is their
// type, and the unit of everything until it is written out. WITH_... say which outputs are wanted.
#include "common/lanes.h"
#include "common/sheet.h"
#include "common/status.h"

// The parameters, as PsdReadout packs them, in the input's unit where none is given.
#define HALF_LENGTH 0  // L/2 times the correction for the load resistors [m]
#define LIMIT 1        // what |right - left| / sum is at the strip's ends, load resistors considered
#define MINIMUM 2      // of the sum
#define SATURATION 3   // of either channel, dark level included
#define AMPERE 4       // per unit of the input
#define DARK_LEFT 5
#define DARK_RIGHT 6
#define RIGHT_GAIN 7   // brings the right channel to the left one's gain
#define INDEPENDENT 8  // noise of each channel, squared
#define OPPOSED 9      // noise that leaves one electrode and enters the other, squared
#define COMMON 10      // variance of the place times the sum: a spot of finitely many electrons [m^2]

#ifdef VECTOR_VARIANT
#define BLOCK 16  // vectors that are judged together
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
#elif defined(VECTOR_VARIANT)
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
#ifdef VECTOR_VARIANT
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
#ifdef VECTOR_VARIANT
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
inline reals sigma_of(reals balance, reals sum, constant real *p) {
    const reals spread = p[INDEPENDENT] * (1 + balance * balance) / 2 + p[OPPOSED];
    return sqrt(4 * p[HALF_LENGTH] * p[HALF_LENGTH] * spread / (sum * sum) + p[COMMON] / sum);
}
#endif

// Why samples are not good; the weightiest reason comes last. Codes without a dark level are finite and not negative.
inline masks reasons(reals left, reals right, masks saturated, reals sum, reals difference, constant real *p) {
    masks flags = STATUS_OK;
#ifdef SIGNED
    flags = fabs(difference) > p[LIMIT] * sum ? (masks)STATUS_OUT_OF_RANGE : flags;
#endif
    flags = sum <= p[MINIMUM] ? (masks)STATUS_LOW_SIGNAL : flags;
    flags |= saturated & STATUS_SATURATED;
#ifdef SIGNED
    flags = LANED(not_finite)(left) | LANED(not_finite)(right) ? (masks)STATUS_NOT_FINITE : flags;
#endif
    return flags;
}

// What is known of a block's samples so far: enough to tell whether all are good.
#ifdef SIGNED
typedef masks Verdict;
#define UNBLEMISHED 0
inline int is_blemished(Verdict bad, constant real *p) { return any_lane(bad); }
#else
// Of codes, which are numbers, the extremes suffice: in vectors they cost less than masks.
typedef struct {
    reals least_sum, largest_code;
} Verdict;
#define UNBLEMISHED {MAXFLOAT, 0}
inline int is_blemished(Verdict worst, constant real *p) {
    return any_lane(mask_of(worst.least_sum <= p[MINIMUM]) | mask_of(worst.largest_code >= p[SATURATION]));
}
#endif

// Reads the sample(s) at `sample`, writes what is asked for there, and adds to the verdict. Unless it is told to be
// careful it writes as if all were good: the caller comes again where some are not.
inline void read_out(const int careful, int sample, Verdict *verdict, global const CODE *currents,
                     global real *position, global real *total, global uchar *status, global real *sigma,
                     global real *g, global real *h, constant real *p, int samples, global const real *table,
                     int strips, int knots, constant real *sheet) {
    reals left, right;
    load_pair(currents, sample, samples, &left, &right);
    const reals larger = left > right ? left : right;
    const masks saturated = mask_of(larger >= p[SATURATION]);
#ifdef SIGNED
    masks good = mask_of(left < p[SATURATION]) & mask_of(right < p[SATURATION]);
#else
    masks good = ~saturated;
#endif
#ifdef DARK_LEVEL
    left -= p[DARK_LEFT];
    right -= p[DARK_RIGHT];
#endif
#ifdef GAIN
    right *= p[RIGHT_GAIN];
#endif
    const reals sum = left + right, difference = right - left;
    // Comparisons that hold: NaN fails them, and the saturation limit keeps infinity and an overflowing sum out.
    good &= mask_of(sum > p[MINIMUM]);
#ifdef SIGNED
    good &= mask_of(fabs(difference) <= p[LIMIT] * sum);
    *verdict |= ~good;
#else
    verdict->least_sum = sum < verdict->least_sum ? sum : verdict->least_sum;
    verdict->largest_code = larger > verdict->largest_code ? larger : verdict->largest_code;
#endif
    const reals balance = difference / sum;
    reals u = p[HALF_LENGTH] * balance;
    masks flags = STATUS_OK;
    if (careful) {
        flags = reasons(left, right, saturated, sum, difference, p);
        u = nan_where(~good, u);
    }
#ifdef LINEARITY
    u = nan_where(~good, corrected(zero_where(~good, u), sample, strips, table, knots, p[HALF_LENGTH] * p[LIMIT]));
#endif
#ifdef WITH_POSITION
    store_reals(u, position + sample);
#endif
#ifdef WITH_TOTAL
    store_reals(sum * p[AMPERE], total + sample);
#endif
#ifdef WITH_SIGMA
    store_reals(nan_where(~good, sigma_of(balance, sum, p)), sigma + sample);
#endif
#ifdef WITH_SHEET
    reals at_g, at_h;
    const bytes lost = LANED(sheet_point)(u, strip_numbers(sample, strips), sheet, &at_g, &at_h);
    // The sheet sees NaN where the reading was bad: the reason is the reading's own.
    flags |= LANED(convert_bits)(lost) & good;
#ifdef WITH_G
    store_reals(at_g, g + sample);
#endif
#ifdef WITH_H
    store_reals(at_h, h + sample);
#endif
#endif
#ifdef WITH_STATUS
    store_bytes(convert_bytes(flags), status + sample);
#endif
}

kernel void psd_readout(global const CODE *currents, global real *position, global real *total, global uchar *status,
                        global real *sigma, global real *g, global real *h, constant real *p, int samples, int each,
                        global const real *table, int strips, int knots, constant real *sheet) {
    Verdict verdict = UNBLEMISHED;
#define READ_OUT(careful, sample)                                                                                      \
    read_out(careful, sample, &verdict, currents, position, total, status, sigma, g, h, p, samples, table, strips,     \
             knots, sheet)
#ifdef VECTOR_VARIANT
    // The last strip takes the remainder too, and its last vector overlaps the one before: no sample is left over,
    // and no other work-item writes there.
    int sample = get_global_id(0) * each;
    const int end = get_global_id(0) + 1 == get_global_size(0) ? samples : sample + each;
    int all_troubled = 0;
    while (sample + BLOCK * LANES <= end) {
        // Blocks with bad samples come in runs and are few: they are noted, and written again with care.
        const int blocks = min((end - sample) / (BLOCK * LANES), 32);
        const uint all = ~0u >> (32 - blocks);
        uint troubled = all_troubled ? all : 0, found = 0;
        for (int block = 0; block < blocks && !all_troubled; block++) {
            verdict = (Verdict)UNBLEMISHED;
            for (int k = 0; k < BLOCK; k++) READ_OUT(0, sample + (block * BLOCK + k) * LANES);
            troubled |= (uint)is_blemished(verdict, p) << block;
        }
        for (; troubled; troubled &= troubled - 1) {
            const int block = 31 - clz(troubled & -troubled);
            verdict = (Verdict)UNBLEMISHED;
            for (int k = 0; k < BLOCK; k++) READ_OUT(1, sample + (block * BLOCK + k) * LANES);
            found |= (uint)is_blemished(verdict, p) << block;
        }
        all_troubled = found == all;
        sample += blocks * BLOCK * LANES;
    }
    for (; sample < end; sample += LANES) READ_OUT(1, min(sample, end - LANES));
#else
    READ_OUT(1, get_global_id(0));
#endif
}
