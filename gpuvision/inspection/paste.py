"""Solder paste deposits in a height map: height, area, volume and offset of each aperture, with standard deviations.

Too much paste leads to short circuits, too little to unstable contacts: F. de Jong, *Range Imaging and Visual Servoing
for industrial applications*, TU Delft 2008, section 1.2.2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Precision, to_numpy
from gpuvision.inspection import height_noise
from gpuvision.inspection.aperture_cells import Bools, Window, aperture_windows, cells_of, owner_map
from gpuvision.inspection.apertures import Aperture, BoardPlacement
from gpuvision.inspection.deposits import DepositSums, MeasureDeposits, deposit_boxes, deposit_surfaces
from gpuvision.inspection.phase_sigmas import complete_phase, phase_sigmas
from gpuvision.inspection.reference_surface import MAX_ORDER, ReferenceSurface, fit_reference
from gpuvision.inspection.top_height import top_height
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.ranging.height_map import Grid
from gpuvision.status import Status
from gpuvision.validation import finite, integer

_DOUBLINGS = 4  # of the width of the ring, until it has enough cells
_MOST_RINGS = 50  # rings from which the correlation is estimated. Chosen: they have 100 000 cells
_TOP_PATCH = 0.15  # half width of the patch of the largest height, in square roots of the area. Chosen
_SIGNIFICANCE = 3.0  # standard deviations of the volume from which on a deposit has an offset
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
        Range: above 0.
    margin : float
        Distance from the aperture [m] up to which paste belongs to it. Default 50 um. Of two apertures, a cell belongs
        to the nearest. Range: 0 or more.
    ring : float
        Width of the ring around the margin [m] in which the board is the reference. Default 0.2 mm; wider where the
        ring has too few cells. Range: above 0.
    reference_order : int
        Order of the reference surface, 0 to 2. Default 1: a plane.
    pad_height : float
        Height [m] of the bare pad above the reference surface: copper is higher than laminate, and lower than a solder
        mask that covers the traces around it. Default 0.
    least_valid : float
        Least fraction of cells with a height, above 0, at most 1; below it a deposit is not measured. Default 0.8.
    least_reference : int
        Least number of cells of the reference surface. Default 30. Range: 7 or more.

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
        Standard deviation of the heights [m] that the sigmas use, with the phase: median over all cells.
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
    phase: npt.NDArray[np.floating] | None = None,
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
    phase : numpy.ndarray, optional
        Standard deviation of an error that neighbouring cells share [m], one per cell, NaN where it is unknown: of the
        phase of a laser line in its pixel. Default: none.
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

    The phase counts as one error of all cells of a deposit, and one error of its reference, independent of each other:
    an upper bound of the standard deviation for reference surfaces of order 0 and 1. See
    `gpuvision.inspection.phase_sigmas.phase_sigmas`.
    """
    heights = np.asarray(z, np.float64)
    if heights.shape != grid.shape:
        raise ValueError(f"heights have shape {heights.shape}, the grid has {grid.shape}; expected the same")
    board = _measure_board(heights, grid, [each.moved(placement) for each in apertures], settings)
    noise = np.asarray(board.scatter if sigma is None else sigma, np.float64)
    job = _Job(
        heights,
        height_noise.complete_sigmas(noise, grid.shape),
        complete_phase(None if phase is None else np.asarray(phase, np.float64), grid.shape),
        grid,
        settings,
        _correlation_area(heights, grid, board, settings, correlation_area),
        placement,
    )
    sums = _sums(job, board.known, precision, device)
    _add_phase(sums, job, board.known)
    return _deposits(apertures, job, board, sums)


class _Known(NamedTuple):
    """An aperture in the height map with its cells and its reference surface; its number among all apertures."""

    number: int
    aperture: Aperture
    window: Window
    surface: ReferenceSurface


class _Board(NamedTuple):
    """Board around the apertures.

    ``apertures`` and their ``windows`` (None: outside) in the height map, (rows, columns) which cells are ``free`` of
    paste, the ``known`` apertures, which have a reference surface, and the median ``scatter`` about these surfaces [m].
    """

    apertures: Sequence[Aperture]
    windows: Sequence[Window | None]
    free: Bools
    known: Sequence[_Known]
    scatter: float


class _Job(NamedTuple):
    """Height map with its standard deviations, and how it is measured."""

    z: Float64
    sigmas: Float64
    phases: Float64 | None
    grid: Grid
    settings: PasteSettings
    correlated: float
    placement: BoardPlacement


def _measure_board(z: Float64, grid: Grid, apertures: Sequence[Aperture], settings: PasteSettings) -> _Board:
    """Find the cells of apertures in the height map, and fit the board around each aperture."""
    windows = aperture_windows(apertures, grid, settings.margin)
    free = np.isfinite(z)
    for window in windows:
        if window is not None:
            free[window.rows, window.columns] &= ~window.cells
    known = []
    for number, (aperture, window) in enumerate(zip(apertures, windows, strict=True)):
        surface = None if window is None else _reference(z, free, grid, aperture, settings)
        if window is not None and surface is not None:
            known.append(_Known(number, aperture, window, surface))
    scatter = float(np.median([each.surface.scale for each in known])) if known else math.nan
    return _Board(apertures, windows, free, known, scatter)


def _reference(
    z: Float64, free: Bools, grid: Grid, aperture: Aperture, settings: PasteSettings
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


def _correlation_area(z: Float64, grid: Grid, board: _Board, settings: PasteSettings, given: float | None) -> float:
    """Return the given number of cells whose noise is common, or the number that the board shows."""
    if given is not None:
        return finite(given, "correlation_area", minimum=1.0)
    width = settings.margin + settings.ring
    rings = [height_noise.Ring(each.window, each.surface, width) for each in board.known]
    return height_noise.correlation_area(z, board.free, grid, rings[:: max(len(rings) // _MOST_RINGS, 1)])


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
        significance=_SIGNIFICANCE,
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


def _add_phase(sums: dict[str, Float64], job: _Job, known: Sequence[_Known]) -> None:
    """Add the error of the phase to the standard deviations; a volume that is no longer significant has no offset."""
    sums["height_max_phase"] = np.zeros(len(known))
    if job.phases is None:
        return
    for index, each in enumerate(known):
        window = each.window
        found = phase_sigmas(
            _heights_above(job, each),
            job.phases[window.rows, window.columns],
            job.grid,
            window,
            job.placement,
            threshold=job.settings.level,
            volume=float(sums["volume"][index]),
            centroid=each.aperture.centroid + job.placement.matrix @ sums["offset"][index],
        )
        for name in ("volume", "area", "height_mean", "offset"):
            total = sums[f"{name}_sigma"]
            total[index] = np.hypot(total[index], getattr(found, name))
        sums["height_max_phase"][index] = found.height_max
    weak = np.abs(sums["volume"]) < _SIGNIFICANCE * sums["volume_sigma"]
    sums["status"][weak] = Status.LOW_SIGNAL
    sums["offset"][weak] = sums["offset_sigma"][weak] = math.nan


def _heights_above(job: _Job, each: _Known) -> Float64:
    """Return the heights of an aperture's window above its reference surface [m]."""
    window = each.window
    x, y = np.meshgrid(job.grid.x[window.columns], job.grid.y[window.rows])
    return job.z[window.rows, window.columns] - each.surface.heights(x, y) - job.settings.pad_height


def _tops_and_references(
    job: _Job, known: Sequence[_Known], statuses: Sequence[str], phases: Float64
) -> tuple[list[tuple[float, float]], list[float]]:
    """Return the height of the highest patch with its standard deviation, and the height of the board, of each."""
    grid, settings = job.grid, job.settings
    tops, references = [], []
    for each, phase in zip(known, phases, strict=True):
        aperture, window, surface = each.aperture, each.window, each.surface
        references.append(float(surface.heights(aperture.centroid[:1], aperture.centroid[1:])[0]) + settings.pad_height)
        if statuses[each.number] == "holes":
            tops.append((math.nan, math.nan))
            continue
        height = _heights_above(job, each)
        half = max(round(_TOP_PATCH * math.sqrt(aperture.area / (grid.cell_x * grid.cell_y))), 1)
        spread = job.sigmas[window.rows, window.columns]
        top = top_height(np.where(window.cells, height, math.nan), window.cells, spread, half)
        basis = surface.basis(*aperture.centroid[:, None])[:, 0]
        variance = job.correlated * (top.sigma**2 + float(basis @ surface.covariance @ basis))
        tops.append((top.height, math.hypot(math.sqrt(variance), phase)))
    return tops, references


def _spread(values: npt.ArrayLike, known: Sequence[_Known], others: Sequence[float]) -> Float64:
    """Return values of all apertures, (n, ...), from the values of the known ones and of the others."""
    given = np.asarray(values, np.float64)
    spread = np.empty((len(others), *given.shape[1:]))
    spread[:] = np.asarray(others, np.float64).reshape(-1, *([1] * (given.ndim - 1)))
    spread[[each.number for each in known]] = given
    return spread


def _deposits(apertures: Sequence[Aperture], job: _Job, board: _Board, sums: Mapping[str, Float64]) -> Deposits:
    """Return the deposits of all apertures of the board, NaN where a deposit is not measured."""
    statuses = ["outside" if each is None else "no reference" for each in board.windows]
    for each, flags in zip(board.known, sums["status"], strict=True):
        statuses[each.number] = _STATUS[Status(int(flags))]
    tops, references = _tops_and_references(job, board.known, statuses, sums["height_max_phase"])
    top = np.array(tops).reshape(-1, 2)
    areas = np.array([each.area for each in apertures])
    unknown = [math.nan] * len(apertures)
    others = ("status", "valid", "height_max_phase")
    measured = {name: _spread(values, board.known, unknown) for name, values in sums.items() if name not in others}
    noise = job.sigmas if job.phases is None else np.hypot(job.sigmas, job.phases)
    return Deposits(
        names=tuple(each.name for each in apertures),
        status=tuple(statuses),
        expected_area=areas,
        expected_volume=areas * job.settings.stencil,
        centre=np.array([each.centroid for each in board.apertures]).reshape(-1, 2),
        height_max=_spread(top[:, 0], board.known, unknown),
        height_max_sigma=_spread(top[:, 1], board.known, unknown),
        reference=_spread(np.array(references), board.known, unknown),
        valid=_spread(sums["valid"], board.known, [0.0 if each is None else math.nan for each in board.windows]),
        noise=float(np.median(noise[board.free] if board.free.any() else noise)),
        board_scatter=board.scatter,
        correlation_area=job.correlated,
        **measured,
    )
