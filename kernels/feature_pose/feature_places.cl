// Places of rulers and fiducials in the frame of a camera at a pose (feature_view.h).
//
// Inputs:  pose (3,): x, y [m], theta [rad]; corner (2,): column, row of the frame's first pixel in the full image.
// Outputs: rulers (ruler_count, 7), as ruler.cl takes them with PER_RULER; matched, drilled (count, 3): x, y, radius [px].
// Tables:  ruler, fiducial (matched ones, then drilled ones), view.
// Options: WIDE.
// Variants: vector: one work-item places everything (a second core would take longer to start); work-item: the items of
//          a group place every 64th feature each.
#include "feature_pose/feature_view.h"

kernel void place_features(global const WIDE *restrict pose, global const real *restrict corner,
                           global real *restrict rulers, global real *restrict matched, global real *restrict drilled,
                           constant const FeatureRuler *ruler, constant const FeatureFiducial *fiducial,
                           constant const FeatureView *view, const int ruler_count, const int matched_count,
                           const int drilled_count) {
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
    }
}
