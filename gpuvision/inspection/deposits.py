"""Solder paste deposits in a height map: height, area, volume and offset of each aperture, with standard deviations.

Too much paste leads to short circuits, too little to unstable contacts: F. de Jong, *Range Imaging and Visual Servoing
for industrial applications*, TU Delft 2008, section 1.2.2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt
from scipy.special import ndtr

from gpuvision.inspection.apertures import Aperture, BoardPlacement
from gpuvision.inspection.coverage import covered
from gpuvision.inspection.reference_surface import MAX_ORDER, ReferenceSurface, fit_reference
from gpuvision.inspection.top_height import top_height
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.ranging.regrid import Grid
from gpuvision.validation import finite, integer

_DOUBLINGS = 4  # of the width of the ring, until it has enough cells
_LAGS = 4  # cells up to which the noise is taken for correlated; regridding correlates neighbours. Chosen
_MOST_RINGS = 50  # rings from which the correlation is estimated. Chosen: they have 100 000 cells
_SIGNIFICANT = 3.0  # standard deviations of a correlation that counts, and of a volume that is a deposit
_CLIPPED = 3.0  # residuals beyond this many standard deviations are not noise
_TOP_PATCH = 0.15  # half width of the patch of the largest height, in square roots of the area. Chosen

Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class PasteSettings:
    """Settings of the measurement of solder paste.

    Parameters
    ----------
    stencil : float
        Thickness of the stencil [m], above 0: the expected height of the paste.
    threshold : float, optional
        Height above the board [m] from which on a cell counts to the area. Default: half of the stencil.
    margin : float
        Distance from the aperture [m] up to which paste belongs to it. Default 50 um. Of two apertures, a cell belongs
        to the nearest.
    ring : float
        Width of the ring around the margin [m] in which the board is the reference. Default 0.2 mm; wider where the
        ring has too few cells.
    reference_order : int
        Order of the reference surface, 0 to 2. Default 1: a plane.
    pad_height : float
        Height [m] of the bare pad above the reference surface: copper is higher than laminate, and lower than a solder
        mask that covers the traces around it. Default 0.
    least_valid : float
        Least fraction of cells with a height, above 0, at most 1; below it a deposit is not measured. Default 0.8.
    least_reference : int
        Least number of cells of the reference surface. Default 30.

    Raises
    ------
    ValueError
        A number is out of range.
    """

    stencil: float
    threshold: float | None = None
    margin: float = 50e-6
    ring: float = 0.2e-3
    reference_order: int = 1
    pad_height: float = 0.0
    least_valid: float = 0.8
    least_reference: int = 30

    def __post_init__(self) -> None:
        object.__setattr__(self, "stencil", finite(self.stencil, "PasteSettings.stencil", above=0.0))
        level = self.stencil / 2 if self.threshold is None else self.threshold
        object.__setattr__(self, "threshold", finite(level, "PasteSettings.threshold", above=0.0))
        object.__setattr__(self, "margin", finite(self.margin, "PasteSettings.margin", minimum=0.0))
        object.__setattr__(self, "ring", finite(self.ring, "PasteSettings.ring", above=0.0))
        object.__setattr__(self, "pad_height", finite(self.pad_height, "PasteSettings.pad_height"))
        integer(self.reference_order, "PasteSettings.reference_order", minimum=0, maximum=MAX_ORDER)
        integer(self.least_reference, "PasteSettings.least_reference", minimum=7)
        finite(self.least_valid, "PasteSettings.least_valid", above=0.0, maximum=1.0)

    @property
    def level(self) -> float:
        """Height from which on a cell counts to the area [m]."""
        assert self.threshold is not None  # set by __post_init__
        return self.threshold


class Deposits(NamedTuple):
    """Measured deposits, one for each aperture: arrays (n,). NaN where a deposit is not measured.

    Attributes
    ----------
    names
        Names of the apertures.
    status
        "measured"; "missing" (no volume of 3 standard deviations; it has no offset); "holes" (too few cells with a
        height); "outside" (beyond the height map); "no reference" (no board around it).
    expected_area, expected_volume
        Area of the aperture [m^2]; area times thickness of the stencil [m^3].
    centre : (n, 2)
        Centroid of the aperture in the height map [m].
    area, area_sigma
        Area of the cells above the threshold [m^2].
    volume, volume_sigma
        Volume above the reference surface within the margin [m^3].
    height_mean, height_mean_sigma
        Mean height of the cells above the threshold [m].
    height_max, height_max_sigma
        Height of the highest patch [m].
    offset : (n, 2)
        Centroid of the volume less that of the aperture [m], in the coordinates of the board's files.
    offset_sigma : (n, 2)
        Standard deviations of the offset [m].
    valid
        Fraction of the cells with a height.
    reference
        Height of the reference surface at the centre [m].
    noise
        Standard deviation of the heights [m] that the sigmas use: median over all cells.
    board_scatter
        Robust standard deviation of the board about the reference surfaces [m]: noise and roughness.
    correlation_area
        Number of cells whose noise is common, 1 for independent cells: variances of sums are larger by this factor.
    """

    names: tuple[str, ...]
    status: tuple[str, ...]
    expected_area: Float64
    expected_volume: Float64
    centre: Float64
    area: Float64
    area_sigma: Float64
    volume: Float64
    volume_sigma: Float64
    height_mean: Float64
    height_mean_sigma: Float64
    height_max: Float64
    height_max_sigma: Float64
    offset: Float64
    offset_sigma: Float64
    valid: Float64
    reference: Float64
    noise: float
    board_scatter: float
    correlation_area: float


class _Window(NamedTuple):
    """Part of the height map around an aperture: slices, cells of the aperture, and cells that belong to it."""

    rows: slice
    columns: slice
    core: Bools
    cells: Bools


def measure_deposits(
    z: npt.NDArray[np.floating],
    grid: Grid,
    apertures: Sequence[Aperture],
    placement: BoardPlacement,
    settings: PasteSettings,
    *,
    sigma: float | npt.NDArray[np.floating] | None = None,
    correlation_area: float | None = None,
) -> Deposits:
    """Measure the solder paste of every aperture.

    Parameters
    ----------
    z : numpy.ndarray
        Heights [m], (rows, columns); NaN in holes.
    grid : Grid
        Grid of the heights.
    apertures : sequence of Aperture
        Apertures in the coordinates of the board.
    placement : BoardPlacement
        Place of the board in the height map.
    settings : PasteSettings
        Stencil, margins and reference surface.
    sigma : float or numpy.ndarray, optional
        Random standard deviation of the heights [m]: one for all, or one per cell. Default: the robust standard
        deviation of the board about the reference surfaces, which includes the roughness of the board.
    correlation_area : float, optional
        Number of cells whose noise is common, 1 or more. Default: estimated from the board about the reference
        surfaces, up to 4 cells apart.

    Returns
    -------
    Deposits

    Raises
    ------
    ValueError
        The heights do not have the shape of the grid, or a standard deviation is negative.

    Notes
    -----
    The volume is the sum of all heights above the reference surface within the margin, times the area of a cell:
    a sum without a threshold has no bias by noise. Cells without a height get the mean height of the valid cells of the
    same aperture, or of its margin. The standard deviations contain the noise of the cells and the covariance of the
    reference surface. They do not contain errors that all heights share (scale, calibration), nor the sampling of steep
    walls: a vertical wall of height h and length p changes the volume by up to h p c / 2 with cells of size c, if it is
    parallel to the cells, and by much less otherwise.
    """
    heights = np.asarray(z, np.float64)
    if heights.shape != grid.shape:
        raise ValueError(f"heights have shape {heights.shape}, the grid has {grid.shape}; expected the same")
    moved = [each.moved(placement) for each in apertures]
    windows = aperture_windows(moved, grid, settings.margin)
    free = np.isfinite(heights)
    for window in windows:
        if window is not None:
            free[window.rows, window.columns] &= ~window.cells
    surfaces = [
        None if window is None else _reference(heights, free, grid, window, each, settings)
        for window, each in zip(windows, moved, strict=True)
    ]
    scales = [each.scale for each in surfaces if each is not None]
    estimated = float(np.median(scales)) if scales else math.nan
    sigmas = _sigmas(sigma, estimated, grid)
    if correlation_area is None:
        rings = [
            (heights, free, grid, window, surface, settings)
            for window, surface in zip(windows, surfaces, strict=True)
            if window is not None and surface is not None
        ]
        correlated = _correlation_area(rings[:: max(len(rings) // _MOST_RINGS, 1)])
    else:
        correlated = finite(correlation_area, "correlation_area", minimum=1.0)
    to_board = np.asarray(np.linalg.inv(placement.matrix), np.float64)
    rows = [
        _measure(heights, sigmas, grid, aperture, window, surface, settings, correlated, to_board)
        for aperture, window, surface in zip(moved, windows, surfaces, strict=True)
    ]
    areas = np.array([each.area for each in apertures])
    table = np.array([each[1] for each in rows]).reshape(-1, 14)
    known = sigmas[free] if free.any() else sigmas
    return Deposits(
        names=tuple(each.name for each in apertures),
        status=tuple(each[0] for each in rows),
        expected_area=areas,
        expected_volume=areas * settings.stencil,
        centre=np.array([each.centroid for each in moved]).reshape(-1, 2),
        area=table[:, 0],
        area_sigma=table[:, 1],
        volume=table[:, 2],
        volume_sigma=table[:, 3],
        height_mean=table[:, 4],
        height_mean_sigma=table[:, 5],
        height_max=table[:, 6],
        height_max_sigma=table[:, 7],
        offset=table[:, 8:10],
        offset_sigma=table[:, 10:12],
        valid=table[:, 12],
        reference=table[:, 13],
        noise=float(np.median(known)),
        board_scatter=estimated,
        correlation_area=correlated,
    )


def _sigmas(sigma: float | npt.NDArray[np.floating] | None, estimated: float, grid: Grid) -> Float64:
    return complete_sigmas(np.asarray(estimated if sigma is None else sigma, np.float64), grid.shape)


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


def aperture_windows(apertures: Sequence[Aperture], grid: Grid, margin: float) -> list[_Window | None]:
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
    windows: list[_Window | None] = []
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
        windows.append(_Window(rows, columns, core, cells) if core.any() else None)
    return windows


def cells_of(bounds: Float64, grid: Grid, margin: float) -> tuple[slice, slice]:
    """Return the rows and columns whose centres lie in bounds (2, 2) [m] with a margin."""
    low, high = bounds[0] - margin, bounds[1] + margin
    first = max(math.ceil((low[0] - grid.left) / grid.cell_x), 0)
    last = min(math.floor((high[0] - grid.left) / grid.cell_x), grid.columns - 1)
    top = max(math.ceil((grid.top - high[1]) / grid.cell_y), 0)
    bottom = min(math.floor((grid.top - low[1]) / grid.cell_y), grid.rows - 1)
    return slice(top, max(bottom + 1, top)), slice(first, max(last + 1, first))


def _reference(
    z: Float64, free: Bools, grid: Grid, window: _Window, aperture: Aperture, settings: PasteSettings
) -> ReferenceSurface | None:
    """Return the surface through the board in a ring around an aperture, wider where it has too few cells."""
    ring = settings.ring
    for _ in range(_DOUBLINGS + 1):
        rows, columns = cells_of(aperture.bounds, grid, settings.margin + ring)
        row, column = np.nonzero(free[rows, columns])
        if len(row) >= settings.least_reference:
            x, y = grid.x[columns][column], grid.y[rows][row]
            return fit_reference(x, y, z[rows, columns][row, column], settings.reference_order)
        ring *= 2
    return None


def _correlation_area(
    rings: Sequence[tuple[Float64, Bools, Grid, _Window, ReferenceSurface, PasteSettings]],
) -> float:
    """Return the sum of the correlations of the noise of a cell with all cells up to 4 cells away, 1 or more."""
    lags = [(row, column) for row in range(_LAGS + 1) for column in range(-_LAGS, _LAGS + 1) if (row, column) > (0, 0)]
    products, counts = np.zeros(len(lags)), np.zeros(len(lags))
    variance = total = 0.0
    for z, free, grid, window, surface, settings in rings:
        if surface.scale <= 0:
            continue
        reach = math.ceil((settings.margin + settings.ring) / min(grid.cell_x, grid.cell_y))
        rows = slice(max(window.rows.start - reach, 0), window.rows.stop + reach)
        columns = slice(max(window.columns.start - reach, 0), window.columns.stop + reach)
        residual = (z[rows, columns] - surface.heights(*np.meshgrid(grid.x[columns], grid.y[rows]))) / surface.scale
        used = free[rows, columns] & (np.abs(residual) <= _CLIPPED)
        values = np.where(used, residual, 0.0)
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


def _measure(
    z: Float64,
    sigmas: Float64,
    grid: Grid,
    aperture: Aperture,
    window: _Window | None,
    surface: ReferenceSurface | None,
    settings: PasteSettings,
    correlated: float,
    to_board: Float64,
) -> tuple[str, list[float]]:
    """Return the status of a deposit, and its numbers in the order of the fields of `Deposits` from ``area`` on."""
    nothing = [math.nan] * 12
    if window is None:
        return "outside", [*nothing, 0.0, math.nan]
    if surface is None:
        return "no reference", [*nothing, math.nan, math.nan]
    part = z[window.rows, window.columns]
    level = float(surface.heights(aperture.centroid[:1], aperture.centroid[1:])[0]) + settings.pad_height
    used = window.cells & np.isfinite(part)
    strata = [window.core, window.cells & ~window.core]
    valid = float(np.count_nonzero(used) / np.count_nonzero(window.cells))
    if any(np.count_nonzero(used & each) < settings.least_valid * np.count_nonzero(each) for each in strata):
        return "holes", [*nothing, valid, level]
    share = np.zeros(part.shape)
    for each in strata:
        share[used & each] = int(np.count_nonzero(each)) / max(int(np.count_nonzero(used & each)), 1)
    row, column = np.nonzero(used)
    x, y = grid.x[window.columns][column], grid.y[window.rows][row]
    weight, basis = share[used], surface.basis(x, y)
    height = part[used] - surface.coefficients @ basis - settings.pad_height
    noise = np.maximum(sigmas[window.rows, window.columns][used], np.finfo(np.float64).tiny)
    covariance = correlated * surface.covariance
    cell = grid.cell_x * grid.cell_y

    def variance(own: Float64, gradient: Float64) -> float:
        """Return the variance of a sum: of its cells, and of the reference surface through the gradient."""
        return float(correlated * np.sum(own) + gradient @ covariance @ gradient)

    volume = cell * float(np.sum(weight * height))
    volume_sigma = cell * math.sqrt(variance((weight * noise) ** 2, basis @ weight))
    # A cell counts with the probability that its height with noise exceeds the threshold.
    above = height > settings.level
    ratio = np.clip((settings.level - height) / noise, -40.0, 40.0)
    chance, density = ndtr(-ratio), np.exp(-(ratio**2) / 2) / math.sqrt(2 * math.pi)
    crossing = basis @ (weight * density / noise)  # change of the count with the reference surface
    count = float(np.sum(weight[above]))
    area_sigma = cell * math.sqrt(variance(weight**2 * chance * (1 - chance), crossing))
    mean = float(np.sum((weight * height)[above]) / count) if count else math.nan
    mean_sigma = math.nan
    if count:
        # Moments of (height - mean) of a cell if it exceeds the threshold, and 0 otherwise (truncated normal).
        centred = height - mean
        first = centred * chance + noise * density
        second = centred**2 * chance + 2 * centred * noise * density + noise**2 * (chance + ratio * density)
        gradient = -(basis @ (weight * above)) - (settings.level - mean) * crossing
        mean_sigma = math.sqrt(variance(weight**2 * np.maximum(second - first**2, 0.0), gradient)) / count
    measured = np.full(part.shape, math.nan)
    measured[used] = height
    half = max(round(_TOP_PATCH * math.sqrt(aperture.area) / math.sqrt(cell)), 1)
    spread = np.full(part.shape, 0.0)
    spread[used] = noise
    top = top_height(measured, window.cells, spread, half)
    at_top = surface.basis(*aperture.centroid[:, None])[:, 0]
    top_sigma = math.sqrt(correlated * top.sigma**2 + at_top @ covariance @ at_top)
    offset, offset_sigma = np.full(2, math.nan), np.full(2, math.nan)
    status = "missing"
    if volume > _SIGNIFICANT * volume_sigma:
        status = "measured"
        total = float(np.sum(weight * height))
        place = np.stack([x, y]) - aperture.centroid[:, None]
        centre = place @ (weight * height) / total
        arms = to_board @ (place - centre[:, None]) * weight / total
        offset = to_board @ centre
        offset_sigma = np.sqrt([variance((arm * noise) ** 2, basis @ arm) for arm in arms])
    numbers = [cell * count, area_sigma, volume, volume_sigma, mean, mean_sigma, top.height, top_sigma]
    return status, [*numbers, *offset, *offset_sigma, valid, level]
