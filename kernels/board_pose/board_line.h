// Lines of a board (board_pose.cl): robust fits through the edges of each line, and the rows of the pose that they give.
//
// Options: WITH_ETCH_BIAS: rows have an etch factor; the options of line_fit/line_fit.h; vector variant: the options of
//          pose/pose.h; work-item variant: INPUT, type of the rows.
#ifndef BOARD_LINE_H
#define BOARD_LINE_H

#include "line_fit/line_fit.h"
#ifdef VECTOR_VARIANT
#include "pose/pose_rows.h"
#define LINE_ROWS pose_rows
#else
#include "pose/pose_input.h"
#define LINE_ROWS global PoseRow *
#endif

// Line of the artwork: LINE in board_pose.py.
typedef struct {
    real normal_x, normal_y, x, y; // unit normal, and a point [m]
    real sigma;                    // standard deviation of its position on the board [m]
    real etch_factor;
} BoardLine;

// Rows per line: two for offset and angle, one for the offset of a line with a single ruler.
static inline int rows_of_line(int rulers) { return rulers > 1 ? 2 : 1; }

// Store row i: at u along the line, the measured line is displaced by v along its normal, with the given variance [m2].
// The variance of the line's position on the board is added. A row with a number that is not finite, or with a variance
// that is not positive, is missing.
static inline void put_line_row(LINE_ROWS rows, int i, global const BoardLine *line, real u, real v, real variance) {
    const real x = line->x + u * line->normal_y, y = line->y - u * line->normal_x;
    const real moved_x = v * line->normal_x, moved_y = v * line->normal_y;
    const int is_known = variance > 0 && !not_finite(variance);
    const real sigma = is_known ? sqrt(variance + line->sigma * line->sigma) : REAL_NAN;
#ifdef VECTOR_VARIANT
    put_row(rows, i, row_with_sigma(line->normal_x, line->normal_y, x, y, moved_x, moved_y, sigma, line->etch_factor));
#else
    global PoseRow *row = rows + i;
    row->normal_x = line->normal_x, row->normal_y = line->normal_y;
    row->x = x, row->y = y;
    row->displacement_x = moved_x, row->displacement_y = moved_y;
    row->sigma = sigma;
#ifdef WITH_ETCH_BIAS
    row->etch_factor = line->etch_factor;
#endif
#endif
}

// Store the rows of line i with `rulers` rulers, fitted through (x, y) along (c, s).
//
// Offset and angle are uncorrelated at (x, y). At the distance +-sigma(offset) / sigma(angle) from it the offsets have
// the variance 2 sigma(offset)^2 and the covariance sigma(offset)^2 - reach^2 sigma(angle)^2 = 0: two independent rows
// carry the same information as offset and angle. A line with one edge, or with all edges in one place, has no angle
// and gives one row.
static inline void put_line(LINE_ROWS rows, int i, int rulers, global const BoardLine *line, real x, real y, real c,
                            real s, real offset_variance, real angle_variance, int has_angle) {
    const real reach = has_angle ? sqrt(offset_variance / angle_variance) : 0, side = c < 0 ? -reach : reach;
    const int first = rows_of_line(rulers) * i;
    put_line_row(rows, first, line, x - side * c, y - side * s, has_angle ? 2 * offset_variance : offset_variance);
    if (rulers > 1)
        put_line_row(rows, first + 1, line, x + side * c, y + side * s, has_angle ? 2 * offset_variance : REAL_NAN);
}

// Fit LANES lines from `first` on, or in a work-group one line; store their rows and status, and the weight of each edge.
// `reach`: largest |u| + |v| in sigmas. The least scale is the rounding error of the places, in sigmas.
INLINE void fit_lines(laned_points all, reals reach, int first, int lines, global const BoardLine *line,
                      constant int *pairs, int trials, int steps, LINE_ROWS rows, global real *edge_weights,
                      global ushort *status) {
    const reals rounding = (reals)REAL_EPSILON * reach + (reals)1e-30f;
    const laned_fit fit = line_fit(all, pairs, trials, steps, rounding, rounding);
    const masks flags = line_status(fit);
    for (int lane = 0; lane < LANES && first + lane < lines && GROUP_ITEM == 0; lane++) {
        const int has_angle = LANE_BITS(fit.points, lane) > 1 && !LANE_BITS(fit.coincide, lane);
        put_line(rows, first + lane, all.count, line + first + lane, LANE(fit.line.x, lane), LANE(fit.line.y, lane),
                 LANE(fit.line.c, lane), LANE(fit.line.s, lane), LANE(fit.variance_of_offset, lane),
                 LANE(fit.variance_of_angle, lane), has_angle);
        status[first + lane] = (ushort)LANE_BITS(flags, lane);
    }
    for (int k = GROUP_ITEM; k < all.count; k += GROUP_ITEMS) {
        const laned_point at = point_at(all, k);
        const reals z = line_distance(fit.line, at.x, at.y) * at.certainty;
        const reals weight = kept_where(mask_of(at.certainty > (reals)0), loss_weight(z / fit.scale));
        for (int lane = 0; lane < LANES && first + lane < lines; lane++)
            edge_weights[(first + lane) * all.count + k] = LANE(weight, lane);
    }
}

#endif
