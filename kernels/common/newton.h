// Inverse of a displacement field by Newton's method: the point (x + back) that the displacement moves to (x, y).
//
// `back` is small compared with the point, so it keeps its digits in single precision.
//
// The includer defines NEWTON_STEP(x, y, back_x, back_y, table, &step_x, &step_y, &left): the Newton step from
// (x, y) + back and the squared remaining distance `left` there. It returns the mask of points at which the field is
// invertible.
#ifndef NEWTON_H
#define NEWTON_H
#include "common/lanes.h"

#define NEWTON_STEPS 100
// Squared limits, relative to the squared distance from the centre: a distance or step that is rounding (64 eps^2), and a
// step so small that halving it further is useless (eps^2 / 64).
#define NEWTON_ROUNDING ((real)(64 * REAL_EPSILON * REAL_EPSILON))
#define NEWTON_STUCK ((real)(REAL_EPSILON * REAL_EPSILON / 64))

// Find `back` for the wanted points, from a start value in *back_x, *back_y.
//
// The search starts at the centre, where the displacement is 0, with a step to the start value. A step that leaves the
// invertible region, or does not reduce the distance, is halved. The search converges where the remaining distance or the
// next step is rounding. For a point beyond the fold of the lens the search ends at the fold, where neither condition
// holds. Returns the mask of points without a solution.
static inline masks LANED(newton_back)(reals x, reals y, masks wanted, constant real *table, reals *back_x, reals *back_y) {
    const reals own_x = zero_where(~wanted, x), own_y = zero_where(~wanted, y), square = own_x * own_x + own_y * own_y;
    reals at_x = -own_x, at_y = -own_y, left = square, ahead = square;
    // A start value is NaN if the search that computed it did not converge: the comparison rejects it.
    const masks guessed = wanted & mask_of(*back_x * *back_x + *back_y * *back_y < square);
    reals step_x = own_x + zero_where(~guessed, *back_x), step_y = own_y + zero_where(~guessed, *back_y);
    masks open = wanted;
    for (int k = 0; k < NEWTON_STEPS && any_lane(open); k++) {
        reals next_x, next_y, next_left;
        const reals try_x = at_x + step_x, try_y = at_y + step_y;
        const masks inside = NEWTON_STEP(own_x, own_y, try_x, try_y, table, &next_x, &next_y, &next_left);
        const masks better = inside & mask_of(next_left < left);
        at_x = better ? try_x : at_x;
        at_y = better ? try_y : at_y;
        left = better ? next_left : left;
        step_x = better ? next_x : step_x / 2;
        step_y = better ? next_y : step_y / 2;
        const reals size = step_x * step_x + step_y * step_y;
        ahead = better ? size : ahead;
        open = mask_of(left > NEWTON_ROUNDING * square) & mask_of(ahead > NEWTON_ROUNDING * square) &
               mask_of(size > NEWTON_STUCK * square);
    }
    // Apply the last step, which is at rounding level where the search converged.
    *back_x = wanted ? at_x + step_x : *back_x;
    *back_y = wanted ? at_y + step_y : *back_y;
    return wanted & mask_of(left > NEWTON_ROUNDING * square) & mask_of(ahead > NEWTON_ROUNDING * square);
}

#endif
