// The place (x + back) which a displacement takes to (x, y): Newton's method, for the way back. It is small beside the
// place, so it keeps its digits in single precision.
//
// Who includes this defines NEWTON_STEP(x, y, back_x, back_y, table, &step_x, &step_y, &left): the Newton step from
// (x, y) + back, and the squared distance `left` there; it returns where the place is in the part that is one-to-one.
#ifndef NEWTON_H
#define NEWTON_H
#include "common/lanes.h"

#define NEWTON_STEPS 100
// Squares, relative to the place's own: of a distance or step that is rounding, and of a step that leads nowhere.
#define NEWTON_ROUNDING ((real)(64 * REAL_EPSILON * REAL_EPSILON))
#define NEWTON_STUCK ((real)(REAL_EPSILON * REAL_EPSILON / 64))

// The way back for the places that are wanted, from a guess of it. A step that leaves the one-to-one part or gains
// nothing over the centre, where nothing is displaced, and whatever came after, is halved. The answer is where the
// distance left, or the step ahead, is rounding; at the fold, where the search for a place past it ends, neither is.
// Returns where there is none.
static inline masks LANED(newton_back)(reals x, reals y, masks wanted, constant real *table, reals *back_x, reals *back_y) {
    const reals own_x = zero_where(~wanted, x), own_y = zero_where(~wanted, y), square = own_x * own_x + own_y * own_y;
    reals at_x = -own_x, at_y = -own_y, left = square, ahead = square;
    // A guess may be no number, where it comes from a search that did not settle.
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
    // The last step is still to come, or next to nothing.
    *back_x = wanted ? at_x + step_x : *back_x;
    *back_y = wanted ? at_y + step_y : *back_y;
    return wanted & mask_of(left > NEWTON_ROUNDING * square) & mask_of(ahead > NEWTON_ROUNDING * square);
}

#endif
