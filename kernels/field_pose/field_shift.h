// Shift of a point of a view on the distance map of a field, for the exhaustive search.
#ifndef FIELD_SHIFT_H
#define FIELD_SHIFT_H

// Return the shift of a point for a heading; -1 for a point that is not finite or out of range.
static inline int shift_of(float2 point, float2 heading, float per_cell, float max_range_squared, int border,
                           int stride) {
    // NaN compares false.
    if (!(point.x * point.x + point.y * point.y <= max_range_squared)) return -1;
    const float x = (heading.x * point.x - heading.y * point.y) * per_cell;
    const float y = (heading.y * point.x + heading.x * point.y) * per_cell;
    return ((int)rint(y) + border) * stride + (int)rint(x) + border;
}

#endif
