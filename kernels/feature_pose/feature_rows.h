// Rows of the pose of a camera (pose/pose.h) from measured rulers and fiducials, and the camera's pose from the solution.
#ifndef FEATURE_ROWS_H
#define FEATURE_ROWS_H

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

#endif
