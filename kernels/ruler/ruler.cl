// Edges along calipers (rulers): position, amplitude, width, sigma, spacing and status of each ruler.
//
// Inputs:  image (rows, columns), type CODE; rulers (count, RULER_INPUTS): x, y [px], cos, sin of the direction; with
//          PER_RULER also the polarity, and least and greatest spacing of a pair [px].
// Outputs: position, width, sigma, spacing [px], amplitude [grey levels], status: (count,) or (count, MAX_EDGES).
// Tables:  table, parameters (ruler.h); model, lens or camera (LENS, CAMERA).
// Variants: vector: a work-item processes `each` rulers, with vectors of 16 samples; work-item: a group of RULER_GROUP
//           items per ruler.
#include "ruler/ruler.h"

// Store the edges of LANES rulers from `ruler` on, as far as they exist.
static inline void store_edges(private const ruler_edge *edges, uint ruler, uint count, global real *position,
                        global real *amplitude, global real *width, global real *sigma, global real *spacing,
                        global uchar *status) {
    for (int k = 0; k < MAX_EDGES; k++) {
        for (uint lane = 0; lane < LANES && ruler + lane < count; lane++) {
            const ulong i = ((ulong)ruler + lane) * MAX_EDGES + k;
            position[i] = ((private const real *)&edges[k].position)[lane];
            amplitude[i] = ((private const real *)&edges[k].amplitude)[lane];
            width[i] = ((private const real *)&edges[k].width)[lane];
            sigma[i] = ((private const real *)&edges[k].sigma)[lane];
#ifdef PAIRS
            spacing[i] = ((private const real *)&edges[k].spacing)[lane];
#endif
            status[i] = ((private const bits *)&edges[k].status)[lane];
        }
    }
}

kernel void ruler_edges(global const CODE *restrict image, global const real *restrict rulers,
                        global real *restrict position, global real *restrict amplitude, global real *restrict width,
                        global real *restrict sigma, global real *restrict spacing, global uchar *restrict status,
                        constant real *table, constant real *model, const int rows, const int columns,
                        const uint count, const uint each) {
    ruler_edge edges[MAX_EDGES];
#ifdef VECTOR_VARIANT
    const uint first = get_global_id(0) * each, end = min(first + each, count);
    for (uint ruler = first; ruler < end; ruler += LANES) {
        ruler_measure(image, rows, columns, rulers + RULER_INPUTS * (ulong)ruler, RULER_INPUTS, count - ruler, table,
                      model, edges);
        store_edges(edges, ruler, count, position, amplitude, width, sigma, spacing, status);
    }
#else
    local real profile[RULER_CAPACITY], slopes[RULER_SLOPES_CAPACITY];
    local int flags;
    const uint ruler = get_group_id(0);
    global const real *of = rulers + RULER_INPUTS * (ulong)ruler;
    ruler_place place;
    const int out = ruler_layout(rows, columns, of[0], of[1], of[2], of[3], table, &place);
#ifdef PER_RULER
    ruler_set_kind(of[4], of[5], of[6], table, &place);
#endif
    ruler_measure_placed(image, columns, &place, out, table, model, profile, slopes, &flags, edges);
    if (get_local_id(0) == 0)
        store_edges(edges, ruler, count, position, amplitude, width, sigma, spacing, status);
#endif
}
