"""Exact area coverage: the part of each cell of a grid that polygons cover."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]

_ROWS_AT_ONCE = 1024  # rows of the grid that are accumulated at once: bounds the memory for the pieces of the sides


def add_coverage(grid: npt.NDArray[np.float32], rings: list[Float64], weight: float) -> None:
    """Add to each cell of a grid a weight times the part of its area that lies inside closed rings.

    Parameters
    ----------
    grid
        (rows, columns); cell (row, column) covers the square from (column, row) to (column + 1, row + 1).
    rings
        Corners (n, 2), x and y in cells, closed from the last to the first corner. Areas count positive inside rings
        that run from the x axis towards the y axis, and negative inside the others (holes): a point counts as often as
        rings wind around it.
    weight
        Factor on the area.

    Notes
    -----
    Each side adds the area between itself and the right border of the grid (Green's theorem). It is cut at the borders
    of the cells; a piece inside one cell adds to that cell the trapezoid on its right, and its height to all cells
    further right, by one cumulative sum over each row. The areas are exact to the rounding of double precision.
    """
    if not rings:
        return
    start = np.concatenate(rings)
    end = np.concatenate([np.roll(each, -1, axis=0) for each in rings])
    sloped = start[:, 1] != end[:, 1]
    start, end = start[sloped], end[sloped]
    low, high = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    for first in range(0, len(grid), _ROWS_AT_ONCE):
        block = grid[first : first + _ROWS_AT_ONCE]
        near = (high > first) & (low < first + len(block))
        if near.any():
            shift = np.array([0.0, first])
            _add_block(block, start[near] - shift, end[near] - shift, weight)


def _add_block(block: npt.NDArray[np.float32], start: Float64, end: Float64, weight: float) -> None:
    """Add the areas to the right of sides (n, 2) to rows of a grid whose first row begins at y = 0."""
    rows, columns = block.shape
    row, x0, x1, height = _cut_at_rows(start, end, rows)
    piece, column, middle, share = _cut_at_columns(np.minimum(x0, x1), np.maximum(x0, x1), columns)
    # Two columns beyond the grid take what does not count. Left of the grid a piece acts like one on its left border.
    inside = np.clip(middle - column, 0.0, 1.0)
    at_left = column < 0
    inside[at_left] = 0.0
    flat = row[piece] * (columns + 2) + np.maximum(column, 0)
    amount = weight * height[piece] * share
    size = rows * (columns + 2)
    steps = np.bincount(flat, amount * (1.0 - inside), size) + np.bincount(flat + 1, amount * inside, size + 1)[:size]
    block += np.cumsum(steps.reshape(rows, columns + 2), axis=1)[:, :columns].astype(np.float32)


def _cut_at_rows(start: Float64, end: Float64, rows: int) -> tuple[npt.NDArray[np.int64], Float64, Float64, Float64]:
    """Cut sides (n, 2) at whole y; return row, x of both ends, and signed height of each piece inside the grid."""
    low, high = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    first = np.maximum(np.floor(low), 0).astype(np.int64)
    count = np.minimum(np.ceil(high), rows).astype(np.int64) - first
    side = np.repeat(np.arange(len(start)), count)
    row = np.arange(len(side)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    below, above = np.maximum(low[side], row), np.minimum(high[side], row + 1)
    slope = (end[:, 0] - start[:, 0]) / (end[:, 1] - start[:, 1])
    x0, x1 = (start[side, 0] + slope[side] * (y - start[side, 1]) for y in (below, above))
    # Sides that run towards smaller y have the polygon on their right: their area counts.
    return row, x0, x1, np.where(end[side, 1] < start[side, 1], above - below, below - above)


def _cut_at_columns(
    low: Float64, high: Float64, columns: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Float64, Float64]:
    """Cut pieces at whole x; return piece, column (-1 left, columns right of the grid), middle x, and share."""
    first, last = (np.clip(np.floor(each), -1, columns).astype(np.int64) for each in (low, high))
    count = last - first + 1
    piece = np.repeat(np.arange(len(low)), count)
    column = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    a = np.where(column < 0, low[piece], np.maximum(low[piece], column))
    b = np.where(column == columns, high[piece], np.minimum(high[piece], column + 1))
    width = (high - low)[piece]
    share = np.divide(b - a, width, out=np.ones_like(width), where=width > 0.0)
    return piece, column, (a + b) / 2, share
