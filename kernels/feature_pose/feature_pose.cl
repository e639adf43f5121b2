// Pose of a camera over a board from the measured edges, pairs of edges and fiducials (feature_view.h).
//
// Each ruler gives one row of the pose (pose/pose.h), each fiducial two, along the principal axes of its covariance.
//
// Inputs:  expected (3,): pose of the camera for which the features were placed; of the rulers position, sigma [px],
//          status (ruler_count,); of matched and of drilled fiducials shift [px], size [px], covariance [px^2], status.
// Outputs: pose (3,) [m, m, rad] and covariance (3, 3) of the camera; motion (3,) of the board about the placement point,
//          as the expected camera sees it, and motion_covariance at that camera's centre; residuals [m] and weights
//          (rows,): rulers, then two for each fiducial; feature_status: rulers, then fiducials; the others as in pose.cl.
// Tables:  ruler, fiducial, view; subsets as in pose.cl.
// Options: WIDE; WITH_RULERS, WITH_MATCHED, WITH_DRILLED: these features exist; the options of pose/pose.h.
// Variants: as in pose.cl. One work-item computes the pose.
#include "feature_pose/feature_view.h"
#include "pose/pose_result.h"

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
} feature_rows;

static inline void put_row(feature_rows rows, int i, real nx, real ny, real px, real py, real ex, real ey, real sigma,
                           real etch_factor) {
    const int good = sigma > 0 && !not_finite(sigma + ex + ey);
    rows.nx[i] = good ? nx : 0;
    rows.ny[i] = good ? ny : 0;
    rows.px[i] = good ? px : 0;
    rows.py[i] = good ? py : 0;
    rows.ex[i] = good ? ex : 0;
    rows.ey[i] = good ? ey : 0;
    rows.certainty[i] = good ? 1 / sigma : 0;
#ifdef WITH_ETCH_BIAS
    rows.etch_factor[i] = good ? etch_factor : 0;
#endif
}

// Results of blob.cl.
typedef struct {
    global const real *shift;
    global const real *size;
    global const real *covariance;
    global const uchar *status;
} found_blobs;

// Store the two rows of a fiducial along the principal axes of its covariance, and return its status.
//
// A blob whose size differs from the drawn one by more than the tolerance is not the fiducial: AMBIGUOUS. The shift of
// the image [px] and the axes are taken to the board by the inverse of the view's linear part, scale S' R(theta).
static inline uchar put_fiducial(feature_rows rows, int row, FeatureFiducial from, found_blobs found, int i,
                                 feature_matrix to, real scale, real sigma_px, real tolerance) {
    global const real *shift = found.shift + 2 * i, *covariance = found.covariance + 9 * i;
    const int is_wrong = fabs(found.size[i] * scale - from.radius) > tolerance;
    const real xx = covariance[0] + sigma_px * sigma_px, yy = covariance[4] + sigma_px * sigma_px, xy = covariance[1];
    // Larger eigenvalue, and its direction: the column of C - smaller I with the larger norm.
    const real mean = (real)0.5f * (xx + yy), half_difference = (real)0.5f * (xx - yy);
    const real root = sqrt(half_difference * half_difference + xy * xy);
    const real along_x = half_difference >= 0 ? half_difference + root : xy;
    const real along_y = half_difference >= 0 ? xy : root - half_difference;
    const real length = sqrt(along_x * along_x + along_y * along_y), per = length > 0 ? 1 / length : 0;
    const real u = length > 0 ? along_x * per : 1, v = along_y * per;
    const real back_xx = to.xx * scale, back_xy = to.yx * scale, back_yx = to.xy * scale, back_yy = to.yy * scale;
    const real ex = (back_xx * shift[0] + back_xy * shift[1]) * scale, ey = (back_yx * shift[0] + back_yy * shift[1]) * scale;
    const real nx = back_xx * u + back_xy * v, ny = back_yx * u + back_yy * v;
    const real mx = back_xy * u - back_xx * v, my = back_yy * u - back_yx * v;
    const real none = is_wrong ? REAL_NAN : 0;
    put_row(rows, row, nx, ny, from.x, from.y, ex, ey, sqrt(mean + root) * scale + none, 0);
    put_row(rows, row + 1, mx, my, from.x, from.y, ex, ey, sqrt(mean - root) * scale + none, 0);
    return found.status[i] | (is_wrong ? STATUS_AMBIGUOUS : 0);
}

// Change a motion of the board and its covariance into the pose of the camera and its covariance, in place.
//
// The rows give the board's motion q = R p + t as the expected camera at c sees it; the camera is then at
// c' = R^T (c - t), and its angle is less by that of R. With P = R c + t, the measured place of the point c:
// c' = R^T (c - P) + c, so that dc' = -R^T dP - J R^T (c - P) dtheta with J the rotation by 90 degrees.
static inline void store_camera(global const real *motion, real at_x, real at_y, global const WIDE *expected,
                                real residual_scale, global WIDE *pose, global WIDE *covariance,
                                global const real *of_board) {
    const real half_sine = sin(motion[2] / 2), less = -2 * half_sine * half_sine, s = sin(motion[2]), c = 1 + less;
    // c - P = -(R - I) c - t, from small numbers.
    const real x = -(less * at_x - s * at_y) - motion[0], y = -(s * at_x + less * at_y) - motion[1];
    const real back_x = c * x + s * y, back_y = c * y - s * x;
    const real jacobian[3][3] = {{-c, -s, back_y}, {s, -c, -back_x}, {0, 0, -1}};
    pose[0] = expected[0] + back_x;
    pose[1] = expected[1] + back_y;
    const WIDE turn = expected[2] - motion[2], whole = 2 * (WIDE)3.14159265358979323846;
    pose[2] = turn - whole * rint(turn / whole);
    const real per = 1 / (residual_scale * residual_scale);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            real total = 0;
            for (int k = 0; k < 3; k++)
                for (int l = 0; l < 3; l++) total += jacobian[i][k] * of_board[3 * k + l] * jacobian[j][l];
            covariance[3 * i + j] = total * per;
        }
}

kernel void feature_pose(global const WIDE *restrict expected,
#ifdef WITH_RULERS
                         global const real *restrict position, global const real *restrict sigma,
                         global const uchar *restrict ruler_status,
#endif
#ifdef WITH_MATCHED
                         global const real *restrict matched_shift, global const real *restrict matched_size,
                         global const real *restrict matched_covariance, global const uchar *restrict matched_status,
#endif
#ifdef WITH_DRILLED
                         global const real *restrict drilled_shift, global const real *restrict drilled_size,
                         global const real *restrict drilled_covariance, global const uchar *restrict drilled_status,
#endif
                         global WIDE *restrict pose, global WIDE *restrict covariance, global uchar *restrict status,
                         global real *restrict residuals, global real *restrict weights,
                         global uchar *restrict feature_status, global real *restrict scale,
                         global real *restrict residual_scale, global real *restrict condition,
                         global int *restrict rank, global int *restrict inliers, global real *restrict etch,
                         global real *restrict inlier_fraction, global real *restrict leverage,
                         global real *restrict motion, global real *restrict motion_covariance,
                         constant const FeatureRuler *ruler, constant const FeatureFiducial *fiducial,
                         constant const FeatureView *view, const int ruler_count, const int matched_count,
                         const int drilled_count, constant int *subsets, const int trials, const int steps,
                         const real min_scale, const real rank_tolerance, const real min_inlier_fraction,
                         const real max_leverage, const real max_shift, const real max_turn, const real etch_certainty,
                         const real ruler_sigma_px, const real matched_sigma_px, const real drilled_sigma_px,
                         const real tolerance) {
    if (get_global_id(0)) return;
    real nx[CAPACITY], ny[CAPACITY], px[CAPACITY], py[CAPACITY], ex[CAPACITY], ey[CAPACITY], certainty[CAPACITY];
    reals room[CAPACITY];
#ifdef WITH_ETCH_BIAS
    real etch_factor[CAPACITY];
#else
    private real *etch_factor = 0;
#endif
    const feature_rows rows = {nx, ny, px, py, ex, ey, certainty, etch_factor};
    const real per_pixel = view->scale;
#ifdef WITH_RULERS
    for (int i = 0; i < ruler_count; i++) {
        const FeatureRuler from = ruler[i];
        const real moved = position[i] * per_pixel;
        const real of = sqrt(sigma[i] * sigma[i] + ruler_sigma_px * ruler_sigma_px) * per_pixel;
        put_row(rows, i, from.normal_x, from.normal_y, from.x, from.y, from.normal_x * moved, from.normal_y * moved, of,
                from.etch_factor);
        feature_status[i] = ruler_status[i];
    }
#endif
#if defined(WITH_MATCHED) || defined(WITH_DRILLED)
    const feature_matrix to = linear_of(expected, view);
#endif
#ifdef WITH_MATCHED
    const found_blobs by_match = {matched_shift, matched_size, matched_covariance, matched_status};
    for (int i = 0; i < matched_count; i++)
        feature_status[ruler_count + i] = put_fiducial(rows, ruler_count + 2 * i, fiducial[i], by_match, i, to,
                                                       per_pixel, matched_sigma_px, tolerance);
#endif
#ifdef WITH_DRILLED
    const found_blobs by_edges = {drilled_shift, drilled_size, drilled_covariance, drilled_status};
    for (int i = 0; i < drilled_count; i++)
        feature_status[ruler_count + matched_count + i] =
            put_fiducial(rows, ruler_count + 2 * (matched_count + i), fiducial[matched_count + i], by_edges, i, to,
                         per_pixel, drilled_sigma_px, tolerance);
#endif
    const int count = ruler_count + 2 * (matched_count + drilled_count), padded = (count + LANES - 1) / LANES * LANES;
    for (int i = count; i < padded; i++) put_row(rows, i, 0, 0, 0, 0, 0, 0, 0, 0);
    real sum = 0, sum_x = 0, sum_y = 0;
    for (int i = 0; i < count; i++) {
        sum += certainty[i] > 0;
        sum_x += px[i];
        sum_y += py[i];
    }
    pose_rows all = {nx, ny, px, py, ex, ey, certainty, etch_factor, padded, etch_certainty};
    const pose_frame frame = centre_rows(&all, sum, sum_x, sum_y);
    const laned_pose about = {0, 0, 0, 0, 0, 0, 0};
    solved_pose fit = pose_solved(about, all, subsets, trials, steps, min_scale, rank_tolerance, room);
    const pose_outputs outputs = {motion, 0,         0,    motion_covariance, residuals, weights, scale, residual_scale,
                                  condition, rank, inliers, status,           etch,      inlier_fraction, leverage};
    const pose_limits limits = {min_inlier_fraction, max_leverage, max_shift, max_turn};
    const real at_x = expected[0] - view->placement_x, at_y = expected[1] - view->placement_y;
    const int all_finite = !(not_finite(at_x) | not_finite(at_y) | not_finite((real)expected[2]));
#ifdef GIVEN_SCALE
    const real factor = 1;
#else
    const real factor = fit.covariance_factor;
    if (factor < 1) fit.covariance_factor = 1;
#endif
    store_pose(fit, all, frame, all_finite, 0, count, limits, at_x, at_y, outputs);
#ifdef GIVEN_SCALE
    const real smallest = 1;
#else
    // The residuals of few edges may be small by chance: the covariance is not scaled down by them. fmin: 1 for NaN,
    // no degrees of freedom.
    const real smallest = factor < 1 ? 1 : fmin(*residual_scale, (real)1);
#endif
    store_camera(motion, at_x, at_y, expected, smallest, pose, covariance, motion_covariance);
    for (int i = 0; i < 9 && factor < 1; i++) motion_covariance[i] *= factor;
}
