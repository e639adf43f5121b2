// Rows of a pose in the work-group that solves it (IN_GROUP, common/group.h).
//
// The items read the rows from global memory in each pass, and transform them to their frame: many rows do not fit in
// local memory, and adjacent items read adjacent rows. A work-item that solves a pose alone copies the rows to columns
// (pose_rows.h).
#ifndef POSE_GROUP_ROWS_H
#define POSE_GROUP_ROWS_H
#include "common/group.h"
#include "pose/pose_equation.h"
#include "pose/pose_input.h"

// Rows of a pose, and the frame to which `row_of` transforms them.
typedef struct {
    global const PoseRow *rows;
    pose_frame frame;
    int count;
    real etch; // 1/sigma of the etch bias
} pose_rows;

INLINE laned_row row_of(pose_rows all, int i) {
    const pose_row row = read_row(all.rows + i, 1);
    const pose_frame frame = all.frame;
    const int there = row.certainty > 0;
    return (laned_row){row.nx,
                       row.ny,
                       there ? (row.px - frame.x) * frame.per_size : 0,
                       there ? (row.py - frame.y) * frame.per_size : 0,
                       row.ex * frame.per_size,
                       row.ey * frame.per_size,
                       row.certainty * frame.size,
                       row.etch_factor};
}
INLINE laned_row row_for_all(pose_rows all, int i) { return row_of(all, i); }
INLINE laned_row gather_rows(pose_rows all, constant const int *at) { return row_of(all, at[0]); }
INLINE real certainty_of(pose_rows all, int i) { return row_of(all, i).certainty; }

// Return the rows in their frame: their centre from a first pass, their size from a second one.
INLINE pose_rows framed_rows(global const PoseRow *rows, int count, real etch, local real *sums) {
    pose_rows all = {rows, {0, 0, 1, 1}, count, etch};
    EACH_PART(part) {
        real values[3] = {0, 0, 0};
        for (int i = part; i < count; i += PARTS) {
            const laned_row at = row_of(all, i);
            values[0] += at.certainty > 0;
            values[1] += at.px;
            values[2] += at.py;
        }
        group_put(values, 3, part, sums);
    }
    local const real *totals = group_total(0, 3, sums);
    const real present = max(totals[0], (real)1);
    all.frame.x = totals[1] / present;
    all.frame.y = totals[2] / present;
    EACH_PART(part) {
        real square = 0;
        for (int i = part; i < count; i += PARTS) {
            const laned_row at = row_of(all, i);
            square += at.px * at.px + at.py * at.py;
        }
        group_put(&square, 1, part, sums);
    }
    totals = group_total(0, 1, sums);
    all.frame.size = totals[0] > 0 ? sqrt(totals[0] / present) : 1;
    all.frame.per_size = 1 / all.frame.size;
    all.etch *= all.frame.size;
    return all;
}

#endif
