// Signed distance of a point to the lines of a field, straight segments and arcs, and its gradient.
#ifndef FIELD_H
#define FIELD_H

// Numbers per shape. Segment: midpoint x, y [m], direction c, s, half the length [m], 0, 0. Arc: centre x, y [m],
// direction c, s from the centre to the arc's midpoint, cosine and sine of half its opening angle (full circle: -2, 0),
// radius [m].
#define SHAPE 7

// Signed distance to a shape [m], and its gradient (x, y), a unit vector.
typedef struct {
    float distance, x, y;
} field_offset;

// Return the distance to an end point: `to` is the vector from it in the shape's frame, (c, s) the frame's x axis.
static inline field_offset end_distance(float2 to, float c, float s) {
    const float far = sqrt(to.x * to.x + to.y * to.y);
    const float2 unit = far > 0 ? to / far : (float2)(1, 0);
    const field_offset offset = {far, c * unit.x - s * unit.y, s * unit.x + c * unit.y};
    return offset;
}

// Return the signed distance of (x, y) to a shape.
//
// Segment: the distance across it, or to its nearer end. Arc: distance to the centre less the radius within the opening
// angle, otherwise the distance to its nearer end. A point is within the opening if the cosine of its angle from the
// arc's midpoint is at least the cosine of half the opening; a cosine of -2 accepts all angles (full circle).
static inline field_offset field_distance(constant float *shape, float x, float y) {
    const float c = shape[2], s = shape[3], radius = shape[6], dx = x - shape[0], dy = y - shape[1];
    const float along = c * dx + s * dy, across = c * dy - s * dx;
    if (radius == 0) {
        const float over = fabs(along) - shape[4];
        if (over > 0) return end_distance((float2)(copysign(over, along), across), c, s);
        const field_offset offset = {across, -s, c};
        return offset;
    }
    const float2 end = (float2)(radius * shape[4], copysign(radius * shape[5], across));
    field_offset offset = end_distance((float2)(along, across), c, s);
    if (along < offset.distance * shape[4]) return end_distance((float2)(along, across) - end, c, s);
    offset.distance -= radius;
    return offset;
}

// Number of candidates for the nearest shape stored per cell. The shape nearest to the cell's centre is first; it is
// repeated where there are fewer candidates.
#define NEAREST 4

#endif
