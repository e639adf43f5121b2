// Sums, maxima and order statistics over the rows of a problem that a work-item or a work-group solves.
//
// Without GROUP_PER_PROBLEM, and in the vector variant, one work-item solves a problem, and the functions below return
// its values unchanged. With GROUP_PER_PROBLEM the work-item variant solves a problem with a work-group of up to PARTS
// items. Rows are then summed in PARTS parts: part p has the rows p, p + PARTS, ... An item sums whole parts, and one
// item adds up the parts of a sum in a fixed order. The results therefore do not depend on the size of the group.
//
//     EACH_PART(part) {
//         ... sum the rows part * LANES, part * LANES + PARTS * LANES, ... in `values` (one row in each lane)
//         group_put(values, count, part, sums);
//     }
//     GROUP_SPACE const reals *totals = group_total(values, count, sums);
//
// `sums` is local memory for ROOM_FOR(count) numbers: the totals, then the parts of each sum. All items of the group
// call the functions, and all items read the totals, which are valid until the next call. A call may follow another one
// without a barrier: group_put writes the parts, which group_total last reads before its second barrier, and
// group_total writes the totals after its first barrier.
//
// Functions that call them are INLINE. Without the attribute always_inline, PoCL 3.1 ended the process (segmentation
// fault) at the first use of pose.cl in a group, and ran line_fit.cl with equal results. The cause is not known.
//
// Large state that is used on both sides of a barrier (solved_pose) is in GROUP_SPACE, where item 0 writes it: in
// private memory it would take registers of every item on a GPU. Each item computes small state (a line) from the
// totals; it is equal in all items.
#ifndef GROUP_H
#define GROUP_H
#include "common/least_squares.h"
#include "common/robust.h"

#if defined(GROUP_PER_PROBLEM) && !defined(VECTOR_VARIANT)
#define IN_GROUP
#define GROUP_SPACE local
#define GROUP_ITEM ((int)get_local_id(0))
#define GROUP_ITEMS ((int)get_local_size(0))
#define PARTS 64
#define PART_PITCH (PARTS + 1) // an odd pitch: items that add up different sums read different memory banks
#define TOTALS 64              // most sums
#define ROOM_FOR(count) (TOTALS + (count) * PART_PITCH)
#else
#define GROUP_SPACE private
#define GROUP_ITEM 0
#define GROUP_ITEMS 1
#define PARTS 1
#endif

// Function without barriers, on private memory, in which an item computes alone. It is not inlined on PoCL: inlined,
// the eigenvalues of a pose came out wrong while pose.h was written. With its present state PoCL 3.1 passes the tests
// of test_pose.py in both cases. A pointer to local memory as an argument crashed its compiler (blob_match.h).
//
// Loops with barriers run at least once (do ... while) and have one exit. PoCL 3.1 copies what follows a branch around a
// barrier: with five loops that may not run at all, find_blobs did not compile in five minutes, with these loops in 7 s.
//
// Sums are arrays, not structs that are read as arrays: with Mesa 22.3 every index of a struct of single numbers gave its
// first member.
#if defined(IN_GROUP) && defined(POCL_DEVICE_ADDRESS_BITS)
#define BETWEEN_BARRIERS static __attribute__((noinline))
#else
#define BETWEEN_BARRIERS static inline
#endif

#define EACH_PART(part) for (int part = GROUP_ITEM; part < PARTS; part += GROUP_ITEMS)

#ifdef IN_GROUP
#define group_barrier() barrier(CLK_LOCAL_MEM_FENCE)

INLINE void group_put(private const real *values, int count, int part, local real *sums) {
    for (int k = 0; k < count; k++) sums[TOTALS + k * PART_PITCH + part] = values[k];
}

// Four chains of additions: the loads of local memory overlap.
INLINE local const real *group_total(private const real *values, int count, local real *sums) {
    group_barrier();
    for (int k = GROUP_ITEM; k < count; k += GROUP_ITEMS) {
        local const real *parts = sums + TOTALS + k * PART_PITCH;
        real a = 0, b = 0, c = 0, d = 0;
        for (int part = 0; part < PARTS; part += 4) {
            a += parts[part];
            b += parts[part + 1];
            c += parts[part + 2];
            d += parts[part + 3];
        }
        sums[k] = (a + b) + (c + d);
    }
    group_barrier();
    return sums;
}

// Add up values of all items in item 0, `most` sums at a time: `sums` has room for `most` sums. The group has PARTS items.
INLINE void group_add_up(private real *values, int count, int most, local real *sums) {
#pragma unroll
    for (int from = 0; from < count; from += most) {
        const int now = min(most, count - from);
        group_put(values + from, now, GROUP_ITEM, sums);
        local const real *totals = group_total(0, now, sums);
        if (GROUP_ITEM == 0)
            for (int k = 0; k < now; k++) values[from + k] = totals[k];
    }
}

// Return the largest of the values that group_put stored, one for each part.
INLINE real group_largest(local real *sums) {
    group_barrier();
    real largest = sums[TOTALS];
    for (int part = 1; part < PARTS; part++) largest = max(largest, sums[TOTALS + part]);
    group_barrier();
    return largest;
}

// Return the item with the least score; of equal scores, the item with the first trial. Items without a score give
// INFINITY and the trial INT_MAX. `sums` has room for two sums.
INLINE int group_best(real score, int trial, local real *sums) {
    local real *scores = sums + TOTALS, *trials = scores + PARTS;
    group_barrier();
    scores[GROUP_ITEM] = score;
    trials[GROUP_ITEM] = as_real((bits)trial);
    group_barrier();
    int best = 0;
    for (int item = 1; item < GROUP_ITEMS; item++) {
        const int is_first = scores[item] == scores[best] && as_bits(trials[item]) < as_bits(trials[best]);
        best = scores[item] < scores[best] || is_first ? item : best;
    }
    group_barrier();
    return best;
}

// Return the order statistic as ranked_of (common/robust.h) of `count` values in local memory; `sums` has room for
// DIGITS sums.
//
// Three bits at a time: the counts below seven patterns decide them with one sum over the group.
#define DIGITS 7
// Count a value where it is below the pattern of a digit; read the digit from the counts.
INLINE void count_below(bits value, bits found, int shift, private int *below) {
    for (int k = 0; k < DIGITS; k++) below[k] += value < (found | ((bits)(k + 1) << shift));
}
INLINE int digit_of(private const int *below, int rank) {
    int digit = 0;
    for (int k = 0; k < DIGITS; k++) digit += below[k] < rank;
    return digit;
}

INLINE real group_ranked(local const real *values, int count, int rank, int lowest, local real *sums) {
    bits found = 0;
    for (int bit = BITS_BELOW_SIGN - 3; bit > lowest - 3; bit -= 3) {
        const int shift = max(bit, lowest);
        EACH_PART(part) {
            int below[DIGITS];
            for (int k = 0; k < DIGITS; k++) below[k] = 0;
            for (int i = part; i < count; i += PARTS) count_below(as_bits(values[i]), found, shift, below);
            real counts[DIGITS];
            for (int k = 0; k < DIGITS; k++) counts[k] = below[k];
            group_put(counts, DIGITS, part, sums);
        }
        local const real *below = group_total(0, DIGITS, sums);
        // The last digit has fewer bits where the number of bits is no multiple of three.
        const int digits = (1 << (bit + 3 - shift)) - 1;
        int digit = 0;
        for (int k = 0; k < digits; k++) digit += below[k] < rank;
        found |= (bits)digit << shift;
    }
    return as_real(found);
}
#else
#define group_barrier()
INLINE void group_put(private const reals *values, int count, int part, private real *sums) {}
INLINE private const reals *group_total(private const reals *values, int count, private real *sums) {
    return values;
}
INLINE void group_add_up(private reals *values, int count, int most, private real *sums) {}

// The same of `count` values, padded with infinity to whole vectors; bit by bit, with LANES values at once.
INLINE real group_ranked(private const real *values, int count, int rank, int lowest, private real *sums) {
    bits found = 0;
    for (int bit = BITS_BELOW_SIGN - 1; bit >= lowest; bit--) {
        const bits next = found | ((bits)1 << bit);
        int below = 0;
        for (int i = 0; i < count; i += LANES)
            below += (int)popcount(lane_bits(mask_of(as_masks(READ(values, i)) < (masks)next)));
        found = below >= rank ? found : next;
    }
    return as_real(found);
}
#endif

#endif
