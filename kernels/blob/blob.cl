// Fiducials and blobs of a known shape near given positions: calipers (rulers) across the contour, then a robust fit of the
// shape to their edges, optionally refined by the grey levels (blob_match.h).
//
// Inputs:  image (rows, columns), type CODE; places (count, PLACE): x, y, size, and the angle of shapes that are not round.
// Outputs: (count,) each: x, y, size, residual, distance, blur [px], angle [rad], symmetry, contrast, centroid (gravity_x,
//          gravity_y), inliers, status; shift (count, 2); covariance (count, FREEDOMS, FREEDOMS).
// Tables:  table: parameters of ruler.h. ruler_table: six rows of PADDED_SPOKES numbers for a shape of size 1: centre of
//          the ruler (x, y); its direction (x, y), outwards from the fiducial; distance of the edge from the centre; 1,
//          or 0 for padding.
// Options: ROUND: the contour is one circle or two, FREEDOMS is 3: x, y, size; else straight edges, FREEDOMS is 4: x, y,
//          size, angle. EITHER_POLARITY: fiducials may be brighter or darker than the background. MATCH_IMAGE: refine by
//          grey levels. SPOKES: number of rulers, even; opposite rulers are SPOKES / 2 apart. PADDED_SPOKES: SPOKES
//          rounded up to whole vectors.
// Variants: vector: a work-item processes `each` fiducials, 16 rulers in a vector; work-item: a work-group of
//          RULER_GROUP items per fiducial, one ruler after the other.
#include "blob/blob_match.h"
#include "ruler/ruler.h"

#define LEAST_REACH (real)0.6f    // residual up to which an edge is an inlier before the scale is known [px]
#define LEAST_SCALE (real)0.01f   // smallest scale of the residuals [px]
// Rulers are placed again unless the shape moved by less than this [px].
#ifdef MATCH_IMAGE
#define STILL (real)2
#else
#define STILL (real)0.1f
#endif
#define MOST_STEPS 12             // iterations with shrinking scale
#define STEPS_AT_SCALE 2          // iterations at the estimated scale
#define RING (real)2              // width of the background ring for the centroid [px]
#define BILINEAR (real)(1.0f / 6) // variance that bilinear sampling adds to the blur [px^2]
#define BEYOND (real)2.5f         // distance of background samples from an edge, in blurs
#define OWN (real)0.5f            // smallest weight of an edge that belongs to the fiducial

#ifdef ROUND
#define PLACE 3
#define START_REACH LEAST_REACH // residual up to which an edge supports a start shape [px]
#else
#define PLACE 4
#define START_REACH (3 * LEAST_REACH) // larger: start shapes have the nominal angle
#endif

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

// Robust scale of the residuals within reach: their median absolute deviation.
static inline real scale_of(private const blob_edges *edges, blob_layout layout, blob_shape shape, real bent, real reach) {
    const real cosine = cos(shape.angle), sine = sin(shape.angle);
    real distances[PADDED_SPOKES];
    masks inside = 0;
    for (int i = 0; i < PADDED_SPOKES; i += LANES) {
        const reals distance = FABS(equation_of(edges, i, layout, shape, cosine, sine, bent).residual);
        const masks near = mask_of(READ(edges->there, i) > (reals)0) & mask_of(distance <= (reals)reach);
        inside -= near;
        *(private reals_at *)(distances + i) = near ? distance : (reals)INFINITY;
    }
    const int within = (int)sum_of(LANED(convert_real)(inside));
    bits found = 0;
    for (int bit = BITS_BELOW_SIGN - 1; bit >= BITS_TO_ONE_PERCENT; bit--) {
        const bits next = found | ((bits)1 << bit);
        masks below = 0;
        for (int i = 0; i < PADDED_SPOKES; i += LANES) below -= mask_of(as_masks(READ(distances, i)) < (masks)next);
        found = (int)sum_of(LANED(convert_real)(below)) > within / 2 ? found : next;
    }
    return MAD_TO_SIGMA * (1 + FEW_FITTED / fmax((real)(within - FREEDOMS), (real)1)) * as_real(found);
}

// One Gauss-Newton step of the reweighted fit; return 0 if it is singular.
static inline int fit_step(private const blob_edges *edges, blob_layout layout, real scale, private blob_shape *shape,
                    private real *blur, real across) {
    const real cosine = cos(shape->angle), sine = sin(shape->angle), per_scale = 1 / scale;
#ifdef ROUND
    const real bent = *blur + across;
#else
    const real bent = 0;
#endif
    reals matrix[TRIANGLE], right[FREEDOMS], step[FREEDOMS], weights = 0, blurs = 0;
    for (int j = 0; j < TRIANGLE; j++) matrix[j] = 0;
    for (int j = 0; j < FREEDOMS; j++) right[j] = 0;
    for (int i = 0; i < PADDED_SPOKES; i += LANES) {
        const blob_equation equation = equation_of(edges, i, layout, *shape, cosine, sine, bent);
        const reals weight = READ(edges->there, i) * loss_weight(equation.residual * (reals)per_scale);
        for (int j = 0; j < FREEDOMS; j++) {
            const reals weighted = weight * equation.row[j];
            right[j] += weighted * equation.residual;
            for (int k = 0; k <= j; k++) matrix[CELL(j, k)] += weighted * equation.row[k];
        }
        weights += weight;
        blurs += weight * READ(edges->blur, i);
    }
    for (int j = 0; j < TRIANGLE; j++) matrix[j] = (reals)sum_of(matrix[j]);
    for (int j = 0; j < FREEDOMS; j++) right[j] = (reals)sum_of(right[j]);
    if (any_lane(factored(matrix))) return 0;
    solved(matrix, right, step);
    shape->x += FIRST(step[0]);
    shape->y += FIRST(step[1]);
    shape->size += FIRST(step[2]);
#ifndef ROUND
    shape->angle += FIRST(step[3]);
#endif
    *blur = sum_of(blurs) / sum_of(weights);
    return shape->size > 0 && !not_finite(shape->x + shape->y + shape->size + shape->angle);
}

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

// Fit the shape to the edges by reweighted least squares, with the scale halved from step to step and then estimated from
// the residuals. Return 0 if the fit is singular.
static inline int fit_shape(private const blob_edges *edges, blob_layout layout, real reach, real noise, real across,
                     private blob_shape *shape, private real *blur, private real *scale) {
    const real predicted = fmax(sqrt(noise), LEAST_SCALE), least = fmax(LEAST_REACH / TUNING, predicted);
    *scale = fmax(reach / TUNING, least);
    for (int step = 0; step < MOST_STEPS; step++) {
        if (!fit_step(edges, layout, *scale, shape, blur, across)) return 0;
        if (*scale <= least) break;
        *scale = fmax(*scale / 2, least);
    }
    for (int step = 0; step < STEPS_AT_SCALE; step++) {
#ifdef ROUND
        const real bent = *blur + across;
#else
        const real bent = 0;
#endif
        const real measured = scale_of(edges, layout, *shape, bent, TUNING * *scale);
        *scale = fmin(fmax(measured, predicted), least);
        if (!fit_step(edges, layout, *scale, shape, blur, across)) return 0;
    }
    return 1;
}

// Quality of a fit: covariance, residual, symmetry, contrast, weights of the edges, counts.
typedef struct {
    real covariance[FREEDOMS][FREEDOMS];
    real residual, symmetry, contrast;
    real weights[PADDED_SPOKES + SPOKES / 2 + LANES];
    int inliers, saturated, regular;
} blob_quality;

static inline blob_quality quality_of(private blob_edges *edges, blob_layout layout, blob_shape shape, real scale, real bent,
                           real overlap) {
    const real cosine = cos(shape.angle), sine = sin(shape.angle), per_scale = 1 / scale;
    blob_quality quality;
    reals matrix[TRIANGLE], weights = 0, squares = 0, noises = 0, amplitudes = 0, inliers = 0;
    reals slopes = 0;
    real height[PADDED_SPOKES + SPOKES / 2 + LANES];
    private real *of = quality.weights;
    for (int j = 0; j < TRIANGLE; j++) matrix[j] = 0;
    quality.saturated = 0;
    for (int i = 0; i < PADDED_SPOKES; i += LANES) {
        const blob_equation equation = equation_of(edges, i, layout, shape, cosine, sine, bent);
        const reals z = equation.residual * (reals)per_scale, weight = READ(edges->there, i) * loss_weight(z);
        const masks is_in = mask_of(weight > (reals)0);
        for (int j = 0; j < FREEDOMS; j++)
            for (int k = 0; k <= j; k++)
                matrix[CELL(j, k)] += kept_where(is_in, equation.row[j] * equation.row[k]);
        weights += weight;
        squares += weight * weight * z * z;
        slopes += kept_where(is_in, loss_slope(z));
        noises += kept_where(is_in, READ(edges->noise, i));
        amplitudes += weight * READ(edges->amplitude, i);
        inliers += kept_where(is_in, (reals)1);
        *(private reals_at *)(of + i) = weight;
        *(private reals_at *)(height + i) = FABS(READ(edges->amplitude, i));
        for (int lane = 0; lane < LANES; lane++)
            quality.saturated |= edges->saturated[i + lane] & (LANE_BITS(is_in, lane) != 0);
    }
    const real count = sum_of(inliers), free = fmax(count - FREEDOMS, (real)1), mean = sum_of(slopes) / count;
    quality.inliers = (int)count;
    quality.residual = scale * sqrt(sum_of(squares) / sum_of(weights));
    quality.contrast = -sum_of(amplitudes) / sum_of(weights);
    // Variance of an edge: the larger one of the variance predicted from the noise and the variance of the residuals.
    const real measured = scale * scale * sum_of(squares) / (free * mean * mean);
    const real predicted = sum_of(noises) / (count * (real)EFFICIENCY);
    const real variance = fmax(measured, predicted) * fmax(overlap / shape.size, (real)1);
    for (int j = 0; j < TRIANGLE; j++) matrix[j] = (reals)sum_of(matrix[j]);
    quality.regular = !any_lane(factored(matrix)) && mean > 0;
    for (int j = 0; j < FREEDOMS; j++) {
        reals unit[FREEDOMS], column[FREEDOMS];
        for (int k = 0; k < FREEDOMS; k++) unit[k] = (reals)(real)(j == k);
        solved(matrix, unit, column);
        for (int k = 0; k < FREEDOMS; k++) quality.covariance[j][k] = variance * FIRST(column[k]);
    }
    for (int i = 0; i < SPOKES / 2 + LANES; i++) {
        of[SPOKES + i] = of[i];
        height[SPOKES + i] = height[i];
    }
    reals agreed = 0;
    for (int i = 0; i < PADDED_SPOKES; i += LANES) {
        const reals here = READ(height, i), there = READ(height, i + SPOKES / 2);
        const reals low = here < there ? here : there, high = here < there ? there : here;
        const reals product = READ(of, i) * READ(of, i + SPOKES / 2) * FROM(layout.counts, i);
        agreed += sqrt(product) * low / (high + (reals)1e-30f);
    }
    quality.symmetry = sum_of(agreed) / SPOKES;
    return quality;
}

// Grey level of the background, sampled beyond the edges of the fit.
static inline real background_of(global const CODE *image, int rows, int columns, real x, real y, blob_shape shape,
                          private const blob_edges *edges, private const real *weights, blob_layout layout, real blur) {
    const real cosine = cos(shape.angle), sine = sin(shape.angle), out = BEYOND * blur + (real)0.5f;
    real sum = 0, all = 0;
    for (int i = 0; i < SPOKES; i++) {
        const real nx = layout.nx[i], ny = layout.ny[i];
        const int column = (int)rint(x + edges->x[i] + out * (cosine * nx - sine * ny));
        const int row = (int)rint(y + edges->y[i] + out * (sine * nx + cosine * ny));
        const int inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows);
        const real level = convert_real(image[inside ? row * columns + column : 0]);
        const real weight = (inside && !not_finite(level)) ? weights[i] : 0;
        sum += weight > 0 ? weight * level : 0;
        all += weight;
    }
    return sum / all;
}

// Mark the parts of the contour whose edges disagree with the shape, as wide as the spacing of the rulers.
static inline void hide(blob_shape shape, private const real *weights, blob_layout layout, real spacing, real blur,
                 private blob_hidden *hidden) {
    const real cosine = cos(shape.angle), sine = sin(shape.angle);
    hidden->count = 0;
    hidden->half_width = spacing * shape.size;
    hidden->half_length = ABOUT_BLURS * blur + ABOUT + 1;
    for (int i = 0; i < SPOKES; i++) {
        if (weights[i] >= OWN) continue;
        const real bx = layout.bx[i], by = layout.by[i], nx = layout.nx[i], ny = layout.ny[i];
        hidden->x[hidden->count] = shape.size * (cosine * bx - sine * by);
        hidden->y[hidden->count] = shape.size * (sine * bx + cosine * by);
        hidden->nx[hidden->count] = cosine * nx - sine * ny;
        hidden->ny[hidden->count++] = sine * nx + cosine * ny;
    }
}

// Centroid of the grey levels over the background of a ring around the fiducial, relative to (x, y). Return 0 if the ring
// leaves the image.
static inline int gravity_of(global const CODE *image, int rows, int columns, real x, real y, real reach, private real *to_x,
                      private real *to_y) {
    const real outer = reach + RING;
    if (!(x - outer >= 0 && y - outer >= 0 && x + outer <= columns - 1 && y + outer <= rows - 1)) return 0;
    const int left = (int)(x - outer), right = (int)(x + outer), top = (int)(y - outer), bottom = (int)(y + outer);
    // Subtract one grey level first: sums of differences keep more digits.
    const reals level = (reals)convert_real(image[(int)y * columns + (int)x]);
    reals area = 0, sum = 0, sum_x = 0, sum_y = 0, at_x = 0, at_y = 0, about = 0, sum_about = 0;
    for (int row = top; row <= bottom; row++) {
        const reals dy = (reals)(row - y);
        for (int column = left; column <= right; column += LANES) {
            const int from = min(column, columns - LANES);
            const reals place = (reals)(real)from + COUNTED, dx = place - (reals)x, square = dx * dx + dy * dy;
            const masks fresh = mask_of(place >= (reals)(real)column);
            const masks in = fresh & mask_of(square <= (reals)(reach * reach));
            const masks ring = fresh & ~in & mask_of(square <= (reals)(outer * outer));
            const reals grey = PIXELS(image + row * columns + from) - level, mine = kept_where(in, grey);
            area += kept_where(in, (reals)1);
            at_x += kept_where(in, dx);
            at_y += kept_where(in, dy);
            sum += mine;
            sum_x += mine * dx;
            sum_y += mine * dy;
            about += kept_where(ring, (reals)1);
            sum_about += kept_where(ring, grey);
        }
    }
    const real background = sum_of(sum_about) / sum_of(about), per = 1 / (sum_of(sum) - background * sum_of(area));
    *to_x = (sum_of(sum_x) - background * sum_of(at_x)) * per;
    *to_y = (sum_of(sum_y) - background * sum_of(at_y)) * per;
    return !not_finite(*to_x + *to_y) && fabs(*to_x) <= reach && fabs(*to_y) <= reach;
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

kernel void find_blobs(global const CODE *restrict image, global const real *restrict places, global real *restrict x,
                       global real *restrict y, global real *restrict shift, global real *restrict size,
                       global real *restrict angle, global real *restrict covariance, global real *restrict residual,
                       global int *restrict inliers, global real *restrict symmetry, global real *restrict gravity_x,
                       global real *restrict gravity_y, global real *restrict distance, global real *restrict contrast,
                       global real *restrict blur, global uchar *restrict status, constant real *table,
                       constant real *ruler_table, const int rows, const int columns, const uint count, const uint each,
                       const real search, const int least, const real across, const real overlap, const real extent,
                       const real pixel_noise, const real spacing, const int passes) {
    const blob_layout layout = {ruler_table,
                                ruler_table + PADDED_SPOKES,
                                ruler_table + 2 * PADDED_SPOKES,
                                ruler_table + 3 * PADDED_SPOKES,
                                ruler_table + 4 * PADDED_SPOKES,
                                ruler_table + 5 * PADDED_SPOKES};
#ifdef VECTOR_VARIANT
    const uint first = get_global_id(0) * each, end = min(first + each, count);
    const int mine = 1;
#else
    local ruler_memory rulers;
    local real shared_state[5];
    local blob_edges shared;
    const uint first = get_group_id(0), end = first + 1;
    const int mine = get_local_id(0) == 0;
#endif
    blob_edges edges;
    for (uint n = first; n < end; n++) {
        global const real *place = places + (ulong)n * PLACE;
#ifdef ROUND
        const blob_shape nominal = {0, 0, place[2], 0};
#else
        const blob_shape nominal = {0, 0, place[2], place[3]};
#endif
        const int bad = not_finite(place[0]) | not_finite(place[1]) | not_finite(nominal.size) |
                        not_finite(nominal.angle) | !(nominal.size > 0);
        blob_shape shape = nominal;
        real variance = 0, noise = 0, scale = 0;
        int found = 0, agreed = 0;
        for (int pass = 0; pass < passes && !bad; pass++) {
            const blob_shape from = shape;
            int done = 1;
#ifdef VECTOR_VARIANT
            measure(image, rows, columns, place[0], place[1], from, from.angle, table, layout, &edges);
#else
            measure(image, rows, columns, place[0], place[1], from, from.angle, table, layout, &shared, &rulers);
#endif
            if (mine) {
#ifndef VECTOR_VARIANT
                edges = shared;
#endif
                const real cosine = cos(nominal.angle), sine = sin(nominal.angle);
                found = keep_edges(&edges, layout, nominal, cosine, sine, search, &noise, &variance);
                if (pass == 0 && found >= least) shape = start_of(&edges, layout, nominal, START_REACH);
                agreed = found >= least && fit_shape(&edges, layout, 2 * START_REACH, noise, across, &shape, &variance,
                                                     &scale);
                const real dx = shape.x - from.x, dy = shape.y - from.y, ds = shape.size - from.size;
                const real da = (shape.angle - from.angle) * from.size;
#ifndef VECTOR_VARIANT
                shared = edges;
#endif
                done = !agreed || dx * dx + dy * dy + ds * ds + da * da < STILL * STILL;
            }
#ifndef VECTOR_VARIANT
            barrier(CLK_LOCAL_MEM_FENCE);
            if (mine) {
                shared_state[0] = shape.x, shared_state[1] = shape.y, shared_state[2] = shape.size, shared_state[3] = shape.angle;
                shared_state[4] = done;
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            shape.x = shared_state[0], shape.y = shared_state[1], shape.size = shared_state[2], shape.angle = shared_state[3];
            done = shared_state[4] != 0;
#endif
            if (done) break;
        }
        if (!mine) continue;
#ifndef VECTOR_VARIANT
        edges = shared;
#endif
#ifdef ROUND
        const real bent = variance + across;
#else
        const real bent = 0;
#endif
        blob_quality quality;
        int what = bad ? STATUS_NOT_FINITE : 0;
        if (!bad) {
            what |= SPOKES - edges.outside < least ? STATUS_OUT_OF_RANGE : 0;
            what |= SPOKES - edges.broken < least ? STATUS_NOT_FINITE : 0;
            if (!what && found < least) what = STATUS_LOW_SIGNAL;
            if (!what && !agreed) what = STATUS_AMBIGUOUS;
        }
        if (!what) {
            quality = quality_of(&edges, layout, shape, scale, bent, overlap);
            if (quality.inliers < least || !quality.regular) what = STATUS_AMBIGUOUS;
            else if (shape.x * shape.x + shape.y * shape.y > search * search) what = STATUS_OUT_OF_RANGE;
        }
#ifdef MATCH_IMAGE
        if (!what) {
            blob_grey grey = {0, quality.contrast, sqrt(fmax(variance - BILINEAR, SHARPEST * SHARPEST))};
            grey.background = background_of(image, rows, columns, place[0], place[1], shape, &edges, quality.weights,
                                            layout, grey.blur);
            blob_hidden hidden;
            hide(shape, quality.weights, layout, spacing, grey.blur, &hidden);
            if (!match(image, rows, columns, place[0], place[1], pixel_noise, extent, &hidden, &shape, &grey,
                       quality.covariance))
                what = STATUS_AMBIGUOUS;
            else if (shape.x * shape.x + shape.y * shape.y > search * search) what = STATUS_OUT_OF_RANGE;
            quality.contrast = grey.contrast;
            variance = grey.blur * grey.blur;
        }
#endif
        const int good = !what;
        x[n] = good ? place[0] + shape.x : REAL_NAN;
        y[n] = good ? place[1] + shape.y : REAL_NAN;
        shift[2 * n] = good ? shape.x : REAL_NAN;
        shift[2 * n + 1] = good ? shape.y : REAL_NAN;
        size[n] = good ? shape.size : REAL_NAN;
#ifndef ROUND
        angle[n] = good ? shape.angle : REAL_NAN;
#endif
        for (int j = 0; j < FREEDOMS; j++)
            for (int k = 0; k < FREEDOMS; k++)
                covariance[((ulong)n * FREEDOMS + j) * FREEDOMS + k] = good ? quality.covariance[j][k] : REAL_NAN;
        residual[n] = good ? quality.residual : REAL_NAN;
        inliers[n] = good ? quality.inliers : 0;
        symmetry[n] = good ? quality.symmetry : REAL_NAN;
        distance[n] = good ? sqrt(shape.x * shape.x + shape.y * shape.y) : REAL_NAN;
        contrast[n] = good ? quality.contrast : REAL_NAN;
        blur[n] = good ? sqrt(variance) : REAL_NAN;
        real to_x = 0, to_y = 0;
        const real middle_x = place[0] + shape.x, middle_y = place[1] + shape.y;
        const int heavy = good && gravity_of(image, rows, columns, middle_x, middle_y,
                                             shape.size * extent + (real)2.5f * sqrt(variance) + 1, &to_x, &to_y);
        gravity_x[n] = heavy ? middle_x + to_x : REAL_NAN;
        gravity_y[n] = heavy ? middle_y + to_y : REAL_NAN;
        status[n] = (uchar)(what | (good && quality.saturated ? STATUS_SATURATED : 0));
    }
}
