// Rows of a pose as columns in the private memory of the work-item that solves it.
#ifndef POSE_ROWS_H
#define POSE_ROWS_H
#include "common/robust.h"
#include "pose/pose_equation.h"

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

static inline real certainty_of(pose_rows all, int i) { return all.certainty[i]; }

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

// Transform rows to their frame, in place. `sum` is the number of rows, (sum_x, sum_y) the sum of their places.
static inline pose_frame centre_rows(private pose_rows *all, real sum, real sum_x, real sum_y) {
    private real *px = (private real *)all->px, *py = (private real *)all->py;
    private real *ex = (private real *)all->ex, *ey = (private real *)all->ey;
    private real *certainty = (private real *)all->certainty;
    const real x = sum_x / max(sum, (real)1), y = sum_y / max(sum, (real)1);
    real square = 0;
    for (int i = 0; i < all->count; i++) {
        px[i] = certainty[i] > 0 ? px[i] - x : 0;
        py[i] = certainty[i] > 0 ? py[i] - y : 0;
        square += px[i] * px[i] + py[i] * py[i];
    }
    const real size = square > 0 ? sqrt(square / sum) : 1, per_size = 1 / size;
    for (int i = 0; i < all->count; i++) {
        px[i] *= per_size, py[i] *= per_size, ex[i] *= per_size, ey[i] *= per_size;
        certainty[i] *= size;
    }
    all->etch *= size;
    return (pose_frame){x, y, size, per_size};
}

#endif
