// Merge of two height maps over the same cells, by two sensors or two recordings. MergeHeights
// (gpuvision/ranging/merge_heights.py) says what each case means.
//
// A cell is present in a map if its height, and its sigma under WITH_SIGMA, are finite and its status has no flag but
// SATURATED, AMBIGUOUS and NOT_INVERTIBLE (doubtful). With d = z1 - z2, variances v1, v2 and n = max_sigmas the maps
// agree where
//     |d| <= n sqrt(v1 + v2) + tolerance,        merged: z1 - d v1 / (v1 + v2), sigma = sqrt(v1 v2 / (v1 + v2)).
// Without sigma the weights are 1/2 and the limit is the tolerance.
//
// Inputs:  z1, intensity1, z2, intensity2  (cells,) INPUT [m, any];  status1, status2  (cells,) uchar flags
//          sigma1, sigma2  (cells,) INPUT [m], under WITH_SIGMA
// Outputs: z, intensity  (cells,) real, NaN where no height is taken;  status  (cells,) uchar
//          sigma  (cells,) real [m], null without WITH_SIGMA;  source  (cells,) uchar: 1 first, 2 second, 4 disagree,
//          8 a height of one map that require_both drops
// Arguments: cells, each (see Work), max_sigmas, tolerance [m], disagreement: height where the maps disagree, one of the
//          constants below; 0: no height. require_both: whether a height that one map alone has is dropped, 0 or 1.
// Build options: INPUT, INPUT16 (float or double), REAL_IS_DOUBLE, WITH_SIGMA, VECTOR_VARIANT, PAST_CACHES.
// Work:    vector variant: a work-item processes `each` consecutive cells in vectors of 16. Otherwise: one work-item per
//          cell, in work-groups of at most `cells` work-items.
#include "common/load.h"
#include "common/status.h"

// Order of DISAGREEMENTS in merge_heights.py.
#define KEEP_FIRST 1
#define KEEP_SECOND 2
#define KEEP_LOWER 3
#define KEEP_HIGHER 4
#define KEEP_MEAN 5
#define STATUS_DOUBTFUL (STATUS_SATURATED | STATUS_AMBIGUOUS | STATUS_NOT_INVERTIBLE)

typedef struct {
    reals z, intensity, sigma;
    ints status, present; // present: mask
} Heights;

static inline Heights load_heights(ulong i, global const INPUT *z, global const INPUT *intensity,
                                   global const uchar *status, global const INPUT *sigma) {
    Heights made;
    made.z = load_inputs(z + i);
    made.intensity = load_inputs(intensity + i);
    made.status = to_ints(*(global const bytes_at *)(status + i));
    ints lost = not_finite_lanes(made.z);
#ifdef WITH_SIGMA
    made.sigma = load_inputs(sigma + i);
    lost |= not_finite_lanes(made.sigma) | int_mask(made.sigma <= 0);
#else
    made.sigma = (reals)1;
#endif
    made.status |= flag_where(lost & int_mask(made.status == 0), STATUS_NOT_FINITE);
    made.present = ~lost & int_mask((made.status & ~STATUS_DOUBTFUL) == 0);
    return made;
}

// Merge the LANES cells from cell i on.
static inline void merge_at(ulong i, Heights one, Heights two, real max_sigmas, real tolerance, int disagreement,
                            int require_both, global real *z, global real *intensity, global uchar *status, global real *sigma,
                            global uchar *source) {
    const ints both = one.present & two.present;
    const reals difference = one.z - two.z;
    // Divided by the larger sigma: squares of small standard deviations would underflow.
    const reals larger = lane_max(one.sigma, two.sigma);
    const reals part1 = one.sigma / larger, part2 = two.sigma / larger;
    const reals sum = part1 * part1 + part2 * part2;
    const reals weight2 = part1 * part1 / sum;
#ifdef WITH_SIGMA
    const reals limit = max_sigmas * larger * sqrt(sum) + tolerance;
#else
    const reals limit = (reals)tolerance;
#endif
    const ints agree = both & int_mask(fabs(difference) <= limit), disagree = both & ~agree;
    // Where the maps disagree and one of them is doubtful, the other one is taken.
    const ints doubtful1 = int_mask(one.status != 0), doubtful2 = int_mask(two.status != 0);
    const ints settled = disagree & (doubtful1 ^ doubtful2), open = disagree & ~settled;
    const ints alone = one.present ^ two.present;
    const ints dropped = require_both ? alone : (ints)0; // its status is the flags of both maps: of a cell without height
    ints take1 = (one.present & alone & ~dropped) | (settled & doubtful2);
    ints take2 = (two.present & alone & ~dropped) | (settled & doubtful1);
    ints mean = agree;
    switch (disagreement) { // the same in all work-items
    case KEEP_FIRST: take1 |= open; break;
    case KEEP_SECOND: take2 |= open; break;
    case KEEP_LOWER:
        take1 |= open & int_mask(difference <= 0);
        take2 |= open & int_mask(difference > 0);
        break;
    case KEEP_HIGHER:
        take1 |= open & int_mask(difference >= 0);
        take2 |= open & int_mask(difference < 0);
        break;
    case KEEP_MEAN: mean |= open; break;
    }
    const masks nothing = to_masks(~(take1 | take2 | mean));
    const reals merged = one.z - weight2 * difference;
    store_reals(nan_where(nothing, choose_reals(take1, one.z, choose_reals(take2, two.z, merged))), z + i);
    const reals light = one.intensity + weight2 * (two.intensity - one.intensity);
    store_reals(nan_where(nothing, choose_reals(take1, one.intensity, choose_reals(take2, two.intensity, light))),
                intensity + i);
#ifdef WITH_SIGMA
    const reals spread = one.sigma * (part2 / sqrt(sum));
    store_reals(nan_where(nothing, choose_reals(take1, one.sigma, choose_reals(take2, two.sigma, spread))), sigma + i);
#endif
    const ints flags1 = one.status & ~take2, flags2 = two.status & ~take1;
    // A height that one map alone has keeps the flags of that map.
    const ints kept = choose_ints(open, (one.status | two.status) | (ints)STATUS_AMBIGUOUS, flags1 | flags2);
    store_bytes(convert_bytes(kept), status + i);
    const ints from = (take1 & (ints)1) | (take2 & (ints)2) | (mean & (ints)3);
    store_bytes(convert_bytes(from | (disagree & (ints)4) | (dropped & (ints)8)), source + i);
}

kernel void merge_heights(global const INPUT *restrict z1, global const INPUT *restrict intensity1,
                          global const uchar *restrict status1, global const INPUT *restrict z2,
                          global const INPUT *restrict intensity2, global const uchar *restrict status2,
#ifdef WITH_SIGMA
                          global const INPUT *restrict sigma1, global const INPUT *restrict sigma2,
#endif
                          global real *restrict z, global real *restrict intensity, global uchar *restrict status,
                          global real *restrict sigma, global uchar *restrict source, const ulong cells,
                          const ulong each, const real max_sigmas, const real tolerance, const int disagreement,
                          const int require_both) {
#ifndef WITH_SIGMA
    global const INPUT *sigma1 = 0, *sigma2 = 0;
#endif
    // The last vector, or work-group, is moved back to end with the last cell, and some cells are computed twice with
    // the same result. This costs less than a test for the end in every work-item.
#ifdef VECTOR_VARIANT
    const ulong first = get_global_id(0) * each, end = min(first + each, cells);
    for (ulong next = first; next < end; next += LANES) {
        const ulong i = min(next, cells - LANES);
        merge_at(i, load_heights(i, z1, intensity1, status1, sigma1), load_heights(i, z2, intensity2, status2, sigma2),
                 max_sigmas, tolerance, disagreement, require_both, z, intensity, status, sigma, source);
    }
#else
    const ulong group = get_local_size(0), i = min(get_group_id(0) * group, cells - group) + get_local_id(0);
    merge_at(i, load_heights(i, z1, intensity1, status1, sigma1), load_heights(i, z2, intensity2, status2, sigma2),
             max_sigmas, tolerance, disagreement, require_both, z, intensity, status, sigma, source);
#endif
}
