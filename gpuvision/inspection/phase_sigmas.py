"""Standard deviations of deposits by an error of the heights that neighbouring cells share: the phase of the line.

The error by the place of a laser line in its pixel is the same along whole profiles, and over half a pixel of the
line's movement, which may be hundreds of cells. It does not average out over a deposit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gpuvision.inspection.aperture_cells import Bools, Window
from gpuvision.inspection.apertures import BoardPlacement
from gpuvision.inspection.height_noise import complete_sigmas
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.ranging.height_map import Grid

# A height above the board is a difference: the phase of the deposit and the phase of the board are independent.
_DIFFERENCE = math.sqrt(2.0)


class PhaseSigmas(NamedTuple):
    """Standard deviations of a deposit by the phase, in SI units; ``offset`` has two values, along x and y."""

    volume: float
    area: float
    height_mean: float
    height_max: float
    offset: Float64


def complete_phase(phase: Float64 | None, shape: tuple[int, int]) -> Float64 | None:
    """Return the sigmas of all cells as `complete_sigmas`; None without a known one."""
    if phase is None or not np.isfinite(phase).any():
        return None
    return complete_sigmas(phase, shape)


def common_sigma(phase: Float64, cells: Bools) -> float:
    """Return the root mean square of the sigmas of cells: the sigma of their common error [m]; NaN without a cell."""
    return math.sqrt(float(np.mean(phase[cells] ** 2))) if cells.any() else math.nan


def phase_sigmas(
    height: Float64,
    phase: Float64,
    grid: Grid,
    window: Window,
    placement: BoardPlacement,
    *,
    threshold: float,
    volume: float,
    centroid: Float64,
) -> PhaseSigmas:
    """Return the standard deviations of a deposit by an error that all its cells share.

    Parameters
    ----------
    height : numpy.ndarray
        Heights of the window above the reference surface [m], (rows, columns); NaN in holes.
    phase : numpy.ndarray
        Standard deviations of the error of the window's cells [m], (rows, columns).
    grid : Grid
        Grid of the height map.
    window : Window
        Cells of the deposit.
    placement : BoardPlacement
        Place of the board; offsets are in its coordinates.
    threshold : float
        Height from which on a cell counts to the area [m].
    volume : float
        Volume of the deposit [m^3].
    centroid : numpy.ndarray
        Centroid of the volume in the height map [m], (2,); NaN if the deposit has no offset.

    Notes
    -----
    For a sum ``sum(g e)`` of N cells with errors e of root mean square s the bound of Cauchy and Schwarz is
    ``s sqrt(N sum(g^2))``, for any correlation of the errors. It is attained by an error that is proportional to the
    weights g; for a volume by an error that all cells share. The reference surface of order 0 or 1 has at most the same
    error; its phase is independent of the deposit's. The area changes by the cells within one sigma of the threshold.
    """
    sigma = _DIFFERENCE * common_sigma(phase, window.cells)
    cell = grid.cell_x * grid.cell_y
    inside = window.cells & np.isfinite(height)
    near = np.count_nonzero(inside & (np.abs(height - threshold) <= sigma))
    places = np.stack(np.meshgrid(grid.x[window.columns], grid.y[window.rows]), axis=-1)[window.cells]
    away = (places - centroid) @ np.linalg.inv(placement.matrix).T
    moment = len(places) * np.sqrt(np.mean(away**2, axis=0)) * cell
    return PhaseSigmas(
        volume=sigma * len(places) * cell,
        area=0.5 * near * cell,
        height_mean=sigma,
        height_max=sigma,
        offset=sigma * moment / abs(volume) if volume else np.full(2, math.nan),
    )
