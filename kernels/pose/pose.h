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
// Etch bias (WITH_ETCH_BIAS): copper reaches beyond its drawn edges by one unknown distance, with a given standard deviation
// around 0. An edge moves along its normal by g times this distance (g: etch factor), so that h has the further term g.
//
// Options: POSE_PARAMETERS: number of pose parameters, 3 (rigid), 4 (common scale) or 6 (two scales and shear). FREEDOMS:
//          number of unknowns, POSE_PARAMETERS and the etch bias. WITH_ETCH_BIAS: solve for the etch bias. CAPACITY: size of the row
//          arrays. START_STEPS: Gauss-Newton steps of a start candidate. GIVEN_SCALE: known scale of the residuals in
//          sigmas; otherwise it is estimated from their median. EFFICIENCY: of the loss for normal residuals, for the
//          covariance at a known scale.
#ifndef POSE_H
#define POSE_H

#include "common/least_squares.h"
#include "common/robust.h"

// Poses, one per lane: D, the translation (x, y), and the etch bias.
typedef struct {
    reals dxx, dxy, dyx, dyy, x, y, etch;
} laned_pose;

// Rows, one per lane: normal, place, displacement, certainty 1/sigma (0: missing row), and etch factor.
typedef struct {
    reals nx, ny, px, py, ex, ey, certainty, etch_factor;
} laned_row;

// Columns of all rows, padded with rows of certainty 0 to whole vectors.
typedef struct {
    private const real *nx;
    private const real *ny;
    private const real *px;
    private const real *py;
    private const real *ex;
    private const real *ey;
    private const real *certainty;
    private const real *etch_factor; // null without WITH_ETCH_BIAS
    int count;
    real etch; // 1/sigma of the etch bias
} pose_rows;

// Linearised equations, one per lane: Jacobian row h and residual.
typedef struct {
    reals row[FREEDOMS], residual;
} pose_equation;

// Load LANES rows from row i on.
static inline laned_row row_of(pose_rows all, int i) {
#ifdef WITH_ETCH_BIAS
    const reals etch_factor = READ(all.etch_factor, i);
#else
    const reals etch_factor = 0;
#endif
    return (laned_row){READ(all.nx, i), READ(all.ny, i), READ(all.px, i),        READ(all.py, i),
                       READ(all.ex, i), READ(all.ey, i), READ(all.certainty, i), etch_factor};
}

// Broadcast row i to all lanes.
static inline laned_row row_for_all(pose_rows all, int i) {
#ifdef WITH_ETCH_BIAS
    const reals etch_factor = all.etch_factor[i];
#else
    const reals etch_factor = 0;
#endif
    return (laned_row){(reals)all.nx[i], (reals)all.ny[i], (reals)all.px[i],        (reals)all.py[i],
                       (reals)all.ex[i], (reals)all.ey[i], (reals)all.certainty[i], etch_factor};
}

// Compute Jacobian row and residual of a feature row at a pose.
static inline pose_equation equation_of(laned_pose pose, laned_row at) {
    const reals wx = at.ex - pose.x - (pose.dxx * at.px + pose.dxy * at.py);
    const reals wy = at.ey - pose.y - (pose.dyx * at.px + pose.dyy * at.py);
    const reals axx = (reals)1 + pose.dxx, ayy = (reals)1 + pose.dyy;
    const reals per = (reals)1 / (axx * ayy - pose.dxy * pose.dyx);
    const reals bx = (ayy * wx - pose.dxy * wy) * per, by = (axx * wy - pose.dyx * wx) * per;
    const reals x = at.px + bx, y = at.py + by;
    pose_equation equation;
    equation.residual = at.nx * bx + at.ny * by - at.etch_factor * pose.etch;
    equation.row[0] = at.nx;
    equation.row[1] = at.ny;
    equation.row[2] = at.ny * x - at.nx * y;
#if POSE_PARAMETERS == 4
    equation.row[3] = at.nx * x + at.ny * y;
#elif POSE_PARAMETERS == 6
    equation.row[3] = at.nx * x;
    equation.row[4] = at.ny * y;
    equation.row[5] = at.nx * y;
#endif
#ifdef WITH_ETCH_BIAS
    equation.row[POSE_PARAMETERS] = at.etch_factor;
#endif
    return equation;
}

static inline reals residual_of(laned_pose pose, laned_row at) { return equation_of(pose, at).residual; }

// Compute T exp(step). The angle step is used as the tangent of the rotation, cos = 1 / sqrt(1 + tan^2): this differs
// from the exponential in third order, and the last step of the iteration is about 0. It needs no trigonometry.
static inline laned_pose pose_after(laned_pose pose, private const reals *step) {
    const reals tangent = step[2], cosine = (reals)1 / sqrt((reals)1 + tangent * tangent), sine = tangent * cosine;
    // cosine - 1 = -sine^2 / (1 + cosine), without cancellation.
    const reals less = -sine * sine / ((reals)1 + cosine);
    reals exx = less, exy = -sine, eyx = sine, eyy = less;
#if POSE_PARAMETERS == 4
    exx += cosine * step[3], exy -= sine * step[3], eyx += sine * step[3], eyy += cosine * step[3];
#elif POSE_PARAMETERS == 6
    exx += cosine * step[3], exy += cosine * step[5] - sine * step[4];
    eyx += sine * step[3], eyy += sine * step[5] + cosine * step[4];
#endif
    const reals axx = (reals)1 + pose.dxx, ayy = (reals)1 + pose.dyy;
    const laned_pose next = {pose.dxx + axx * exx + pose.dxy * eyx,  pose.dxy + axx * exy + pose.dxy * eyy,
                             pose.dyx + pose.dyx * exx + ayy * eyx,  pose.dyy + pose.dyx * exy + ayy * eyy,
                             pose.x + axx * step[0] + pose.dxy * step[1], pose.y + pose.dyx * step[0] + ayy * step[1],
#ifdef WITH_ETCH_BIAS
                             pose.etch + step[POSE_PARAMETERS]};
#else
                             0};
#endif
    return next;
}

// Add weight h h^T to the lower triangle of the normal matrix, and weight h residual to the right side.
static inline void add_equation(pose_equation equation, reals weight, private reals *matrix, private reals *right) {
    for (int i = 0; i < FREEDOMS; i++) {
        const reals weighted = weight * equation.row[i];
        right[i] += weighted * equation.residual;
        for (int j = 0; j <= i; j++) matrix[CELL(i, j)] += weighted * equation.row[j];
    }
}

// Add the prior of the etch bias, etch = 0 with the given certainty (1/sigma), to the normal equations.
static inline void add_etch(laned_pose pose, real certainty, private reals *matrix, private reals *right) {
#ifdef WITH_ETCH_BIAS
    const reals square = (reals)(certainty * certainty);
    matrix[CELL(POSE_PARAMETERS, POSE_PARAMETERS)] += square;
    right[POSE_PARAMETERS] -= square * pose.etch;
#endif
}

// Gather the values at the indices at[0 .. LANES - 1].
#ifdef VECTOR_VARIANT
static inline reals gather(private const real *from, constant const int *at) {
    return (reals)(from[at[0]], from[at[1]], from[at[2]], from[at[3]], from[at[4]], from[at[5]], from[at[6]],
                   from[at[7]], from[at[8]], from[at[9]], from[at[10]], from[at[11]], from[at[12]], from[at[13]],
                   from[at[14]], from[at[15]]);
}
#else
static inline reals gather(private const real *from, constant const int *at) { return from[at[0]]; }
#endif

// Gather LANES rows by their indices.
static inline laned_row gather_rows(pose_rows all, constant const int *at) {
#ifdef WITH_ETCH_BIAS
    const reals etch_factor = gather(all.etch_factor, at);
#else
    const reals etch_factor = 0;
#endif
    return (laned_row){gather(all.nx, at), gather(all.ny, at), gather(all.px, at),        gather(all.py, at),
                       gather(all.ex, at), gather(all.ey, at), gather(all.certainty, at), etch_factor};
}

// Compute the score of each lane's candidate pose over all rows, least is best: the loss where the scale is given,
// otherwise the absolute residual of rank (n + FREEDOMS + 1) / 2 in sigmas, to 1 % (least median of squares, Rousseeuw
// and Leroy, 1987).
static inline reals pose_score(laned_pose pose, pose_rows all, private reals *distances, int present) {
#ifdef WITH_ETCH_BIAS
    const reals off = pose.etch * (reals)all.etch;
    reals loss = (reals)0.5f * off * off;
#else
    reals loss = 0;
#endif
    for (int i = 0; i < all.count; i++) {
        const laned_row at = row_for_all(all, i);
        const reals z = residual_of(pose, at) * at.certainty;
#ifdef GIVEN_SCALE
        loss += loss_of(z * (reals)((real)1 / (real)(GIVEN_SCALE)));
#else
        distances[i] = at.certainty > (reals)0 ? FABS(z) : (reals)INFINITY;
#endif
    }
#ifdef GIVEN_SCALE
    return loss;
#else
    return ranked_of(distances, all.count, (masks)((present + FREEDOMS + 1) / 2), BITS_TO_ONE_PERCENT);
#endif
}

// Find the start pose: the candidate with the least score.
//
// A candidate is the pose through FREEDOMS rows, from START_STEPS Gauss-Newton steps from `start`. `subsets` holds the
// rows of LANES candidates side by side, (trials / LANES, FREEDOMS, LANES): each lane solves one candidate.
static inline laned_pose pose_start(laned_pose start, pose_rows all, constant const int *subsets, int trials,
                                    private reals *distances, int present) {
    laned_pose best = start;
    real least = INFINITY;
    for (int trial = 0; trial < trials; trial += LANES) {
        laned_row of[FREEDOMS];
        for (int k = 0; k < FREEDOMS; k++)
            of[k] = gather_rows(all, subsets + (size_t)trial * FREEDOMS + k * LANES);
        laned_pose candidate = start;
        masks bad = 0;
        for (int step = 0; step < START_STEPS; step++) {
            reals matrix[TRIANGLE], right[FREEDOMS], change[FREEDOMS];
            for (int i = 0; i < TRIANGLE; i++) matrix[i] = 0;
            for (int i = 0; i < FREEDOMS; i++) right[i] = 0;
            for (int k = 0; k < FREEDOMS; k++) {
#ifdef WITH_ETCH_BIAS
                const reals weight = of[k].certainty * of[k].certainty;
#else
                const reals weight = mask_of(of[k].certainty > (reals)0) ? (reals)1 : (reals)0;
#endif
                add_equation(equation_of(candidate, of[k]), weight, matrix, right);
            }
            add_etch(candidate, all.etch, matrix, right);
            bad |= factored(matrix);
            solved(matrix, right, change);
            candidate = pose_after(candidate, change);
        }
        const reals loss = pose_score(candidate, all, distances, present);
        for (int lane = 0; lane < LANES; lane++) {
            if (LANE_BITS(bad, lane) || !(LANE(loss, lane) < least)) continue;
            least = LANE(loss, lane);
            best = (laned_pose){(reals)LANE(candidate.dxx, lane), (reals)LANE(candidate.dxy, lane),
                                (reals)LANE(candidate.dyx, lane), (reals)LANE(candidate.dyy, lane),
                                (reals)LANE(candidate.x, lane),   (reals)LANE(candidate.y, lane),
                                (reals)LANE(candidate.etch, lane)};
        }
    }
    return best;
}

// Return the scale of the residuals in sigmas: GIVEN_SCALE, or 1.4826 times the median absolute residual to 1 %, with
// the small-sample correction 1 + few / (n - FREEDOMS).
//
// Only residuals up to `reach` take part: once a first scale is known, this removes the outliers, which raise the
// median. The median is built bit by bit as in ranked_of (common/robust.h), here over rows in lanes.
static inline real pose_scale(laned_pose pose, pose_rows all, private reals *room, real reach, real few,
                              real min_scale) {
#ifdef GIVEN_SCALE
    return (real)(GIVEN_SCALE);
#else
    private real *distances = (private real *)room;
    masks inside = 0;
    for (int i = 0; i < all.count; i += LANES) {
        const laned_row at = row_of(all, i);
        const reals z = FABS(residual_of(pose, at) * at.certainty);
        const masks there = mask_of(at.certainty > (reals)0);
        inside -= there & mask_of(z <= (reals)reach);
        *(private reals_at *)(distances + i) = there ? z : (reals)INFINITY;
    }
    const int within = (int)sum_of(LANED(convert_real)(inside));
    bits found = 0;
    for (int bit = BITS_BELOW_SIGN - 1; bit >= BITS_TO_ONE_PERCENT; bit--) {
        const bits next = found | ((bits)1 << bit);
        masks below = 0;
        for (int i = 0; i < all.count; i += LANES) below -= mask_of(as_masks(READ(distances, i)) < (masks)next);
        found = (int)sum_of(LANED(convert_real)(below)) > within / 2 ? found : next;
    }
    const real free = max((real)(within - FREEDOMS), (real)1);
    return max(min_scale, MAD_TO_SIGMA * (1 + few / free) * as_real(found));
#endif
}

// Normal equations over all rows at a pose, and the sums of psi'(z) and psi(z)^2 over the inliers for the covariance.
typedef struct {
    reals matrix[TRIANGLE], right[FREEDOMS];
    int inliers;
    real slopes, squares;
} pose_sums;

// Weight of a row in the sums.
#define WEIGHTED 0   // robust weight
#define EVENLY 1     // 1 for rows with a robust weight above 0 (inliers), 0 for others
#define EVERY_ROW 2  // 1

// Sum the normal equations of all rows. Padding rows have certainty 0 and do not contribute.
static inline void pose_summed(laned_pose pose, pose_rows all, real per_scale, int how, private pose_sums *sums) {
    masks inliers = 0;
    reals slopes = 0, squares = 0;
    for (int i = 0; i < TRIANGLE; i++) sums->matrix[i] = 0;
    for (int i = 0; i < FREEDOMS; i++) sums->right[i] = 0;
    for (int i = 0; i < all.count; i += LANES) {
        const laned_row at = row_of(all, i);
        const pose_equation equation = equation_of(pose, at);
        const reals z = equation.residual * at.certainty * (reals)per_scale, weight = loss_weight(z);
        const masks is_in = mask_of(at.certainty * weight > (reals)0);
        const reals counts = how == WEIGHTED ? weight : how == EVENLY ? kept_where(is_in, (reals)1) : (reals)1;
        add_equation(equation, at.certainty * at.certainty * counts, sums->matrix, sums->right);
        inliers -= is_in;
        slopes += kept_where(is_in, loss_slope(z));
        squares += kept_where(is_in, weight * weight * z * z);
    }
    for (int i = 0; i < TRIANGLE; i++) sums->matrix[i] = (reals)sum_of(sums->matrix[i]);
    for (int i = 0; i < FREEDOMS; i++) sums->right[i] = (reals)sum_of(sums->right[i]);
    add_etch(pose, all.etch / per_scale, sums->matrix, sums->right);
    sums->inliers = (int)sum_of(LANED(convert_real)(inliers));
    sums->slopes = sum_of(slopes);
    sums->squares = sum_of(squares);
}

typedef struct {
    real cell[POSE_PARAMETERS][POSE_PARAMETERS];
} pose_matrix;

// Return the information matrix of the pose parameters, with the etch bias b eliminated (Schur complement):
// M_ij - M_ib M_jb / M_bb.
static inline pose_matrix pose_part(private const reals *triangle) {
    pose_matrix of;
    for (int i = 0; i < POSE_PARAMETERS; i++)
        for (int j = 0; j <= i; j++) {
            of.cell[i][j] = FIRST(triangle[CELL(i, j)]);
#ifdef WITH_ETCH_BIAS
            of.cell[i][j] -= FIRST(triangle[CELL(POSE_PARAMETERS, i)]) * FIRST(triangle[CELL(POSE_PARAMETERS, j)]) /
                             FIRST(triangle[CELL(POSE_PARAMETERS, POSE_PARAMETERS)]);
#endif
            of.cell[j][i] = of.cell[i][j];
        }
    return of;
}

// Compute the least and the largest eigenvalue of a symmetric matrix by Jacobi rotations (5 sweeps, up to 6 x 6).
// Returns the rank: the number of eigenvalues above `rank_tolerance` times the largest.
//
// The rotations work on a copy: Mesa 22.3 passes structs by reference, so that a change of a parameter changes the
// variable of the caller.
static inline int eigenvalues(const pose_matrix symmetric, real rank_tolerance, private real *least,
                              private real *largest) {
    pose_matrix of = symmetric;
    for (int sweep = 0; sweep < 5; sweep++)
        for (int p = 0; p < POSE_PARAMETERS - 1; p++)
            for (int q = p + 1; q < POSE_PARAMETERS; q++) {
                if (of.cell[p][q] == 0) continue;
                const real ratio = (of.cell[q][q] - of.cell[p][p]) / (2 * of.cell[p][q]);
                const real t = (ratio < 0 ? -1 : 1) / (fabs(ratio) + sqrt(ratio * ratio + 1));
                const real c = 1 / sqrt(t * t + 1), s = t * c;
                for (int k = 0; k < POSE_PARAMETERS; k++) {
                    const real kp = of.cell[k][p], kq = of.cell[k][q];
                    of.cell[k][p] = c * kp - s * kq;
                    of.cell[k][q] = s * kp + c * kq;
                }
                for (int k = 0; k < POSE_PARAMETERS; k++) {
                    const real pk = of.cell[p][k], qk = of.cell[q][k];
                    of.cell[p][k] = c * pk - s * qk;
                    of.cell[q][k] = s * pk + c * qk;
                }
                of.cell[p][q] = of.cell[q][p] = 0;
            }
    *least = *largest = of.cell[0][0];
    for (int i = 1; i < POSE_PARAMETERS; i++) {
        *least = min(*least, of.cell[i][i]);
        *largest = max(*largest, of.cell[i][i]);
    }
    int rank = 0;
    for (int i = 0; i < POSE_PARAMETERS; i++) rank += of.cell[i][i] > rank_tolerance * *largest;
    return rank;
}

// Return the inlier fraction of the information, for the combination of parameters with the least fraction.
//
// It is the minimum over v of (v^T M v) / (v^T A v), with the information matrices M of the inliers and A of all rows.
// With the Cholesky factor A = L L^T, this is the least eigenvalue of L^-1 M L^-T. 0 where A is singular.
static inline real least_inlier_fraction(const pose_matrix of_inliers, const pose_matrix all) {
    pose_matrix inlier_matrix = of_inliers; // a copy, as in `eigenvalues`
    real factor[POSE_PARAMETERS][POSE_PARAMETERS];
    for (int i = 0; i < POSE_PARAMETERS; i++)
        for (int j = 0; j <= i; j++) {
            real sum = all.cell[i][j];
            for (int k = 0; k < j; k++) sum -= factor[i][k] * factor[j][k];
            if (i == j && !(sum > all.cell[i][i] * (8 * REAL_EPSILON))) return 0;
            factor[i][j] = i == j ? sqrt(sum) : sum / factor[j][j];
        }
    for (int column = 0; column < POSE_PARAMETERS; column++)
        for (int i = 0; i < POSE_PARAMETERS; i++) {
            for (int k = 0; k < i; k++) inlier_matrix.cell[i][column] -= factor[i][k] * inlier_matrix.cell[k][column];
            inlier_matrix.cell[i][column] /= factor[i][i];
        }
    for (int row = 0; row < POSE_PARAMETERS; row++)
        for (int i = 0; i < POSE_PARAMETERS; i++) {
            for (int k = 0; k < i; k++) inlier_matrix.cell[row][i] -= factor[i][k] * inlier_matrix.cell[row][k];
            inlier_matrix.cell[row][i] /= factor[i][i];
        }
    real least, largest;
    eigenvalues(inlier_matrix, 0, &least, &largest);
    return least;
}

// Solution in the frame of the rows (their centre is 0, their size 1).
typedef struct {
    laned_pose pose;
    real covariance[FREEDOMS][FREEDOMS]; // of the step d in T exp(d), about the centre of the rows, over the factor
    real covariance_factor;              // 1, or the variance of the residuals where it is too small to be multiplied
    real scale, residual_scale, condition;
    real inlier_fraction, leverage; // least inlier fraction of the information; largest leverage of an inlier
    int present, inliers, rank;
} solved_pose;

// Least variance of the residuals that is multiplied into the covariance: above the smallest normal number by the square
// of a sigma of 1e-9 of the size of the rows.
#ifdef REAL_IS_DOUBLE
#define LEAST_VARIANCE ((real)1e-280)
#else
#define LEAST_VARIANCE ((real)1e-20f)
#endif

// Compute the covariance and the largest leverage from the normal equations of the inliers, each with weight 1.
//
// Covariance of an M-estimator (Huber, 1981): variance * A^-1, A = sum of h h^T / sigma^2 over the inliers. With a
// given scale, variance = scale^2 / EFFICIENCY. Otherwise it is estimated from the residuals z in units of the scale:
// variance = scale^2 (sum psi(z)^2 / (n - FREEDOMS)) / (mean psi'(z))^2; without degrees of freedom residual_scale is NaN
// and the sigmas are trusted, variance = 1. The leverage of a row is h^T A^-1 h / sigma^2.
static inline void pose_covariance(private solved_pose *fit, pose_rows all, private const pose_sums *sums) {
    reals factor[TRIANGLE];
    for (int i = 0; i < TRIANGLE; i++) factor[i] = sums->matrix[i];
    factored(factor);
    const real free = (real)(fit->inliers - FREEDOMS), mean = sums->slopes / fit->inliers;
    fit->residual_scale = free > 0 ? fit->scale * sqrt(sums->squares / free) / mean : REAL_NAN;
#ifdef GIVEN_SCALE
    const real whole = fit->scale * fit->scale / (real)(EFFICIENCY);
#else
    const real whole = free > 0 ? fit->residual_scale * fit->residual_scale : 1;
#endif
    // Exact rows have a variance of 0 or nearly so, from which no leverage follows.
    const int is_usual = whole >= LEAST_VARIANCE && whole < (real)INFINITY;
    const real variance = is_usual ? whole : 1;
    fit->covariance_factor = is_usual ? 1 : whole;
    for (int i = 0; i < FREEDOMS; i++) {
        reals unit[FREEDOMS], column[FREEDOMS];
        for (int k = 0; k < FREEDOMS; k++) unit[k] = (reals)(real)(i == k);
        solved(factor, unit, column);
        for (int k = 0; k < FREEDOMS; k++) fit->covariance[i][k] = variance * FIRST(column[k]);
    }
    fit->leverage = 0;
#ifdef ROBUST
    for (int at = 0; at < all.count; at += LANES) {
        const laned_row row = row_of(all, at);
        const pose_equation equation = equation_of(fit->pose, row);
        const masks is_in =
            mask_of(row.certainty * loss_weight(equation.residual * row.certainty / fit->scale) > (reals)0);
        reals sum = 0;
        for (int i = 0; i < FREEDOMS; i++)
            for (int k = 0; k < FREEDOMS; k++)
                sum += equation.row[i] * equation.row[k] * (reals)(fit->covariance[i][k] / variance);
        sum = kept_where(is_in, sum * row.certainty * row.certainty);
        for (int lane = 0; lane < LANES; lane++) fit->leverage = max(fit->leverage, LANE(sum, lane));
    }
#endif
}

// Solve one pose. With a robust loss: start candidates, then `steps` reweighted Gauss-Newton steps; the scale is
// estimated again before the step RESCALED_AT. Rows must be centred and scaled to size 1 (pose_result.h), so that
// shifts and turns have the same unit for `condition` and the rank. `room` is scratch space of CAPACITY reals.
//
// Not inlined: PoCL 3.1 computes wrong weights in the work-item variant of board_pose.cl when this function is inlined
// behind the kernel's last barrier (bisected; the vector variant and Intel's runtime are not affected).
static __attribute__((noinline)) solved_pose pose_solved(laned_pose start, pose_rows all, constant const int *subsets,
                                                         int trials, int steps, real min_scale, real rank_tolerance,
                                                         private reals *room) {
    solved_pose fit;
    real present = 0;
    for (int i = 0; i < all.count; i++) present += all.certainty[i] > 0;
    fit.present = (int)present;
    fit.pose = start;
    pose_sums sums;
    fit.scale = min_scale;
#ifdef ROBUST
    fit.pose = pose_start(start, all, subsets, trials, room, fit.present);
    fit.scale = pose_scale(fit.pose, all, room, INFINITY, FEW_TRIED, min_scale);
#endif
    for (int step = 0; step < steps; step++) {
#ifdef ROBUST
        if (RESCALED_AT(step))
            fit.scale = pose_scale(fit.pose, all, room, (real)2.5f * fit.scale, FEW_FITTED, min_scale);
#elif defined(WITH_ETCH_BIAS)
        // The prior of the etch bias is weighed against residuals in units of their scale.
        fit.scale = pose_scale(fit.pose, all, room, INFINITY, FEW_FITTED, min_scale);
#endif
        reals change[FREEDOMS];
        pose_summed(fit.pose, all, 1 / fit.scale, WEIGHTED, &sums);
        if (any_lane(factored(sums.matrix))) break;
        solved(sums.matrix, sums.right, change);
        fit.pose = pose_after(fit.pose, change);
    }
#ifndef ROBUST
    fit.scale = pose_scale(fit.pose, all, room, INFINITY, FEW_FITTED, min_scale);
#endif
    pose_summed(fit.pose, all, 1 / fit.scale, EVERY_ROW, &sums);
    const pose_matrix row_matrix = pose_part(sums.matrix);
    pose_summed(fit.pose, all, 1 / fit.scale, EVENLY, &sums);
    const pose_matrix inlier_matrix = pose_part(sums.matrix);
    fit.inliers = sums.inliers;
    real least, largest;
    fit.rank = eigenvalues(inlier_matrix, rank_tolerance, &least, &largest);
    fit.inlier_fraction = least_inlier_fraction(inlier_matrix, row_matrix);
    fit.condition = sqrt(largest / max(least, (real)REAL_EPSILON * largest));
    pose_covariance(&fit, all, &sums);
    return fit;
}

#endif
