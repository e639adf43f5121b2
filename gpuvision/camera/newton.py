"""Newton's method for the inverse of a displacement field; the kernels use ``kernels/common/newton.h``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
# Takes points (n, 2); returns their displacements (n, 2), the Jacobian (n, 2, 2) of the displaced points, and whether
# each point lies in the region where the displacement is invertible (n,).
Displacement = Callable[[Float64], tuple[Float64, Float64, npt.NDArray[np.bool_]]]

_MAX_ITERATIONS = 100
_EPSILON = float(np.finfo(np.float64).eps)
# Derived from double precision: squared residual or step, relative to the point's squared norm, below which it is
# rounding (8 eps), and below which a step changes nothing (eps / 8).
_ROUNDING, _NO_CHANGE = 64.0 * _EPSILON**2, _EPSILON**2 / 64.0


def invert_displacement(displacement: Displacement, moved: Float64) -> Float64:
    """Invert a displacement field: return the points that it moves to the given ones.

    Parameters
    ----------
    displacement : callable
        Displacement field with its Jacobian; zero, with identity Jacobian, at the origin.
    moved : numpy.ndarray
        (..., 2): displaced points.

    Returns
    -------
    numpy.ndarray
        (..., 2): original points; NaN where none exists in the invertible region.

    Notes
    -----
    The iteration starts at the origin, so that the first step leads to the given point itself. A step that leaves the
    invertible region or does not reduce the residual is halved. The unknown is the negative displacement: it is small
    against the point, so its rounding error is small. A point is found if its residual or its next step is at rounding
    level. For points past the fold the iteration ends at the fold, where both conditions fail.
    """
    target = moved.reshape(-1, 2)
    correction, step = -target, target.copy()
    with np.errstate(all="ignore"):
        square = np.sum(target**2, axis=-1)
        residual_square, step_square = square.copy(), square.copy()
        active = np.flatnonzero(np.isfinite(square))
        for _ in range(_MAX_ITERATIONS):
            if not len(active):
                break
            trial = correction[active] + step[active]
            move, jacobian, inside = displacement(target[active] + trial)
            residual = move + trial
            distance = np.sum(residual**2, axis=-1)
            better = inside & (distance < residual_square[active])
            accepted = active[better]
            correction[accepted], residual_square[accepted] = trial[better], distance[better]
            step[accepted] = -np.linalg.solve(jacobian[better], residual[better][..., None])[..., 0]
            step[active[~better]] *= 0.5
            sizes = np.sum(step[active] ** 2, axis=-1)
            step_square[accepted] = sizes[better]
            least = np.minimum(residual_square[active], step_square[active])
            active = active[(least > _ROUNDING * square[active]) & (sizes > _NO_CHANGE * square[active])]
        found = np.minimum(residual_square, step_square) <= _ROUNDING * square
    # The last step computed has not been applied yet; apply it.
    return np.asarray(np.where(found[:, None], target + (correction + step), np.nan).reshape(moved.shape))


def determinant(jacobian: Float64) -> Float64:
    """Return the determinants (...) of matrices (..., 2, 2)."""
    return np.asarray(jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0])
