// Pose of a board from an image: edges along calipers (rulers), a robust line through the edges of each line of the artwork,
// and a robust pose from these lines.
//
// Variants: vector: board_pose, one work-item computes everything in one launch, 16 rulers or lines in a vector (starting
//           a second core would take longer than the computation); work-item: three launches: board_edges, groups of
//           RULERS_PER_GROUP rulers; board_lines, an item per line; pose/pose.cl.
//
// A program has one of the three kernels: BOARD_EDGES builds board_edges, BOARD_LINES board_lines, otherwise board_pose
// is built. Each kernel states its inputs and options.
#ifdef BOARD_EDGES
// Edges along the rulers of a board, in the frames of their lines (board_edge.h).
//
// Inputs:  image (rows, columns), type CODE; rulers (count,) BoardRuler.
// Outputs: edges (count,) [px]; status (count,); places (3, count): u, v [m], certainty [1/m].
// Tables:  table, model (ruler/ruler.h).
// Options: BOARD_EDGES; the options of ruler/ruler.h.
// Work:    a group of RULER_GROUP items takes RULERS_PER_GROUP rulers (ruler/ruler_group.h).
#include "board_pose/board_edge.h"

kernel void board_edges(global const CODE *restrict image, global const BoardRuler *restrict rulers,
                        global real *restrict edges, global uchar *restrict status, global real *restrict places,
                        constant real *table, constant real *model, const int rows, const int columns,
                        const uint count) {
    local ruler_memory shared;
    // Items beyond the last ruler repeat it, because all items of a group take part in its barriers.
    const uint i = get_group_id(0) * RULERS_PER_GROUP + ruler_of_item(), last = min(i, count - 1);
    global const BoardRuler *of = rulers + last;
    const real4 ruler = {of->x_px, of->y_px, of->cosine, of->sine};
    const ruler_edge edge = ruler_measure(image, rows, columns, ruler, table, model, &shared);
    if (i != last || ruler_lane() > 0) return;
    const board_edge found = board_edge_of(edge.position, edge.sigma, of);
    places[i] = found.u;
    places[count + i] = found.v;
    places[2 * count + i] = found.certainty;
    edges[i] = edge.position;
    status[i] = (uchar)edge.status;
}
#elif defined(BOARD_LINES)
// Robust lines through the edges of a board, as rows of its pose (board_line.h).
//
// Inputs:  places (3, lines, each): u, v [m], certainty [1/m]; line (lines,) BoardLine.
// Outputs: rows (lines * ROWS_PER_LINE,) PoseRow, as pose/pose.cl takes them; edge_weights (lines, each).
// Tables:  pairs (pair_trials, 2): edges of the start candidates of a line.
// Options: BOARD_LINES; the options of board_line.h.
// Work:    an item per line. The edges of a line are copied to private memory, because the fit reads them many times.
#include "board_pose/board_line.h"

kernel void board_lines(global const real *restrict places, global const BoardLine *restrict line,
                        global PoseRow *restrict rows, global real *restrict edge_weights, const int lines, const int each,
                        constant int *pairs, const int pair_trials, const int steps) {
    const int i = get_global_id(0);
    if (i >= lines) return;
    real u[MAX_RULERS_PER_LINE], v[MAX_RULERS_PER_LINE], certainty[MAX_RULERS_PER_LINE], distances[MAX_RULERS_PER_LINE];
    for (int k = 0; k < each; k++) {
        u[k] = places[i * each + k];
        v[k] = places[(lines + i) * each + k];
        certainty[k] = places[(2 * lines + i) * each + k];
    }
    const laned_points all = {u, v, certainty, distances, each};
    fit_lines(all, i, lines, line, pairs, pair_trials, steps, rows, edge_weights);
}
#else
// Inputs:  image (rows, columns), type CODE; rulers (lines, each) BoardRuler; line (lines,) BoardLine.
// Tables:  table, model (ruler/ruler.h); pairs (pair_trials, 2): edges of the start candidates of a line; subsets
//          (trials / LANES, FREEDOMS, LANES): rows of the start candidates of the pose.
// Outputs: pose (3,) x, y [m], theta [rad]; deformation (3,); placement (2,) [m]; covariance (POSE_PARAMETERS,
//          POSE_PARAMETERS); residuals [m] and weights (lines, ROWS_PER_LINE); scale, residual_scale, condition, rank,
//          inliers, status, etch [m], inlier_fraction, leverage: one number each (pose/pose.cl); edges [px], edge_status,
//          edge_weights (lines, each).
// Options: the options of ruler/ruler.h, line_fit/line_fit.h and pose/pose.h; MAX_RULERS_PER_LINE: capacity
//          for the rulers of a line; MAX_RULERS: capacity for all rulers.
// Work:    one work-item.
#include "board_pose/board_edge.h"
#include "board_pose/board_line.h"
#include "pose/pose_result.h"

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
    const int count = ROWS_PER_LINE * lines;
    real numbers[POSE_COLUMNS][CAPACITY];
    pose_rows all = rows_in(numbers, (count + LANES - 1) / LANES * LANES, etch_certainty);
    real place[3][MAX_RULERS];
    ruler_edge edge[MAX_EDGES];
    for (int first = 0; first < lines * each; first += LANES) {
        ruler_measure(image, rows, columns, (global const real *)(rulers + first), RULER_NUMBERS, lines * each - first,
                      table, model, edge);
        for (int lane = 0; lane < LANES && first + lane < lines * each; lane++) {
            const int i = first + lane;
            const board_edge found = board_edge_of(LANE(edge[0].position, lane), LANE(edge[0].sigma, lane), rulers + i);
            place[0][i] = found.u;
            place[1][i] = found.v;
            place[2][i] = found.certainty;
            edges[i] = LANE(edge[0].position, lane);
            edge_status[i] = (uchar)LANE_BITS(edge[0].status, lane);
        }
    }
    for (int first = 0; first < lines; first += LANES) {
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
        const laned_points points = {x, y, certainty, distances, each};
        fit_lines(points, first, lines, line, pairs, pair_trials, steps, all, edge_weights);
    }
    const pose_row missing = {0, 0, 0, 0, 0, 0, 0, 0};
    for (int i = count; i < all.count; i++) put_row(all, i, missing);
    reals distances[CAPACITY];
    const pose_room room = {distances, 0};
    const pose_frame frame = centre_rows(&all);
    const laned_pose about = {0, 0, 0, 0, 0, 0, 0};
    solved_pose fit;
    fit.pose = about;
    pose_solved(&fit, all, subsets, trials, steps, 1e-3f, rank_tolerance, room);
    const pose_outputs outputs = {pose,   deformation, placement, covariance, residuals, weights,
                                  scale,  residual_scale,      condition, rank,       inliers,   status,     etch,
                                  inlier_fraction, leverage};
    const pose_limits limits = {min_inlier_fraction, max_leverage, max_shift, max_turn};
    store_pose(&fit, all, frame, 1, 0, count, limits, place_x, place_y, outputs);
}
#endif
