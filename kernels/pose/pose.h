// A board's pose by robust, weighted Gauss-Newton from scalar equations, and its covariance.
//
// A point p of the artwork is seen at q = p + e. The pose T(p) = (I + D) p + t says that it is seen there if
// n . (T^-1(q) - p) = 0, for a feature's normal n: of an edge its own, of a point two at right angles. With
// w = e - t - D p that is n . (I + D)^-1 w, in which nothing large is subtracted. A step d of the pose turns it into
// T exp(d), and adds h . d to n . (T^-1(q) - p): h = (n, n . J p', ...) with p' = T^-1(q).
//
// With ETCHED the copper of the whole board is larger all round by one more unknown, about which something is known
// before: an edge out of the copper lies that much further along its normal, h has 1 more.
#ifndef POSE_H
#define POSE_H

#include "common/least_squares.h"
#include "common/robust.h"

// OF_POSE: 3, the board is rigid; 4, with a scale; 6, with scales along both axes and a shear. FREEDOMS: the etching, too.
typedef struct {
    reals dxx, dxy, dyx, dyy, x, y, etch;
} laned_pose;

// One equation: normal, place, what it was seen to be displaced by, 1/sigma, and how much the etching displaces it.
typedef struct {
    reals nx, ny, px, py, ex, ey, certainty, grows;
} laned_row;

#ifdef ETCHED
#define ETCH_OF(from, i) READ((from), i)
#define ETCH_FOR_ALL(from, i) ((reals)((from)[i]))
#define ETCH_GATHERED(from, at) GATHERED(from, at)
#else
#define ETCH_OF(from, i) ((reals)0)
#define ETCH_FOR_ALL(from, i) ((reals)0)
#define ETCH_GATHERED(from, at) ((reals)0)
#endif

// Equations side by side, padded with ones of certainty zero to whole vectors.
typedef struct {
    private const real *nx;
    private const real *ny;
    private const real *px;
    private const real *py;
    private const real *ex;
    private const real *ey;
    private const real *certainty;
    private const real *grows; // null without ETCHED
    int count;
    real etch; // 1/sigma of what is known of the etching before
} pose_rows;

typedef struct {
    reals row[FREEDOMS], residual;
} pose_equation;

static inline laned_row row_of(pose_rows all, int i) {
    return (laned_row){READ(all.nx, i), READ(all.ny, i), READ(all.px, i),       READ(all.py, i),
                       READ(all.ex, i), READ(all.ey, i), READ(all.certainty, i), ETCH_OF(all.grows, i)};
}

// The same one for all lanes.
static inline laned_row row_for_all(pose_rows all, int i) {
    return (laned_row){(reals)all.nx[i], (reals)all.ny[i], (reals)all.px[i],       (reals)all.py[i],
                       (reals)all.ex[i], (reals)all.ey[i], (reals)all.certainty[i],
                       ETCH_FOR_ALL(all.grows, i)};
}

static inline pose_equation equation_of(laned_pose pose, laned_row at) {
    const reals wx = at.ex - pose.x - (pose.dxx * at.px + pose.dxy * at.py);
    const reals wy = at.ey - pose.y - (pose.dyx * at.px + pose.dyy * at.py);
    const reals axx = (reals)1 + pose.dxx, ayy = (reals)1 + pose.dyy;
    const reals per = (reals)1 / (axx * ayy - pose.dxy * pose.dyx);
    const reals bx = (ayy * wx - pose.dxy * wy) * per, by = (axx * wy - pose.dyx * wx) * per;
    const reals x = at.px + bx, y = at.py + by;
    pose_equation equation;
    equation.residual = at.nx * bx + at.ny * by - at.grows * pose.etch;
    equation.row[0] = at.nx;
    equation.row[1] = at.ny;
    equation.row[2] = at.ny * x - at.nx * y;
#if OF_POSE == 4
    equation.row[3] = at.nx * x + at.ny * y;
#elif OF_POSE == 6
    equation.row[3] = at.nx * x;
    equation.row[4] = at.ny * y;
    equation.row[5] = at.nx * y;
#endif
#ifdef ETCHED
    equation.row[OF_POSE] = at.grows;
#endif
    return equation;
}

static inline reals residual_of(laned_pose pose, laned_row at) { return equation_of(pose, at).residual; }

// T exp(step). The angle is taken for its tangent: at the end of the iteration it is zero.
static inline laned_pose pose_after(laned_pose pose, private const reals *step) {
    const reals tangent = step[2], cosine = (reals)1 / sqrt((reals)1 + tangent * tangent), sine = tangent * cosine;
    const reals less = -sine * sine / ((reals)1 + cosine); // cosine - 1, to all its digits
    reals exx = less, exy = -sine, eyx = sine, eyy = less;
#if OF_POSE == 4
    exx += cosine * step[3], exy -= sine * step[3], eyx += sine * step[3], eyy += cosine * step[3];
#elif OF_POSE == 6
    exx += cosine * step[3], exy += cosine * step[5] - sine * step[4];
    eyx += sine * step[3], eyy += sine * step[5] + cosine * step[4];
#endif
    const reals axx = (reals)1 + pose.dxx, ayy = (reals)1 + pose.dyy;
    const laned_pose next = {pose.dxx + axx * exx + pose.dxy * eyx,  pose.dxy + axx * exy + pose.dxy * eyy,
                             pose.dyx + pose.dyx * exx + ayy * eyx,  pose.dyy + pose.dyx * exy + ayy * eyy,
                             pose.x + axx * step[0] + pose.dxy * step[1], pose.y + pose.dyx * step[0] + ayy * step[1],
#ifdef ETCHED
                             pose.etch + step[OF_POSE]};
#else
                             0};
#endif
    return next;
}

static inline void add_equation(pose_equation equation, reals weight, private reals *matrix, private reals *right) {
    for (int i = 0; i < FREEDOMS; i++) {
        const reals weighted = weight * equation.row[i];
        right[i] += weighted * equation.residual;
        for (int j = 0; j <= i; j++) matrix[CELL(i, j)] += weighted * equation.row[j];
    }
}

// Adds what is known of the etching before, as one more equation.
static inline void add_etch(laned_pose pose, real certainty, private reals *matrix, private reals *right) {
#ifdef ETCHED
    const reals square = (reals)(certainty * certainty);
    matrix[CELL(OF_POSE, OF_POSE)] += square;
    right[OF_POSE] -= square * pose.etch;
#endif
}

#ifdef VECTOR_VARIANT
#define GATHERED(from, at)                                                                                             \
    (reals)((from)[(at)[0]], (from)[(at)[1]], (from)[(at)[2]], (from)[(at)[3]], (from)[(at)[4]], (from)[(at)[5]],        \
            (from)[(at)[6]], (from)[(at)[7]], (from)[(at)[8]], (from)[(at)[9]], (from)[(at)[10]], (from)[(at)[11]],      \
            (from)[(at)[12]], (from)[(at)[13]], (from)[(at)[14]], (from)[(at)[15]])
#else
#define GATHERED(from, at) ((from)[(at)[0]])
#endif

// How badly each lane's pose does: the loss at the scale that is known, or the median of the residuals to a percent.
static inline reals pose_score(laned_pose pose, pose_rows all, private reals *distances, int present) {
#ifdef ETCHED
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
    }
    return loss;
#else
        distances[i] = at.certainty > (reals)0 ? FABS(z) : (reals)INFINITY;
    }
    return ranked_of(distances, all.count, (masks)((present + FREEDOMS + 1) / 2), BITS_TO_ONE_PERCENT);
#endif
}

// Of the poses that FREEDOMS equations each make, the one that does best; `subsets` has the equations of LANES poses
// side by side: (trials / LANES, FREEDOMS, LANES).
static inline laned_pose pose_start(laned_pose near, pose_rows all, constant const int *subsets, int trials,
                             private reals *distances, int present) {
    laned_pose best = near;
    real least = INFINITY;
    for (int trial = 0; trial < trials; trial += LANES) {
        laned_row of[FREEDOMS];
        for (int k = 0; k < FREEDOMS; k++) {
            constant const int *at = subsets + (size_t)trial * FREEDOMS + k * LANES;
            of[k] = (laned_row){GATHERED(all.nx, at), GATHERED(all.ny, at), GATHERED(all.px, at),
                                GATHERED(all.py, at), GATHERED(all.ex, at), GATHERED(all.ey, at),
                                GATHERED(all.certainty, at), ETCH_GATHERED(all.grows, at)};
        }
        laned_pose tried = near;
        masks bad = 0;
        for (int step = 0; step < START_STEPS; step++) {
            reals matrix[TRIANGLE], right[FREEDOMS], change[FREEDOMS];
            for (int i = 0; i < TRIANGLE; i++) matrix[i] = 0;
            for (int i = 0; i < FREEDOMS; i++) right[i] = 0;
            for (int k = 0; k < FREEDOMS; k++) {
#ifdef ETCHED
                const reals weight = of[k].certainty * of[k].certainty;
#else
                const reals weight = mask_of(of[k].certainty > (reals)0) ? (reals)1 : (reals)0;
#endif
                add_equation(equation_of(tried, of[k]), weight, matrix, right);
            }
            add_etch(tried, all.etch, matrix, right);
            bad |= factored(matrix);
            solved(matrix, right, change);
            tried = pose_after(tried, change);
        }
        const reals loss = pose_score(tried, all, distances, present);
        for (int lane = 0; lane < LANES; lane++) {
            if (LANE_BITS(bad, lane) || !(LANE(loss, lane) < least)) continue;
            least = LANE(loss, lane);
            best = (laned_pose){(reals)LANE(tried.dxx, lane), (reals)LANE(tried.dxy, lane), (reals)LANE(tried.dyx, lane),
                                (reals)LANE(tried.dyy, lane), (reals)LANE(tried.x, lane),   (reals)LANE(tried.y, lane),
                                (reals)LANE(tried.etch, lane)};
        }
    }
    return best;
}

// The scale of the residuals in sigmas: as it is known, or by their median; of those only within `reach`, once a scale
// is known: outliers raise the median too.
static inline real pose_scale(laned_pose pose, pose_rows all, private reals *room, real reach, real few, real smallest) {
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
    return max(smallest, MAD_TO_SIGMA * (1 + few / free) * as_real(found));
#endif
}

// What the equations say together at a pose: the matrix of their squares, and what is left.
typedef struct {
    reals matrix[TRIANGLE], right[FREEDOMS];
    int inliers;
    real slopes, squares;
} pose_sums;

#define WEIGHTED 0
#define EVENLY 1     // those that count at all count fully
#define EVERY_ROW 2  // that there is

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
    real cell[OF_POSE][OF_POSE];
} pose_matrix;

// The pose's part of a matrix: what the etching takes is taken out.
static inline pose_matrix pose_part(private const reals *triangle) {
    pose_matrix of;
    for (int i = 0; i < OF_POSE; i++)
        for (int j = 0; j <= i; j++) {
            of.cell[i][j] = FIRST(triangle[CELL(i, j)]);
#ifdef ETCHED
            of.cell[i][j] -= FIRST(triangle[CELL(OF_POSE, i)]) * FIRST(triangle[CELL(OF_POSE, j)]) /
                             FIRST(triangle[CELL(OF_POSE, OF_POSE)]);
#endif
            of.cell[j][i] = of.cell[i][j];
        }
    return of;
}

// Eigenvalues of a symmetric matrix by Jacobi's rotations: least and largest, and how many are over a share of the
// largest.
static inline int eigenvalues(pose_matrix of, real share, private real *least, private real *largest) {
    for (int sweep = 0; sweep < 5; sweep++)
        for (int p = 0; p < OF_POSE - 1; p++)
            for (int q = p + 1; q < OF_POSE; q++) {
                if (of.cell[p][q] == 0) continue;
                const real ratio = (of.cell[q][q] - of.cell[p][p]) / (2 * of.cell[p][q]);
                const real t = (ratio < 0 ? -1 : 1) / (fabs(ratio) + sqrt(ratio * ratio + 1));
                const real c = 1 / sqrt(t * t + 1), s = t * c;
                for (int k = 0; k < OF_POSE; k++) {
                    const real kp = of.cell[k][p], kq = of.cell[k][q];
                    of.cell[k][p] = c * kp - s * kq;
                    of.cell[k][q] = s * kp + c * kq;
                }
                for (int k = 0; k < OF_POSE; k++) {
                    const real pk = of.cell[p][k], qk = of.cell[q][k];
                    of.cell[p][k] = c * pk - s * qk;
                    of.cell[q][k] = s * pk + c * qk;
                }
                of.cell[p][q] = of.cell[q][p] = 0;
            }
    *least = *largest = of.cell[0][0];
    for (int i = 1; i < OF_POSE; i++) {
        *least = min(*least, of.cell[i][i]);
        *largest = max(*largest, of.cell[i][i]);
    }
    int rank = 0;
    for (int i = 0; i < OF_POSE; i++) rank += of.cell[i][i] > share * *largest;
    return rank;
}

// Which share of all that the rows say of the pose agrees, of the combination of freedoms of which least does: the
// least eigenvalue of L^-1 M L^-T, M of those that agree and L L^T of all.
static inline real least_agreement(pose_matrix agrees, pose_matrix all) {
    real factor[OF_POSE][OF_POSE];
    for (int i = 0; i < OF_POSE; i++)
        for (int j = 0; j <= i; j++) {
            real sum = all.cell[i][j];
            for (int k = 0; k < j; k++) sum -= factor[i][k] * factor[j][k];
            if (i == j && !(sum > all.cell[i][i] * (8 * REAL_EPSILON))) return 0;
            factor[i][j] = i == j ? sqrt(sum) : sum / factor[j][j];
        }
    for (int column = 0; column < OF_POSE; column++)
        for (int i = 0; i < OF_POSE; i++) {
            for (int k = 0; k < i; k++) agrees.cell[i][column] -= factor[i][k] * agrees.cell[k][column];
            agrees.cell[i][column] /= factor[i][i];
        }
    for (int row = 0; row < OF_POSE; row++)
        for (int i = 0; i < OF_POSE; i++) {
            for (int k = 0; k < i; k++) agrees.cell[row][i] -= factor[i][k] * agrees.cell[row][k];
            agrees.cell[row][i] /= factor[i][i];
        }
    real least, largest;
    eigenvalues(agrees, 0, &least, &largest);
    return least;
}

typedef struct {
    laned_pose pose;
    real covariance[FREEDOMS][FREEDOMS]; // of the step in the artwork's frame, about the origin of the rows' places
    real scale, spread, condition;
    real agreement, leverage; // least share that agrees, and the largest of a row in its own residual
    int present, inliers, rank;
} solved_pose;

static inline void pose_covariance(private solved_pose *fit, pose_rows all, private const pose_sums *sums) {
    reals factor[TRIANGLE];
    for (int i = 0; i < TRIANGLE; i++) factor[i] = sums->matrix[i];
    factored(factor);
    const real free = (real)(fit->inliers - FREEDOMS), mean = sums->slopes / fit->inliers;
    fit->spread = fit->scale * sqrt(sums->squares / free) / mean;
#ifdef GIVEN_SCALE
    const real variance = fit->scale * fit->scale / (real)(EFFICIENCY);
#else
    const real variance = fit->spread * fit->spread;
#endif
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
        const masks is_in = mask_of(row.certainty * loss_weight(equation.residual * row.certainty / fit->scale) > (reals)0);
        reals sum = 0;
        for (int i = 0; i < FREEDOMS; i++)
            for (int k = 0; k < FREEDOMS; k++)
                sum += equation.row[i] * equation.row[k] * (reals)(fit->covariance[i][k] / variance);
        sum = kept_where(is_in, sum * row.certainty * row.certainty);
        for (int lane = 0; lane < LANES; lane++) fit->leverage = max(fit->leverage, LANE(sum, lane));
    }
#endif
}

// The places' unit must be about their distance from the origin. `room` has as many reals as there are rows.
// Not inlined: PoCL 3.1 computes wrong weights in the work-item variant of board_pose.cl when this function is inlined
// behind the kernel's last barrier (bisected; the vector variant and Intel's runtime are not affected).
static __attribute__((noinline)) solved_pose pose_solved(laned_pose near, pose_rows all, constant const int *subsets, int trials, int steps,
                               real smallest, real share, private reals *room) {
    solved_pose fit;
    real present = 0;
    for (int i = 0; i < all.count; i++) present += all.certainty[i] > 0;
    fit.present = (int)present;
    fit.pose = near;
    pose_sums sums;
    fit.scale = smallest;
#ifdef ROBUST
    fit.pose = pose_start(near, all, subsets, trials, room, fit.present);
    fit.scale = pose_scale(fit.pose, all, room, INFINITY, FEW_TRIED, smallest);
#endif
    for (int step = 0; step < steps; step++) {
        if (RESCALED_AT(step)) fit.scale = pose_scale(fit.pose, all, room, (real)2.5f * fit.scale, FEW_FITTED, smallest);
        reals change[FREEDOMS];
        pose_summed(fit.pose, all, 1 / fit.scale, WEIGHTED, &sums);
        if (any_lane(factored(sums.matrix))) break;
        solved(sums.matrix, sums.right, change);
        fit.pose = pose_after(fit.pose, change);
    }
#ifndef ROBUST
    fit.scale = pose_scale(fit.pose, all, room, INFINITY, FEW_FITTED, smallest);
#endif
    pose_summed(fit.pose, all, 1 / fit.scale, EVERY_ROW, &sums);
    const pose_matrix every = pose_part(sums.matrix);
    pose_summed(fit.pose, all, 1 / fit.scale, EVENLY, &sums);
    const pose_matrix agrees = pose_part(sums.matrix);
    fit.inliers = sums.inliers;
    real least, largest;
    fit.rank = eigenvalues(agrees, share, &least, &largest);
    fit.agreement = least_agreement(agrees, every);
    fit.condition = sqrt(largest / max(least, (real)REAL_EPSILON * largest));
    pose_covariance(&fit, all, &sums);
    return fit;
}

#endif
