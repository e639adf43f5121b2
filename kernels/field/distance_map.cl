// For every cell of a grid over a field: how far the nearest line is, which ones may be the nearest within the cell,
// and what a point in its middle costs, d^2 / (c^2 + d^2), in FIELD_LEVELS steps. One cell a work-item.
#include "field/field.h"

kernel void field_map(global const float *restrict at_x, global float *restrict distance,
                      global uchar *restrict nearest, global ushort *restrict level, const float first_y,
                      const float cell, constant float *shapes, const int count, const float square) {
    const size_t column = get_global_id(0), row = get_global_id(1), i = row * get_global_size(0) + column;
    const float x = at_x[column], y = first_y + (float)row * cell;
    float away[NEAREST];
    int which[NEAREST];
    for (int place = 0; place < NEAREST; place++) {
        away[place] = INFINITY;
        which[place] = 0;
    }
    for (int k = 0; k < count; k++) {
        const float far = fabs(field_away(shapes + SHAPE * k, x, y).away);
        for (int place = NEAREST - 1; place >= 0 && far < away[place]; place--) {
            if (place + 1 < NEAREST) {
                away[place + 1] = away[place];
                which[place + 1] = which[place];
            }
            away[place] = far;
            which[place] = k;
        }
    }
    // Half the cell's diagonal nearer, and the nearest one as much further.
    const float limit = away[0] + 1.42f * cell;
    for (int place = 0; place < NEAREST; place++)
        nearest[NEAREST * i + place] = (uchar)which[away[place] <= limit ? place : 0];
    distance[i] = away[0];
    level[i] = (ushort)(away[0] * away[0] / (square + away[0] * away[0]) * (float)FIELD_LEVELS + 0.5f);
}
