// Cost of the points of a view at every pose of a grid (exhaustive search).
//
// The positions are the centres of the map's cells: for one heading, a point is one shift of the map (shift_sums.h).
// The cost of a pose is the mean of the levels of the cells in which the points lie.
//
// Inputs:  points (count, 2) in the robot's frame [m]; points that are not finite, or out of range, are not used.
// Tables:  level (map rows, stride) uint16 (distance_map.cl), border: cells around the positions; headings (headings,
//          2) cosine and sine; per_cell: cells per metre; max_range_squared: square of the largest range [m2].
// Outputs: scores, least, column (shift_sums.h); seen (headings,) number of points used.
// Options: COST_LEVELS, CAPACITY (size of the array of shifts), WITH_SCORES.
// Variants: vector: a work-item per heading and `each` rows of positions; work-item: a group of BLOCK items per heading
//          and block of positions.
#include "common/shift_sums.h"

// Return the shift of a point for a heading; -1 for a point that is not finite or out of range.
static inline int shift_of(float2 point, float2 heading, float per_cell, float max_range_squared, int border,
                           int stride) {
    // NaN compares false.
    if (!(point.x * point.x + point.y * point.y <= max_range_squared)) return -1;
    const float x = (heading.x * point.x - heading.y * point.y) * per_cell;
    const float y = (heading.y * point.x + heading.x * point.y) * per_cell;
    return ((int)rint(y) + border) * stride + (int)rint(x) + border;
}

#ifdef VECTOR_VARIANT
kernel void field_pose_search(global const float *restrict points, global float *restrict scores,
                              global float *restrict least, global int *restrict column, global int *restrict seen,
                              global const ushort *restrict level, constant float *headings, const int count,
                              const int rows, const int columns, const int border, const int stride,
                              const float per_cell, const float max_range_squared, const int each) {
    const int turn = (int)get_global_id(1), first = (int)get_global_id(0) * each, end = min(first + each, rows);
    const float2 heading = (float2)(headings[2 * turn], headings[2 * turn + 1]);
    int shifts[CAPACITY], used = 0;
    for (int i = 0; i < count; i++) {
        const float2 point = (float2)(points[2 * i], points[2 * i + 1]);
        const int shift = shift_of(point, heading, per_cell, max_range_squared, border, stride);
        shifts[used] = shift;
        used += shift >= 0;
    }
    if (first == 0) seen[turn] = used;
    sum_rows(level, shifts, used, turn, first, end, rows, columns, stride, scores, least, column);
}
#else
kernel void field_pose_search(global const float *restrict points, global float *restrict scores,
                              global float *restrict least, global int *restrict column, global int *restrict seen,
                              global const ushort *restrict level, constant float *headings, const int count,
                              const int rows, const int columns, const int border, const int stride,
                              const float per_cell, const float max_range_squared, const int each) {
    const int item = (int)get_local_id(0), turn = (int)get_group_id(2);
    local int shifts[CAPACITY], used;
    local uint key;
    if (item == 0) {
        used = 0;
        key = NO_KEY;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int i = item; i < count; i += BLOCK) {
        const int shift = shift_of((float2)(points[2 * i], points[2 * i + 1]),
                                   (float2)(headings[2 * turn], headings[2 * turn + 1]), per_cell, max_range_squared,
                                   border, stride);
        if (shift >= 0) shifts[atomic_inc(&used)] = shift;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    sum_block(level, shifts, used, &key, columns, stride, scores, least, column);
    if (item == 0 && get_group_id(1) == 0 && get_group_id(0) == 0) seen[turn] = used;
}
#endif
