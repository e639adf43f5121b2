// A frame to a pose at once: edges along rulers, robust lines through the edges of each line of the artwork, and the
// pose from the lines. One work-item does a whole fix on CPU runtimes (waking another core takes longer than it does);
// on GPUs a work-group does: rulers together, then an item a line, then one the pose.
//
// A ruler has RULER numbers: centre and direction in the image, and where its samples lie in its line's own frame,
// (u, v) = ((u0, v0) + s (du, dv)) / (1 + s bend) for a sample s pixels from the centre.
#include "line_fit/line_fit.h"
#include "pose/pose_result.h"
#include "ruler/ruler.h"

#define RULER 9
#define LINE 6 // unit normal, point, standard deviation of where it was made, how much the etching displaces it

// Rows that a line makes: offset and angle, or of a single edge its offset.
#define EACH_ROWS (EACH > 1 ? 2 : 1)

#ifdef VECTOR_VARIANT
#define SHARED private
#else
#define SHARED local
#endif

// What rulers found, one after the other: places in their line's frame, and certainties.
typedef struct {
    SHARED real *u;
    SHARED real *v;
    SHARED real *certainty;
} fix_places;

static inline void put_edge(real position, real sigma, global const real *ruler, int i, fix_places to) {
    const real per = 1 / (1 + position * ruler[8]);
    const real at_u = (ruler[4] + position * ruler[6]) * per, at_v = (ruler[5] + position * ruler[7]) * per;
    // Along the ruler a pixel moves the place across the line by so much.
    const real across = fabs(ruler[7] - at_v * ruler[8]) * per * sigma;
    const int good = !not_finite(at_u) & !not_finite(at_v) & !not_finite(across) & across > 0;
    to.u[i] = good ? at_u : 0;
    to.v[i] = good ? at_v : 0;
    to.certainty[i] = good ? 1 / across : 0;
}

typedef struct {
    SHARED real *nx;
    SHARED real *ny;
    SHARED real *px;
    SHARED real *py;
    SHARED real *ex;
    SHARED real *ey;
    SHARED real *certainty;
    SHARED real *grows;
} fix_rows;

static inline void put_row(fix_rows rows, int i, global const real *line, real u, real v, real variance) {
    const int good = variance > 0 && !not_finite(variance) && !not_finite(u + v);
    const real sigma = sqrt(variance + line[4] * line[4]);
    rows.nx[i] = good ? line[0] : 0;
    rows.ny[i] = good ? line[1] : 0;
    rows.px[i] = good ? line[2] + u * line[1] : 0;
    rows.py[i] = good ? line[3] - u * line[0] : 0;
    rows.ex[i] = good ? v * line[0] : 0;
    rows.ey[i] = good ? v * line[1] : 0;
    rows.certainty[i] = good ? 1 / sigma : 0;
    rows.grows[i] = line[5];
}

// A line is two rows: places either side of its middle whose offsets are uncorrelated carry its offset and its angle.
// With one edge, or all in one place, it has no angle, and is one row.
static inline void put_line(fix_rows rows, int i, global const real *line, real x, real y, real c, real s, real of_offset,
                     real of_angle, int has_angle) {
    const real reach = has_angle ? sqrt(of_offset / of_angle) : 0, side = c < 0 ? -reach : reach;
    put_row(rows, EACH_ROWS * i, line, x - side * c, y - side * s, has_angle ? 2 * of_offset : of_offset);
    if (EACH_ROWS > 1)
        put_row(rows, EACH_ROWS * i + 1, line, x + side * c, y + side * s, has_angle ? 2 * of_offset : REAL_NAN);
}

// Lines `first` on of this item, LANES at once: rows of each, and a weight for each edge.
static inline void fit_lines(laned_points all, int first, int lines, global const real *line, constant int *pairs, int trials,
                      int steps, fix_rows rows, global real *edge_weights) {
    reals reach = 0;
    for (int k = 0; k < all.count; k++) {
        const reals far = (FABS(all.x[k]) + FABS(all.y[k])) * all.certainty[k];
        reach = far > reach ? far : reach;
    }
    const laned_fit fit = line_fit(all, pairs, trials, steps, (reals)REAL_EPSILON * reach + (reals)1e-30f);
    for (int lane = 0; lane < LANES && first + lane < lines; lane++) {
        const int has_angle = LANE_BITS(fit.points, lane) > 1 && !LANE_BITS(fit.coincide, lane);
        put_line(rows, first + lane, line + (first + lane) * LINE, LANE(fit.line.x, lane), LANE(fit.line.y, lane),
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

kernel void board_pose(global const CODE *restrict image, global const real *restrict rulers,
                      global const real *restrict line, global real *restrict pose, global real *restrict deformation,
                      global real *restrict placement, global real *restrict covariance,
                      global real *restrict residuals, global real *restrict weights, global real *restrict scale,
                      global real *restrict spread, global real *restrict condition, global int *restrict rank,
                      global int *restrict inliers, global uchar *restrict status, global real *restrict etch, global real *restrict agreement,
                      global real *restrict leverage, global real *restrict edges,
                      global uchar *restrict edge_status, global real *restrict edge_weights, constant real *table,
                      constant real *model, const int rows, const int columns, const int lines, const int each,
                      constant int *pairs, const int pair_trials, constant int *subsets, const int trials,
                      const int steps, const real share, const real least_agreeing,
                      const real largest_leverage, const real shift_within, const real turn_within, const real place_x,
                      const real place_y, const real etch_certainty) {
    const int count = EACH_ROWS * lines, padded = (count + LANES - 1) / LANES * LANES;
    SHARED real row[8][CAPACITY];
    const fix_rows lined = {row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7]};
    ruler_edge edge[MOST];
    SHARED real place[3][ROOM];
    const fix_places places_of = {place[0], place[1], place[2]};
#ifdef VECTOR_VARIANT
    const int item = 0, items = LANES;
    for (int first = 0; first < lines * each; first += LANES) {
        ruler_measure(image, rows, columns, rulers + first * RULER, RULER, lines * each - first, table, model, edge);
        for (int lane = 0; lane < LANES && first + lane < lines * each; lane++) {
            const int i = first + lane;
            put_edge(LANE(edge[0].position, lane), LANE(edge[0].sigma, lane), rulers + i * RULER, i, places_of);
            edges[i] = LANE(edge[0].position, lane);
            edge_status[i] = (uchar)LANE_BITS(edge[0].status, lane);
        }
    }
#else
    local real profile[LENGTH], slopes[RULER_SLOPES];
    local int flags;
    const int item = get_local_id(0), items = RULER_GROUP;
    for (int i = 0; i < lines * each; i++) {
        ruler_measure(image, rows, columns, vload4(0, rulers + i * RULER), table, model, profile, slopes, &flags, edge);
        if (item == 0) {
            put_edge(edge[0].position, edge[0].sigma, rulers + i * RULER, i, places_of);
            edges[i] = edge[0].position;
            edge_status[i] = (uchar)edge[0].status;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
#endif
    for (int first = item; first < lines; first += items) {
        reals x[EACH], y[EACH], certainty[EACH], distances[EACH];
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
    real nx[CAPACITY], ny[CAPACITY], px[CAPACITY], py[CAPACITY], ex[CAPACITY], ey[CAPACITY], certain[CAPACITY];
    real grows[CAPACITY];
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
        grows[i] = there ? row[7][i] : 0;
        sum += certain[i] > 0;
        sum_x += px[i];
        sum_y += py[i];
    }
    pose_rows all = {nx, ny, px, py, ex, ey, certain, grows, padded, etch_certainty};
    const pose_frame frame = framed(&all, sum, sum_x, sum_y);
    const laned_pose about = {0, 0, 0, 0, 0, 0, 0};
    const solved_pose fit = pose_solved(about, all, subsets, trials, steps, 1e-3f, share, room);
    const pose_outputs outputs = {pose,   deformation, placement, covariance, residuals, weights,
                                  scale,  spread,      condition, rank,       inliers,   status,     etch,
                                  agreement, leverage};
    const pose_limits asked = {least_agreeing, largest_leverage, shift_within, turn_within};
    store_pose(fit, all, frame, 1, 0, count, asked, place_x, place_y, outputs);
}
