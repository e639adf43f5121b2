// Start pose: the best of many poses through few rows each.
#ifndef POSE_START_H
#define POSE_START_H
#include "common/group.h"
#include "pose/pose_equation.h"
#ifdef IN_GROUP
#include "pose/pose_group_rows.h"
#else
#include "pose/pose_rows.h"
#endif

// Scratch memory of the items that solve a pose: distances of the rows, and in a group ROOM_FOR_SUMS numbers for
// common/group.h.
typedef struct {
    GROUP_SPACE reals *distances;
    GROUP_SPACE real *sums;
} pose_room;

// Absolute residuals in sigmas; infinity for missing rows.
static inline reals row_sigmas(laned_pose pose, laned_row at) {
    const reals z = residual_of(pose, at) * at.certainty;
    return at.certainty > (reals)0 ? FABS(z) : (reals)INFINITY;
}

// Compute the score of each lane's candidate pose over all rows, least is best: the loss where the scale is given,
// otherwise the absolute residual of rank (n + FREEDOMS + 1) / 2 in sigmas, to 1 % (least median of squares, Rousseeuw
// and Leroy, 1987).
//
// Local memory has no room for the residuals of every candidate: a work-group computes them again for every three bits
// of the order statistic (group_ranked of common/group.h ranks an array that is in local memory).
BETWEEN_BARRIERS reals pose_score(laned_pose pose, pose_rows all, pose_room room, int present) {
#ifdef GIVEN_SCALE
#ifdef WITH_ETCH_BIAS
    const reals off = pose.etch * (reals)all.etch;
    reals loss = (reals)0.5f * off * off;
#else
    reals loss = 0;
#endif
    for (int i = 0; i < all.count; i++) {
        const laned_row at = row_for_all(all, i);
        const reals z = residual_of(pose, at) * at.certainty;
        loss += loss_of(z * (reals)((real)1 / (real)(GIVEN_SCALE)));
    }
    return loss;
#else
    const int rank = (present + FREEDOMS + 1) / 2;
#ifdef IN_GROUP
    bits found = 0;
    for (int shift = BITS_BELOW_SIGN - 3; shift >= BITS_TO_ONE_PERCENT; shift -= 3) {
        int below[DIGITS];
        for (int k = 0; k < DIGITS; k++) below[k] = 0;
        for (int i = 0; i < all.count; i++) count_below(as_bits(row_sigmas(pose, row_of(all, i))), found, shift, below);
        found |= (bits)digit_of(below, rank) << shift;
    }
    return as_real(found);
#else
    for (int i = 0; i < all.count; i++) room.distances[i] = row_sigmas(pose, row_for_all(all, i));
    return ranked_of(room.distances, all.count, (masks)rank, BITS_TO_ONE_PERCENT);
#endif
#endif
}

// Return the pose through FREEDOMS rows in each lane, from START_STEPS Gauss-Newton steps; `bad` gets the lanes whose
// rows do not determine a pose.
BETWEEN_BARRIERS laned_pose pose_through(laned_pose start, pose_rows all, constant const int *subset,
                                         private masks *bad) {
    laned_row of[FREEDOMS];
    for (int k = 0; k < FREEDOMS; k++) of[k] = gather_rows(all, subset + k * LANES);
    laned_pose candidate = start;
    *bad = 0;
    for (int step = 0; step < START_STEPS; step++) {
        reals matrix[TRIANGLE], right[FREEDOMS], change[FREEDOMS];
        for (int i = 0; i < TRIANGLE; i++) matrix[i] = 0;
        for (int i = 0; i < FREEDOMS; i++) right[i] = 0;
        for (int k = 0; k < FREEDOMS; k++) {
#ifdef WITH_ETCH_BIAS
            const reals weight = of[k].certainty * of[k].certainty;
#else
            const reals weight = mask_of(of[k].certainty > (reals)0) ? (reals)1 : (reals)0;
#endif
            add_equation(equation_of(candidate, of[k]), weight, weight, matrix, right);
        }
        add_etch(candidate, all.etch, matrix, right);
        *bad |= factored(matrix);
        solved(matrix, right, change);
        candidate = pose_after(candidate, change);
    }
    return candidate;
}

// Find the start pose: the candidate with the least score.
//
// A candidate is the pose through FREEDOMS rows, from START_STEPS Gauss-Newton steps from `pose`. `subsets` holds the
// rows of LANES candidates side by side, (trials / LANES, FREEDOMS, LANES): each lane solves one candidate. The items
// of a group solve different candidates; the item of the best candidate computes its pose again and stores it.
INLINE void pose_start(GROUP_SPACE laned_pose *pose, pose_rows all, constant const int *subsets, int trials,
                       pose_room room, int present) {
    const laned_pose start = *pose;
    real least = INFINITY;
#ifdef IN_GROUP
    int chosen = INT_MAX;
    for (int trial = GROUP_ITEM; trial < trials; trial += GROUP_ITEMS) {
        masks bad;
        const real score = pose_score(pose_through(start, all, subsets + trial * FREEDOMS, &bad), all, room, present);
        const int better = !bad && score < least;
        least = better ? score : least;
        chosen = better ? trial : chosen;
    }
    if (group_best(least, chosen, room.sums) == GROUP_ITEM && chosen < INT_MAX) {
        masks bad;
        *pose = pose_through(start, all, subsets + chosen * FREEDOMS, &bad);
    }
    group_barrier();
#else
    for (int trial = 0; trial < trials; trial += LANES) {
        masks bad;
        const laned_pose candidate = pose_through(start, all, subsets + (size_t)trial * FREEDOMS, &bad);
        const reals loss = pose_score(candidate, all, room, present);
        for (int lane = 0; lane < LANES; lane++) {
            if (LANE_BITS(bad, lane) || !(LANE(loss, lane) < least)) continue;
            least = LANE(loss, lane);
            *pose = (laned_pose){(reals)LANE(candidate.dxx, lane), (reals)LANE(candidate.dxy, lane),
                                 (reals)LANE(candidate.dyx, lane), (reals)LANE(candidate.dyy, lane),
                                 (reals)LANE(candidate.x, lane),   (reals)LANE(candidate.y, lane),
                                 (reals)LANE(candidate.etch, lane)};
        }
    }
#endif
}

#endif
