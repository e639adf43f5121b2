// Edges of a fiducial: placement of its calipers (rulers), storage and selection of the edges that they find.
//
// Options: as in blob.cl.
#ifndef BLOB_EDGES_H
#define BLOB_EDGES_H
#include "blob/blob_model.h"
#include "common/group.h"
#include "ruler/ruler.h"

#if defined(IN_GROUP) && RULER_GROUP != PARTS
#error "group_add_up takes a part of the pixels from each item"
#endif

// LANES values of an array of edges, from edge i on.
#define AT(array, i) (*(GROUP_SPACE reals_at *)((array) + (i)))

// Edges of a fiducial: positions relative to the nominal one, variances of blur and of position; flags of the rulers.
typedef struct {
    real x[PADDED_SPOKES], y[PADDED_SPOKES], amplitude[PADDED_SPOKES], blur[PADDED_SPOKES], noise[PADDED_SPOKES], there[PADDED_SPOKES];
    bits flags[PADDED_SPOKES];
} blob_edges;
typedef masks masks_at __attribute__((aligned(sizeof(bits))));
#define FLAGS_AT(edges, i) (*(GROUP_SPACE masks_at *)((edges)->flags + (i)))

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

// Scratch memory of a group: sums (common/group.h), or the rulers while they are measured.
#define ROUND_SUMS 20 // most sums that a group adds up at a time
typedef union {
#ifdef IN_GROUP
    real sums[ROOM_FOR(ROUND_SUMS)];
    ruler_memory rulers;
#else
    real sums[1];
#endif
} blob_room;

// Residual of an edge (distance outside the shape) and its derivatives. A round edge appears nearer to the centre: blur and
// averaging across by a variance v move it to the mean of sqrt(R^2 - u^2) over u with that variance (`bent`).
static inline blob_equation equation_of(GROUP_SPACE const blob_edges *edges, int i, blob_layout layout, blob_shape shape,
                                 real cosine, real sine, real bent) {
    blob_equation equation;
    const reals x = AT(edges->x, i) - shape.x, y = AT(edges->y, i) - shape.y, height = FROM(layout.height, i);
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

// Rulers i, i + 1, ... of each lane: centre relative to the nominal position, and direction.
typedef struct {
    reals x, y, along_x, along_y;
} ruler_line;

static inline ruler_line ruler_of(int i, blob_layout layout, blob_shape shape, real cosine, real sine) {
    const reals bx = FROM(layout.bx, i), by = FROM(layout.by, i), nx = FROM(layout.nx, i), ny = FROM(layout.ny, i);
    return (ruler_line){shape.x + shape.size * (cosine * bx - sine * by), shape.y + shape.size * (sine * bx + cosine * by),
                        cosine * nx - sine * ny, sine * nx + cosine * ny};
}

// Store the edges that the rulers i, i + 1, ... of each lane found. The rulers are placed for `shape`, turned by its angle.
static inline void take_edges(ruler_edge edge, int i, blob_layout layout, blob_shape shape, real cosine, real sine,
                              GROUP_SPACE blob_edges *edges) {
    const ruler_line at = ruler_of(i, layout, shape, cosine, sine);
    const masks counts = mask_of(FROM(layout.counts, i) > (reals)0);
    const masks none = ~counts | mask_of((edge.status & (RULER_USELESS | STATUS_LOW_SIGNAL)) != 0);
    const reals position = zero_where(none, edge.position);
    AT(edges->x, i) = at.x + position * at.along_x;
    AT(edges->y, i) = at.y + position * at.along_y;
    AT(edges->amplitude, i) = zero_where(none, edge.amplitude);
    AT(edges->blur, i) = zero_where(none, edge.width * edge.width);
    AT(edges->noise, i) = zero_where(none, edge.sigma * edge.sigma);
    AT(edges->there, i) = zero_where(none, (reals)1);
    FLAGS_AT(edges, i) = counts & edge.status;
}

// Place the rulers of a fiducial near (x, y) and store their edges.
INLINE void measure(global const CODE *image, int rows, int columns, real x, real y, blob_shape shape,
                    constant real *table, blob_layout layout, GROUP_SPACE blob_edges *edges,
                    GROUP_SPACE blob_room *room) {
    const real cosine = cosine_of(shape), sine = sine_of(shape);
#ifdef IN_GROUP
    for (int first = 0; first < PADDED_SPOKES; first += RULERS_PER_GROUP) {
        const int i = min(first + ruler_of_item(), PADDED_SPOKES - 1);
        const ruler_line at = ruler_of(i, layout, shape, cosine, sine);
        const real4 ruler = {x + at.x, y + at.y, at.along_x, at.along_y};
        const ruler_edge edge = ruler_measure(image, rows, columns, ruler, table, 0, &room->rulers);
        if (ruler_lane() == 0 && first + ruler_of_item() < PADDED_SPOKES)
            take_edges(edge, i, layout, shape, cosine, sine, edges);
    }
    group_barrier();
#elif defined(VECTOR_VARIANT)
    for (int i = 0; i < PADDED_SPOKES; i += LANES) {
        const ruler_line at = ruler_of(i, layout, shape, cosine, sine);
        ruler_edge edge;
        ruler_measure_lanes(image, rows, columns, x + at.x, y + at.y, at.along_x, at.along_y, table, 0, &edge);
        take_edges(edge, i, layout, shape, cosine, sine, edges);
    }
#endif
}

// Numbers of edges that were kept, and of rulers that leave the image or have a pixel that is not finite; mean variances
// of the kept edges.
typedef struct {
    int found, outside, broken;
    real noise, blur;
} blob_count;

// Reject edges further than `search` from the nominal contour and, with EITHER_POLARITY, edges of the minority polarity.
INLINE blob_count keep_edges(GROUP_SPACE blob_edges *edges, blob_layout layout, blob_shape nominal, real search,
                             GROUP_SPACE blob_room *room) {
    const real cosine = cosine_of(nominal), sine = sine_of(nominal);
#ifdef EITHER_POLARITY
    reals sum;
    EACH_PART(part) {
        sum = 0;
        for (int i = part * LANES; i < PADDED_SPOKES; i += PARTS * LANES) sum += AT(edges->amplitude, i);
        group_put(&sum, 1, part, room->sums);
    }
    const reals sign = sum_of(*group_total(&sum, 1, room->sums)) < 0 ? (reals)-1 : (reals)1;
#endif
    reals sums[5];
    EACH_PART(part) {
        for (int k = 0; k < 5; k++) sums[k] = 0;
        for (int i = part * LANES; i < PADDED_SPOKES; i += PARTS * LANES) {
            const blob_equation equation = equation_of(edges, i, layout, nominal, cosine, sine, 0);
            masks near = mask_of(AT(edges->there, i) > (reals)0) & mask_of(FABS(equation.residual) <= (reals)search);
#ifdef EITHER_POLARITY
            near &= mask_of(sign * AT(edges->amplitude, i) > (reals)0);
#endif
            const masks flags = FLAGS_AT(edges, i);
            sums[0] += kept_where(near, (reals)1);
            sums[1] += kept_where(near, AT(edges->noise, i));
            sums[2] += kept_where(near, AT(edges->blur, i));
            sums[3] += kept_where(mask_of((flags & (masks)STATUS_OUT_OF_RANGE) != 0), (reals)1);
            sums[4] += kept_where(mask_of((flags & (masks)STATUS_NOT_FINITE) != 0), (reals)1);
            AT(edges->there, i) = kept_where(near, (reals)1);
        }
        group_put(sums, 5, part, room->sums);
    }
    GROUP_SPACE const reals *totals = group_total(sums, 5, room->sums);
    const real count = sum_of(totals[0]), per = fmax(count, (real)1);
    return (blob_count){(int)count, (int)sum_of(totals[3]), (int)sum_of(totals[4]), sum_of(totals[1]) / per,
                        sum_of(totals[2]) / per};
}

#endif
