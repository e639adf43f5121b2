// A receiver before a segment, and its view of the segment.
#ifndef SEGMENT_VIEW_H
#define SEGMENT_VIEW_H
#include "occluded_irradiance/visible.h"

// The clearance takes at most this fraction of the height of either end above the other's surface.
#define CLEARANCE_SHARE ((real)0.5)

// Start and axes of a segment: along it (u), normal to its surface (e), and both (w); its length.
typedef struct {
    real x, y, z, ux, uy, uz, ex, ey, ez, wx, wy, wz, length;
} segment_axes;

// Receiver: position and unit normal.
typedef struct {
    real x, y, z, nx, ny, nz;
} observer;

// Receiver in the axes of a segment, as line_irradiance.h takes it; toward, toward_end: heights of the segment's ends
// above the receiver's plane.
typedef struct {
    real along, height, aside, past, by_u, by_n, by_w, toward, toward_end;
} placement;

#ifdef INTERVALS
// View of a segment from a receiver.
static inline view view_from(const segment_axes *of, const placement *from, const observer *at, real clearance) {
    view v;
    const real height = from->height, aside = from->aside, along = from->along;
    const real toward = from->toward, most = fmax(toward, from->toward_end);
    const real depth = sqrt(height * height + aside * aside), per = (real)1 / depth;
    const real up = -height * per, side = -aside * per, per_length = (real)1 / of->length;
    v.x = at->x, v.y = at->y, v.z = at->z;
    v.start_x = of->x, v.start_y = of->y, v.start_z = of->z;
    v.step_x = of->length * of->ux, v.step_y = of->length * of->uy, v.step_z = of->length * of->uz;
    v.deep_x = up * of->ex + side * of->wx, v.deep_y = up * of->ey + side * of->wy;
    v.deep_z = up * of->ez + side * of->wz;
    v.across_x = up * of->wx - side * of->ex, v.across_y = up * of->wy - side * of->ey;
    v.across_z = up * of->wz - side * of->ez;
    v.along_x = (depth * of->ux + along * v.deep_x) * per_length;
    v.along_y = (depth * of->uy + along * v.deep_y) * per_length;
    v.along_z = (depth * of->uz + along * v.deep_z) * per_length;
    const real over = fmin(clearance, CLEARANCE_SHARE * height);
    v.far = depth - depth * (over / height);
    v.lift = fmin(clearance, CLEARANCE_SHARE * most);
    v.lift_deep = toward * per, v.lift_along = (from->toward_end - toward) * per;
    v.near = fmax(depth * (v.lift / most), depth * (real)1e-12);
    view_set_plane(&v);
    // Occluders lie above the lit surface and above the receiver's surface.
    v.halves[4] = view_half_of(&v, of->ex, of->ey, of->ez, over - height);
    v.halves[5] = view_half_of(&v, at->nx, at->ny, at->nz, v.lift);
#ifdef CONVEX_PARTS
    v.above = v.halves[5].least + (real)16 * (real)REAL_EPSILON * (fabs(at->x) + fabs(at->y) + fabs(at->z));
#endif
    return v;
}
#endif

#endif
