"""A polynomial through the points of a grid: how lens and perspective bend it."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre

from gpuvision.camera.pattern import Float64

_DEGREE = 4
# Points for every coefficient, so that one that is off does not bend it much.
_POINTS_PER_TERM = 2


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
