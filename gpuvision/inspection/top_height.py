"""Height of the top of a bump, without the bias of a maximum over noisy cells."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter

from gpuvision.matching.artwork.shapes import Float64

_LEAST_FILLED = 0.6  # share of the cells of a patch that must have a height. Chosen
_LEAST_FOR_CURVED = 10  # cells of a patch for a paraboloid, which has 6 coefficients; fewer give their mean. Chosen


class TopHeight(NamedTuple):
    """Height of a top, and its standard deviation for independent cells; NaN if no patch has enough cells."""

    height: float
    sigma: float


def top_height(z: Float64, allowed: npt.NDArray[np.bool_], sigma: Float64, half: int) -> TopHeight:
    """Measure the height of the highest patch.

    The cells are split like the fields of a chessboard. The cells of one colour choose the place with the highest
    mean; a paraboloid through the cells of the other colour gives the height there, and the other way round; the result
    is the mean of both. The choice is independent of the noise of the measured cells, so that the result has not the
    upward bias of the largest of many noisy heights.

    Parameters
    ----------
    z : numpy.ndarray
        Heights (rows, columns), NaN in holes.
    allowed : numpy.ndarray
        bool, places where the top may lie.
    sigma : numpy.ndarray
        Standard deviations of the heights.
    half : int
        Half width of a patch in cells, 1 or more: it has (2 half + 1)^2 cells.

    Returns
    -------
    TopHeight
    """
    rows, columns = np.arange(z.shape[0])[:, None], np.arange(z.shape[1])[None, :]
    valid = np.isfinite(z)
    dark = (rows + columns) % 2 == 0
    found = []
    for choosing in (dark, np.logical_not(dark)):
        place = _highest(z, valid & choosing, allowed, half)
        if place is None:
            return TopHeight(math.nan, math.nan)
        near = (
            (np.abs(rows - place[0]) <= half) & (np.abs(columns - place[1]) <= half) & valid & np.logical_not(choosing)
        )
        row, column = np.nonzero(near)
        weights = _evaluation_weights(row - place[0], column - place[1])
        if not len(weights):
            return TopHeight(math.nan, math.nan)
        found.append((float(weights @ z[near]), float(np.sum((weights * sigma[near]) ** 2))))
    (one, one_variance), (other, other_variance) = found
    return TopHeight((one + other) / 2, math.sqrt(one_variance + other_variance) / 2)


def _highest(
    z: Float64, used: npt.NDArray[np.bool_], allowed: npt.NDArray[np.bool_], half: int
) -> tuple[int, int] | None:
    """Return the row and column of the allowed patch with the highest mean of the used cells."""
    size = 2 * half + 1
    filled = uniform_filter(used.astype(np.float64), size, mode="constant")
    level = float(np.mean(z[used])) if used.any() else 0.0  # keeps the sums of the filter small
    total = uniform_filter(np.where(used, z - level, 0.0), size, mode="constant")
    enough = allowed & (filled >= _LEAST_FILLED * 0.5)
    if not enough.any():
        return None
    mean = np.where(enough, total / np.where(enough, filled, 1.0), -np.inf)
    row, column = divmod(int(mean.argmax()), int(mean.shape[1]))
    return row, column


def _evaluation_weights(u: npt.NDArray[np.int64], v: npt.NDArray[np.int64]) -> Float64:
    """Return weights of cells whose weighted sum is the value at the origin of a least-squares paraboloid."""
    if len(u) < _LEAST_FOR_CURVED:
        return np.full(len(u), 1.0 / max(len(u), 1))
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1).astype(np.float64)
    return np.asarray(np.linalg.pinv(design)[0])
