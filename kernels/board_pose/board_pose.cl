// Pose of a board from an image in one launch: edges along calipers (rulers), a robust line through the edges of each
// line of the artwork, and a robust pose from these lines.
//
// Inputs:  image (rows, columns), type CODE; rulers (lines, each) BoardRuler; line (lines,) BoardLine.
// Tables:  table, model (ruler/ruler.h); pairs (pair_trials, 2): edges of the start candidates of a line; subsets
//          (trials / LANES, FREEDOMS, LANES): rows of the start candidates of the pose.
// Outputs: pose (3,) x, y [m], theta [rad]; deformation (3,); placement (2,) [m]; covariance (POSE_PARAMETERS,
//          POSE_PARAMETERS); residuals [m] and weights (lines, ROWS_PER_LINE); scale, residual_scale, condition, rank, inliers,
//          status, etch [m], inlier_fraction, leverage: one number each (pose/pose.cl); edges [px], edge_status,
//          edge_weights (lines, each).
// Options: the options of ruler/ruler.h, line_fit/line_fit.h and pose/pose.h; MAX_RULERS_PER_LINE: capacity
//          for the rulers of a line; MAX_RULERS: capacity for all rulers.
// Variants: vector: one work-item computes everything, 16 rulers or lines in a vector (starting a second core would
//          take longer than the computation); work-item: one work-group: all items together for each ruler, then an
//          item per line, then item 0 for the pose.
//
// A ruler takes the position s [px] on it to the frame of its line [m], u along the line and v along its normal, exactly
// for a homography: (u, v) = ((u, v) + s (u_per_px, v_per_px)) / (1 + s projective), with the fields of BoardRuler.
#include "line_fit/line_fit.h"
#include "pose/pose_result.h"
#include "ruler/ruler.h"

// Ruler: RULER in board_pose.py.
typedef struct {
    real x_px, y_px, cosine, sine;      // centre and direction in the image
    real u, v;                          // of the centre, in the frame of the line [m]
    real u_per_px, v_per_px, projective;  // [m/px, m/px, 1/px]
} BoardRuler;
#define RULER_NUMBERS (int)(sizeof(BoardRuler) / sizeof(real))

// Line of the artwork: LINE in board_pose.py.
typedef struct {
    real normal_x, normal_y, x, y; // unit normal, and a point [m]
    real sigma;                    // standard deviation of its position on the board [m]
    real etch_factor;
} BoardLine;

// Rows per line: two for offset and angle, one for the offset of a line with a single ruler.
#define ROWS_PER_LINE (MAX_RULERS_PER_LINE > 1 ? 2 : 1)

#ifdef VECTOR_VARIANT
#define SHARED private
#else
#define SHARED local
#endif

// Measured edges of all rulers: places in the frames of their lines [m], and certainties 1/sigma (0: no edge).
typedef struct {
    SHARED real *u;
    SHARED real *v;
    SHARED real *certainty;
} edge_places;

// Store the edge of ruler i from its position and sigma on the ruler [px].
static inline void put_edge(real position, real sigma, global const BoardRuler *ruler, int i, edge_places to) {
    const real per = 1 / (1 + position * ruler->projective);
    const real at_u = (ruler->u + position * ruler->u_per_px) * per, at_v = (ruler->v + position * ruler->v_per_px) * per;
    // Sigma across the line: |dv/ds| sigma, with dv/ds = (dv - v k) / (1 + s k).
    const real across = fabs(ruler->v_per_px - at_v * ruler->projective) * per * sigma;
    const int good = !not_finite(at_u) & !not_finite(at_v) & !not_finite(across) & across > 0;
    to.u[i] = good ? at_u : 0;
    to.v[i] = good ? at_v : 0;
    to.certainty[i] = good ? 1 / across : 0;
}

// Columns of the rows of the pose (pose/pose.h).
typedef struct {
    SHARED real *nx;
    SHARED real *ny;
    SHARED real *px;
    SHARED real *py;
    SHARED real *ex;
    SHARED real *ey;
    SHARED real *certainty;
    SHARED real *etch_factor;
} line_rows;

// Store row i: at u along the line, the measured line is displaced by v along its normal, with the given variance [m2].
// The variance of the line's position on the board is added. A variance that is not finite makes a missing row.
static inline void put_row(line_rows rows, int i, global const BoardLine *line, real u, real v, real variance) {
    const int good = variance > 0 && !not_finite(variance) && !not_finite(u + v);
    const real sigma = sqrt(variance + line->sigma * line->sigma);
    rows.nx[i] = good ? line->normal_x : 0;
    rows.ny[i] = good ? line->normal_y : 0;
    rows.px[i] = good ? line->x + u * line->normal_y : 0;
    rows.py[i] = good ? line->y - u * line->normal_x : 0;
    rows.ex[i] = good ? v * line->normal_x : 0;
    rows.ey[i] = good ? v * line->normal_y : 0;
    rows.certainty[i] = good ? 1 / sigma : 0;
    rows.etch_factor[i] = line->etch_factor;
}

// Store the rows of line i, fitted through (x, y) along (c, s).
//
// Offset and angle are uncorrelated at (x, y). At the distance +-sigma(offset) / sigma(angle) from it the offsets have
// the variance 2 sigma(offset)^2 and the covariance sigma(offset)^2 - reach^2 sigma(angle)^2 = 0: two independent rows
// carry the same information as offset and angle. A line with one edge, or with all edges in one place, has no angle
// and gives one row.
static inline void put_line(line_rows rows, int i, global const BoardLine *line, real x, real y, real c, real s,
                            real offset_variance, real angle_variance, int has_angle) {
    const real reach = has_angle ? sqrt(offset_variance / angle_variance) : 0, side = c < 0 ? -reach : reach;
    put_row(rows, ROWS_PER_LINE * i, line, x - side * c, y - side * s, has_angle ? 2 * offset_variance : offset_variance);
    if (ROWS_PER_LINE > 1)
        put_row(rows, ROWS_PER_LINE * i + 1, line, x + side * c, y + side * s, has_angle ? 2 * offset_variance : REAL_NAN);
}

// Fit LANES lines from `first` on; store their rows, and the weight of each edge. The least scale is the rounding error
// of the places, in sigmas.
static inline void fit_lines(laned_points all, int first, int lines, global const BoardLine *line, constant int *pairs,
                             int trials, int steps, line_rows rows, global real *edge_weights) {
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

kernel void board_pose(global const CODE *restrict image, global const BoardRuler *restrict rulers,
                      global const BoardLine *restrict line, global real *restrict pose, global real *restrict deformation,
                      global real *restrict placement, global real *restrict covariance,
                      global real *restrict residuals, global real *restrict weights, global real *restrict scale,
                      global real *restrict residual_scale, global real *restrict condition, global int *restrict rank,
                      global int *restrict inliers, global uchar *restrict status, global real *restrict etch,
                      global real *restrict inlier_fraction, global real *restrict leverage,
                      global real *restrict edges, global uchar *restrict edge_status,
                      global real *restrict edge_weights, constant real *table,
                      constant real *model, const int rows, const int columns, const int lines, const int each,
                      constant int *pairs, const int pair_trials, constant int *subsets, const int trials,
                      const int steps, const real rank_tolerance, const real min_inlier_fraction,
                      const real max_leverage, const real max_shift, const real max_turn, const real place_x,
                      const real place_y, const real etch_certainty) {
    const int count = ROWS_PER_LINE * lines, padded = (count + LANES - 1) / LANES * LANES;
    SHARED real row[8][CAPACITY];
    const line_rows lined = {row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7]};
    SHARED real place[3][MAX_RULERS];
    const edge_places places_of = {place[0], place[1], place[2]};
#ifdef VECTOR_VARIANT
    const int item = 0, items = LANES;
    ruler_edge edge[MAX_EDGES];
    for (int first = 0; first < lines * each; first += LANES) {
        ruler_measure(image, rows, columns, (global const real *)(rulers + first), RULER_NUMBERS, lines * each - first,
                      table, model, edge);
        for (int lane = 0; lane < LANES && first + lane < lines * each; lane++) {
            const int i = first + lane;
            put_edge(LANE(edge[0].position, lane), LANE(edge[0].sigma, lane), rulers + i, i, places_of);
            edges[i] = LANE(edge[0].position, lane);
            edge_status[i] = (uchar)LANE_BITS(edge[0].status, lane);
        }
    }
#else
    local ruler_memory shared;
    const int item = get_local_id(0), items = RULER_GROUP, count_of_rulers = lines * each;
    for (int first = 0; first < count_of_rulers; first += RULERS_PER_GROUP) {
        const int i = first + ruler_of_item();
        global const BoardRuler *of = rulers + min(i, count_of_rulers - 1);
        const real4 ruler = {of->x_px, of->y_px, of->cosine, of->sine};
        const ruler_edge edge = ruler_measure(image, rows, columns, ruler, table, model, &shared);
        if (ruler_lane() == 0 && i < count_of_rulers) {
            put_edge(edge.position, edge.sigma, of, i, places_of);
            edges[i] = edge.position;
            edge_status[i] = (uchar)edge.status;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
#endif
    for (int first = item; first < lines; first += items) {
        reals x[MAX_RULERS_PER_LINE], y[MAX_RULERS_PER_LINE], certainty[MAX_RULERS_PER_LINE], distances[MAX_RULERS_PER_LINE];
        for (int k = 0; k < each; k++) {
            x[k] = y[k] = certainty[k] = 0;
            for (int lane = 0; lane < LANES && first + lane < lines; lane++) {
                const int i = (first + lane) * each + k;
                LANE(x[k], lane) = place[0][i];
                LANE(y[k], lane) = place[1][i];
                LANE(certainty[k], lane) = place[2][i];
            }
        }
        const laned_points all = {x, y, certainty, distances, each};
        fit_lines(all, first, lines, line, pairs, pair_trials, steps, lined, edge_weights);
    }
#ifndef VECTOR_VARIANT
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item) return;
#endif
    // Copies in private memory of the rows, padded with missing rows.
    real nx[CAPACITY], ny[CAPACITY], px[CAPACITY], py[CAPACITY], ex[CAPACITY], ey[CAPACITY], certain[CAPACITY];
    real etch_factor[CAPACITY];
    reals room[CAPACITY];
    real sum = 0, sum_x = 0, sum_y = 0;
    for (int i = 0; i < padded; i++) {
        const int there = i < count;
        nx[i] = there ? row[0][i] : 0;
        ny[i] = there ? row[1][i] : 0;
        px[i] = there ? row[2][i] : 0;
        py[i] = there ? row[3][i] : 0;
        ex[i] = there ? row[4][i] : 0;
        ey[i] = there ? row[5][i] : 0;
        certain[i] = there ? row[6][i] : 0;
        etch_factor[i] = there ? row[7][i] : 0;
        sum += certain[i] > 0;
        sum_x += px[i];
        sum_y += py[i];
    }
    pose_rows all = {nx, ny, px, py, ex, ey, certain, etch_factor, padded, etch_certainty};
    const pose_frame frame = centre_rows(&all, sum, sum_x, sum_y);
    const laned_pose about = {0, 0, 0, 0, 0, 0, 0};
    const solved_pose fit = pose_solved(about, all, subsets, trials, steps, 1e-3f, rank_tolerance, room);
    const pose_outputs outputs = {pose,   deformation, placement, covariance, residuals, weights,
                                  scale,  residual_scale,      condition, rank,       inliers,   status,     etch,
                                  inlier_fraction, leverage};
    const pose_limits limits = {min_inlier_fraction, max_leverage, max_shift, max_turn};
    store_pose(fit, all, frame, 1, 0, count, limits, place_x, place_y, outputs);
}
