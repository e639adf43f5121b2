// Rulers of a board (board_pose.cl): measured edges in the frames of their lines.
//
// A ruler takes the position s [px] on it to the frame of its line [m], u along the line and v along its normal, exactly
// for a homography: (u, v) = ((u, v) + s (u_per_px, v_per_px)) / (1 + s projective), with the fields of BoardRuler.
#ifndef BOARD_EDGE_H
#define BOARD_EDGE_H

#include "ruler/ruler.h"

// Ruler: RULER in board_pose.py.
typedef struct {
    real x_px, y_px, cosine, sine;      // centre and direction in the image
    real u, v;                          // of the centre, in the frame of the line [m]
    real u_per_px, v_per_px, projective;  // [m/px, m/px, 1/px]
} BoardRuler;
#define RULER_NUMBERS (int)(sizeof(BoardRuler) / sizeof(real))

// Measured edge: place in the frame of its line [m], and sigma across the line [m] (NaN: no edge).
typedef struct {
    real u, v, sigma;
} board_edge;

// Return the edge of a ruler from its position and sigma on the ruler [px].
static inline board_edge board_edge_of(real position, real sigma, global const BoardRuler *ruler) {
    const real per = 1 / (1 + position * ruler->projective);
    const real at_u = (ruler->u + position * ruler->u_per_px) * per, at_v = (ruler->v + position * ruler->v_per_px) * per;
    // Sigma across the line: |dv/ds| sigma, with dv/ds = (dv - v k) / (1 + s k).
    const real across = fabs(ruler->v_per_px - at_v * ruler->projective) * per * sigma;
    const int good = !not_finite(at_u) & !not_finite(at_v) & !not_finite(across) & across > 0;
    return (board_edge){good ? at_u : 0, good ? at_v : 0, good ? across : REAL_NAN};
}
#endif
