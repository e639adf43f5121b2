"""Families of measured lines, the input of a straight-line calibration.

A family is a set of lines that are parallel in the scene: their undistorted images meet in one vanishing point (F. de
Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 3.3.5). A line is an array
of measured points (column, row), in order along the line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
LineFamilies = Sequence[Sequence[npt.ArrayLike]]

_MIN_POINTS = 3
"""Least number of points of a line. Derived: two points are always straight."""
_MIN_EXTENT = 1e-7
"""Standard deviation [half-diagonals] of the points of a line, below which they coincide. Derived: above rounding."""


def grid_lines(points: npt.ArrayLike, *, diagonals: bool = False) -> tuple[tuple[Float64, ...], ...]:
    """Return the lines of a grid of measured points, without missing points.

    Parameters
    ----------
    points : array_like
        (rows, columns, 2): measured (column, row) [px]; NaN where missing.
    diagonals : bool
        Include both families of diagonals, which are parallel in the scene as well. Default False.

    Returns
    -------
    tuple
        Families: the rows, the columns and, if requested, both diagonals. Lines of fewer than three points are omitted.

    Raises
    ------
    ValueError
        The array has another shape.
    """
    grid = np.asarray(points, dtype=np.float64)
    if grid.ndim != 3 or grid.shape[2] != 2:
        raise ValueError(f"grid points have shape {grid.shape}, expected (rows, columns, 2)")
    arrays = [grid, grid.swapaxes(0, 1)]
    if diagonals:
        arrays += [_diagonals(grid), _diagonals(grid[::-1])]
    return tuple(_family(array) for array in arrays)


def _diagonals(grid: Float64) -> Float64:
    """Return the diagonals as rows, padded with NaN."""
    rows, columns = grid.shape[:2]
    sheared = np.full((rows + columns - 1, rows, 2), np.nan)
    row, column = np.indices((rows, columns))
    sheared[column - row + rows - 1, row] = grid
    return sheared


def _family(array: Float64) -> tuple[Float64, ...]:
    finite = np.isfinite(array[..., 0] + array[..., 1])
    return tuple(line[kept] for line, kept in zip(array, finite, strict=True) if np.count_nonzero(kept) >= _MIN_POINTS)


@dataclass(frozen=True)
class PackedLines:
    """Points of all lines in one array, in normalised coordinates.

    Attributes
    ----------
    x, y
        Coordinates (n,): (pixel - origin) / unit; the points of a line are contiguous.
    line
        Index of each point's line (n,).
    starts, counts
        Index of the first point and number of points of each line (lines,).
    family
        Index of each line's family (lines,); the lines of a family are contiguous.
    family_starts
        Index of the first line of each family that is not empty.
    families
        Number of families.
    origin, unit
        Centre of the points' bounding box (2,) and half its diagonal [px].
    corner
        Half the size of the bounding box (2,), in units.
    used
        Mask over all input points, line by line: the points that are packed.
    """

    x: Float64
    y: Float64
    line: Index
    starts: Index
    counts: Index
    family: Index
    family_starts: Index
    families: int
    origin: Float64
    unit: float
    corner: Float64
    used: npt.NDArray[np.bool_]

    def sums(self, values: Float64) -> Float64:
        """Return the sums of values (..., n) over each line, (..., lines)."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=-1))


def pack(given: LineFamilies) -> PackedLines:
    """Check families of lines and pack their points.

    Raises
    ------
    TypeError
        A line is no array of numbers.
    ValueError
        No line has three finite points, or the points of a line coincide.
    """
    lines = [np.asarray(line, dtype=np.float64) for family in given for line in family]
    owner = np.repeat(np.arange(len(given)), [len(family) for family in given])
    if not lines:
        raise ValueError("there are no lines; expected families of lines of at least three points")
    if any(line.ndim != 2 or line.shape[1] != 2 for line in lines):
        shape = next(line.shape for line in lines if line.ndim != 2 or line.shape[1] != 2)
        raise ValueError(f"a line has shape {shape}, expected (points, 2)")
    counts = np.array([len(line) for line in lines])
    places = np.concatenate(lines)
    finite = np.isfinite(places[:, 0] + places[:, 1])
    line = np.repeat(np.arange(len(lines)), counts)
    if not finite.all():
        places, line = places[finite], line[finite]
        counts = np.bincount(line, minlength=len(lines))
    if counts.min() < _MIN_POINTS:
        kept = counts >= _MIN_POINTS
        chosen = kept[line]
        finite[finite] = chosen
        places, line = places[chosen], (np.cumsum(kept) - 1)[line[chosen]]
        counts, owner = counts[kept], owner[kept]
    if not len(places):
        raise ValueError("no line has three finite points; two points are straight however the lens bends")
    return _normalised(places, line, counts, owner, len(given), finite)


def _normalised(
    places: Float64, line: Index, counts: Index, family: Index, families: int, used: npt.NDArray[np.bool_]
) -> PackedLines:
    x, y = places.T.copy()
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    unit = 0.5 * float(np.hypot(*(high - low)))
    origin = 0.5 * (low + high)
    if not unit > 0.0:
        raise ValueError("all points lie on one place; expected lines across the image")
    x, y = (x - origin[0]) / unit, (y - origin[1]) / unit
    starts = np.cumsum(counts) - counts
    family_starts = np.flatnonzero(np.diff(family, prepend=-1))
    corner = 0.5 * (high - low) / unit
    packed = PackedLines(x, y, line, starts, counts, family, family_starts, families, origin, unit, corner, used)
    spread = packed.sums(x * x + y * y) / counts - (packed.sums(x) / counts) ** 2 - (packed.sums(y) / counts) ** 2
    if spread.min() < _MIN_EXTENT**2:
        raise ValueError(f"all points of line {int(np.argmin(spread))} lie on one place; expected points along it")
    return packed
