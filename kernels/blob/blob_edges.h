// Edges of a fiducial: placement of its calipers (rulers), storage and selection of the edges that they find.
//
// Options: as in blob.cl.
#ifndef BLOB_EDGES_H
#define BLOB_EDGES_H
#include "blob/blob_model.h"
#include "ruler/ruler.h"

// Edges of a fiducial: positions relative to the nominal one, variances of blur and of position.
typedef struct {
    real x[PADDED_SPOKES], y[PADDED_SPOKES], amplitude[PADDED_SPOKES], blur[PADDED_SPOKES], noise[PADDED_SPOKES], there[PADDED_SPOKES];
    int saturated[PADDED_SPOKES];
    int outside, broken;
} blob_edges;

typedef struct {
    constant real *bx;
    constant real *by;
    constant real *nx;
    constant real *ny;
    constant real *height;
    constant real *counts;
} blob_layout;

typedef struct {
    reals row[FREEDOMS], residual;
} blob_equation;

#define FROM(table, i) (*(constant const reals_at *)((table) + (i)))

// Residual of an edge (distance outside the shape) and its derivatives. A round edge appears nearer to the centre: blur and
// averaging across by a variance v move it to the mean of sqrt(R^2 - u^2) over u with that variance (`bent`).
static inline blob_equation equation_of(private const blob_edges *edges, int i, blob_layout layout, blob_shape shape,
                                 real cosine, real sine, real bent) {
    blob_equation equation;
    const reals x = READ(edges->x, i) - shape.x, y = READ(edges->y, i) - shape.y, height = FROM(layout.height, i);
#ifdef ROUND
    const reals square = x * x + y * y + (reals)1e-12f, per = rsqrt(square);
    equation.residual = sqrt(square + bent + (real)0.5f * bent * bent * per * per) - shape.size * height;
    equation.row[0] = x * per;
    equation.row[1] = y * per;
#else
    const reals nx = FROM(layout.nx, i), ny = FROM(layout.ny, i);
    const reals across_x = cosine * nx - sine * ny, across_y = sine * nx + cosine * ny;
    equation.residual = across_x * x + across_y * y - shape.size * height;
    equation.row[0] = across_x;
    equation.row[1] = across_y;
    equation.row[3] = across_y * x - across_x * y;
#endif
    equation.row[2] = height;
    return equation;
}

// Address space of the edges: private to a work-item (vector variant), or shared by a work-group.
#ifdef VECTOR_VARIANT
#define EDGE_SPACE private
#else
#define EDGE_SPACE local
#endif

// Store the edges that a vector of rulers found.
static inline void take_edges(ruler_edge edge, int i, blob_layout layout, blob_shape shape, real cosine, real sine,
                       reals from_x, reals from_y, EDGE_SPACE blob_edges *edges) {
    const reals nx = FROM(layout.nx, i), ny = FROM(layout.ny, i);
    const masks counts = mask_of(FROM(layout.counts, i) > (reals)0);
    const masks none = ~counts | mask_of((edge.status & (RULER_USELESS | STATUS_LOW_SIGNAL)) != 0);
    const reals position = zero_where(none, edge.position);
    *(EDGE_SPACE reals_at *)(edges->x + i) = from_x + position * (cosine * nx - sine * ny);
    *(EDGE_SPACE reals_at *)(edges->y + i) = from_y + position * (sine * nx + cosine * ny);
    *(EDGE_SPACE reals_at *)(edges->amplitude + i) = zero_where(none, edge.amplitude);
    *(EDGE_SPACE reals_at *)(edges->blur + i) = zero_where(none, edge.width * edge.width);
    *(EDGE_SPACE reals_at *)(edges->noise + i) = zero_where(none, edge.sigma * edge.sigma);
    *(EDGE_SPACE reals_at *)(edges->there + i) = zero_where(none, (reals)1);
    const masks flags = counts & edge.status;
    for (int lane = 0; lane < LANES; lane++) {
        const int flag = LANE_BITS(flags, lane);
        edges->saturated[i + lane] = (flag & STATUS_SATURATED) != 0;
        edges->outside += (flag & STATUS_OUT_OF_RANGE) != 0;
        edges->broken += (flag & STATUS_NOT_FINITE) != 0;
    }
}

// Reject edges further than `search` from the nominal contour and, with EITHER_POLARITY, edges of the minority polarity. Return
// the number of edges kept, and their mean variances.
static inline int keep_edges(private blob_edges *edges, blob_layout layout, blob_shape nominal, real cosine, real sine,
                      real search, private real *noise, private real *blur) {
#ifdef EITHER_POLARITY
    reals sum = 0;
    for (int i = 0; i < PADDED_SPOKES; i += LANES) sum += READ(edges->amplitude, i);
    const reals sign = sum_of(sum) < 0 ? (reals)-1 : (reals)1;
#endif
    reals kept = 0, noises = 0, blurs = 0;
    for (int i = 0; i < PADDED_SPOKES; i += LANES) {
        const blob_equation equation = equation_of(edges, i, layout, nominal, cosine, sine, 0);
        masks near = mask_of(READ(edges->there, i) > (reals)0) & mask_of(FABS(equation.residual) <= (reals)search);
#ifdef EITHER_POLARITY
        near &= mask_of(sign * READ(edges->amplitude, i) > (reals)0);
#endif
        kept += kept_where(near, (reals)1);
        noises += kept_where(near, READ(edges->noise, i));
        blurs += kept_where(near, READ(edges->blur, i));
        *(private reals_at *)(edges->there + i) = kept_where(near, (reals)1);
    }
    const real count = sum_of(kept);
    *noise = sum_of(noises) / fmax(count, (real)1);
    *blur = sum_of(blurs) / fmax(count, (real)1);
    return (int)count;
}

// Place the rulers of a fiducial and store their edges.
static inline void measure(global const CODE *image, int rows, int columns, real x, real y, blob_shape shape, real turned,
                    constant real *table, blob_layout layout, EDGE_SPACE blob_edges *edges
#ifndef VECTOR_VARIANT
                    ,
                    local ruler_memory *rulers
#endif
) {
    const real cosine = cos(turned), sine = sin(turned);
#ifdef VECTOR_VARIANT
    edges->outside = edges->broken = 0;
#else
    if (get_local_id(0) == 0) edges->outside = edges->broken = 0;
#endif
    for (int i = 0; i < PADDED_SPOKES; i += LANES) {
        const reals bx = FROM(layout.bx, i), by = FROM(layout.by, i), nx = FROM(layout.nx, i), ny = FROM(layout.ny, i);
        const reals from_x = shape.x + shape.size * (cosine * bx - sine * by);
        const reals from_y = shape.y + shape.size * (sine * bx + cosine * by);
        const reals along_x = cosine * nx - sine * ny, along_y = sine * nx + cosine * ny;
#ifdef VECTOR_VARIANT
        ruler_edge edge;
        ruler_measure_lanes(image, rows, columns, x + from_x, y + from_y, along_x, along_y, table, 0, &edge);
        take_edges(edge, i, layout, shape, cosine, sine, from_x, from_y, edges);
#else
        const real4 ruler = {x + from_x, y + from_y, along_x, along_y};
        const ruler_edge edge = ruler_measure(image, rows, columns, ruler, table, 0, rulers);
        if (get_local_id(0) == 0) take_edges(edge, i, layout, shape, cosine, sine, from_x, from_y, edges);
#endif
    }
}

#endif
