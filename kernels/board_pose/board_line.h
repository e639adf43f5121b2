// Lines of a board (board_pose.cl): robust fits through the edges of each line, and the rows of the pose that they give.
//
// Options: MAX_RULERS_PER_LINE; WITH_ETCH_BIAS: rows have an etch factor; the options of line_fit/line_fit.h.
#ifndef BOARD_LINE_H
#define BOARD_LINE_H

#include "line_fit/line_fit.h"

// Line of the artwork: LINE in board_pose.py.
typedef struct {
    real normal_x, normal_y, x, y; // unit normal, and a point [m]
    real sigma;                    // standard deviation of its position on the board [m]
    real etch_factor;
} BoardLine;

// Rows per line: two for offset and angle, one for the offset of a line with a single ruler.
#define ROWS_PER_LINE (MAX_RULERS_PER_LINE > 1 ? 2 : 1)

#ifdef VECTOR_VARIANT
// Columns of the rows of the pose (pose/pose.h).
typedef struct {
    private real *nx;
    private real *ny;
    private real *px;
    private real *py;
    private real *ex;
    private real *ey;
    private real *certainty;
    private real *etch_factor;
} line_rows;
#define LINE_ROWS line_rows
#else
// Rows as pose/pose.cl takes them: PoseRow.
#ifdef WITH_ETCH_BIAS
#define ROW_NUMBERS 8
#else
#define ROW_NUMBERS 7
#endif
#define LINE_ROWS global real *
#endif

// Store row i: at u along the line, the measured line is displaced by v along its normal, with the given variance [m2].
// The variance of the line's position on the board is added. A variance that is not finite makes a missing row.
static inline void put_row(LINE_ROWS rows, int i, global const BoardLine *line, real u, real v, real variance) {
    const int good = variance > 0 && !not_finite(variance) && !not_finite(u + v);
    const real sigma = sqrt(variance + line->sigma * line->sigma);
#ifdef VECTOR_VARIANT
    rows.nx[i] = good ? line->normal_x : 0;
    rows.ny[i] = good ? line->normal_y : 0;
    rows.px[i] = good ? line->x + u * line->normal_y : 0;
    rows.py[i] = good ? line->y - u * line->normal_x : 0;
    rows.ex[i] = good ? v * line->normal_x : 0;
    rows.ey[i] = good ? v * line->normal_y : 0;
    rows.certainty[i] = good ? 1 / sigma : 0;
    rows.etch_factor[i] = line->etch_factor;
#else
    global real *row = rows + ROW_NUMBERS * i;
    row[0] = line->normal_x;
    row[1] = line->normal_y;
    row[2] = line->x + u * line->normal_y;
    row[3] = line->y - u * line->normal_x;
    row[4] = v * line->normal_x;
    row[5] = v * line->normal_y;
    row[6] = good ? sigma : REAL_NAN;
#ifdef WITH_ETCH_BIAS
    row[7] = line->etch_factor;
#endif
#endif
}

// Store the rows of line i, fitted through (x, y) along (c, s).
//
// Offset and angle are uncorrelated at (x, y). At the distance +-sigma(offset) / sigma(angle) from it the offsets have
// the variance 2 sigma(offset)^2 and the covariance sigma(offset)^2 - reach^2 sigma(angle)^2 = 0: two independent rows
// carry the same information as offset and angle. A line with one edge, or with all edges in one place, has no angle
// and gives one row.
static inline void put_line(LINE_ROWS rows, int i, global const BoardLine *line, real x, real y, real c, real s,
                            real offset_variance, real angle_variance, int has_angle) {
    const real reach = has_angle ? sqrt(offset_variance / angle_variance) : 0, side = c < 0 ? -reach : reach;
    put_row(rows, ROWS_PER_LINE * i, line, x - side * c, y - side * s, has_angle ? 2 * offset_variance : offset_variance);
    if (ROWS_PER_LINE > 1)
        put_row(rows, ROWS_PER_LINE * i + 1, line, x + side * c, y + side * s, has_angle ? 2 * offset_variance : REAL_NAN);
}

// Fit LANES lines from `first` on; store their rows, and the weight of each edge. The least scale is the rounding error
// of the places, in sigmas.
static inline void fit_lines(laned_points all, int first, int lines, global const BoardLine *line, constant int *pairs,
                             int trials, int steps, LINE_ROWS rows, global real *edge_weights) {
    reals reach = 0;
    for (int k = 0; k < all.count; k++) {
        const reals far = (FABS(all.x[k]) + FABS(all.y[k])) * all.certainty[k];
        reach = far > reach ? far : reach;
    }
    const laned_fit fit = line_fit(all, pairs, trials, steps, (reals)REAL_EPSILON * reach + (reals)1e-30f);
    for (int lane = 0; lane < LANES && first + lane < lines; lane++) {
        const int has_angle = LANE_BITS(fit.points, lane) > 1 && !LANE_BITS(fit.coincide, lane);
        put_line(rows, first + lane, line + first + lane, LANE(fit.line.x, lane), LANE(fit.line.y, lane),
                 LANE(fit.line.c, lane), LANE(fit.line.s, lane), LANE(fit.variance_of_offset, lane),
                 LANE(fit.variance_of_angle, lane), has_angle);
    }
    for (int k = 0; k < all.count; k++) {
        const reals z = line_distance(fit.line, all.x[k], all.y[k]) * all.certainty[k];
        const reals weight = kept_where(mask_of(all.certainty[k] > (reals)0), loss_weight(z / fit.scale));
        for (int lane = 0; lane < LANES && first + lane < lines; lane++)
            edge_weights[(first + lane) * all.count + k] = LANE(weight, lane);
    }
}

#endif
