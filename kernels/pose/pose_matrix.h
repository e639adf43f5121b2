// Information matrices of the pose parameters: eigenvalues, and the fraction that the inliers have.
#ifndef POSE_MATRIX_H
#define POSE_MATRIX_H
#include "common/least_squares.h"

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

#endif
