// Points of a line, and their certainties 1/sigma (0: missing point).
//
// The work-group of a line (IN_GROUP, common/group.h) reads the points again from global memory wherever it needs them.
// A work-item has copies in private memory, of one line per lane.
#ifndef LINE_FIT_POINTS_H
#define LINE_FIT_POINTS_H
#include "common/group.h"

typedef struct {
    reals x, y, certainty;
} laned_point;

#ifdef IN_GROUP
// Points as line_fit.cl takes them; their coordinates are relative to the origin.
typedef struct {
    global const INPUT *points;
    global const INPUT *sigma; // null without WITH_SIGMA
    real origin_x, origin_y;
    local real *distances; // of all points, for the scale
    local real *sums;      // ROOM_FOR_SUMS numbers
    int count;
} laned_points;
#define ROOM_FOR_SUMS ROOM_FOR(DIGITS)
#ifdef GIVEN_SCALE
#define ROOM_FOR_DISTANCES 1
#else
#define ROOM_FOR_DISTANCES CAPACITY
#endif

static inline laned_point point_at(laned_points all, int i) {
    const real x = all.points[2 * i], y = all.points[2 * i + 1];
    int good = !not_finite(x) & !not_finite(y);
    real certainty = 1;
#ifdef WITH_SIGMA
    const real sigma = all.sigma[i];
    good &= !not_finite(sigma) & sigma > 0;
    certainty = 1 / sigma;
#endif
    return (laned_point){good ? x - all.origin_x : 0, good ? y - all.origin_y : 0, good ? certainty : 0};
}

// Return the points relative to the first valid one: coordinates of a large image leave few digits for distances.
// `reach` gets the largest |x| + |y| in sigmas.
INLINE laned_points about_first_point(const laned_points given, private real *reach) {
    laned_points all = given;
    EACH_PART(part) {
        real first = -INFINITY;
        for (int i = part; i < all.count; i += PARTS)
            first = max(first, point_at(all, i).certainty > 0 ? (real)-i : -INFINITY);
        group_put(&first, 1, part, all.sums);
    }
    const real found = group_largest(all.sums);
    EACH_PART(part) {
        real farthest = 0;
        for (int i = part; i < all.count; i += PARTS) {
            const laned_point at = point_at(all, i);
            farthest = max(farthest, (fabs(at.x) + fabs(at.y)) * at.certainty);
        }
        group_put(&farthest, 1, part, all.sums);
    }
    *reach = group_largest(all.sums);
    const int first = found > -INFINITY ? (int)-found : -1;
    all.origin_x = first < 0 ? 0 : (real)all.points[2 * max(first, 0)];
    all.origin_y = first < 0 ? 0 : (real)all.points[2 * max(first, 0) + 1];
    return all;
}
#else
// Points of each lane.
typedef struct {
    private const reals *x;
    private const reals *y;
    private const reals *certainty;
    private reals *distances; // scratch space for `count` values
    int count;
    private real *sums; // not used
} laned_points;

static inline laned_point point_at(laned_points all, int i) {
    return (laned_point){all.x[i], all.y[i], all.certainty[i]};
}
#endif

#endif
