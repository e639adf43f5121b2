"""Polynomial model of a grid under lens distortion and perspective, and its outliers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre
from scipy.ndimage import maximum_filter

from gpuvision.camera.patterns.pattern import Float64, nan_median

_MAX_DEGREE = 4
# Least number of points per coefficient; limits the influence of a single outlier.
_POINTS_PER_TERM = 2
# Rounds of the outlier search, and the side of the neighbourhood (nodes) in which a round removes the worst point only.
_ROUNDS = 5
_NEIGHBOURHOOD = 7


class GridPolynomial:
    """Least-squares polynomial from grid index (column, row) to image position.

    The degree is 4 along columns and along rows, lower if few points are known.

    Parameters
    ----------
    points : numpy.ndarray
        (rows, columns, 2): positions [px], NaN where missing; at least one known.
    """

    def __init__(self, points: Float64) -> None:
        rows, columns = points.shape[:2]
        known = np.isfinite(points[..., 0])
        degree = min(_MAX_DEGREE, int(np.sqrt(np.count_nonzero(known) / _POINTS_PER_TERM)) - 1)
        degrees = tuple(max(0, min(degree, count - 2)) for count in (columns, rows))
        i, j = np.indices((rows, columns))
        # Legendre polynomials on -1 to 1 are nearly orthogonal: the normal equations are well conditioned.
        self._u, self._v = (2.0 * each / max(count - 1, 1) - 1.0 for each, count in ((j, columns), (i, rows)))
        self._per_node = 2.0 / max(columns - 1, 1), 2.0 / max(rows - 1, 1)
        design = legendre.legvander2d(self._u[known], self._v[known], degrees)
        terms = np.linalg.lstsq(design.T @ design, design.T @ points[known], rcond=None)[0]
        self._terms = terms.reshape(degrees[0] + 1, degrees[1] + 1, 2)

    def derivative(self, by_column: int, by_row: int) -> Float64:
        """Return the derivative of the given orders (0, 0: the position) at every node, (rows, columns, 2)."""
        terms = legendre.legder(self._terms, by_column, self._per_node[0], 0)
        terms = legendre.legder(terms, by_row, self._per_node[1], 1)
        return np.asarray(np.moveaxis(legendre.legval2d(self._u, self._v, terms), 0, -1))


def agrees_with_grid(points: Float64, max_medians: float, min_tolerance: float) -> npt.NDArray[np.bool_]:
    """Return which points agree with the positions that their neighbours predict.

    Parameters
    ----------
    points : numpy.ndarray
        (rows, columns, 2); NaN where missing.
    max_medians : float
        Accepted deviation as a multiple of the grid's median deviation.
    min_tolerance : float
        Deviation that is always accepted [grid steps].

    Returns
    -------
    numpy.ndarray
        (rows, columns) bool; True also for isolated points, which no neighbour predicts.
    """
    if not np.isfinite(points).any():
        return np.zeros(points.shape[:2], dtype=np.bool_)
    model = GridPolynomial(points)
    cell = np.abs(cross(model.derivative(1, 0), model.derivative(0, 1)))
    limit = min_tolerance * float(np.sqrt(np.median(cell)))
    rest = points - model.derivative(0, 0)
    good = np.ones(points.shape[:2], dtype=np.bool_)
    for last in (*[False] * (_ROUNDS - 1), True):
        distance = np.nan_to_num(_distance_from_prediction(rest))
        if distance.any():
            limit = max(limit, max_medians * float(np.median(distance[distance > 0.0])))
        # An outlier distorts the predictions of its neighbours: remove the worst point of a neighbourhood first.
        worst = (distance > limit) & (last | (distance == maximum_filter(distance, _NEIGHBOURHOOD)))
        good &= ~worst
        rest[worst] = np.nan
        if not worst.any():
            break
    return good


def cross(a: Float64, b: Float64) -> Float64:
    """Return the signed area that two steps (..., 2) span."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _distance_from_prediction(points: Float64) -> Float64:
    """Return the distance (rows, columns) of every point from the prediction of its row and column neighbours.

    A cubic through two neighbours on each side, or a line through one on each side, predicts the point. At a border a
    parabola through three neighbours on one side predicts it; its noise is larger, so the distance counts half.
    """
    rows, columns = points.shape[:2]
    padded = np.pad(points, ((3, 3), (3, 3), (0, 0)), constant_values=np.nan)
    central, one_sided = [], []
    for down, right in ((0, 1), (1, 0)):
        at = {
            k: padded[3 + k * down : 3 + k * down + rows, 3 + k * right : 3 + k * right + columns]
            for k in (-3, -2, -1, 1, 2, 3)
        }
        line = 0.5 * (at[-1] + at[1])
        cubic = (4.0 * (at[-1] + at[1]) - at[-2] - at[2]) / 6.0
        central.append(np.where(np.isfinite(cubic), cubic, line))
        one_sided += [3.0 * (at[k] - at[2 * k]) + at[3 * k] for k in (-1, 1)]
    distance, one_sided_distance = (
        np.linalg.norm(points - nan_median(np.stack(each)), axis=-1) for each in (central, one_sided)
    )
    return np.asarray(np.where(np.isfinite(distance), distance, 0.5 * one_sided_distance))
