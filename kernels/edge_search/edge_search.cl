// Exhaustive search of a grid of poses by known edges: means of cells, costs of edges by direction, and the sums of
// costs.
//
// cell_means:  mean of each cell of cell x cell pixels.
//   Inputs: image (rows, columns), type CODE. Outputs: means (cell rows, cell columns) float32 [grey levels].
//   One work-item per cell; rows of work-items are padded to whole work-groups.
// edge_levels: cost 1 - (max g_k^2 / (g^2 + t^2))^2 of an edge, for 8 directions k of its normal, pi / 8 apart.
//   Inputs: means (rows, columns); threshold_squared: t^2, t a quarter of the threshold; directions (CHANNELS, 2)
//   cosine and sine of the normals. Outputs: level (CHANNELS, rows + 2 border, columns + 2 border) uint16 in COST_LEVELS
//   steps. One work-item per cell; rows of work-items are padded to whole work-groups.
// edge_search: mean cost of the edges at every shift and heading of the grid (shift_sums.h).
//   Inputs: level; shifts (headings, count) int32: index into level of the cell of each edge at the first position.
//   Outputs: scores, least, column (shift_sums.h); seen (headings,) number of edges used.
//   Variants: vector: a work-item per heading and `each` rows of positions; work-item: a group of BLOCK items per
//   heading and block of positions.
//
// Options: one kernel per build: CODE (pixel type, cell_means), FROM_MEANS (edge_levels), or CAPACITY (size of the
//          array of shifts, edge_search) with WITH_SCORES. COST_LEVELS: the cost 1 (edge_levels, edge_search).
#include "common/real.h"
#ifdef CAPACITY
#include "common/shift_sums.h"
#endif

#define CHANNELS 8

// Compute the means of the cells.
#ifdef CODE
kernel void cell_means(global const CODE *restrict image, global float *restrict means, const int columns,
                       const int cell) {
    const size_t x = get_global_id(0), y = get_global_id(1), cells = columns / cell;
    if (x >= cells) return;
    global const CODE *from = image + (y * columns + x) * cell;
    float sum = 0;
    for (int row = 0; row < cell; row++)
        for (int column = 0; column < cell; column++) sum += (float)from[(size_t)row * columns + column];
    means[y * cells + x] = sum / (float)(cell * cell);
}
#endif

// Compute the costs of edges. g is the gradient over 3 x 3 cells (Sobel), g_k its component along the normal of channel
// k.
//
// The maximum over the cell and its eight neighbours accepts edges up to one cell away. A cell without gradients around
// it, or in the border, costs 1.
#ifdef FROM_MEANS
kernel void edge_levels(global const float *restrict means, global ushort *restrict level, const int rows,
                        const int columns, const int border, const float threshold_squared,
                        constant float *directions) {
    const int x = (int)get_global_id(0) - border, y = (int)get_global_id(1) - border;
    const size_t stride = columns + 2 * border, plane = stride * get_global_size(1);
    if (get_global_id(0) >= stride) return;
    const size_t at = get_global_id(1) * stride + get_global_id(0);
    float best[CHANNELS];
    for (int k = 0; k < CHANNELS; k++) best[k] = 0;
    const int left = max(x - 1, 1), right = min(x + 1, columns - 2), low = max(y - 1, 1), high = min(y + 1, rows - 2);
    for (int j = low; j <= high; j++)
        for (int i = left; i <= right; i++) {
            global const float *up = means + (size_t)(j - 1) * columns + i, *on = up + columns, *down = on + columns;
            const float gx = 0.125f * ((up[1] - up[-1]) + 2.0f * (on[1] - on[-1]) + (down[1] - down[-1]));
            const float gy = 0.125f * ((down[-1] - up[-1]) + 2.0f * (down[0] - up[0]) + (down[1] - up[1]));
            const float per = 1.0f / (gx * gx + gy * gy + threshold_squared);
            for (int k = 0; k < CHANNELS; k++) {
                const float along = gx * directions[2 * k] + gy * directions[2 * k + 1];
                const float share = along * along * per;
                // NaN compares false: a gradient that is not finite is skipped.
                best[k] = share > best[k] ? share : best[k];
            }
        }
    for (int k = 0; k < CHANNELS; k++)
        level[k * plane + at] = (ushort)((1.0f - best[k] * best[k]) * (float)COST_LEVELS + 0.5f);
}
#endif

// Sum the costs. A shift outside 0 to limit - 1 leaves the map at some position (or is negative: no edge); it is not
// used.
#ifdef CAPACITY
#ifdef VECTOR_VARIANT
kernel void edge_search(global const ushort *restrict level, global const int *restrict shifts,
                        global float *restrict scores, global float *restrict least, global int *restrict column,
                        global int *restrict seen, const int count, const int rows, const int columns,
                        const int stride, const int limit, const int each) {
    const int turn = (int)get_global_id(1), first = (int)get_global_id(0) * each, end = min(first + each, rows);
    int used_shifts[CAPACITY], used = 0;
    for (int i = 0; i < count; i++) {
        const int shift = shifts[(size_t)turn * count + i];
        used_shifts[used] = shift;
        used += (uint)shift < (uint)limit;
    }
    if (first == 0) seen[turn] = used;
    sum_rows(level, used_shifts, used, turn, first, end, rows, columns, stride, scores, least, column);
}
#else
kernel void edge_search(global const ushort *restrict level, global const int *restrict shifts,
                        global float *restrict scores, global float *restrict least, global int *restrict column,
                        global int *restrict seen, const int count, const int rows, const int columns,
                        const int stride, const int limit, const int each) {
    const int item = (int)get_local_id(0), turn = (int)get_group_id(2);
    local int used_shifts[CAPACITY], used;
    local uint key;
    if (item == 0) {
        used = 0;
        key = NO_KEY;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int i = item; i < count; i += BLOCK) {
        const int shift = shifts[(size_t)turn * count + i];
        if ((uint)shift < (uint)limit) used_shifts[atomic_inc(&used)] = shift;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    sum_block(level, used_shifts, used, &key, columns, stride, scores, least, column);
    if (item == 0 && get_group_id(1) == 0 && get_group_id(0) == 0) seen[turn] = used;
}
#endif
#endif
