// Pose of a board from an image: edges along calipers (rulers), a robust line through the edges of each line of the artwork,
// and a robust pose from these lines.
//
// Variants: vector: board_pose, one work-item computes everything in one launch, 16 rulers or lines in a vector (starting
//           a second core would take longer than the computation); work-item: three launches: board_edges, groups of
//           RULERS_PER_GROUP rulers; board_lines, a group per line; pose/pose.cl.
//
// A program has one of the three kernels: BOARD_EDGES builds board_edges, BOARD_LINES board_lines, otherwise board_pose
// is built. Each kernel states its inputs and options.
#ifdef BOARD_EDGES
// Edges along the rulers of a board, in the frames of their lines (board_edge.h).
//
// Inputs:  image (rows, columns), type CODE; rulers (count,) BoardRuler.
// Outputs: edges (count,) [px]; status (count,); places (count, 2): u, v [m]; sigmas (count,): across the line [m].
// Tables:  table, model (ruler/ruler.h).
// Options: BOARD_EDGES; the options of ruler/ruler.h.
// Work:    a group of RULER_GROUP items takes RULERS_PER_GROUP rulers (ruler/ruler_group.h).
#include "board_pose/board_edge.h"

kernel void board_edges(global const CODE *restrict image, global const BoardRuler *restrict rulers,
                        global real *restrict edges, global uchar *restrict status, global real *restrict places,
                        global real *restrict sigmas, constant real *table, constant real *model, const int rows,
                        const int columns, const uint count) {
    local ruler_memory shared;
    // Items beyond the last ruler repeat it, because all items of a group take part in its barriers.
    const uint i = get_group_id(0) * RULERS_PER_GROUP + ruler_of_item(), last = min(i, count - 1);
    global const BoardRuler *of = rulers + last;
    const real4 ruler = {of->x_px, of->y_px, of->cosine, of->sine};
    const ruler_edge edge = ruler_measure(image, rows, columns, ruler, table, model, &shared);
    if (i != last || ruler_lane() > 0) return;
    const board_edge found = board_edge_of(edge.position, edge.sigma, of);
    places[2 * i] = found.u;
    places[2 * i + 1] = found.v;
    sigmas[i] = found.sigma;
    edges[i] = edge.position;
    status[i] = (uchar)edge.status;
}
#elif defined(BOARD_LINES)
// Robust lines through the edges of a board, as rows of its pose (board_line.h).
//
// Inputs:  places (lines, each, 2): u, v [m]; sigmas (lines, each): across the line [m]; line (lines,) BoardLine.
// Outputs: rows (lines * rows of a line,) PoseRow, as pose/pose.cl takes them; edge_weights (lines, each); status (lines,),
//          as in line_fit/line_fit.cl.
// Tables:  pairs (pair_trials, 2): edges of the start candidates of a line.
// Options: BOARD_LINES; the options of board_line.h.
// Work:    a group of up to 64 items per line, as in line_fit/line_fit.cl.
#define GROUP_PER_PROBLEM
#define WITH_SIGMA
#include "board_pose/board_line.h"

kernel void board_lines(global const real *restrict places, global const real *restrict sigmas,
                        global const BoardLine *restrict line, global PoseRow *restrict rows,
                        global real *restrict edge_weights, global ushort *restrict status, const int lines,
                        const int each, constant int *pairs, const int pair_trials, const int steps) {
    const int i = get_group_id(0);
    local real sums[ROOM_FOR_SUMS], distances[ROOM_FOR_DISTANCES];
    // Places are relative to the point of their line: no other origin is needed.
    const laned_points all = {places + 2 * i * each, sigmas + i * each, 0, 0, distances, sums, each};
    real reach;
    about_first_point(all, &reach);
    fit_lines(all, reach, i, lines, line, pairs, pair_trials, steps, rows, edge_weights, status);
}
#else
// Inputs:  image (rows, columns), type CODE; rulers (lines, each) BoardRuler; line (lines,) BoardLine.
// Tables:  table, model (ruler/ruler.h); pairs (pair_trials, 2): edges of the start candidates of a line; subsets
//          (trials / LANES, FREEDOMS, LANES): rows of the start candidates of the pose.
// Outputs: pose (3,) x, y [m], theta [rad]; deformation (3,); placement (2,) [m]; covariance (POSE_PARAMETERS,
//          POSE_PARAMETERS); residuals [m] and weights (lines, rows of a line); scale, residual_scale, condition, rank,
//          inliers, status, etch [m], inlier_fraction, leverage: one number each (pose/pose.cl); edges [px], edge_status,
//          edge_weights (lines, each); of_lines (lines,): status, as in line_fit/line_fit.cl.
// Options: the options of ruler/ruler.h, line_fit/line_fit.h and pose/pose.h (ROWS_IN_PAIRS: lines have several rulers);
//          MAX_RULERS_PER_LINE: capacity for the rulers of a line; MAX_RULERS: capacity for all rulers.
// Work:    one work-item.
#include "board_pose/board_edge.h"
#include "board_pose/board_line.h"
#include "pose/pose_result.h"

kernel void board_pose(global const CODE *restrict image, global const BoardRuler *restrict rulers,
                      global const BoardLine *restrict line, global real *restrict pose, global real *restrict deformation,
                      global real *restrict placement, global real *restrict covariance,
                      global real *restrict residuals, global real *restrict weights, global real *restrict scale,
                      global real *restrict residual_scale, global real *restrict condition, global int *restrict rank,
                      global int *restrict inliers, global ushort *restrict status, global real *restrict etch,
                      global real *restrict inlier_fraction, global real *restrict leverage,
                      global real *restrict edges, global uchar *restrict edge_status,
                      global real *restrict edge_weights, global ushort *restrict of_lines, constant real *table,
                      constant real *model, const int rows, const int columns, const int lines, const int each,
                      constant int *pairs, const int pair_trials, constant int *subsets, const int trials,
                      const int steps, const real rank_tolerance, const real min_inlier_fraction,
                      const real max_leverage, const real max_shift, const real max_turn, const real place_x,
                      const real place_y, const real etch_certainty) {
    const int count = rows_of_line(each) * lines;
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
            place[2][i] = found.sigma > 0 ? 1 / found.sigma : 0;
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
        reals reach = 0;
        for (int k = 0; k < each; k++) {
            const reals far = (FABS(x[k]) + FABS(y[k])) * certainty[k];
            reach = far > reach ? far : reach;
        }
        const laned_points points = {x, y, certainty, distances, each};
        fit_lines(points, reach, first, lines, line, pairs, pair_trials, steps, all, edge_weights, of_lines);
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
    store_pose(&fit, all, frame, STATUS_OK, 0, count, limits, place_x, place_y, outputs);
}
#endif
