// Solder paste deposits in a height map: area, volume, mean height and offset of each aperture, with standard
// deviations. Deposit sums with the symbols of MeasureDeposits (gpuvision/inspection/deposits.py).
//
// The cells of an aperture are its core (number k + 1 in `owner`) and its margin (-k - 1). h = z - surface is the height
// of a valid cell, s its sigma, b the terms 1, u, v, u^2, uv, v^2 of the surface, c the area of a cell. Cells without a
// height get the mean height of their part: w = cells / valid cells, of the core or of the margin. Sums over valid cells:
//     volume  c sum w h                          variance  c^2 V(w s, sum w b)
//     area    c sum w [h > t]                    variance  c^2 V(w sqrt(p (1 - p)), sum w b f / s)
//     mean    m = sum w h [h > t] / sum w [h > t]
//     offset  sum w h (x - centre) / sum w h     variance  V(a s, sum a b), a = w (x - centre of the paste) / sum w h
// with V(g, G) = n (sum g^2 + G' C G), C the covariance of the surface, n the number of cells whose noise is common,
// p = P(h + noise > t) the probability that a cell counts, and f the normal density at (t - h) / s.
//
// Inputs:  z, sigma (rows, columns) INPUT [m], sigma above 0; owner (rows, columns) int; boxes (apertures, 4) int: first
//          row, row after the last, first column, column after the last; surfaces (apertures,) Surface.
// Outputs: area, area_sigma [m^2], volume, volume_sigma [m^3], height_mean, height_mean_sigma [m], valid (apertures,);
//          offset, offset_sigma (apertures, 2) [m], in the coordinates of the board; status (apertures,) uchar:
//          NO_DATA (too few valid cells: all but `valid` are NaN), LOW_SIGNAL (no significant volume: no offset).
// Options: INPUT, INPUT16, REAL_IS_DOUBLE, VECTOR_VARIANT.
// Work:    one aperture per work-item; its rows in vectors of 16 cells (vector variant) or cell by cell.
#define TERMS 6
#define FREEDOMS TERMS // of the solvers in least_squares.h
#include "common/load.h"
#include "common/least_squares.h"
#include "common/status.h"

#define FAR_SIGMAS 12 // beyond it the probability that noise crosses the threshold is below 1e-32

// A reference surface: SURFACE in deposits.py. u and v are the coordinates of the surface at the first cell of the box,
// and per column and row; (centre_u, centre_v) is the centroid of the aperture, `length` the unit of u and v [m].
typedef struct {
    real coefficients[TERMS];
    real u, u_per_column, v, v_per_row;
    real centre_u, centre_v, length;
    real covariance[TERMS][TERMS];
} Surface;

typedef struct {
    global const INPUT *z, *sigma;
    global const int *owner;
    long columns, cells;
} Map;

// LANES neighbouring cells: height above the surface and its sigma, coordinates, masks of the valid and of all cells of
// the core and of the margin.
typedef struct {
    reals height, sigma, u, v;
    masks core, margin, valid;
} Cells;

// Load the cells of an aperture from a column on. The last vector of the map moves back; its first lanes, which the
// vector before had, are masked.
static inline Cells load_cells(Map map, private const Surface *surface, int number, int4 box, int row, int column) {
    const long first = (long)row * map.columns, at = min(first + column, map.cells - LANES);
    const ints place = (ints)(int)(at - first) + LANE_NUMBERS;
    const ints inside = int_mask(place >= (ints)column) & int_mask(place < (ints)box.w);
    const ints own = *(global const ints_at *)(map.owner + at);
    Cells cells;
    cells.core = to_masks(inside & int_mask(own == (ints)number));
    cells.margin = to_masks(inside & int_mask(own == (ints)-number));
    const reals z = load_inputs(map.z + at);
    cells.valid = (cells.core | cells.margin) & ~to_masks(not_finite_lanes(z));
    cells.sigma = choose_reals(int_mask(cells.valid != 0), load_inputs(map.sigma + at), (reals)1);
    cells.u = (reals)surface->u + (reals)surface->u_per_column * to_reals(place - (ints)box.z);
    cells.v = (reals)(surface->v + surface->v_per_row * (row - box.x));
    const real *k = surface->coefficients;
    const reals level = (reals)k[0] + cells.u * ((reals)k[1] + (reals)k[3] * cells.u + (reals)k[4] * cells.v) +
                        cells.v * ((reals)k[2] + (reals)k[5] * cells.v);
    cells.height = zero_where(~cells.valid, z - level);
    return cells;
}

// Add a value of each lane, times the terms of the surface, to sums.
static inline void add_terms(reals value, Cells cells, private reals *sums) {
    const reals along = value * cells.u, across = value * cells.v;
    sums[0] += value;
    sums[1] += along;
    sums[2] += across;
    sums[3] += along * cells.u;
    sums[4] += along * cells.v;
    sums[5] += across * cells.v;
}

// Return gradient' covariance gradient.
static inline real surface_variance(private const real *gradient, private const Surface *surface) {
    real sum = 0;
    for (int i = 0; i < TERMS; i++)
        for (int j = 0; j < TERMS; j++) sum += gradient[i] * surface->covariance[i][j] * gradient[j];
    return sum;
}

// Probability that the height of a cell with noise exceeds the threshold, and the normal density there.
typedef struct {
    reals ratio, chance, density;
} Crossing;

static inline Crossing crossing_of(Cells cells, real threshold) {
    Crossing at;
    const reals ratio = ((reals)threshold - cells.height) / cells.sigma;
    at.ratio = lane_max(lane_min(ratio, (reals)FAR_SIGMAS), (reals)-FAR_SIGMAS);
    const masks near = cells.valid & mask_of(at.ratio < (reals)FAR_SIGMAS) & mask_of(at.ratio > (reals)-FAR_SIGMAS);
    at.chance = choose_reals(int_mask(at.ratio < (reals)0), (reals)1, (reals)0);
    at.density = (reals)0;
    if (any_lane(near)) {
        at.chance = (reals)0.5f * erfc(at.ratio * (reals)0.70710678118654752440);
        at.density = exp((reals)-0.5f * at.ratio * at.ratio) * (reals)0.39894228040143267794;
    }
    return at;
}

kernel AS_IT_IS void deposits(global const INPUT *restrict z, global const INPUT *restrict sigma,
                              global const int *restrict owner, global const int *restrict boxes,
                              global const Surface *restrict surfaces, global real *restrict area,
                              global real *restrict area_sigma, global real *restrict volume,
                              global real *restrict volume_sigma, global real *restrict height_mean,
                              global real *restrict height_mean_sigma, global real *restrict offset,
                              global real *restrict offset_sigma, global real *restrict valid,
                              global uchar *restrict status, const int apertures, const int columns, const long cells,
                              const real cell_area, const real threshold, const real correlated, const real least_valid,
                              const real significant, const real board_xx, const real board_xy, const real board_yx,
                              const real board_yy) {
    const int item = (int)get_global_id(0);
    if (item >= apertures) return;
    const Map map = {z, sigma, owner, columns, cells};
    const Surface surface = surfaces[item];
    const int4 box = vload4(item, boxes); // a caller's array is aligned to an element only
    const int number = item + 1;

    // Weights of the valid cells of the core and of the margin.
    ints in_core = 0, in_margin = 0, core_valid = 0, margin_valid = 0;
    for (int row = box.x; row < box.y; row++)
        for (int column = box.z; column < box.w; column += LANES) {
            const Cells at = load_cells(map, &surface, number, box, row, column);
            in_core -= to_ints(at.core);
            in_margin -= to_ints(at.margin);
            core_valid -= to_ints(at.core & at.valid);
            margin_valid -= to_ints(at.margin & at.valid);
        }
    const real of_core = sum_of(to_reals(in_core)), of_margin = sum_of(to_reals(in_margin));
    const real with_core = sum_of(to_reals(core_valid)), with_margin = sum_of(to_reals(margin_valid));
    const int is_measured = with_core >= least_valid * of_core && with_margin >= least_valid * of_margin;
    const reals core_weight = of_core / max(with_core, (real)1), margin_weight = of_margin / max(with_margin, (real)1);

    // Coordinates x, y relative to the centroid, in the unit of the surface: sums stay small.
    reals sum = 0, sum_x = 0, sum_y = 0, above = 0, sum_above = 0, by_chance = 0;
    reals noise = 0, noise_x = 0, noise_y = 0, noise_xx = 0, noise_xy = 0, noise_yy = 0;
    reals terms[TERMS] = {0}, terms_x[TERMS] = {0}, terms_y[TERMS] = {0}, terms_above[TERMS] = {0};
    reals terms_crossing[TERMS] = {0};
    for (int row = box.x; row < box.y; row++)
        for (int column = box.z; column < box.w; column += LANES) {
            const Cells at = load_cells(map, &surface, number, box, row, column);
            if (!any_lane(at.valid)) continue;
            const reals weight =
                zero_where(~at.valid, choose_reals(int_mask(at.core != 0), core_weight, margin_weight));
            const reals x = at.u - (reals)surface.centre_u, y = at.v - (reals)surface.centre_v;
            const reals wh = weight * at.height, ws = weight * at.sigma;
            sum += wh, sum_x += wh * x, sum_y += wh * y;
            noise += ws * ws, noise_x += ws * ws * x, noise_y += ws * ws * y;
            noise_xx += ws * ws * x * x, noise_xy += ws * ws * x * y, noise_yy += ws * ws * y * y;
            add_terms(weight, at, terms);
            add_terms(weight * x, at, terms_x);
            add_terms(weight * y, at, terms_y);
            const Crossing crossing = crossing_of(at, threshold);
            const reals counted = zero_where(~mask_of(at.height > (reals)threshold), weight);
            above += counted, sum_above += counted * at.height;
            by_chance += weight * weight * crossing.chance * ((reals)1 - crossing.chance);
            add_terms(counted, at, terms_above);
            if (any_lane(mask_of(crossing.density > (reals)0)))
                add_terms(weight * crossing.density / at.sigma, at, terms_crossing);
        }
    const real total = sum_of(sum), count = sum_of(above), mean = sum_of(sum_above) / count;
    const real variance_of_sum = sum_of(noise), middle_x = sum_of(sum_x) / total, middle_y = sum_of(sum_y) / total;
    real gradient[TERMS], crossing_gradient[TERMS], mean_gradient[TERMS], gradient_x[TERMS], gradient_y[TERMS];
    for (int i = 0; i < TERMS; i++) {
        gradient[i] = sum_of(terms[i]);
        crossing_gradient[i] = sum_of(terms_crossing[i]);
        mean_gradient[i] = -sum_of(terms_above[i]) - (threshold - mean) * crossing_gradient[i];
        const real along = sum_of(terms_x[i]) - middle_x * gradient[i];
        const real across = sum_of(terms_y[i]) - middle_y * gradient[i];
        gradient_x[i] = (board_xx * along + board_xy * across) * surface.length / total;
        gradient_y[i] = (board_yx * along + board_yy * across) * surface.length / total;
    }

    // Moments of (height - mean) of a cell that exceeds the threshold, 0 otherwise: truncated normal distribution.
    reals moments = 0;
    for (int row = box.x; row < box.y && count > 0; row++)
        for (int column = box.z; column < box.w; column += LANES) {
            const Cells at = load_cells(map, &surface, number, box, row, column);
            if (!any_lane(at.valid)) continue;
            const reals weight =
                zero_where(~at.valid, choose_reals(int_mask(at.core != 0), core_weight, margin_weight));
            const Crossing crossing = crossing_of(at, threshold);
            const reals centred = at.height - (reals)mean, missing = (reals)1 - crossing.chance;
            const reals narrowed =
                crossing.chance + crossing.ratio * crossing.density - crossing.density * crossing.density;
            const reals spread = centred * missing * (centred * crossing.chance + (reals)2 * at.sigma * crossing.density) +
                                 at.sigma * at.sigma * narrowed;
            moments += weight * weight * lane_max(spread, (reals)0);
        }
    const real volume_variance = correlated * (variance_of_sum + surface_variance(gradient, &surface));
    const int is_deposit = total > significant * sqrt(volume_variance);
    const int has_mean = is_measured && count > 0, has_offset = is_measured && is_deposit;
    volume[item] = is_measured ? cell_area * total : REAL_NAN;
    volume_sigma[item] = is_measured ? cell_area * sqrt(volume_variance) : REAL_NAN;
    area[item] = is_measured ? cell_area * count : REAL_NAN;
    const real area_variance = correlated * (sum_of(by_chance) + surface_variance(crossing_gradient, &surface));
    area_sigma[item] = is_measured ? cell_area * sqrt(area_variance) : REAL_NAN;
    height_mean[item] = has_mean ? mean : REAL_NAN;
    const real mean_variance = correlated * (sum_of(moments) + surface_variance(mean_gradient, &surface));
    height_mean_sigma[item] = has_mean ? sqrt(mean_variance) / count : REAL_NAN;

    // sum w^2 s^2 (x - middle)^2 and so on, from the sums about the centroid of the aperture.
    const real xx = sum_of(noise_xx) - middle_x * (2 * sum_of(noise_x) - middle_x * variance_of_sum);
    const real yy = sum_of(noise_yy) - middle_y * (2 * sum_of(noise_y) - middle_y * variance_of_sum);
    const real xy = sum_of(noise_xy) - middle_x * sum_of(noise_y) - middle_y * sum_of(noise_x) +
                    middle_x * middle_y * variance_of_sum;
    const real unit = surface.length / total;
    const real own_x = board_xx * board_xx * xx + 2 * board_xx * board_xy * xy + board_xy * board_xy * yy;
    const real own_y = board_yx * board_yx * xx + 2 * board_yx * board_yy * xy + board_yy * board_yy * yy;
    // Rounding of the differences above may give less than 0 for one valid cell.
    const real variance_x = correlated * (max(own_x, (real)0) * unit * unit + surface_variance(gradient_x, &surface));
    const real variance_y = correlated * (max(own_y, (real)0) * unit * unit + surface_variance(gradient_y, &surface));
    offset[2 * item] = has_offset ? (board_xx * middle_x + board_xy * middle_y) * surface.length : REAL_NAN;
    offset[2 * item + 1] = has_offset ? (board_yx * middle_x + board_yy * middle_y) * surface.length : REAL_NAN;
    offset_sigma[2 * item] = has_offset ? sqrt(variance_x) : REAL_NAN;
    offset_sigma[2 * item + 1] = has_offset ? sqrt(variance_y) : REAL_NAN;
    const real all = of_core + of_margin;
    valid[item] = all > 0 ? (with_core + with_margin) / all : 0;
    status[item] = !is_measured ? STATUS_NO_DATA : is_deposit ? STATUS_OK : STATUS_LOW_SIGNAL;
}
