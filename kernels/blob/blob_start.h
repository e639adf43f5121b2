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
#define WRAPPED (PADDED_SPOKES + SPOKES + LANES)

// Edges in the order of the contour, repeated after the last one; straight edges with normals at the nominal angle.
typedef struct {
    real x[WRAPPED], y[WRAPPED], there[WRAPPED], height[WRAPPED];
#ifndef ROUND
    real nx[WRAPPED], ny[WRAPPED];
#endif
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

// Shape in each lane: centre and size.
typedef struct {
    reals x, y, size;
} laned_shape;

// Residual of an edge, and its derivatives by the position.
typedef struct {
    reals nx, ny, off;
} edge_residual;

#ifdef ROUND
// Edge at (x, y) of a circle: the normal points from the centre to the edge.
static inline edge_residual residual_at(laned_shape of, reals x, reals y, reals height) {
    const reals ax = x - of.x, ay = y - of.y;
    const reals square = ax * ax + ay * ay + (reals)1e-12f, per = rsqrt(square);
    return (edge_residual){ax * per, ay * per, square * per - of.size * height};
}
#define RESIDUAL(of, circuit, take, i)                                                                                 \
    residual_at(of, take((circuit)->x, i), take((circuit)->y, i), take((circuit)->height, i))
#else
// Edge at (x, y) of a straight side with normal (nx, ny).
static inline edge_residual residual_at(laned_shape of, reals x, reals y, reals nx, reals ny, reals height) {
    return (edge_residual){nx, ny, nx * (x - of.x) + ny * (y - of.y) - of.size * height};
}
#define RESIDUAL(of, circuit, take, i)                                                                                 \
    residual_at(of, take((circuit)->x, i), take((circuit)->y, i), take((circuit)->nx, i), take((circuit)->ny, i),      \
                take((circuit)->height, i))
#endif
#define FOR_ALL(from, i) ((reals)((from)[i]))

// Shapes through three edges each (first edges i, i + 1, ...), by Newton's method. `start` is copied: Mesa 22.3 passes
// structs by reference, so that a change of a parameter changes the variable of the caller.
static inline laned_shape shape_through(private const blob_circuit *circuit, int i, int j, int k,
                                        const laned_shape start) {
    laned_shape shape = start;
    for (int step = 0; step < START_STEPS; step++) {
        const edge_residual one = RESIDUAL(shape, circuit, READ, i), two = RESIDUAL(shape, circuit, READ, j);
        const edge_residual three = RESIDUAL(shape, circuit, READ, k);
        const reals ux = one.nx, uy = one.ny, u = one.off, vx = two.nx, vy = two.ny, v = two.off;
        const reals wx = three.nx, wy = three.ny, w = three.off;
        const reals uh = READ(circuit->height, i), vh = READ(circuit->height, j), wh = READ(circuit->height, k);
        const reals a = vy * wh - vh * wy, b = vh * wx - vx * wh, c = vx * wy - vy * wx;
        const reals whole = 1 / (ux * a + uy * b + uh * c);
        shape.x += whole * (u * a + v * (wy * uh - wh * uy) + w * (uy * vh - uh * vy));
        shape.y += whole * (u * b + v * (wh * ux - wx * uh) + w * (uh * vx - ux * vh));
        shape.size += whole * (u * c + v * (wx * uy - wy * ux) + w * (ux * vy - uy * vx));
    }
    return shape;
}

// Start shape: among the shapes through three edges, the shape with the least sum of truncated squares.
static inline blob_shape start_of(private const blob_edges *edges, blob_layout layout, blob_shape near, real reach) {
    blob_circuit circuit;
    wrap(edges, layout, cos(near.angle), sin(near.angle), &circuit);
    const laned_shape from = {(reals)near.x, (reals)near.y, (reals)near.size};
    blob_shape best = near;
    real least = SPOKES * reach * reach;
    for (int p = 0; p < PATTERNS; p++)
        for (int i = 0; i < PADDED_SPOKES; i += LANES) {
            const int j = i + pattern[p][0] * SPOKES / 16, k = i + pattern[p][1] * SPOKES / 16;
            const laned_shape tried = shape_through(&circuit, i, j, k, from);
            const reals found = READ(circuit.there, i) * READ(circuit.there, j) * READ(circuit.there, k);
            const masks all = mask_of(found > (reals)0);
            reals loss = 0;
            for (int m = 0; m < SPOKES; m++) {
                const reals off = RESIDUAL(tried, &circuit, FOR_ALL, m).off, squared = off * off;
                const masks there = mask_of((reals)circuit.there[m] > (reals)0);
                const masks in = there & mask_of(squared < (reals)(reach * reach));
                loss += in ? squared : (reals)(reach * reach);
            }
            loss = all ? loss : (reals)INFINITY;
            if (!any_lane(mask_of(loss < (reals)least))) continue;
            for (int lane = 0; lane < LANES; lane++) {
                if (!(LANE(loss, lane) < least)) continue;
                least = LANE(loss, lane);
                best.x = LANE(tried.x, lane), best.y = LANE(tried.y, lane), best.size = LANE(tried.size, lane);
            }
        }
    return best;
}

#endif
