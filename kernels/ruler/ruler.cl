// Edges along calipers (rulers): position, amplitude, width, sigma, spacing and status of each ruler.
//
// Inputs:  image (rows, columns), type CODE; rulers (count, RULER_INPUTS): x, y [px], cos, sin of the direction; with
//          PER_RULER also the polarity, and least and greatest spacing of a pair [px].
// Outputs: position, width, sigma, spacing [px], amplitude [grey levels], status: (count,) or (count, MAX_EDGES).
// Tables:  table, parameters (ruler.h); model, lens or camera (LENS, CAMERA).
// Variants: vector: a work-item processes `each` rulers, with vectors of 16 samples; work-item: a group of RULER_GROUP
//           items takes RULERS_PER_GROUP rulers: samples, gradients and the search for edges over all items, then an
//           item per ruler, or per edge with CHOOSE_ALL, for the sub-pixel edge (ruler_group.h).
#include "common/team.h"
#include "ruler/ruler.h"

// Store lane `lane` of an edge as result i.
static inline void store_edge(private const ruler_edge *edge, uint lane, ulong i, global real *position,
                              global real *amplitude, global real *width, global real *sigma, global real *spacing,
                              global uchar *status) {
    position[i] = ((private const real *)&edge->position)[lane];
    amplitude[i] = ((private const real *)&edge->amplitude)[lane];
    width[i] = ((private const real *)&edge->width)[lane];
    sigma[i] = ((private const real *)&edge->sigma)[lane];
#ifdef PAIRS
    spacing[i] = ((private const real *)&edge->spacing)[lane];
#endif
    status[i] = ((private const bits *)&edge->status)[lane];
}

#if !defined(VECTOR_VARIANT) && defined(CHOOSE_ALL)
// Store the edges of the rulers of a group: each item computes the edges at its gradients. Places without an edge get NaN.
static inline void store_all(private const ruler_place *place, constant real *table, local const ruler_memory *shared,
                             uint ruler, global real *position, global real *amplitude, global real *width,
                             global real *sigma, global real *spacing, global uchar *status) {
    const int slopes = (int)table[RULER_LENGTH] - 2 * TAPS, flags = shared->flags[ruler_of_item()];
    const int count = ruler_edges_before(shared, slopes - 1);
    for (int i = 1 + ruler_lane(); i < slopes - 1; i += RULER_ITEMS) {
        const int number = ruler_edges_before(shared, i);
        if (number >= MAX_EDGES || ruler_edges_before(shared, i + 1) == number) continue;
        ruler_edge edge = ruler_edge_at(ruler_peak_before(shared, i), ruler_peak_at(shared, i), place, table);
        if (number == MAX_EDGES - 1 && count > MAX_EDGES) edge.status = STATUS_AMBIGUOUS;
        edge = ruler_flagged(edge, mask_of(1), flags);
        store_edge(&edge, 0, (ulong)ruler * MAX_EDGES + number, position, amplitude, width, sigma, spacing, status);
    }
    ruler_edge none = {REAL_NAN, REAL_NAN, REAL_NAN, REAL_NAN, REAL_NAN, 0};
    none = ruler_flagged(none, mask_of(0), flags);
    for (int number = count + ruler_lane(); number < MAX_EDGES; number += RULER_ITEMS)
        store_edge(&none, 0, (ulong)ruler * MAX_EDGES + number, position, amplitude, width, sigma, spacing, status);
}
#endif

kernel void ruler_edges(global const CODE *restrict image, global const real *restrict rulers,
                        global real *restrict position, global real *restrict amplitude, global real *restrict width,
                        global real *restrict sigma, global real *restrict spacing, global uchar *restrict status,
                        constant real *table, constant real *model, const int rows, const int columns,
                        const uint count, const uint each TEAM_ARGUMENTS) {
#ifdef VECTOR_VARIANT
    ruler_edge edges[MAX_EDGES];
    FOR_EACH_ITEM(item) {
        const uint first = item.x * each, end = min(first + each, count);
        for (uint ruler = first; ruler < end; ruler += LANES) {
            ruler_measure(image, rows, columns, rulers + RULER_INPUTS * (ulong)ruler, RULER_INPUTS, count - ruler, table,
                          model, edges);
            for (int k = 0; k < MAX_EDGES; k++)
                for (uint lane = 0; lane < LANES && ruler + lane < count; lane++)
                    store_edge(edges + k, lane, ((ulong)ruler + lane) * MAX_EDGES + k, position, amplitude, width, sigma,
                               spacing, status);
        }
    }
#else
    local ruler_memory shared;
    // Items beyond the last ruler repeat it, because all items of a group take part in its barriers.
    const uint ruler = get_group_id(0) * RULERS_PER_GROUP + ruler_of_item(), last = min(ruler, count - 1);
    global const real *of = rulers + RULER_INPUTS * (ulong)last;
    ruler_place place;
    const int out = ruler_layout(rows, columns, of[0], of[1], of[2], of[3], table, &place);
#ifdef PER_RULER
    ruler_set_kind(of[4], of[5], of[6], table, &place);
#endif
#ifdef CHOOSE_ALL
    ruler_gradients(image, columns, &place, out, table, model, &shared);
#ifdef PAIRS
    ruler_mark_peaks(&place, table, &shared);
#endif
    ruler_mark_candidates(&place, table, &shared);
    if (ruler == last)
        store_all(&place, table, &shared, ruler, position, amplitude, width, sigma, spacing, status);
#else
    const ruler_edge edge = ruler_measure_placed(image, columns, &place, out, table, model, &shared);
    if (ruler == last && ruler_lane() == 0)
        store_edge(&edge, 0, ruler, position, amplitude, width, sigma, spacing, status);
#endif
#endif
}
