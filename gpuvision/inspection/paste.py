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

from gpuvision.host import Device, Precision, to_numpy
from gpuvision.inspection import height_noise
from gpuvision.inspection.aperture_cells import Bools, Window, aperture_windows, cells_of, owner_map
from gpuvision.inspection.apertures import Aperture, BoardPlacement
from gpuvision.inspection.deposits import DepositSums, MeasureDeposits, deposit_boxes, deposit_surfaces
from gpuvision.inspection.reference_surface import MAX_ORDER, ReferenceSurface, fit_reference
from gpuvision.inspection.top_height import top_height
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.ranging.regrid import Grid
from gpuvision.status import Status
from gpuvision.validation import finite, integer

_DOUBLINGS = 4  # of the width of the ring, until it has enough cells
_MOST_RINGS = 50  # rings from which the correlation is estimated. Chosen: they have 100 000 cells
_TOP_PATCH = 0.15  # half width of the patch of the largest height, in square roots of the area. Chosen
_STATUS = {Status.OK: "measured", Status.LOW_SIGNAL: "missing", Status.NO_DATA: "holes"}


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
        Centroid of the volume minus centroid of the aperture [m], in the coordinates of the board's files.
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


def measure_deposits(
    z: npt.NDArray[np.floating],
    grid: Grid,
    apertures: Sequence[Aperture],
    placement: BoardPlacement,
    settings: PasteSettings,
    *,
    sigma: float | npt.NDArray[np.floating] | None = None,
    correlation_area: float | None = None,
    precision: Precision = None,
    device: Device | None = None,
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
    precision : {"single", "double", None}
        Precision of the sums; None: double where the device has it. The reference surfaces and the highest patches are
        always computed in double precision.
    device : Device, optional
        Where to run. Default `Device.best`.

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
    noise = np.asarray(estimated if sigma is None else sigma, np.float64)
    sigmas = height_noise.complete_sigmas(noise, grid.shape)
    known = [
        _Known(number, aperture, window, surface)
        for number, (aperture, window, surface) in enumerate(zip(moved, windows, surfaces, strict=True))
        if window is not None and surface is not None
    ]
    correlated = _correlation_area(heights, free, grid, known, settings, correlation_area)
    job = _Job(heights, sigmas, grid, settings, correlated, placement)
    sums = _sums(job, known, precision, device)
    statuses = ["outside" if each is None else "no reference" for each in windows]
    for each, flags in zip(known, sums.pop("status"), strict=True):
        statuses[each.number] = _STATUS[Status(int(flags))]
    tops, references = _tops_and_references(job, known, statuses)
    valid = _spread(sums.pop("valid"), known, [0.0 if each is None else math.nan for each in windows])
    return _deposits(apertures, moved, settings, known, sums, tops, references)._replace(
        status=tuple(statuses),
        valid=valid,
        noise=float(np.median(sigmas[free] if free.any() else sigmas)),
        board_scatter=estimated,
        correlation_area=correlated,
    )


class _Known(NamedTuple):
    """An aperture in the height map with its cells and its reference surface; its number among all apertures."""

    number: int
    aperture: Aperture
    window: Window
    surface: ReferenceSurface


class _Job(NamedTuple):
    """Height map with its standard deviations, and how it is measured."""

    z: Float64
    sigmas: Float64
    grid: Grid
    settings: PasteSettings
    correlated: float
    placement: BoardPlacement


def _reference(
    z: Float64, free: Bools, grid: Grid, window: Window, aperture: Aperture, settings: PasteSettings
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
    z: Float64, free: Bools, grid: Grid, known: Sequence[_Known], settings: PasteSettings, given: float | None
) -> float:
    """Return the given number of cells whose noise is common, or the number that the board shows."""
    if given is not None:
        return finite(given, "correlation_area", minimum=1.0)
    width = settings.margin + settings.ring
    rings = [height_noise.Ring(each.window, each.surface, width) for each in known]
    return height_noise.correlation_area(z, free, grid, rings[:: max(len(rings) // _MOST_RINGS, 1)])


def _sums(job: _Job, known: Sequence[_Known], precision: Precision, device: Device | None) -> dict[str, Float64]:
    """Measure area, volume, mean height and offset of the apertures on the device, as float64 arrays."""
    if not known:
        return {name: np.empty((0, 2) if "offset" in name else 0) for name in DepositSums._fields}
    grid, settings = job.grid, job.settings
    windows = [each.window for each in known]
    device = Device.best() if device is None else device
    is_double = device.has_double if precision is None else precision == "double"
    real = np.float64 if is_double else np.float32
    surfaces = deposit_surfaces(
        [each.surface for each in known],
        windows,
        grid,
        np.array([each.aperture.centroid for each in known]),
        settings.pad_height,
    )
    operation = MeasureDeposits(
        apertures=len(known),
        cell_area=grid.cell_x * grid.cell_y,
        threshold=settings.level,
        correlation_area=job.correlated,
        least_valid=settings.least_valid,
        to_board=np.linalg.inv(job.placement.matrix),
    )
    sigmas = np.maximum(job.sigmas, np.finfo(real).tiny)
    sums = operation(
        job.z.astype(real),
        sigmas.astype(real),
        owner_map(windows, grid.shape),
        deposit_boxes(windows),
        surfaces.astype(real),
        device=device,
    )
    return {name: np.asarray(to_numpy(values), np.float64) for name, values in sums._asdict().items()}


def _tops_and_references(
    job: _Job, known: Sequence[_Known], statuses: Sequence[str]
) -> tuple[list[tuple[float, float]], list[float]]:
    """Return the height of the highest patch with its standard deviation, and the height of the board, of each."""
    grid, settings = job.grid, job.settings
    tops, references = [], []
    for each in known:
        aperture, window, surface = each.aperture, each.window, each.surface
        references.append(float(surface.heights(aperture.centroid[:1], aperture.centroid[1:])[0]) + settings.pad_height)
        if statuses[each.number] == "holes":
            tops.append((math.nan, math.nan))
            continue
        x, y = np.meshgrid(grid.x[window.columns], grid.y[window.rows])
        height = job.z[window.rows, window.columns] - surface.heights(x, y) - settings.pad_height
        half = max(round(_TOP_PATCH * math.sqrt(aperture.area / (grid.cell_x * grid.cell_y))), 1)
        spread = job.sigmas[window.rows, window.columns]
        top = top_height(np.where(window.cells, height, math.nan), window.cells, spread, half)
        basis = surface.basis(*aperture.centroid[:, None])[:, 0]
        variance = job.correlated * (top.sigma**2 + float(basis @ surface.covariance @ basis))
        tops.append((top.height, math.sqrt(variance)))
    return tops, references


def _spread(values: npt.ArrayLike, known: Sequence[_Known], others: Sequence[float]) -> Float64:
    """Return values of all apertures, (n, ...), from the values of the known ones and of the others."""
    given = np.asarray(values, np.float64)
    spread = np.empty((len(others), *given.shape[1:]))
    spread[:] = np.asarray(others, np.float64).reshape(-1, *([1] * (given.ndim - 1)))
    spread[[each.number for each in known]] = given
    return spread


def _deposits(
    apertures: Sequence[Aperture],
    moved: Sequence[Aperture],
    settings: PasteSettings,
    known: Sequence[_Known],
    sums: dict[str, Float64],
    tops: Sequence[tuple[float, float]],
    references: Sequence[float],
) -> Deposits:
    """Return the deposits of all apertures, NaN where a deposit is not measured; the caller completes the result."""
    areas = np.array([each.area for each in apertures])
    unknown = [math.nan] * len(apertures)
    top = np.array(tops).reshape(-1, 2)
    own = {name: _spread(values, known, unknown) for name, values in sums.items()}
    return Deposits(
        names=tuple(each.name for each in apertures),
        status=(),
        expected_area=areas,
        expected_volume=areas * settings.stencil,
        centre=np.array([each.centroid for each in moved]).reshape(-1, 2),
        height_max=_spread(top[:, 0], known, unknown),
        height_max_sigma=_spread(top[:, 1], known, unknown),
        reference=_spread(np.array(references), known, unknown),
        valid=np.array(unknown),
        noise=math.nan,
        board_scatter=math.nan,
        correlation_area=math.nan,
        **own,
    )
