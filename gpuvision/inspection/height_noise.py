"""Standard deviations of the cells of a height map, and the correlation of their noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gpuvision.inspection.aperture_cells import Bools, Window
from gpuvision.inspection.reference_surface import ReferenceSurface
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.ranging.height_map import Grid

_LAGS = 4  # cells up to which the noise is taken for correlated; regridding correlates neighbours. Chosen
_SIGNIFICANT = 3.0  # standard deviations of a correlation that counts
_CLIPPED = 3.0  # residuals beyond this many standard deviations are not noise


class Ring(NamedTuple):
    """Board around an aperture: its window, its reference surface, and the width of the board around the window [m]."""

    window: Window
    surface: ReferenceSurface
    width: float


def complete_sigmas(sigma: Float64, shape: tuple[int, int]) -> Float64:
    """Return standard deviations of all cells: unknown ones (NaN) are the median of the known ones.

    Parameters
    ----------
    sigma : numpy.ndarray
        One standard deviation, or one per cell.
    shape : tuple of int
        Shape of the height map.

    Raises
    ------
    ValueError
        A standard deviation is negative, or the standard deviations have another shape.
    """
    if sigma.shape not in ((), shape):
        raise ValueError(f"sigma has shape {sigma.shape}, the grid has {shape}; expected the same, or one number")
    if np.any(sigma < 0):
        raise ValueError("sigma is negative, expected standard deviations [m]")
    known = np.isfinite(sigma)
    level = float(np.median(sigma[known])) if known.any() else math.nan
    return np.broadcast_to(np.where(known, sigma, level), shape)


def correlation_area(z: Float64, free: Bools, grid: Grid, rings: Sequence[Ring]) -> float:
    """Return the sum of the correlations of the noise of a cell with all cells up to 4 cells away, 1 or more.

    Parameters
    ----------
    z : numpy.ndarray
        Heights (rows, columns) [m].
    free : numpy.ndarray
        bool (rows, columns): valid cells of the board.
    grid : Grid
        Grid of the heights.
    rings : sequence of Ring
        Parts of the board about their reference surfaces.
    """
    lags = [(row, column) for row in range(_LAGS + 1) for column in range(-_LAGS, _LAGS + 1) if (row, column) > (0, 0)]
    products, counts = np.zeros(len(lags)), np.zeros(len(lags))
    variance = total = 0.0
    for ring in rings:
        if ring.surface.scale <= 0:
            continue
        values, used = _residuals(z, free, grid, ring)
        variance += float(np.sum(values**2))
        total += float(np.count_nonzero(used))
        for index, (row, column) in enumerate(lags):
            one = (slice(0, values.shape[0] - row), slice(max(-column, 0), values.shape[1] - max(column, 0)))
            other = (slice(row, None), slice(max(column, 0), values.shape[1] - max(-column, 0)))
            products[index] += float(np.sum(values[one] * values[other]))
            counts[index] += float(np.count_nonzero(used[one] & used[other]))
    if not variance > 0:
        return 1.0
    correlation = products / np.maximum(counts, 1) / (variance / total)
    correlation[np.abs(correlation) < _SIGNIFICANT / np.sqrt(np.maximum(counts, 1))] = 0.0
    return max(1.0 + 2.0 * float(np.sum(correlation)), 1.0)


def _residuals(z: Float64, free: Bools, grid: Grid, ring: Ring) -> tuple[Float64, Bools]:
    """Return the heights above the surface in its standard deviations, 0 for cells that are not used, and the used."""
    window, surface = ring.window, ring.surface
    reach = math.ceil(ring.width / min(grid.cell_x, grid.cell_y))
    rows = slice(max(window.rows.start - reach, 0), window.rows.stop + reach)
    columns = slice(max(window.columns.start - reach, 0), window.columns.stop + reach)
    residual = (z[rows, columns] - surface.heights(*np.meshgrid(grid.x[columns], grid.y[rows]))) / surface.scale
    used = free[rows, columns] & (np.abs(residual) <= _CLIPPED)
    return np.where(used, residual, 0.0), used
