// Pose of a camera over a board from the features of a frame: places of the features in the frame, and the pose.
//
// A program has one of the two kernels: PLACE_FEATURES builds the places, otherwise the pose is built. Each kernel states
// its inputs and options.
#ifdef PLACE_FEATURES
// Places of rulers and fiducials in the frame of a camera at a pose (feature_view.h).
//
// Inputs:  pose (3,): x, y [m], theta [rad]; corner (2,): column, row of the frame's first pixel in the full image.
// Outputs: rulers (ruler_count, 7), as ruler.cl takes them with PER_RULER; matched, drilled (count, 3): x, y, radius [px].
// Tables:  ruler, fiducial (matched ones, then drilled ones), view; distortion, correction (feature_lens.h).
// Options: PLACE_FEATURES, WIDE; LENS or CAMERA: the frame is distorted (feature_lens.h).
// Variants: vector: one work-item places everything (a second core would take longer to start); work-item: the items of
//          a group place every 64th feature each.
#include "feature_pose/feature_lens.h"

kernel void place_features(global const WIDE *restrict pose, global const real *restrict corner,
                           global real *restrict rulers, global real *restrict matched, global real *restrict drilled,
                           constant const FeatureRuler *ruler, constant const FeatureFiducial *fiducial,
                           constant const FeatureView *view, const int ruler_count, const int matched_count,
                           const int drilled_count, constant real *distortion, constant real *correction) {
    const feature_matrix to = matrix_of(pose, corner, view);
    for (int i = get_global_id(0); i < ruler_count; i += get_global_size(0)) {
        const FeatureRuler from = ruler[i];
        global real *placed = rulers + 7 * i;
        placed[0] = to.x + (to.xx * from.x + to.xy * from.y);
        placed[1] = to.y + (to.yx * from.x + to.yy * from.y);
        placed[2] = (to.xx * from.normal_x + to.xy * from.normal_y) * view->scale;
        placed[3] = (to.yx * from.normal_x + to.yy * from.normal_y) * view->scale;
        placed[4] = from.polarity;
        placed[5] = from.least_px;
        placed[6] = from.greatest_px;
    }
    for (int i = get_global_id(0); i < matched_count + drilled_count; i += get_global_size(0)) {
        const FeatureFiducial from = fiducial[i];
        global real *placed = i < matched_count ? matched + 3 * i : drilled + 3 * (i - matched_count);
        placed[0] = to.x + (to.xx * from.x + to.xy * from.y);
        placed[1] = to.y + (to.yx * from.x + to.yy * from.y);
        placed[2] = from.radius / view->scale;
#ifdef FEATURE_LENS
        distort_fiducial(placed, corner[0], corner[1], distortion);
#endif
    }
#ifdef FEATURE_LENS
    // An item moves the rulers that it has placed: the vector variant has one item, the other one lane.
    for (int i = LANES * get_global_id(0); i < ruler_count; i += LANES * get_global_size(0))
        distort_rulers(rulers, i, ruler_count, corner[0], corner[1], distortion, correction);
#endif
}
#else
// Pose of a camera over a board from the measured edges, pairs of edges and fiducials (feature_view.h).
//
// Each ruler gives one row of the pose (pose/pose.h), each fiducial two, along the principal axes of its covariance.
//
// Inputs:  expected (3,): pose of the camera for which the features were placed; corner (2,) as for place_features; of the
//          rulers position, sigma [px], status (ruler_count,), of matched and of drilled fiducials shift [px], size [px],
//          covariance [px^2], status, and of each kind the places from place_features.
// Outputs: pose (3,) [m, m, rad] and covariance (3, 3) of the camera; motion (3,) of the board about the placement point,
//          as the expected camera sees it, and motion_covariance at that camera's centre; residuals [m] and weights
//          (rows,): rulers, then two for each fiducial; feature_status: rulers, then fiducials; the others as in pose.cl.
// Tables:  ruler, fiducial, view; correction (feature_lens.h); subsets as in pose.cl.
// Options: WIDE; WITH_RULERS, WITH_MATCHED, WITH_DRILLED: these features exist; LENS or CAMERA: the frame is distorted
//          (feature_lens.h); the options of pose/pose.h.
// Variants: as in pose.cl. One work-item computes the pose.
#include "feature_pose/feature_rows.h"

kernel void feature_pose(global const WIDE *restrict expected, global const real *restrict corner,
#ifdef WITH_RULERS
                         global const real *restrict position, global const real *restrict sigma,
                         global const uchar *restrict ruler_status, global const real *restrict placed_rulers,
#endif
#ifdef WITH_MATCHED
                         global const real *restrict matched_shift, global const real *restrict matched_size,
                         global const real *restrict matched_covariance, global const uchar *restrict matched_status,
                         global const real *restrict placed_matched,
#endif
#ifdef WITH_DRILLED
                         global const real *restrict drilled_shift, global const real *restrict drilled_size,
                         global const real *restrict drilled_covariance, global const uchar *restrict drilled_status,
                         global const real *restrict placed_drilled,
#endif
                         global WIDE *restrict pose, global WIDE *restrict covariance, global ushort *restrict status,
                         global real *restrict residuals, global real *restrict weights,
                         global uchar *restrict feature_status, global real *restrict scale,
                         global real *restrict residual_scale, global real *restrict condition,
                         global int *restrict rank, global int *restrict inliers, global real *restrict etch,
                         global real *restrict inlier_fraction, global real *restrict leverage,
                         global real *restrict motion, global real *restrict motion_covariance,
                         constant const FeatureRuler *ruler, constant const FeatureFiducial *fiducial,
                         constant const FeatureView *view, const int ruler_count, const int matched_count,
                         const int drilled_count, constant real *correction, constant int *subsets, const int trials,
                         const int steps, const real min_scale, const real rank_tolerance,
                         const real min_inlier_fraction, const real max_leverage, const real max_shift,
                         const real max_turn, const real etch_certainty, const real ruler_sigma_px,
                         const real matched_sigma_px, const real drilled_sigma_px, const real tolerance,
                         const real min_share, const real max_residual) {
    if (get_global_id(0)) return;
    const int count = ruler_count + 2 * (matched_count + drilled_count);
    real numbers[POSE_COLUMNS][CAPACITY];
    reals distances[CAPACITY];
    const pose_room room = {distances, 0};
    pose_rows rows = rows_in(numbers, (count + LANES - 1) / LANES * LANES, etch_certainty);
    const real per_pixel = view->scale;
    const real at_x = expected[0] - view->placement_x, at_y = expected[1] - view->placement_y;
    const int is_pose_finite = !(not_finite(at_x) | not_finite(at_y) | not_finite((real)expected[2]));
    const measured_frame frame = {linear_of(expected, view), per_pixel, corner[0], corner[1], is_pose_finite, correction};
#ifdef WITH_RULERS
    const found_edges edges = {position, sigma, ruler_status, placed_rulers};
    put_rulers(rows, ruler, ruler_count, edges, frame, ruler_sigma_px, feature_status);
#endif
#ifdef WITH_MATCHED
    const found_blobs by_match = {matched_shift, matched_size, matched_covariance, matched_status, placed_matched};
    for (int i = 0; i < matched_count; i++)
        feature_status[ruler_count + i] =
            put_fiducial(rows, ruler_count + 2 * i, fiducial[i], by_match, i, frame, matched_sigma_px, tolerance);
#endif
#ifdef WITH_DRILLED
    const found_blobs by_edges = {drilled_shift, drilled_size, drilled_covariance, drilled_status, placed_drilled};
    for (int i = 0; i < drilled_count; i++)
        feature_status[ruler_count + matched_count + i] =
            put_fiducial(rows, ruler_count + 2 * (matched_count + i), fiducial[matched_count + i], by_edges, i, frame,
                         drilled_sigma_px, tolerance);
#endif
    const pose_row missing = {0, 0, 0, 0, 0, 0, 0, 0};
    for (int i = count; i < rows.count; i++) put_row(rows, i, missing);
    const pose_frame centred = centre_rows(&rows);
    const laned_pose about = {0, 0, 0, 0, 0, 0, 0};
    solved_pose fit;
    fit.pose = about;
    pose_solved(&fit, rows, subsets, trials, steps, min_scale, rank_tolerance, room);
    const pose_outputs outputs = {motion, 0,         0,    motion_covariance, residuals, weights, scale, residual_scale,
                                  condition, rank, inliers, status,           etch,      inlier_fraction, leverage};
    const pose_limits limits = {min_inlier_fraction, max_leverage, max_shift, max_turn};
#ifdef GIVEN_SCALE
    const real factor = 1;
#else
    const real factor = fit.covariance_factor;
    if (factor < 1) fit.covariance_factor = 1;
#endif
    const int is_other = is_another_board(&fit, rows, centred.size, ruler_count, matched_count + drilled_count,
                                          feature_status, room, min_share, max_residual);
    const ushort verdict = !is_pose_finite ? STATUS_NOT_FINITE : is_other ? STATUS_AMBIGUOUS : STATUS_OK;
    store_pose(&fit, rows, centred, verdict, 0, count, limits, at_x, at_y, outputs);
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
#endif
