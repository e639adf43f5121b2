"""A polynomial through the points of a grid: how lens and perspective bend it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre
from scipy.ndimage import maximum_filter

from gpuvision.camera.patterns.pattern import Float64, nan_median

_DEGREE = 4
# Points for every coefficient, so that one that is off does not bend it much.
_POINTS_PER_TERM = 2
# Rounds that look for points that are off, and how far a point bears on others.
_ROUNDS = 5
_REACH = 7


class GridPolynomial:
    """Place in the image as a polynomial of column and row, by least squares.

    The degree is 4 along columns and along rows, less where few points are known.

    Parameters
    ----------
    points
        (rows, columns, 2), NaN where missing; at least one known.
    """

    def __init__(self, points: Float64) -> None:
        rows, columns = points.shape[:2]
        known = np.isfinite(points[..., 0])
        degree = min(_DEGREE, int(np.sqrt(np.count_nonzero(known) / _POINTS_PER_TERM)) - 1)
        degrees = tuple(max(0, min(degree, count - 2)) for count in (columns, rows))
        i, j = np.indices((rows, columns))
        # From -1 to 1 Legendre polynomials are near enough to orthogonal for the normal equations.
        self._u, self._v = (2.0 * each / max(count - 1, 1) - 1.0 for each, count in ((j, columns), (i, rows)))
        self._per_node = 2.0 / max(columns - 1, 1), 2.0 / max(rows - 1, 1)
        design = legendre.legvander2d(self._u[known], self._v[known], degrees)
        terms = np.linalg.lstsq(design.T @ design, design.T @ points[known], rcond=None)[0]
        self._terms = terms.reshape(degrees[0] + 1, degrees[1] + 1, 2)

    def derivative(self, by_column: int, by_row: int) -> Float64:
        """Return the derivative of these orders (0 and 0: the place) at every node, (rows, columns, 2)."""
        terms = legendre.legder(self._terms, by_column, self._per_node[0], 0)
        terms = legendre.legder(terms, by_row, self._per_node[1], 1)
        return np.asarray(np.moveaxis(legendre.legval2d(self._u, self._v, terms), 0, -1))


def on_grid(points: Float64, usual: float, least: float) -> npt.NDArray[np.bool_]:
    """Which points lie where their neighbours have them, in grids that lens and perspective bend.

    Parameters
    ----------
    points
        (rows, columns, 2); NaN where missing.
    usual
        They may be off by so many times what is usual in this grid,
    least
        or by this part of a step.

    Returns
    -------
    numpy.ndarray
        (rows, columns); also where nothing predicts a point that stands alone.
    """
    if not np.isfinite(points).any():
        return np.zeros(points.shape[:2], dtype=np.bool_)
    bent = GridPolynomial(points)
    cell = np.abs(cross(bent.derivative(1, 0), bent.derivative(0, 1)))
    limit = least * float(np.sqrt(np.median(cell)))
    rest = points - bent.derivative(0, 0)
    good = np.ones(points.shape[:2], dtype=np.bool_)
    for last in (*[False] * (_ROUNDS - 1), True):
        off = np.nan_to_num(_off_neighbours(rest))
        if off.any():
            limit = max(limit, usual * float(np.median(off[off > 0.0])))
        # A point that is off makes its neighbours look so: the worst goes first.
        worst = (off > limit) & (last | (off == maximum_filter(off, _REACH)))
        good &= ~worst
        rest[worst] = np.nan
        if not worst.any():
            break
    return good


def cross(a: Float64, b: Float64) -> Float64:
    """Area that two steps span, with its sign."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _off_neighbours(points: Float64) -> Float64:
    """How far (rows, columns) every point lies from where its neighbours in its row and its column would have it.

    A cubic through two neighbours on either side, or a line through one, predicts the point. At a border there are
    only parabolas through three neighbours on one side, with more noise: what they tell counts half.
    """
    rows, columns = points.shape[:2]
    padded = np.pad(points, ((3, 3), (3, 3), (0, 0)), constant_values=np.nan)
    amid, beyond = [], []
    for down, right in ((0, 1), (1, 0)):
        at = {
            k: padded[3 + k * down : 3 + k * down + rows, 3 + k * right : 3 + k * right + columns]
            for k in (-3, -2, -1, 1, 2, 3)
        }
        line = 0.5 * (at[-1] + at[1])
        cubic = (4.0 * (at[-1] + at[1]) - at[-2] - at[2]) / 6.0
        amid.append(np.where(np.isfinite(cubic), cubic, line))
        beyond += [3.0 * (at[k] - at[2 * k]) + at[3 * k] for k in (-1, 1)]
    off, off_beyond = (np.linalg.norm(points - nan_median(np.stack(each)), axis=-1) for each in (amid, beyond))
    return np.asarray(np.where(np.isfinite(off), off, 0.5 * off_beyond))
