// A picture's edges on a grid of cells, by direction, and what known edges cost at every pose of a grid.
#define LEVELS 1023
#include "common/shift_sums.h"
#include "common/real.h"

#define CHANNELS 8

// The mean of `cell` times `cell` pixels.
#ifdef CODE
kernel void cell_means(global const CODE *restrict image, global float *restrict means, const int columns,
                       const int cell) {
    const size_t x = get_global_id(0), y = get_global_id(1);
    global const CODE *from = image + (y * columns + x) * cell;
    float sum = 0;
    for (int row = 0; row < cell; row++)
        for (int column = 0; column < cell; column++) sum += (float)from[(size_t)row * columns + column];
    means[y * get_global_size(0) + x] = sum / (float)(cell * cell);
}
#endif

// What an edge costs in each cell: 1 - (max g_k^2 / (g^2 + t^2))^2 over the cell and its eight neighbours, g_k the part
// of the gradient along the channel's normal, LEVELS steps; all of it where there is no gradient. Directions are those
// of the channels' normals.
#ifdef FROM_MEANS
kernel void edge_levels(global const float *restrict means, global ushort *restrict level, const int rows,
                        const int columns, const int border, const float square, constant float *directions) {
    const int x = (int)get_global_id(0) - border, y = (int)get_global_id(1) - border;
    const size_t stride = get_global_size(0), plane = stride * get_global_size(1);
    const size_t at = get_global_id(1) * stride + get_global_id(0);
    float best[CHANNELS];
    for (int k = 0; k < CHANNELS; k++) best[k] = 0;
    const int left = max(x - 1, 1), right = min(x + 1, columns - 2), low = max(y - 1, 1), high = min(y + 1, rows - 2);
    for (int j = low; j <= high; j++)
        for (int i = left; i <= right; i++) {
            global const float *up = means + (size_t)(j - 1) * columns + i, *on = up + columns, *down = on + columns;
            const float gx = 0.125f * ((up[1] - up[-1]) + 2.0f * (on[1] - on[-1]) + (down[1] - down[-1]));
            const float gy = 0.125f * ((down[-1] - up[-1]) + 2.0f * (down[0] - up[0]) + (down[1] - up[1]));
            const float per = 1.0f / (gx * gx + gy * gy + square);
            for (int k = 0; k < CHANNELS; k++) {
                const float along = gx * directions[2 * k] + gy * directions[2 * k + 1];
                const float share = along * along * per;
                // False for NaN, too.
                best[k] = share > best[k] ? share : best[k];
            }
        }
    for (int k = 0; k < CHANNELS; k++)
        level[k * plane + at] = (ushort)((1.0f - best[k] * best[k]) * (float)LEVELS + 0.5f);
}
#endif

// Shifts are counted only where all positions lie in the map.
#ifdef CAPACITY
#ifdef VECTOR_VARIANT
kernel void edge_search(global const ushort *restrict level, global const int *restrict shifts,
                        global float *restrict scores, global float *restrict least, global int *restrict column,
                        global int *restrict seen, const int count, const int rows, const int columns,
                        const int stride, const int limit, const int each) {
    const int turn = (int)get_global_id(1), first = (int)get_global_id(0) * each, end = min(first + each, rows);
    int own[CAPACITY], used = 0;
    for (int i = 0; i < count; i++) {
        const int shift = shifts[(size_t)turn * count + i];
        own[used] = shift;
        used += (uint)shift < (uint)limit;
    }
    if (first == 0) seen[turn] = used;
    sum_rows(level, own, used, turn, first, end, rows, columns, stride, scores, least, column);
}
#else
kernel void edge_search(global const ushort *restrict level, global const int *restrict shifts,
                        global float *restrict scores, global float *restrict least, global int *restrict column,
                        global int *restrict seen, const int count, const int rows, const int columns,
                        const int stride, const int limit, const int each) {
    const int item = (int)get_local_id(0), turn = (int)get_group_id(2);
    local int own[CAPACITY], used;
    local uint key;
    if (item == 0) {
        used = 0;
        key = NO_KEY;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int i = item; i < count; i += BLOCK) {
        const int shift = shifts[(size_t)turn * count + i];
        if ((uint)shift < (uint)limit) own[atomic_inc(&used)] = shift;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    sum_block(level, own, used, &key, columns, stride, scores, least, column);
    if (item == 0 && get_group_id(1) == 0 && get_group_id(0) == 0) seen[turn] = used;
}
#endif
#endif
