// Distance map of a field: distance to the nearest line, candidates for the nearest line, and cost, for each cell of a
// grid.
//
// The cost of a point at the cell's centre is d^2 / (c^2 + d^2), d its distance to the nearest line.
//
// Inputs:  at_x (columns,) x of the columns [m]; first_y, cell: y of the first row, and distance between rows [m];
//          scale_squared: c^2 [m2].
// Tables:  shapes (count, SHAPE): lines and arcs (field.h).
// Outputs: distance (rows, columns) float32 [m]; nearest (rows, columns, NEAREST) uint8, indices of the shapes that may
//          be nearest to a point of the cell; level (rows, columns) uint16, the cost in COST_LEVELS steps.
// Options: COST_LEVELS: the cost 1.
//
// One work-item computes one cell; rows of work-items are padded to whole work-groups.
#include "distance_map/field.h"

kernel void distance_map(global const float *restrict at_x, global float *restrict cell_distance,
                         global uchar *restrict nearest, global ushort *restrict level, const float first_y,
                         const float cell, constant float *shapes, const int count, const float scale_squared,
                         const uint columns) {
    const size_t column = get_global_id(0), row = get_global_id(1), i = row * columns + column;
    if (column >= columns) return;
    const float x = at_x[column], y = first_y + (float)row * cell;
    // The NEAREST smallest distances and their shapes, by insertion. Element NEAREST receives the shape that
    // drops out of the list.
    float distance[NEAREST + 1];
    int which[NEAREST + 1];
    for (int place = 0; place < NEAREST; place++) {
        distance[place] = INFINITY;
        which[place] = 0;
    }
    for (int k = 0; k < count; k++) {
        const float far = fabs(field_distance(shapes + SHAPE * k, x, y).distance);
        for (int place = NEAREST - 1; place >= 0 && far < distance[place]; place--) {
            distance[place + 1] = distance[place];
            which[place + 1] = which[place];
            distance[place] = far;
            which[place] = k;
        }
    }
    // Within the cell a distance differs from that at the centre by up to half the diagonal, 0.71 cell: a shape can be
    // nearest somewhere only if it is at most 1.42 cell farther from the centre than the nearest one.
    const float limit = distance[0] + 1.42f * cell;
    for (int place = 0; place < NEAREST; place++)
        nearest[NEAREST * i + place] = (uchar)which[distance[place] <= limit ? place : 0];
    cell_distance[i] = distance[0];
    level[i] =
        (ushort)(distance[0] * distance[0] / (scale_squared + distance[0] * distance[0]) * (float)COST_LEVELS + 0.5f);
}
