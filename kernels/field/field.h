// Lines of a field: straight ones and arcs, and how far a place is from one.
#ifndef FIELD_H
#define FIELD_H

// A shape is seven numbers: a straight line is its middle (x, y), its direction (c, s), half its length and 0, 0; an
// arc is its centre, the direction of its own middle, the cosine and the sine of half its opening (a whole circle: -2,
// 0), and its radius.
#define SHAPE 7

// How far (x, y) is from the line, signed, and the direction in which that grows.
typedef struct {
    float away, x, y;
} field_offset;

static inline field_offset field_from(float2 to, float c, float s) {
    const float far = sqrt(to.x * to.x + to.y * to.y);
    const float2 unit = far > 0 ? to / far : (float2)(1, 0);
    const field_offset offset = {far, c * unit.x - s * unit.y, s * unit.x + c * unit.y};
    return offset;
}

static inline field_offset field_away(constant float *shape, float x, float y) {
    const float c = shape[2], s = shape[3], radius = shape[6], dx = x - shape[0], dy = y - shape[1];
    const float along = c * dx + s * dy, across = c * dy - s * dx;
    if (radius == 0) {
        const float over = fabs(along) - shape[4];
        if (over > 0) return field_from((float2)(copysign(over, along), across), c, s);
        const field_offset offset = {across, -s, c};
        return offset;
    }
    const float2 end = (float2)(radius * shape[4], copysign(radius * shape[5], across));
    field_offset offset = field_from((float2)(along, across), c, s);
    if (along < offset.away * shape[4]) return field_from((float2)(along, across) - end, c, s);
    offset.away -= radius;
    return offset;
}

// Lines that may be the nearest somewhere in a cell, the nearest to its middle first; it stands again where there are
// fewer.
#define NEAREST 4

#endif
