// Shift of a point of a view on the distance map of a field, for the exhaustive search.
#ifndef FIELD_SHIFT_H
#define FIELD_SHIFT_H

// Round a number of cells, below 2^22, to an integer, half to even: 1.5 * 2^23 has no bits for fractions, so that the sum
// is rounded, and its last bits are the integer. PoCL compiles rint() to branches that depend on the number: the shifts
// took a tenth of a search.
static inline int nearest_cell(float cells) { return as_int(cells + 12582912.0f) - as_int(12582912.0f); }

// Return the shift of a point for a heading; -1 for a point that is not finite or out of range.
static inline int shift_of(float2 point, float2 heading, float per_cell, float max_range_squared, int border,
                           int stride) {
    // NaN compares false.
    if (!(point.x * point.x + point.y * point.y <= max_range_squared)) return -1;
    const float x = (heading.x * point.x - heading.y * point.y) * per_cell;
    const float y = (heading.y * point.x + heading.x * point.y) * per_cell;
    return (nearest_cell(y) + border) * stride + nearest_cell(x) + border;
}

#endif
