// Feature rows as pose.cl takes them.
#ifndef POSE_INPUT_H
#define POSE_INPUT_H
#include "common/group.h"
#include "pose/pose_row.h"

// Feature row: ROW in pose.py, and the etch factor.
typedef struct {
    INPUT normal_x, normal_y;             // unit normal n
    INPUT x, y;                           // place p in the artwork [m]
    INPUT displacement_x, displacement_y; // e, from p to the place where the feature was seen [m]
    INPUT sigma;                          // along the normal [m]
#ifdef WITH_ETCH_BIAS
    INPUT etch_factor;                    // g
#endif
} PoseRow;

// Read a row; a row that is not `there` is missing (pose_row.h).
//
// By field: Mesa 22.3 drops the index of a pointer to numbers that was cast from a pointer to a struct.
INLINE pose_row read_row(global const PoseRow *row, int there) {
#ifdef WITH_ETCH_BIAS
    const real etch_factor = row->etch_factor;
#else
    const real etch_factor = 0;
#endif
    return row_with_sigma(row->normal_x, row->normal_y, row->x, row->y, row->displacement_x, row->displacement_y,
                          there ? (real)row->sigma : 0, etch_factor);
}

#endif
