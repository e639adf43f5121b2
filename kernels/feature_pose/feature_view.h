// Features of a board in numbers, and the view of a camera that looks straight at the board.
//
// A point p of the artwork appears at the pixel m + S R(theta)^T (p - c) - corner. c and theta are the pose of the camera,
// m the middle of the full image, corner the first pixel of the frame in it, and S = diag(+-1, -1) / scale.
//
// Options: WIDE: type of poses, double where the device has it.
#ifndef FEATURE_VIEW_H
#define FEATURE_VIEW_H

#include "common/real.h"

// Ruler: RULER_FEATURE in feature_pose.py.
typedef struct {
    real x, y, normal_x, normal_y;    // centre relative to the placement point [m], unit normal on the board
    real polarity, least_px, greatest_px; // as in ruler/ruler.h [px]
    real etch_factor;
} FeatureRuler;

// Fiducial: FIDUCIAL_FEATURE in feature_pose.py; centre relative to the placement point, and radius [m].
typedef struct {
    real x, y, radius;
} FeatureFiducial;

// Camera and its full image: VIEW in feature_pose.py.
typedef struct {
    WIDE scale, side;                 // size of a pixel [m]; -1 for a board seen from behind, else 1
    WIDE middle_x, middle_y;          // of the full image [px]
    WIDE placement_x, placement_y;    // on the artwork [m]
} FeatureView;

// Linear part and offset of the view: pixel = matrix (p - placement) + (x, y).
typedef struct {
    WIDE xx, xy, yx, yy, x, y;
} feature_matrix;

// Linear part of the view.
static inline feature_matrix linear_of(global const WIDE *pose, constant const FeatureView *view) {
    const WIDE c = cos(pose[2]), s = sin(pose[2]), per = 1 / view->scale, side = view->side * per;
    return (feature_matrix){side * c, side * s, per * s, -per * c, 0, 0};
}

static inline feature_matrix matrix_of(global const WIDE *pose, global const real *corner, constant const FeatureView *view) {
    feature_matrix to = linear_of(pose, view);
    const WIDE x = view->placement_x - pose[0], y = view->placement_y - pose[1];
    to.x = view->middle_x - corner[0] + to.xx * x + to.xy * y;
    to.y = view->middle_y - corner[1] + to.yx * x + to.yy * y;
    return to;
}

#endif
