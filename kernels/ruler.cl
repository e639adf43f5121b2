// Edges along rulers (ruler.h). On CPU runtimes an item takes `each` rulers one after the other, on GPUs a group of
// RULER_GROUP items takes one.
#include "ruler.h"

inline void store_edge(ruler_edge edge, ulong i, global real *position, global real *amplitude, global real *width,
                       global real *sigma, global real *spacing, global uchar *status) {
    // NaN unless there is an edge: SATURATED and AMBIGUOUS come with one.
    position[i] = edge.position;
    amplitude[i] = edge.amplitude;
    width[i] = edge.width;
    sigma[i] = edge.sigma;
#ifdef PAIRS
    spacing[i] = edge.spacing;
#endif
    status[i] = edge.status;
}

kernel void ruler_edges(global const CODE *restrict image, global const real *restrict rulers,
                        global real *restrict position, global real *restrict amplitude, global real *restrict width,
                        global real *restrict sigma, global real *restrict spacing, global uchar *restrict status,
                        constant real *table, constant real *model, const int rows, const int columns,
                        const uint count, const uint each) {
    ruler_edge edges[MOST];
#ifdef STRIP
    const uint first = get_global_id(0) * each, end = min(first + each, count);
    for (uint ruler = first; ruler < end; ruler++) {
        ruler_measure(image, rows, columns, vload4(ruler, rulers), table, model, edges);
        for (int k = 0; k < MOST; k++)
            store_edge(edges[k], (ulong)ruler * MOST + k, position, amplitude, width, sigma, spacing, status);
    }
#else
    local real profile[LENGTH], slopes[RULER_SLOPES];
    local uint bits[2];
    const uint ruler = get_group_id(0);
    ruler_measure(image, rows, columns, vload4(ruler, rulers), table, model, profile, slopes, bits, edges);
    if (get_local_id(0) == 0) {
        for (int k = 0; k < MOST; k++)
            store_edge(edges[k], (ulong)ruler * MOST + k, position, amplitude, width, sigma, spacing, status);
    }
#endif
}
