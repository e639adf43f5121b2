"""Newton's method for the inverse of a displacement field, as in ``kernels/common/newton.h``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
# Takes places (n, 2); returns how far they are moved, the Jacobian of the moved places, and which lie in the part that
# is one-to-one.
Displacement = Callable[[Float64], tuple[Float64, Float64, npt.NDArray[np.bool_]]]

_STEPS = 100
_EPSILON = float(np.finfo(np.float64).eps)
# Squares, relative to the place's own: of a distance or step that is rounding, of a step that leads nowhere.
_ROUNDING, _STUCK = 64.0 * _EPSILON**2, _EPSILON**2 / 64.0


def undo(displacement: Displacement, moved: Float64) -> Float64:
    """Places (..., 2) that the displacement takes to those given; NaN where there are none in the one-to-one part.

    The start is the centre, which is not moved and where the Jacobian is 1: the first step leads to the given place
    itself. A step which leaves the one-to-one part or gains nothing is halved. The way back is the unknown: it is small
    beside the place, so it keeps its digits. It is found where the distance left, or the step ahead, is rounding; at
    the fold, where the search for a place past it ends, neither is.
    """
    wanted = moved.reshape(-1, 2)
    back, step = -wanted, wanted.copy()
    with np.errstate(all="ignore"):
        square = np.sum(wanted**2, axis=-1)
        left, ahead = square.copy(), square.copy()
        going = np.flatnonzero(np.isfinite(square))
        for _ in range(_STEPS):
            if not len(going):
                break
            trial = back[going] + step[going]
            move, jacobian, inside = displacement(wanted[going] + trial)
            rest = move + trial
            distance = np.sum(rest**2, axis=-1)
            better = inside & (distance < left[going])
            taken = going[better]
            back[taken], left[taken] = trial[better], distance[better]
            step[taken] = -np.linalg.solve(jacobian[better], rest[better][..., None])[..., 0]
            step[going[~better]] *= 0.5
            sizes = np.sum(step[going] ** 2, axis=-1)
            ahead[taken] = sizes[better]
            least = np.minimum(left[going], ahead[going])
            going = going[(least > _ROUNDING * square[going]) & (sizes > _STUCK * square[going])]
        found = np.minimum(left, ahead) <= _ROUNDING * square
    # The last step is still to come, or next to nothing.
    return np.asarray(np.where(found[:, None], wanted + (back + step), np.nan).reshape(moved.shape))


def determinant(jacobian: Float64) -> Float64:
    """Of matrices (..., 2, 2)."""
    return np.asarray(jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0])
