// Rows of a pose as columns in the private memory of the work-item that solves it.
#ifndef POSE_ROWS_H
#define POSE_ROWS_H
#include "common/robust.h"
#include "pose/pose_equation.h"
#include "pose/pose_row.h"

// Etch factors have a column with WITH_ETCH_BIAS only.
#ifdef WITH_ETCH_BIAS
#define POSE_COLUMNS 8
#else
#define POSE_COLUMNS 7
#endif

// Columns of all rows, padded with rows of certainty 0 to whole vectors.
typedef struct {
    private real *nx;
    private real *ny;
    private real *px;
    private real *py;
    private real *ex;
    private real *ey;
    private real *certainty;
    private real *etch_factor; // null without WITH_ETCH_BIAS
    int count;
    real etch; // 1/sigma of the etch bias
} pose_rows;

// Return the rows in these columns. `count`: padded with missing rows to whole vectors.
static inline pose_rows rows_in(private real (*columns)[CAPACITY], int count, real etch) {
    private real *etch_factor = POSE_COLUMNS > 7 ? columns[POSE_COLUMNS - 1] : 0;
    return (pose_rows){columns[0], columns[1], columns[2], columns[3], columns[4],
                       columns[5], columns[6], etch_factor, count,      etch};
}

static inline void put_row(pose_rows all, int i, pose_row row) {
    all.nx[i] = row.nx, all.ny[i] = row.ny, all.px[i] = row.px, all.py[i] = row.py, all.ex[i] = row.ex;
    all.ey[i] = row.ey, all.certainty[i] = row.certainty;
#ifdef WITH_ETCH_BIAS
    all.etch_factor[i] = row.etch_factor;
#endif
}

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

// Transform rows to their frame, in place.
static inline pose_frame centre_rows(private pose_rows *all) {
    private real *px = all->px, *py = all->py, *ex = all->ex, *ey = all->ey, *certainty = all->certainty;
    real sum = 0, sum_x = 0, sum_y = 0; // of the rows that are not missing
    for (int i = 0; i < all->count; i++) {
        sum += certainty[i] > 0;
        sum_x += px[i];
        sum_y += py[i];
    }
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
