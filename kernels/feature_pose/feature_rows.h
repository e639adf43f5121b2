// Rows of the pose of a camera (pose/pose.h) from measured rulers and fiducials, and the camera's pose from the solution.
#ifndef FEATURE_ROWS_H
#define FEATURE_ROWS_H

#include "common/status.h"
#include "feature_pose/feature_lens.h"
#include "pose/pose_result.h"

// Frame and expected view: linear part of the view, pixel size [m], first pixel of the frame in the full image, whether the
// expected pose is finite, and with a lens its table (feature_lens.h).
typedef struct {
    feature_matrix to;
    real scale, left, top;
    int is_pose_finite;
    constant real *correction;
} measured_frame;

// Results of ruler.cl, and the rulers that it took.
typedef struct {
    global const real *position;
    global const real *sigma;
    global const uchar *status;
    global const real *placed;
} found_edges;

// Results of blob.cl, and the places that it took.
typedef struct {
    global const real *shift;
    global const real *size;
    global const real *covariance;
    global const uchar *status;
    global const real *placed;
} found_blobs;

// Blob in the undistorted image: shift from the expected place [px], size [px], covariance of the place [px^2], status.
typedef struct {
    real x, y, size, xx, xy, yy;
    uchar status;
} undistorted_blob;

#ifdef FEATURE_LENS
// Status of a feature at a placed coordinate, which is NaN past the fold of the lens.
static inline uchar lens_status(uchar status, real placed, measured_frame frame) {
    return frame.is_pose_finite && not_finite(placed) ? STATUS_NOT_INVERTIBLE : status;
}

// Compute displacements and sigmas of LANES edges from ruler i on, along the normals in the undistorted image [px].
//
// The position of a pair is the middle of its edges, which the lens does not keep: take both edges to the undistorted
// image, half the expected spacing (the middle of its limits) on either side. The limits of a single edge are 0.
static inline void undistort_edges(found_edges found, constant const FeatureRuler *ruler, int i, int count,
                                   measured_frame frame, private real *moved, private real *undistorted_sigma) {
    const feature_matrix to = frame.to;
    real normal_x[LANES], normal_y[LANES];
    for (int k = 0; k < LANES; k++) {
        const FeatureRuler from = ruler[min(i + k, count - 1)];
        normal_x[k] = (to.xx * from.normal_x + to.xy * from.normal_y) * frame.scale;
        normal_y[k] = (to.yx * from.normal_x + to.yy * from.normal_y) * frame.scale;
    }
    global const real *placed = found.placed;
    const reals x = gather_lanes(placed, 7, i, count) + frame.left, y = gather_lanes(placed + 1, 7, i, count) + frame.top;
    const reals cosine = gather_lanes(placed + 2, 7, i, count), sine = gather_lanes(placed + 3, 7, i, count);
    const reals reach = (gather_lanes(placed + 5, 7, i, count) + gather_lanes(placed + 6, 7, i, count)) * (real)0.25f;
    const reals distance = gather_lanes(found.position, 1, i, count);
    const reals move_x = distance * cosine, move_y = distance * sine, reach_x = reach * cosine, reach_y = reach * sine;
    reals slope_x = *(private const reals_at *)normal_x, slope_y = *(private const reals_at *)normal_y;
    *(private reals_at *)moved =
        (real)0.5f *
        (undistorted_offset(x, y, move_x - reach_x, move_y - reach_y, slope_x, slope_y, frame.correction) +
         undistorted_offset(x, y, move_x + reach_x, move_y + reach_y, slope_x, slope_y, frame.correction));
    pull_back_slope(x + move_x, y + move_y, frame.correction, &slope_x, &slope_y);
    *(private reals_at *)undistorted_sigma =
        gather_lanes(found.sigma, 1, i, count) * fabs(slope_x * cosine + slope_y * sine);
}

// Take a blob of the measured image to the undistorted one; its place has the covariance J C J^T.
static inline undistorted_blob undistort_blob(undistorted_blob blob, global const real *placed, measured_frame frame) {
    const real x = placed[0] + frame.left, y = placed[1] + frame.top;
    const lens_slopes at = slopes_at(x + blob.x, y + blob.y, frame.correction);
    const real xx = at.xx * blob.xx + at.xy * blob.xy, xy = at.xx * blob.xy + at.xy * blob.yy;
    const real yx = at.yx * blob.xx + at.yy * blob.xy, yy = at.yx * blob.xy + at.yy * blob.yy;
    return (undistorted_blob){first_lane(undistorted_offset(x, y, blob.x, blob.y, 1, 0, frame.correction)),
                              first_lane(undistorted_offset(x, y, blob.x, blob.y, 0, 1, frame.correction)),
                              blob.size * (real)0.5f * (at.xx + at.yy),
                              xx * at.xx + xy * at.xy,
                              xx * at.yx + xy * at.yy,
                              yx * at.yx + yy * at.yy,
                              lens_status(blob.status, placed[0], frame)};
}
#endif

// Store the rows and the status of all rulers.
static inline void put_rulers(pose_rows rows, constant const FeatureRuler *ruler, int count, found_edges found,
                              measured_frame frame, real sigma_px, global uchar *status) {
#ifdef FEATURE_LENS
    real positions[LANES], sigmas[LANES];
#endif
    for (int i = 0; i < count; i++) {
        const FeatureRuler from = ruler[i];
#ifdef FEATURE_LENS
        if (i % LANES == 0) undistort_edges(found, ruler, i, count, frame, positions, sigmas);
        const real position = positions[i % LANES], sigma = sigmas[i % LANES];
        status[i] = lens_status(found.status[i], found.placed[7 * i], frame);
#else
        const real position = found.position[i], sigma = found.sigma[i];
        status[i] = found.status[i];
#endif
        const real moved = position * frame.scale, of = sqrt(sigma * sigma + sigma_px * sigma_px) * frame.scale;
        put_row(rows, i, row_with_sigma(from.normal_x, from.normal_y, from.x, from.y, from.normal_x * moved,
                                        from.normal_y * moved, of, from.etch_factor));
    }
}

// Store the two rows of a fiducial along the principal axes of its covariance, and return its status.
//
// A blob whose size differs from the drawn one by more than the tolerance is not the fiducial: AMBIGUOUS. The shift of
// the image [px] and the axes are taken to the board by the inverse of the view's linear part, scale S' R(theta).
static inline uchar put_fiducial(pose_rows rows, int row, FeatureFiducial from, found_blobs found, int i,
                                 measured_frame frame, real sigma_px, real tolerance) {
    const feature_matrix to = frame.to;
    const real scale = frame.scale;
    global const real *shift = found.shift + 2 * i, *covariance = found.covariance + 9 * i;
    undistorted_blob blob = {shift[0],      shift[1],      found.size[i],  covariance[0],
                             covariance[1], covariance[4], found.status[i]};
#ifdef FEATURE_LENS
    blob = undistort_blob(blob, found.placed + 3 * i, frame);
#endif
    const int is_wrong = fabs(blob.size * scale - from.radius) > tolerance;
    const real xx = blob.xx + sigma_px * sigma_px, yy = blob.yy + sigma_px * sigma_px, xy = blob.xy;
    // Larger eigenvalue, and its direction: the column of C - smaller I with the larger norm.
    const real mean = (real)0.5f * (xx + yy), half_difference = (real)0.5f * (xx - yy);
    const real root = sqrt(half_difference * half_difference + xy * xy);
    const real along_x = half_difference >= 0 ? half_difference + root : xy;
    const real along_y = half_difference >= 0 ? xy : root - half_difference;
    const real length = sqrt(along_x * along_x + along_y * along_y), per = length > 0 ? 1 / length : 0;
    const real u = length > 0 ? along_x * per : 1, v = along_y * per;
    const real back_xx = to.xx * scale, back_xy = to.yx * scale, back_yx = to.xy * scale, back_yy = to.yy * scale;
    const real ex = (back_xx * blob.x + back_xy * blob.y) * scale, ey = (back_yx * blob.x + back_yy * blob.y) * scale;
    const real nx = back_xx * u + back_xy * v, ny = back_yx * u + back_yy * v;
    const real mx = back_xy * u - back_xx * v, my = back_yy * u - back_yx * v;
    const real none = is_wrong ? REAL_NAN : 0;
    put_row(rows, row, row_with_sigma(nx, ny, from.x, from.y, ex, ey, sqrt(mean + root) * scale + none, 0));
    put_row(rows, row + 1, row_with_sigma(mx, my, from.x, from.y, ex, ey, sqrt(mean - root) * scale + none, 0));
    return blob.status | (is_wrong ? STATUS_AMBIGUOUS : 0);
}

// Return whether the features show another board, or none: fewer than a share of the rows in the image are inliers, or
// their residuals are larger than their sigmas explain by more than a limit [m].
//
// The residuals of the inliers have the variance r^2 sigma^2, with the residual scale r and the median sigma of the rows.
// Their errors explain sigma^2 (1 + 3 sqrt(2 / f)): three standard deviations of a reduced chi-square with f degrees of
// freedom. The rest is compared with the square of the limit. Without degrees of freedom r is NaN, and only the share is
// checked. Features outside the image do not count. `size` is the unit of the rows [m]; `distances` is overwritten.
static inline int is_another_board(private const solved_pose *fit, pose_rows rows, real size, int ruler_count,
                                   int fiducial_count, global const uchar *status, pose_room room, real min_share,
                                   real max_residual) {
    int in_image = 0;
    for (int i = 0; i < ruler_count + fiducial_count; i++)
        in_image += status[i] & STATUS_OUT_OF_RANGE ? 0 : i < ruler_count ? 1 : 2;
    private real *sigmas = (private real *)room.distances;
    for (int i = 0; i < rows.count; i += LANES) {
        const reals certainty = row_of(rows, i).certainty;
        *(private reals_at *)(sigmas + i) = certainty > (reals)0 ? (reals)1 / certainty : (reals)INFINITY;
    }
    const real sigma = group_ranked(sigmas, rows.count, fit->present / 2 + 1, BITS_TO_ONE_PERCENT, room.sums);
    const real explained = 1 + 3 * sqrt(2 / max((real)(fit->inliers - FREEDOMS), (real)1));
    const real rest = max(fit->residual_scale * fit->residual_scale - explained, (real)0);
    return fit->inliers < min_share * in_image || sqrt(rest) * sigma * size > max_residual;
}

// Change a motion of the board and its covariance into the pose of the camera and its covariance, in place.
//
// The rows give the board's motion q = R p + t as the expected camera at c sees it; the camera is then at
// c' = R^T (c - t), and its angle is smaller by the angle of R. With P = R c + t, the measured place of the point c:
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

#endif
