// Pose of a board by iteratively reweighted Gauss-Newton from scalar equations, and its covariance.
//
// The measured position of a point p of the artwork is q = p + e. The pose is T(p) = (I + D) p + t. A feature with the
// unit normal n gives the equation n . (T^-1(q) - p) = 0: an edge one equation, a point two with normals at right
// angles.
//
// Residual: T^-1(q) - p = (I + D)^-1 w with w = e - t - D p. All terms of w are small displacements, so that no large
// coordinates are subtracted and single precision keeps the digits of the displacement.
//
// Jacobian: a step d changes the pose to T exp(d). To first order the residual decreases by h . d, with p' = T^-1(q) =
// (x, y) and h = (n_x, n_y, n_y x - n_x y, ...). The further terms are n . p' for a common scale, or
// (n_x x, n_y y, n_x y) for two scales and the shear.
//
// Etch bias (WITH_ETCH_BIAS): copper reaches beyond its drawn edges by one unknown distance, with a given standard
// deviation around 0. An edge moves along its normal by g times this distance (g: etch factor), so that h has the
// further term g.
//
// Options: POSE_PARAMETERS: number of pose parameters, 3 (rigid), 4 (common scale) or 6 (two scales and shear).
//          FREEDOMS: number of unknowns, POSE_PARAMETERS and the etch bias. WITH_ETCH_BIAS: solve for the etch bias.
//          CAPACITY: size of the row arrays. START_STEPS: Gauss-Newton steps of a start candidate. GIVEN_SCALE: known
//          scale of the residuals in sigmas; otherwise it is estimated from their median. EFFICIENCY: of the loss for
//          normal residuals, for the covariance at a known scale. ROWS_IN_PAIRS: rows 2 k and 2 k + 1 are of one line.
#ifndef POSE_H
#define POSE_H

#include "common/status.h"
#include "pose/pose_matrix.h"
#include "pose/pose_start.h"

// Return the scale of the residuals in sigmas: GIVEN_SCALE, or 1.4826 times the median absolute residual to 1 %, with
// the small-sample correction 1 + few / (n - FREEDOMS).
//
// Only residuals up to `reach` take part: once a first scale is known, this removes the outliers, which raise the
// median.
INLINE real pose_scale(laned_pose pose, pose_rows all, pose_room room, real reach, real few, real min_scale) {
#ifdef GIVEN_SCALE
    return (real)(GIVEN_SCALE);
#else
    GROUP_SPACE real *distances = (GROUP_SPACE real *)room.distances;
    reals inside;
    EACH_PART(part) {
        masks counted = 0;
        for (int i = part * LANES; i < all.count; i += PARTS * LANES) {
            const laned_row at = row_of(all, i);
            const reals z = FABS(residual_of(pose, at) * at.certainty);
            const masks there = mask_of(at.certainty > (reals)0);
            counted -= there & mask_of(z <= (reals)reach);
            *(GROUP_SPACE reals_at *)(distances + i) = there ? z : (reals)INFINITY;
        }
        inside = LANED(convert_real)(counted);
        group_put(&inside, 1, part, room.sums);
    }
    const int within = (int)sum_of(*group_total(&inside, 1, room.sums));
    const real middle = group_ranked(distances, all.count, within / 2 + 1, BITS_TO_ONE_PERCENT, room.sums);
    const real free = max((real)(within - FREEDOMS), (real)1);
    return max(min_scale, MAD_TO_SIGMA * (1 + few / free) * middle);
#endif
}

// Normal equations over all rows at a pose, number of inliers, and the sums of psi'(z) and psi(z)^2 over the inliers
// for the covariance.
typedef struct {
    reals matrix[TRIANGLE], right[FREEDOMS], inliers, slopes, squares;
} pose_sums;
#define POSE_SUMS (TRIANGLE + FREEDOMS + 3)
#define ROOM_FOR_SUMS ROOM_FOR(POSE_SUMS > DIGITS ? POSE_SUMS : DIGITS)
// Distances of the rows of a group; unused with a given scale.
#ifdef GIVEN_SCALE
#define ROOM_FOR_DISTANCES 1
#else
#define ROOM_FOR_DISTANCES CAPACITY
#endif

// Weight of a row in the normal matrix. The right side, the gradient of the loss, always has the robust weights.
#define WEIGHTED 0   // robust weight
#define EVENLY 1     // 1 for rows with a robust weight above 0 (inliers), 0 for others
#define EVERY_ROW 2  // 1

// Sum over all rows; return POSE_SUMS sums. Padding rows have certainty 0 and do not contribute.
INLINE GROUP_SPACE const reals *pose_summed(GROUP_SPACE const laned_pose *at_pose, pose_rows all, real per_scale,
                                            int how, pose_room room, private pose_sums *sums) {
    const laned_pose pose = *at_pose;
    private reals *values = (private reals *)sums;
    EACH_PART(part) {
        masks inliers = 0;
        reals slopes = 0, squares = 0;
        for (int i = 0; i < TRIANGLE; i++) sums->matrix[i] = 0;
        for (int i = 0; i < FREEDOMS; i++) sums->right[i] = 0;
        for (int i = part * LANES; i < all.count; i += PARTS * LANES) {
            const laned_row at = row_of(all, i);
            const pose_equation equation = equation_of(pose, at);
            const reals z = equation.residual * at.certainty * (reals)per_scale, weight = loss_weight(z);
            const masks is_in = mask_of(at.certainty * weight > (reals)0);
            const reals counts = how == WEIGHTED ? weight : how == EVENLY ? kept_where(is_in, (reals)1) : (reals)1;
            const reals square = at.certainty * at.certainty;
            add_equation(equation, square * counts, square * weight, sums->matrix, sums->right);
            inliers -= is_in;
            slopes += kept_where(is_in, loss_slope(z));
            squares += kept_where(is_in, weight * weight * z * z);
        }
        sums->inliers = LANED(convert_real)(inliers);
        sums->slopes = slopes;
        sums->squares = squares;
        for (int i = 0; i < POSE_SUMS; i++) values[i] = (reals)sum_of(values[i]);
        group_put(values, POSE_SUMS, part, room.sums);
    }
    return group_total(values, POSE_SUMS, room.sums);
}

// Copy the sums to private memory.
INLINE void copy_sums(GROUP_SPACE const reals *totals, private pose_sums *sums) {
    for (int i = 0; i < POSE_SUMS; i++) ((private reals *)sums)[i] = totals[i];
}

// Solution in the frame of the rows (their centre is 0, their size 1).
typedef struct {
    laned_pose pose;
    reals row_triangle[TRIANGLE];        // normal matrix of all rows
    real covariance[FREEDOMS][FREEDOMS]; // of the step d in T exp(d), about the centre of the rows, over the factor
    real variance;                       // of a row with sigma 1, of which the covariance is a multiple
    real covariance_factor;              // 1, or the variance of the residuals where it is too small to be multiplied
    real scale, residual_scale, condition;
    real inlier_fraction, leverage; // least inlier fraction of the information; largest leverage of an inlier
    int present, inliers, rank;
    int is_singular; // normal equations of the last step
    int is_open;     // the pose has not converged (CONVERGED_SQUARE of common/status.h)
} solved_pose;

// Least variance of the residuals that is multiplied into the covariance: above the smallest normal number by the
// square of a sigma of 1e-9 of the size of the rows.
#ifdef REAL_IS_DOUBLE
#define LEAST_VARIANCE ((real)1e-280)
#else
#define LEAST_VARIANCE ((real)1e-20f)
#endif

// Compute rank, condition and inlier fraction from the information matrices of the inliers and of all rows.
static inline void pose_quality(private solved_pose *fit, pose_matrix inlier_matrix, pose_matrix row_matrix,
                                real rank_tolerance) {
    real least, largest;
    fit->rank = eigenvalues(inlier_matrix, rank_tolerance, &least, &largest);
    fit->inlier_fraction = least_inlier_fraction(inlier_matrix, row_matrix);
    fit->condition = sqrt(largest / max(least, (real)REAL_EPSILON * largest));
}

// Compute the covariance from the normal equations of the inliers, each with weight 1, and whether the pose has converged.
//
// Covariance of an M-estimator (Huber, 1981): variance * A^-1, A = sum of h h^T / sigma^2 over the inliers. With a
// given scale, variance = scale^2 / EFFICIENCY. Otherwise it is estimated from the residuals z in units of the scale:
// variance = scale^2 (sum psi(z)^2 / (n - FREEDOMS)) / (mean psi'(z))^2; without degrees of freedom residual_scale is
// NaN and the sigmas are trusted, variance = 1.
//
// Convergence: the Newton step from the pose is A^-1 g / (mean psi'(z)), with the gradient g (robust weights). Its square
// in standard deviations is g A^-1 g / (variance mean^2). Rounding changes the residual of a row by rho = 8 epsilon (1 +
// displacement) (SolvePose), and g A^-1 g by up to the sum of (rho / sigma)^2: the rows' errors are projected.
static inline void pose_covariance(private solved_pose *fit, private const pose_sums *sums) {
    reals factor[TRIANGLE], left[FREEDOMS];
    for (int i = 0; i < TRIANGLE; i++) factor[i] = sums->matrix[i];
    factored(factor);
    const real free = (real)(fit->inliers - FREEDOMS), mean = FIRST(sums->slopes) / fit->inliers;
    fit->residual_scale = free > 0 ? fit->scale * sqrt(FIRST(sums->squares) / free) / mean : REAL_NAN;
#ifdef GIVEN_SCALE
    const real whole = fit->scale * fit->scale / (real)(EFFICIENCY);
#else
    const real whole = free > 0 ? fit->residual_scale * fit->residual_scale : 1;
#endif
    // Exact rows have a variance of 0 or nearly so, from which no leverage follows.
    const int is_usual = whole >= LEAST_VARIANCE && whole < (real)INFINITY;
    const real variance = is_usual ? whole : 1;
    fit->variance = variance;
    fit->covariance_factor = is_usual ? 1 : whole;
    solved(factor, sums->right, left);
    real square = 0;
    for (int i = 0; i < FREEDOMS; i++) square += FIRST(left[i]) * FIRST(sums->right[i]);
    const laned_pose pose = fit->pose;
    const real moved = FIRST(FABS(pose.dxx) + FABS(pose.dxy) + FABS(pose.dyx) + FABS(pose.dyy) + FABS(pose.x) + FABS(pose.y));
    const real rounding = 8 * REAL_EPSILON * (1 + moved), slope = max(mean, (real)0);
    fit->is_open = square > slope * slope * CONVERGED_SQUARE * whole +
                                rounding * rounding * FIRST(sums->matrix[CELL(0, 0)] + sums->matrix[CELL(1, 1)]);
    for (int i = 0; i < FREEDOMS; i++) {
        reals unit[FREEDOMS], column[FREEDOMS];
        for (int k = 0; k < FREEDOMS; k++) unit[k] = (reals)(real)(i == k);
        solved(factor, unit, column);
        for (int k = 0; k < FREEDOMS; k++) fit->covariance[i][k] = variance * FIRST(column[k]);
    }
}

#ifdef ROBUST
// Compute the Jacobian rows of LANES rows from row `at` on, divided by their sigmas; 0 for outliers.
INLINE void inlier_jacobian(GROUP_SPACE const solved_pose *fit, pose_rows all, int at, private reals *jacobian) {
    const laned_row row = row_of(all, at);
    const pose_equation equation = equation_of(fit->pose, row);
    const masks is_in = mask_of(row.certainty * loss_weight(equation.residual * row.certainty / fit->scale) > (reals)0);
    for (int i = 0; i < FREEDOMS; i++) jacobian[i] = kept_where(is_in, equation.row[i] * row.certainty);
}

// Return h^T A^-1 g, with the covariance variance * A^-1.
INLINE reals hat_element(GROUP_SPACE const solved_pose *fit, private const reals *h, private const reals *g) {
    reals sum = 0;
    for (int i = 0; i < FREEDOMS; i++)
        for (int k = 0; k < FREEDOMS; k++) sum += h[i] * g[k] * (reals)(fit->covariance[i][k] / fit->variance);
    return sum;
}

#ifdef ROWS_IN_PAIRS
// Return the leverage of the pairs (row 2 k, row 2 k + 1) in the lanes of their rows, from the scaled rows h of `at`.
//
// The pair's block of the hat matrix is ((a, c), (c, b)). Its larger eigenvalue is the share of a combination of the two
// rows that the pair determines itself: 1 where the other rows do not check it.
INLINE reals pair_leverage(GROUP_SPACE const solved_pose *fit, pose_rows all, int at, private const reals *h) {
    reals other[FREEDOMS];
#ifdef VECTOR_VARIANT
    for (int i = 0; i < FREEDOMS; i++) other[i] = h[i].s1032547698badcfe;
#else
    inlier_jacobian(fit, all, at ^ 1, other);
#endif
    const reals a = hat_element(fit, h, h), b = hat_element(fit, other, other), c = hat_element(fit, h, other);
    const reals half_difference = (reals)0.5f * (a - b);
    return (reals)0.5f * (a + b) + sqrt(half_difference * half_difference + c * c);
}
#endif
#endif

// Return the largest leverage of an inlier: h^T A^-1 h / sigma^2.
//
// ROWS_IN_PAIRS: of a pair of rows where at most half of the rows are inliers. Both rows of a pair come from one line of
// the artwork; an outlier displaces both, so that they do not check each other. Without a majority, another pose may have
// as many inliers by chance.
INLINE real pose_leverage(GROUP_SPACE const solved_pose *fit, pose_rows all, pose_room room) {
    real leverage = 0;
#ifdef ROBUST
    EACH_PART(part) {
        real largest = 0;
        for (int at = part * LANES; at < all.count; at += PARTS * LANES) {
            reals h[FREEDOMS];
            inlier_jacobian(fit, all, at, h);
#ifdef ROWS_IN_PAIRS
            const int is_majority = 2 * fit->inliers > fit->present;
            const reals of = is_majority ? hat_element(fit, h, h) : pair_leverage(fit, all, at, h);
#else
            const reals of = hat_element(fit, h, h);
#endif
            for (int lane = 0; lane < LANES; lane++) largest = max(largest, LANE(of, lane));
        }
        leverage = largest;
#ifdef IN_GROUP
        group_put(&largest, 1, part, room.sums);
#endif
    }
#ifdef IN_GROUP
    leverage = group_largest(room.sums);
#endif
#endif
    return leverage;
}

// Return the pose after the Gauss-Newton step of the normal equations; no step where they are singular.
BETWEEN_BARRIERS laned_pose pose_stepped(laned_pose pose, private pose_sums *sums, real etch,
                                         private int *is_singular) {
    reals change[FREEDOMS];
    add_etch(pose, etch, sums->matrix, sums->right);
    *is_singular = any_lane(factored(sums->matrix));
    if (*is_singular) return pose;
    solved(sums->matrix, sums->right, change);
    return pose_after(pose, change);
}

// Compute quality and covariance from the sums over all rows and over the inliers.
BETWEEN_BARRIERS void pose_judged(private solved_pose *fit, private pose_sums *of_rows, private pose_sums *of_inliers,
                                  real etch, real rank_tolerance) {
    add_etch(fit->pose, etch, of_rows->matrix, of_rows->right);
    add_etch(fit->pose, etch, of_inliers->matrix, of_inliers->right);
    fit->inliers = (int)FIRST(of_inliers->inliers);
    pose_quality(fit, pose_part(of_inliers->matrix), pose_part(of_rows->matrix), rank_tolerance);
    pose_covariance(fit, of_inliers);
}

// Return the number of rows that are not missing.
INLINE int rows_present(pose_rows all, pose_room room) {
    reals present;
    EACH_PART(part) {
        real counted = 0;
        for (int i = part; i < all.count; i += PARTS) counted += certainty_of(all, i) > 0;
        present = (reals)counted;
        group_put(&present, 1, part, room.sums);
    }
    return (int)FIRST(*group_total(&present, 1, room.sums));
}

// Solve one pose. With a robust loss: start candidates, then `steps` reweighted Gauss-Newton steps; the scale is
// estimated again before the step RESCALED_AT. Rows must be centred and scaled to size 1 (pose_frame), so that shifts
// and turns have the same unit for `condition` and the rank. `fit` holds the initial pose, and gets the solution. In a
// group item 0 computes steps, covariance and quality from the sums.
//
// Not inlined where an item solves a pose alone: with PoCL 3.1 the work-item variant of board_pose.cl, when it was one
// kernel with barriers, gave wrong weights with this function inlined, and right ones without. The vector variant and
// Intel's runtime gave right weights in both cases.
#ifdef IN_GROUP
INLINE
#else
static __attribute__((noinline))
#endif
void pose_solved(GROUP_SPACE solved_pose *fit, pose_rows all, constant const int *subsets, int trials, int steps,
                 real min_scale, real rank_tolerance, pose_room room) {
    const int present = rows_present(all, room);
    GROUP_SPACE laned_pose *pose = &fit->pose;
    pose_sums sums;
    real scale = min_scale;
#ifdef ROBUST
    pose_start(pose, all, subsets, trials, room, present);
    scale = pose_scale(*pose, all, room, INFINITY, FEW_TRIED, min_scale);
#endif
    for (int step = 0; step < steps; step++) {
#ifdef ROBUST
        if (RESCALED_AT(step)) scale = pose_scale(*pose, all, room, (real)2.5f * scale, FEW_FITTED, min_scale);
#elif defined(WITH_ETCH_BIAS)
        // The prior of the etch bias is weighed against residuals in units of their scale.
        scale = pose_scale(*pose, all, room, INFINITY, FEW_FITTED, min_scale);
#endif
        GROUP_SPACE const reals *totals = pose_summed(pose, all, 1 / scale, WEIGHTED, room, &sums);
        if (GROUP_ITEM == 0) {
            int is_singular;
            copy_sums(totals, &sums);
            *pose = pose_stepped(*pose, &sums, all.etch / (1 / scale), &is_singular);
            fit->is_singular = is_singular;
        }
        group_barrier();
        if (fit->is_singular) break;
    }
#ifndef ROBUST
    scale = pose_scale(*pose, all, room, INFINITY, FEW_FITTED, min_scale);
#endif
    GROUP_SPACE const reals *totals = pose_summed(pose, all, 1 / scale, EVERY_ROW, room, &sums);
    for (int i = GROUP_ITEM; i < TRIANGLE; i += GROUP_ITEMS) fit->row_triangle[i] = totals[i];
    totals = pose_summed(pose, all, 1 / scale, EVENLY, room, &sums);
    if (GROUP_ITEM == 0) {
        pose_sums of_rows;
        for (int i = 0; i < TRIANGLE; i++) of_rows.matrix[i] = fit->row_triangle[i];
        for (int i = 0; i < FREEDOMS; i++) of_rows.right[i] = 0;
        copy_sums(totals, &sums);
        solved_pose judged;
        judged.pose = *pose;
        judged.present = present;
        judged.scale = scale;
        judged.is_singular = fit->is_singular;
        pose_judged(&judged, &of_rows, &sums, all.etch / (1 / scale), rank_tolerance);
        *fit = judged;
    }
    group_barrier();
    const real leverage = pose_leverage(fit, all, room);
    if (GROUP_ITEM == 0) fit->leverage = leverage;
    group_barrier();
}

#endif
