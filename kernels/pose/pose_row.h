// Row of a pose: one scalar equation n . (T^-1(p + e) - p) = g etch (pose.h).
#ifndef POSE_ROW_H
#define POSE_ROW_H
#include "common/real.h"

// Unit normal n, place p, displacement e, certainty 1/sigma along the normal, etch factor g; zeros: the row is missing.
typedef struct {
    real nx, ny, px, py, ex, ey, certainty, etch_factor;
} pose_row;

// Return a row with a standard deviation. A row is missing if a number is not finite or sigma is not positive.
static inline pose_row row_with_sigma(real nx, real ny, real px, real py, real ex, real ey, real sigma, real etch_factor) {
    const int good = !not_finite(nx) & !not_finite(ny) & !not_finite(px) & !not_finite(py) & !not_finite(ex) &
                     !not_finite(ey) & !not_finite(sigma) & !not_finite(etch_factor) & (sigma > 0);
    return (pose_row){good ? nx : 0, good ? ny : 0, good ? px : 0,        good ? py : 0,
                      good ? ex : 0, good ? ey : 0, good ? 1 / sigma : 0, good ? etch_factor : 0};
}

#endif
