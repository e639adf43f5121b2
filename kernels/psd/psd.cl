// Position sensitive device (PSD): a pair of currents -> position, total current, status, predicted noise.
//
// The currents divide inversely to the distances from the electrodes (F. de Jong, section 4.2.1):
//     u = (L/2) (right - left) / (right + left)
//
// Inputs:  currents    (samples, 2) INPUT, pairs (left, right); under PLANAR (2, samples): all left, then all right
// values
//          table       PsdTable, in units of the input
//          linearity   (strips, knots) real [m], under LINEARITY: correction added to u
//          sheet       SheetTable (common/sheet.h), under WITH_SHEET
// Outputs: (samples,), each one compiled only under its WITH_... option:
//          position real [m], total real [A], status uchar, sigma real [m] (standard deviation of the position),
//          g, h real [m] (point in the sheet of light), sigma_g, sigma_h real [m] (standard deviation of g and h by
//          sigma), systematic_g, systematic_h real [m] (the same by the covariance of the triangulation)
// Build options: INPUT, INPUT2, INPUT4, INPUT16 (float, double or ushort), REAL_IS_DOUBLE, PLANAR, DARK_LEVEL (subtract dark currents),
//          GAIN (equalise the channels), LINEARITY, SIGNED (a current can be negative or not finite, or the range is
//          shorter than the strip), BACKGROUND (shot noise of light and dark current all over the strip),
//          WITH_POSITION/TOTAL/STATUS/SIGMA/SHEET/G/H/SIGMA_G/SIGMA_H/SYSTEMATIC_G/SYSTEMATIC_H, LENS, LENS_K2, LENS_K3, LENS_K4,
//          WORD_PAIRS (vector variant: pairs of ushort), PAST_CACHES, VECTOR_VARIANT.
// Work:    vector variant: a work-item processes `each` consecutive samples, the last one up to 2 `each` - 1.
//          Otherwise: a work-item processes 4 samples that lie a work-group apart (common/item_samples.h).
#include "common/item_samples.h"
#include "common/load.h"
#include "common/sheet.h"
#include "common/status.h"
#include "common/team.h"

// Parameters in units of the input if no other unit is given, in the order of PsdTable in gpuvision/ranging/psd.py.
typedef struct {
    real half_length;  // L/2, divided by `limit` [m]
    real limit;        // |right - left| / sum at the ends of the strip: below 1 with load resistors
    real range;        // largest |right - left| / sum of a trusted position: `limit` less the margin at the ends
    real minimum;      // smallest sum of a trusted position (exclusive)
    real saturation;   // of a channel, dark level included
    real ampere;       // amperes per unit of the input
    real dark_left, dark_right;
    real right_gain;   // factor that brings the right channel to the gain of the left one
    real independent;  // mean variance of the noise of the two channels, after the gain correction
    real asymmetry;    // half of the left channel's variance less the right channel's, after the gain correction
    real opposed;      // variance of noise that leaves one electrode and enters the other
    real background;   // variance of the sum: shot noise of background light and dark current
    real common_noise;  // variance of the position times the sum: shot noise of a spot of finite width [m^2]
} PsdTable;

typedef struct {
    global const INPUT *currents;
    global real *position, *total;
    global uchar *status;
    global real *sigma, *g, *h, *sigma_g, *sigma_h, *systematic_g, *systematic_h;
    constant PsdTable *table;
    int samples, strips, knots;
    global const real *linearity;
    constant SheetTable *sheet;
} Readout;

#ifdef VECTOR_VARIANT
typedef uint16 words_at __attribute__((aligned(2)));  // pairs of 16-bit codes; an array is aligned to a code only

static inline void load_pair(const Readout *io, int sample, reals *left, reals *right) {
#ifdef PLANAR
    *left = load_inputs(io->currents + sample);
    *right = load_inputs(io->currents + io->samples + sample);
#else
    global const INPUT *pairs = io->currents + 2 * sample;
#ifdef WORD_PAIRS
    // The left code is the lower half of a word on the little-endian CPUs of this variant. A mask and a shift cost less
    // than the shuffles that separate even and odd codes.
    prefetch_inputs(pairs);
    prefetch_inputs(pairs + LANES);
    const uint16 words = *(global const words_at *)pairs;
    *left = LANED(convert_real)(as_int16(words & 0xffff));
    *right = LANED(convert_real)(as_int16(words >> 16));
#else
    const reals low = load_inputs(pairs), high = load_inputs(pairs + LANES);
    *left = (reals)(low.even, high.even);
    *right = (reals)(low.odd, high.odd);
#endif
#endif
}
#else
// Load the currents of the samples of this work-item.
static inline void load_item_currents(const Readout *io, real4 *left, real4 *right) {
#ifdef PLANAR
    *left = load_item_samples(io->currents, io->samples);
    *right = load_item_samples(io->currents + io->samples, io->samples);
#else
    load_item_pairs(io->currents, io->samples, left, right);
#endif
}
#endif

#ifdef LINEARITY
// Correction at position u of a strip [m]: linear between knots that divide the strip evenly from end to end.
static inline real correction(real u, int strip, const Readout *io, real half_length) {
    const real place = (u / half_length + 1) * (io->knots - 1) / 2;
    const int knot = clamp((int)place, 0, io->knots - 2);
    global const real *at = io->linearity + strip * io->knots + knot;
    return at[0] + (place - knot) * (at[1] - at[0]);
}

static inline reals corrected(reals u, int sample, const Readout *io) {
    const real half_length = io->table->half_length * io->table->limit;
#ifdef VECTOR_VARIANT
    real lane[LANES];
    vstore16(u, 0, lane);
    for (int k = 0; k < LANES; k++) lane[k] += correction(lane[k], (sample + k) % io->strips, io, half_length);
    return vload16(0, lane);
#else
    return u + correction(u, sample % io->strips, io, half_length);
#endif
}
#endif

#if defined(WITH_SIGMA) || defined(WITH_SIGMA_G) || defined(WITH_SIGMA_H)
// Standard deviation of the position, from variances of the currents: u has the derivatives -L right / sum^2 with
// respect to left and L left / sum^2 with respect to right, so that variances l, r of independent noise give
//     L^2 / sum^2 ((l + r)/4 (1 + balance^2) + (l - r)/2 balance).
// Opposed noise is the same everywhere. Common noise (the electrons of one light spot divide together) leaves the width
// of the spot. An electron of the background moves the position by its distance from it, of variance L^2/12 + u^2; here
// in units of L^2 with L/2 = half_length limit, u = half_length balance.
static inline reals sigma_of(reals balance, reals sum, constant PsdTable *table) {
    reals spread = table->independent * (1 + balance * balance) / 2 + table->opposed;
#ifdef GAIN
    spread += table->asymmetry * balance;
#endif
#ifdef BACKGROUND
    spread += table->background * (table->limit * table->limit / 3 + balance * balance) / 4;
#endif
    const real length = 4 * table->half_length * table->half_length;
    return sqrt(length * spread / (sum * sum) + table->common_noise / sum);
}
#endif

// Flags of samples that are not good; a later assignment has priority. Integer codes without a dark level are finite
// and not negative, so the tests under SIGNED are not compiled for them.
static inline masks flags_of(reals left, reals right, masks saturated, reals sum, reals difference,
                             constant PsdTable *table) {
    masks flags = STATUS_OK;
#ifdef SIGNED
    flags = fabs(difference) > table->range * sum ? (masks)STATUS_OUT_OF_RANGE : flags;
#endif
    flags = sum <= table->minimum ? (masks)STATUS_LOW_SIGNAL : flags;
    flags |= saturated & STATUS_SATURATED;
#ifdef SIGNED
    flags = LANED(not_finite)(left) | LANED(not_finite)(right) ? (masks)STATUS_NOT_FINITE : flags;
#endif
    return flags;
}

// Verdict: summary of a block of samples that tells whether all of them are good.
#ifdef SIGNED
typedef masks Verdict;  // lanes with a bad sample
static inline Verdict clean_verdict(void) { return 0; }
static inline int has_bad(Verdict bad, constant PsdTable *table) { return any_lane(bad); }
#else
// For integer codes the extremes of the block suffice; as vectors they cost less than masks.
typedef struct {
    reals least_sum, largest_code;
} Verdict;
static inline Verdict clean_verdict(void) {
    const Verdict verdict = {MAXFLOAT, 0};
    return verdict;
}
static inline int has_bad(Verdict worst, constant PsdTable *table) {
    return any_lane(mask_of(worst.least_sum <= table->minimum) | mask_of(worst.largest_code >= table->saturation));
}
#endif

// Compute the LANES samples from `sample` on from their currents, write the outputs, and add the samples to the verdict.
// Without `careful` the outputs are written as if all samples were good: the caller repeats a block that has a bad
// sample with `careful`.
static inline void write_samples(const int careful, int sample, reals left, reals right, const Readout *io,
                                 Verdict *verdict) {
    constant PsdTable *table = io->table;
    const reals larger = left > right ? left : right;
    const masks saturated = mask_of(larger >= table->saturation);
#ifdef SIGNED
    masks good = mask_of(left < table->saturation) & mask_of(right < table->saturation);
#else
    masks good = ~saturated;
#endif
#ifdef DARK_LEVEL
    left -= table->dark_left;
    right -= table->dark_right;
#endif
#ifdef GAIN
    right *= table->right_gain;
#endif
    const reals sum = left + right, difference = right - left;
    // These comparisons are false for NaN. The saturation limit excludes infinity and sums that overflow.
    good &= mask_of(sum > table->minimum);
#ifdef SIGNED
    good &= mask_of(fabs(difference) <= table->range * sum);
    *verdict |= ~good;
#else
    verdict->least_sum = sum < verdict->least_sum ? sum : verdict->least_sum;
    verdict->largest_code = larger > verdict->largest_code ? larger : verdict->largest_code;
#endif
    const reals balance = difference / sum;
    reals u = table->half_length * balance;
    masks flags = STATUS_OK;
    if (careful) {
        flags = flags_of(left, right, saturated, sum, difference, table);
        u = nan_where(~good, u);
    }
#ifdef LINEARITY
    u = nan_where(~good, corrected(zero_where(~good, u), sample, io));
#endif
#ifdef WITH_POSITION
    store_reals(u, io->position + sample);
#endif
#ifdef WITH_TOTAL
    store_reals(sum * table->ampere, io->total + sample);
#endif
#ifdef WITH_SIGMA
    store_reals(nan_where(~good, sigma_of(balance, sum, table)), io->sigma + sample);
#endif
#ifdef WITH_SHEET
    // The number of the strip is the second sensor coordinate.
    const reals strip = to_reals((sample + LANE_NUMBERS) % io->strips);
    reals at_g, at_h;
    const SheetPlace place = sheet_place(u, strip, io->sheet);
    const bytes lost = sheet_point_at(&place, io->sheet, &at_g, &at_h);
    // An invalid reading enters the sheet as NaN; its status is the flag of the reading, not the flag of the sheet.
    flags |= LANED(convert_bits)(lost) & good;
#ifdef WITH_G
    store_reals(at_g, io->g + sample);
#endif
#ifdef WITH_H
    store_reals(at_h, io->h + sample);
#endif
#if defined(WITH_SIGMA_G) || defined(WITH_SIGMA_H)
    const SheetVariances noise = sheet_noise_at(&place, sigma_of(balance, sum, table), (reals)0, io->sheet);
#endif
#ifdef WITH_SIGMA_G
    store_reals(nan_where(mask_of(LANED(not_finite)(at_g)), sqrt(noise.g)), io->sigma_g + sample);
#endif
#ifdef WITH_SIGMA_H
    store_reals(nan_where(mask_of(LANED(not_finite)(at_h)), sqrt(noise.h)), io->sigma_h + sample);
#endif
#if defined(WITH_SYSTEMATIC_G) || defined(WITH_SYSTEMATIC_H)
    const SheetVariances systematic = sheet_systematic_at(&place, io->sheet);
#endif
#ifdef WITH_SYSTEMATIC_G
    store_reals(nan_where(mask_of(LANED(not_finite)(at_g)), sqrt(systematic.g)), io->systematic_g + sample);
#endif
#ifdef WITH_SYSTEMATIC_H
    store_reals(nan_where(mask_of(LANED(not_finite)(at_h)), sqrt(systematic.h)), io->systematic_h + sample);
#endif
#endif
#ifdef WITH_STATUS
    store_bytes(convert_bytes(flags), io->status + sample);
#endif
}

#ifdef VECTOR_VARIANT
#define BLOCK 16  // vectors that share a verdict

static inline void read_samples(const int careful, int sample, const Readout *io, Verdict *verdict) {
    reals left, right;
    load_pair(io, sample, &left, &right);
    write_samples(careful, sample, left, right, io, verdict);
}

// Read the samples of a block; return whether one of them is bad.
static inline int read_block(const int careful, int first, const Readout *io) {
    Verdict verdict = clean_verdict();
    for (int k = 0; k < BLOCK; k++) read_samples(careful, first + k * LANES, io, &verdict);
    return has_bad(verdict, io->table);
}

// Read the samples begin <= sample < end. Blocks with bad samples are rare and contiguous. Blocks are read quickly, in
// groups of up to 32; the blocks with a bad sample are noted in the bits of `troubled` and read again with care. Where
// all blocks of a group were bad, the next group is read with care at once.
static inline void read_range(int begin, int end, const Readout *io) {
    int sample = begin, all_troubled = 0;
    while (sample + BLOCK * LANES <= end) {
        const int blocks = min((end - sample) / (BLOCK * LANES), 32);
        const uint all = ~0u >> (32 - blocks);
        uint troubled = all_troubled ? all : 0, found = 0;
        for (int block = 0; block < blocks && !all_troubled; block++) {
            troubled |= (uint)read_block(0, sample + block * BLOCK * LANES, io) << block;
        }
        for (; troubled; troubled &= troubled - 1) {
            const int block = 31 - clz(troubled & -troubled);
            found |= (uint)read_block(1, sample + block * BLOCK * LANES, io) << block;
        }
        all_troubled = found == all;
        sample += blocks * BLOCK * LANES;
    }
    Verdict unused = clean_verdict();
    for (; sample < end; sample += LANES) read_samples(1, min(sample, end - LANES), io, &unused);
}
#endif

kernel void psd_readout(global const INPUT *currents, global real *position, global real *total, global uchar *status,
                        global real *sigma, global real *g, global real *h, global real *sigma_g,
                        global real *sigma_h, global real *systematic_g, global real *systematic_h,
                        constant PsdTable *table, int samples, int each, global const real *linearity, int strips,
                        int knots, constant SheetTable *sheet TEAM_ARGUMENTS) {
    const Readout io = {currents, position,     total,        status, sigma,   g,      h,     sigma_g,   sigma_h,
                        systematic_g, systematic_h, table,  samples, strips, knots, linearity, sheet};
#ifdef VECTOR_VARIANT
    // The last work-item also processes the remainder, and its last vector overlaps the previous vector: every sample
    // is covered, and no other work-item writes there.
    FOR_EACH_ITEM(item) {
        const int begin = item.x * each;
        read_range(begin, item.x + 1 == ITEM_COLUMNS ? samples : begin + each, &io);
    }
#else
    Verdict unused = clean_verdict();
    real4 left, right;
    load_item_currents(&io, &left, &right);
    // Each step moves the next sample to the first lane: an index that changes would put the lanes into memory.
    const ulong first = first_item_sample();
    for (int k = 0; k < ITEM_SAMPLES && first + k * item_step() < (ulong)samples; k++) {
        write_samples(1, (int)(first + k * item_step()), left.x, right.x, &io, &unused);
        left = left.yzww;
        right = right.yzww;
    }
#endif
}
