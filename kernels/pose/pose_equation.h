// Equations of a pose: residual and Jacobian of a feature row, and a step of the pose (pose.h has the derivation).
#ifndef POSE_EQUATION_H
#define POSE_EQUATION_H
#include "common/least_squares.h"

// Frame of the rows: centre [m], size [m] and 1 / size.
//
// In this frame the centre of the rows is 0, and their root-mean-square distance from it is 1:
// p' = (p - centre) / size, e' = e / size, sigma' = sigma / size. Shifts and turns then have the same unit, and places
// have no large offset that costs digits. A translation t of the frame is t size metres.
typedef struct {
    real x, y, size, per_size;
} pose_frame;

// Poses, one per lane: D, the translation (x, y), and the etch bias.
typedef struct {
    reals dxx, dxy, dyx, dyy, x, y, etch;
} laned_pose;

// Rows, one per lane: normal, place, displacement, certainty 1/sigma (0: missing row), and etch factor.
typedef struct {
    reals nx, ny, px, py, ex, ey, certainty, etch_factor;
} laned_row;

// Linearised equations, one per lane: Jacobian row h and residual.
typedef struct {
    reals row[FREEDOMS], residual;
} pose_equation;

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

// Add weight h h^T to the lower triangle of the normal matrix, and right_weight h residual to the right side.
static inline void add_equation(pose_equation equation, reals weight, reals right_weight, private reals *matrix,
                                private reals *right) {
    for (int i = 0; i < FREEDOMS; i++) {
        const reals weighted = weight * equation.row[i];
        right[i] += right_weight * equation.row[i] * equation.residual;
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

#endif
