// Start shape of the fit to the edges of a fiducial: the best of the shapes through three edges.
//
// Options: as in blob.cl.
#ifndef BLOB_START_H
#define BLOB_START_H
#include "blob/blob_edges.h"

// Triples of rulers for start shapes: offsets of the second and third ruler in sixteenths of the contour.
#define PATTERNS 4
__constant int pattern[PATTERNS][2] = {{4, 8}, {5, 10}, {3, 6}, {2, 6}};
#define START_STEPS 3

// Edges in the order of the contour; straight edges with normals at the nominal angle.
typedef struct {
    reals x, y, there, height, nx, ny;
} contour_edge;

#ifdef IN_GROUP
typedef struct {
    local const blob_edges *edges;
    blob_layout layout;
    real cosine, sine;
} blob_circuit;

static inline contour_edge edge_from(private const blob_circuit *circuit, int i) {
    const int at = i % SPOKES;
    const real nx = circuit->layout.nx[at], ny = circuit->layout.ny[at];
    local const blob_edges *edges = circuit->edges;
    return (contour_edge){edges->x[at], edges->y[at], edges->there[at], circuit->layout.height[at],
                          circuit->cosine * nx - circuit->sine * ny, circuit->sine * nx + circuit->cosine * ny};
}
#define edge_for_all edge_from
#else
// The edges are repeated after the last one, so that each lane can begin with another edge.
#define WRAPPED (PADDED_SPOKES + SPOKES + LANES)
typedef struct {
    real x[WRAPPED], y[WRAPPED], there[WRAPPED], height[WRAPPED], nx[WRAPPED], ny[WRAPPED];
} blob_circuit;

static inline void wrap(private const blob_edges *edges, blob_layout layout, real cosine, real sine,
                 private blob_circuit *circuit) {
    for (int from = 0; from <= SPOKES; from += SPOKES)
        for (int i = 0; i < PADDED_SPOKES; i += LANES) {
            *(private reals_at *)(circuit->x + from + i) = READ(edges->x, i);
            *(private reals_at *)(circuit->y + from + i) = READ(edges->y, i);
            *(private reals_at *)(circuit->there + from + i) = READ(edges->there, i);
            *(private reals_at *)(circuit->height + from + i) = FROM(layout.height, i);
#ifndef ROUND
            const reals nx = FROM(layout.nx, i), ny = FROM(layout.ny, i);
            *(private reals_at *)(circuit->nx + from + i) = cosine * nx - sine * ny;
            *(private reals_at *)(circuit->ny + from + i) = sine * nx + cosine * ny;
#endif
        }
}

// Edges i, i + 1, ... of the lanes.
static inline contour_edge edge_from(private const blob_circuit *circuit, int i) {
    contour_edge edge = {READ(circuit->x, i), READ(circuit->y, i), READ(circuit->there, i), READ(circuit->height, i), 0, 0};
#ifndef ROUND
    edge.nx = READ(circuit->nx, i), edge.ny = READ(circuit->ny, i);
#endif
    return edge;
}

// Edge i in all lanes.
static inline contour_edge edge_for_all(private const blob_circuit *circuit, int i) {
    contour_edge edge = {(reals)circuit->x[i], (reals)circuit->y[i], (reals)circuit->there[i], (reals)circuit->height[i], 0, 0};
#ifndef ROUND
    edge.nx = (reals)circuit->nx[i], edge.ny = (reals)circuit->ny[i];
#endif
    return edge;
}
#endif

// Shape in each lane: centre and size.
typedef struct {
    reals x, y, size;
} laned_shape;

// Residual of an edge, and its derivatives by the position.
typedef struct {
    reals nx, ny, off;
} edge_residual;

// A circle: the normal points from the centre to the edge. Straight sides have the normal of the edge.
static inline edge_residual residual_at(laned_shape of, contour_edge edge) {
    const reals ax = edge.x - of.x, ay = edge.y - of.y;
#ifdef ROUND
    const reals square = ax * ax + ay * ay + (reals)1e-12f, per = rsqrt(square);
    return (edge_residual){ax * per, ay * per, square * per - of.size * edge.height};
#else
    return (edge_residual){edge.nx, edge.ny, edge.nx * ax + edge.ny * ay - of.size * edge.height};
#endif
}

// Shapes through three edges each (first edges i, i + 1, ...), by Newton's method. `start` is copied: Mesa 22.3 passes
// structs by reference, so that a change of a parameter changes the variable of the caller.
static inline laned_shape shape_through(private const contour_edge *edges, const laned_shape start) {
    laned_shape shape = start;
    for (int step = 0; step < START_STEPS; step++) {
        const edge_residual one = residual_at(shape, edges[0]), two = residual_at(shape, edges[1]);
        const edge_residual three = residual_at(shape, edges[2]);
        const reals ux = one.nx, uy = one.ny, u = one.off, vx = two.nx, vy = two.ny, v = two.off;
        const reals wx = three.nx, wy = three.ny, w = three.off;
        const reals uh = edges[0].height, vh = edges[1].height, wh = edges[2].height;
        const reals a = vy * wh - vh * wy, b = vh * wx - vx * wh, c = vx * wy - vy * wx;
        const reals whole = 1 / (ux * a + uy * b + uh * c);
        shape.x += whole * (u * a + v * (wy * uh - wh * uy) + w * (uy * vh - uh * vy));
        shape.y += whole * (u * b + v * (wh * ux - wx * uh) + w * (uh * vx - ux * vh));
        shape.size += whole * (u * c + v * (wx * uy - wy * ux) + w * (ux * vy - uy * vx));
    }
    return shape;
}

#ifdef VECTOR_VARIANT
static inline real least_of(reals value) {
    const real8 a = value.lo < value.hi ? value.lo : value.hi;
    const real4 b = a.lo < a.hi ? a.lo : a.hi;
    const real low = b.x < b.y ? b.x : b.y, high = b.z < b.w ? b.z : b.w;
    return low < high ? low : high;
}
#else
static inline real least_of(reals value) { return value; }
#endif

// Compute the shape through the edges i, i + pattern[p][0] / 16 and i + pattern[p][1] / 16 of the contour in each lane,
// and its sum of truncated squares; infinity where an edge is missing.
static inline reals start_loss(private const blob_circuit *circuit, int p, int i, laned_shape near, real reach,
                               private laned_shape *tried) {
    const contour_edge edges[3] = {edge_from(circuit, i), edge_from(circuit, i + pattern[p][0] * SPOKES / 16),
                                   edge_from(circuit, i + pattern[p][1] * SPOKES / 16)};
    const masks all = mask_of(edges[0].there * edges[1].there * edges[2].there > (reals)0);
    *tried = shape_through(edges, near);
    const reals most = (reals)(reach * reach);
    reals loss = 0;
    for (int m = 0; m < SPOKES; m++) {
        const contour_edge edge = edge_for_all(circuit, m);
        const reals off = residual_at(*tried, edge).off;
        loss += edge.there * lane_min(off * off, most) + ((reals)1 - edge.there) * most;
    }
    return all ? loss : (reals)INFINITY;
}

// Replace `shape` by the start shape: among the shapes through three edges, the shape with the least sum of truncated
// squares. The items of a group try different triples. No triples are tried unless `is_wanted`.
INLINE void start_of(GROUP_SPACE blob_shape *shape, GROUP_SPACE const blob_edges *edges, blob_layout layout,
                     int is_wanted, real reach, GROUP_SPACE blob_room *room) {
    const real cosine = cosine_of(*shape), sine = sine_of(*shape);
    const laned_shape near = {(reals)shape->x, (reals)shape->y, (reals)shape->size};
    real least = SPOKES * reach * reach;
#ifdef IN_GROUP
    const blob_circuit circuit = {edges, layout, cosine, sine};
    const int triples = is_wanted ? PATTERNS * SPOKES : 0;
    int chosen = INT_MAX;
    laned_shape best = near;
    for (int triple = GROUP_ITEM; triple < triples; triple += GROUP_ITEMS) {
        laned_shape tried;
        const real loss = start_loss(&circuit, triple / SPOKES, triple % SPOKES, near, reach, &tried);
        const int better = loss < least;
        chosen = better ? triple : chosen;
        least = better ? loss : least;
        best = better ? tried : best;
    }
    if (group_best(chosen < INT_MAX ? least : (real)INFINITY, chosen, room->sums) == GROUP_ITEM && chosen < INT_MAX)
        shape->x = best.x, shape->y = best.y, shape->size = best.size;
    group_barrier();
#else
    if (!is_wanted) return;
    blob_circuit circuit;
    wrap(edges, layout, cosine, sine, &circuit);
    laned_shape best = near;
    reals losses = (reals)least, triples = 0;
    for (int p = 0; p < PATTERNS; p++)
        for (int i = 0; i < PADDED_SPOKES; i += LANES) {
            laned_shape tried;
            const reals loss = start_loss(&circuit, p, i, near, reach, &tried);
            const masks better = mask_of(loss < losses);
            losses = better ? loss : losses;
            triples = better ? to_reals((ints)(p * PADDED_SPOKES + i) + LANE_NUMBERS) : triples;
            best.x = better ? tried.x : best.x;
            best.y = better ? tried.y : best.y;
            best.size = better ? tried.size : best.size;
        }
    // Of equal losses the first triple counts, as in the groups: shapes with opposite outliers have equal losses.
    triples = mask_of(losses == (reals)least_of(losses)) ? triples : (reals)INFINITY;
    const int lane = lowest_bit(lane_bits(mask_of(triples == (reals)least_of(triples))));
    shape->x = LANE(best.x, lane), shape->y = LANE(best.y, lane), shape->size = LANE(best.size, lane);
#endif
}

#endif
