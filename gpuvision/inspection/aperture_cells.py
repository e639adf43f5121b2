"""Cells of a height map that belong to the apertures of a stencil."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from gpuvision.inspection.apertures import Aperture
from gpuvision.inspection.coverage import covered
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.ranging.height_map import Grid

Bools = npt.NDArray[np.bool_]


class Window(NamedTuple):
    """Part of the height map around an aperture: slices, cells of the aperture, and cells that belong to it."""

    rows: slice
    columns: slice
    core: Bools
    cells: Bools


def aperture_windows(apertures: Sequence[Aperture], grid: Grid, margin: float) -> list[Window | None]:
    """Return the cells that belong to each aperture: at most a margin away, and nearer to it than to any other.

    Parameters
    ----------
    apertures : sequence of Aperture
        Apertures in the coordinates of the height map.
    grid : Grid
        Grid of the height map.
    margin : float
        Largest distance from the aperture [m].

    Returns
    -------
    list
        None where the aperture with its margin is not within the height map, or has no cell.
    """
    x, y = grid.x, grid.y
    owner = np.zeros(grid.shape, np.int32)
    boxes = []
    for number, aperture in enumerate(apertures, 1):
        rows, columns = cells_of(aperture.bounds, grid, 0.0)
        inside = covered(aperture.shapes, x[columns], y[rows])
        owner[rows, columns][inside] = number
        low, high = aperture.bounds
        fits = low[0] - margin >= x[0] - grid.cell_x / 2 and high[0] + margin <= x[-1] + grid.cell_x / 2
        fits &= low[1] - margin >= y[-1] - grid.cell_y / 2 and high[1] + margin <= y[0] + grid.cell_y / 2
        boxes.append(bool(fits) and bool(inside.any()))
    windows: list[Window | None] = []
    for number, (aperture, fits) in enumerate(zip(apertures, boxes, strict=True), 1):
        if not fits:
            windows.append(None)
            continue
        # Cells up to twice the margin away: the nearest aperture of a cell within the margin is not farther.
        rows, columns = cells_of(aperture.bounds, grid, 2 * margin + 2 * max(grid.cell_x, grid.cell_y))
        near = owner[rows, columns]
        core = near == number
        distance, place = distance_transform_edt(near == 0, sampling=(grid.cell_y, grid.cell_x), return_indices=True)
        cells = (near[tuple(place)] == number) & (distance <= margin)
        windows.append(Window(rows, columns, core, cells) if core.any() else None)
    return windows


def cells_of(bounds: Float64, grid: Grid, margin: float) -> tuple[slice, slice]:
    """Return the rows and columns whose centres lie in bounds (2, 2) [m] with a margin."""
    low, high = bounds[0] - margin, bounds[1] + margin
    first = max(math.ceil((low[0] - grid.left) / grid.cell_x), 0)
    last = min(math.floor((high[0] - grid.left) / grid.cell_x), grid.columns - 1)
    top = max(math.ceil((grid.top - high[1]) / grid.cell_y), 0)
    bottom = min(math.floor((grid.top - low[1]) / grid.cell_y), grid.rows - 1)
    return slice(top, max(bottom + 1, top)), slice(first, max(last + 1, first))


def owner_map(windows: Sequence[Window | None], shape: tuple[int, int]) -> npt.NDArray[np.int32]:
    """Return the number of the window that each cell belongs to, as `gpuvision.MeasureDeposits` takes it.

    Parameters
    ----------
    windows : sequence of Window or None
        Result of `aperture_windows`; None is skipped, and counts.
    shape : tuple of int
        Shape of the height map.

    Returns
    -------
    numpy.ndarray
        int32 (rows, columns): k + 1 for the cells of aperture k, -k - 1 for the cells of its margin, 0 for others.
    """
    owner = np.zeros(shape, np.int32)
    for number, window in enumerate(windows, 1):
        if window is not None:
            part = owner[window.rows, window.columns]
            part[window.cells] = np.where(window.core, number, -number)[window.cells]
    return owner
