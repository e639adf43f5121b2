// Small least-squares problems in lanes: sums over lanes, and Cholesky factorisation and solution of the normal equations
// with FREEDOMS unknowns (or a given number).
#ifndef LEAST_SQUARES_H
#define LEAST_SQUARES_H

#include "common/lanes.h"

#define READ(from, i) (*(private const reals_at *)((from) + (i)))

#ifdef VECTOR_VARIANT
static inline real sum_of(reals value) {
    const real8 a = value.lo + value.hi;
    const real4 b = a.lo + a.hi;
    return (b.x + b.y) + (b.z + b.w);
}
#define FIRST(value) (value).s0
// Loops over a matrix: unrolled, a CPU keeps its numbers in registers; each number depends on the numbers before it.
#define UNROLLED _Pragma("unroll")
#else
static inline real sum_of(reals value) { return value; }
#define FIRST(value) (value)
#define UNROLLED
#endif

// Lower triangle of a symmetric matrix, row by row: (0, 0), (1, 0), (1, 1), ...
#define TRIANGLE (FREEDOMS * (FREEDOMS + 1) / 2)
#define CELL(row, column) ((row) * ((row) + 1) / 2 + (column))

// Cholesky factorisation in place; the diagonal holds reciprocals. Returns the lanes in which the matrix is singular.
INLINE masks factored_of(const int unknowns, private reals *matrix) {
    masks bad = 0;
    UNROLLED for (int i = 0; i < unknowns; i++) {
        const reals diagonal = matrix[CELL(i, i)];
        UNROLLED for (int j = 0; j <= i; j++) {
            reals sum = matrix[CELL(i, j)];
            UNROLLED for (int k = 0; k < j; k++) sum -= matrix[CELL(i, k)] * matrix[CELL(j, k)];
            if (j < i) matrix[CELL(i, j)] = sum * matrix[CELL(j, j)];
            else {
                const masks none = mask_of(!(sum > diagonal * (reals)(8 * REAL_EPSILON)));
                bad |= none;
                matrix[CELL(i, i)] = (reals)1 / sqrt(none ? (reals)1 : sum);
            }
        }
    }
    return bad;
}

INLINE void solved_of(const int unknowns, private const reals *factor, private const reals *right,
                      private reals *solution) {
    UNROLLED for (int i = 0; i < unknowns; i++) {
        reals sum = right[i];
        UNROLLED for (int k = 0; k < i; k++) sum -= factor[CELL(i, k)] * solution[k];
        solution[i] = sum * factor[CELL(i, i)];
    }
    UNROLLED for (int i = unknowns - 1; i >= 0; i--) {
        reals sum = solution[i];
        UNROLLED for (int k = i + 1; k < unknowns; k++) sum -= factor[CELL(k, i)] * solution[k];
        solution[i] = sum * factor[CELL(i, i)];
    }
}

#define factored(matrix) factored_of(FREEDOMS, matrix)
#define solved(factor, right, solution) solved_of(FREEDOMS, factor, right, solution)

#endif
