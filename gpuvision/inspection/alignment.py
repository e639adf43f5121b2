"""Alignment of a board with a height map by its solder paste: correlation of the pattern, then least squares."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import fft
from scipy.ndimage import median_filter

from gpuvision.inspection.apertures import Aperture, BoardPlacement
from gpuvision.inspection.coverage import covered
from gpuvision.inspection.paste import Deposits, PasteSettings, measure_deposits
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.ranging.height_map import Grid
from gpuvision.validation import finite

_CELLS_ACROSS = 4.0  # coarse cells across the median aperture. Chosen
_MOST_COARSE = 1024  # coarse cells along a side. Chosen: a correlation takes 0.1 s
_BACKGROUND = 5.0  # width of the median filter that finds the board, in aperture sizes
_MOST_FITTED = 200  # apertures of the least-squares fit. Chosen: they determine the place to a tenth of one offset
_ROUNDS = 6  # of the least-squares fit
_CONVERGED = 1e-8  # motion of a deposit in a round [m]
_CONVERGED_SIGMAS = 0.1  # or of the place [standard deviations]. Derived: it adds 0.5 % to the root-mean-square error
_TUKEY = 4.685
_SECOND_PEAK = 0.95  # a second place whose correlation reaches this share of the best one is as good. Chosen


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Place of a board in a height map, fitted to its solder paste.

    Attributes
    ----------
    placement : BoardPlacement
        Fitted place.
    covariance : (3, 3)
        Covariance of x, y [m] and theta [rad] about the centre of the apertures, from the scatter of the offsets.
    centre : (2,)
        Centre of the fitted apertures in the height map [m].
    residual_scale : float
        Robust standard deviation of the offsets about the fit [m].
    count : int
        Number of fitted deposits.
    correlation : float
        Correlation of the height map with the pattern, 0 to 1.
    second_correlation : float
        Correlation of the second best place, more than half an aperture away.
    converged : bool
        Whether the last round of the fit moved the place, shift and rotation together, by at most a tenth of its
        standard deviation, or no deposit by more than 10 nm. Default True.
    """

    placement: BoardPlacement
    covariance: Float64
    centre: Float64
    residual_scale: float
    count: int
    correlation: float
    second_correlation: float
    converged: bool = True

    @property
    def is_ambiguous(self) -> bool:
        """Whether another place within the search range fits about as well."""
        return self.second_correlation > _SECOND_PEAK * self.correlation


def align_apertures(
    z: npt.NDArray[np.floating],
    grid: Grid,
    apertures: Sequence[Aperture],
    settings: PasteSettings,
    *,
    initial: BoardPlacement,
    search_range: tuple[float, float],
) -> Alignment:
    """Find the place of a board in a height map by its solder paste.

    Parameters
    ----------
    z : numpy.ndarray
        Heights [m], (rows, columns); NaN in holes.
    grid : Grid
        Grid of the heights.
    apertures : sequence of Aperture
        Apertures in the coordinates of the board, two or more.
    settings : PasteSettings
        Settings of the measurement.
    initial : BoardPlacement
        Place where the search begins.
    search_range : tuple of float
        Largest shift [m] of the centre of the apertures, and largest rotation [rad]; a rotation above pi is pi.

    Returns
    -------
    Alignment

    Raises
    ------
    ValueError
        Fewer than two deposits are found, the height map shows no part of the pattern, or a number of the search range
        is negative or not finite.

    Notes
    -----
    The common shift and rotation of all deposits is taken for the place of the board: a stencil that is misaligned as a
    whole is not visible in offsets about this fit.
    """
    shift, turn = (
        finite(each, f"the {name} of the search range", minimum=0.0)
        for each, name in zip(search_range, ("shift", "rotation"), strict=True)
    )
    middle = np.mean([each.centroid for each in apertures], axis=0)
    coarse, heights = _coarse_heights(np.asarray(z, np.float64), grid, apertures)
    placement, best, second = _correlate(coarse, heights, apertures, middle, initial, (shift, min(turn, math.pi)))
    reach = max(settings.margin, 1.5 * max(coarse.cell_x, coarse.cell_y))
    fit = _fit_deposits(z, grid, apertures, settings, placement, reach)
    return Alignment(
        placement=fit.placement,
        covariance=fit.covariance,
        centre=fit.centre,
        residual_scale=fit.residual_scale,
        count=fit.deposits,
        correlation=best,
        second_correlation=second,
        converged=fit.converged,
    )


class _RigidFit(NamedTuple):
    """Fitted place of a board, and the number of fitted deposits; see the attributes of `Alignment`.

    ``motion`` (3,) is the shift of the centre [m] and the rotation [rad] by this round, ``moved`` [m] the largest
    motion of a deposit.
    """

    placement: BoardPlacement
    covariance: Float64
    residual_scale: float
    deposits: int
    centre: Float64
    motion: Float64
    moved: float

    @property
    def converged(self) -> bool:
        """Whether this round hardly moved the place; see `Alignment`."""
        distance = float(self.motion @ np.linalg.pinv(self.covariance) @ self.motion)
        return self.moved <= _CONVERGED or distance <= _CONVERGED_SIGMAS**2


def _fit_deposits(
    z: npt.NDArray[np.floating],
    grid: Grid,
    apertures: Sequence[Aperture],
    settings: PasteSettings,
    placement: BoardPlacement,
    reach: float,
) -> _RigidFit:
    """Fit the place to the offsets of the deposits, first within a distance ``reach`` [m] from the apertures.

    The first round looks farther: the correlation is right to about a coarse cell.
    """
    fitted = list(apertures)[:: max(len(apertures) // _MOST_FITTED, 1)]
    rounds = [reach] + [settings.margin] * (_ROUNDS - 1)
    for margin in rounds:
        found = measure_deposits(
            z, grid, fitted, placement, dataclasses.replace(settings, margin=margin), correlation_area=1.0
        )
        fit = _fit_rigid(found, placement)
        placement = fit.placement
        if margin == settings.margin and fit.moved <= _CONVERGED:
            break
    return fit


def _coarse_heights(z: Float64, grid: Grid, apertures: Sequence[Aperture]) -> tuple[Grid, Float64]:
    """Return a coarser grid and the heights above the board on it, 0 in holes, limited to typical heights."""
    size = math.sqrt(float(np.median([each.area for each in apertures])))
    cell = max(grid.cell_x, grid.cell_y)
    target = max(size / _CELLS_ACROSS, max(grid.columns * grid.cell_x, grid.rows * grid.cell_y) / _MOST_COARSE, cell)
    cells = zip(grid.shape, (grid.cell_y, grid.cell_x), strict=True)
    factors = [min(max(round(target / each), 1), count) for count, each in cells]
    rows, columns = (count // factor for count, factor in zip(grid.shape, factors, strict=True))
    blocks = z[: rows * factors[0], : columns * factors[1]].reshape(rows, factors[0], columns, factors[1])
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    means = np.where(known, blocks, 0.0).sum(axis=(1, 3)) / np.maximum(count, 1)
    if not count.any():
        raise ValueError("the height map has no height; expected the heights of a board")
    filled = np.where(count > 0, means, np.median(means[count > 0]))
    coarse = Grid(
        left=grid.left + (factors[1] - 1) / 2 * grid.cell_x,
        top=grid.top - (factors[0] - 1) / 2 * grid.cell_y,
        cell_x=factors[1] * grid.cell_x,
        cell_y=factors[0] * grid.cell_y,
        columns=columns,
        rows=rows,
    )
    width = max(round(_BACKGROUND * size / target), 3) | 1
    above = np.where(count > 0, filled - median_filter(filled, width, mode="nearest"), 0.0)
    limit = float(np.percentile(above, 99))
    return coarse, np.clip(above, 0.0, limit) if limit > 0 else above


def _correlate(
    grid: Grid,
    heights: Float64,
    apertures: Sequence[Aperture],
    middle: Float64,
    initial: BoardPlacement,
    search_range: tuple[float, float],
) -> tuple[BoardPlacement, float, float]:
    """Return the place with the best correlation, its correlation, and the correlation of the second best place."""
    shift, turn = search_range
    reach = max(float(np.max(np.abs(np.concatenate([each.bounds for each in apertures]) - middle))), grid.cell_x)
    step = max(grid.cell_x, grid.cell_y) / reach
    turns = np.linspace(-turn, turn, 2 * math.ceil(turn / step) + 1)
    pad = [fft.next_fast_len(2 * count, real=True) for count in heights.shape]
    centred = heights - heights.mean()
    spectrum = fft.rfft2(centred, pad)
    norm = float(np.sqrt(np.sum(centred**2)))
    rows = np.rint(fft.fftfreq(pad[0], 1 / pad[0])).astype(int)[:, None]
    columns = np.rint(fft.fftfreq(pad[1], 1 / pad[1])).astype(int)[None, :]
    allowed = np.hypot(rows * grid.cell_y, columns * grid.cell_x) <= shift + min(grid.cell_x, grid.cell_y) / 2
    allowed &= (np.abs(rows) < heights.shape[0]) & (np.abs(columns) < heights.shape[1])
    # A map takes up to 34 MB: of all rotations only the map with the highest peak is kept.
    score, best, place = -math.inf, centred, initial
    for each in turns:
        placement = _turned(initial, middle, float(each))
        pattern = _pattern(grid, apertures, placement)
        spread = float(np.sqrt(np.sum((pattern - pattern.mean()) ** 2)))
        if spread > 0 and norm > 0:
            found = fft.irfft2(spectrum * np.conj(fft.rfft2(pattern - pattern.mean(), pad)), pad)
            found = np.where(allowed, found / (spread * norm), -np.inf)
            if (peak := float(found.max())) > score:
                score, best, place = peak, found, placement
    if not math.isfinite(score):
        raise ValueError("the height map shows no part of the paste pattern; give another initial pose")
    size = math.sqrt(float(np.median([each.area for each in apertures])))
    row, column, second = _peaks(best, rows, columns, grid, size)
    placement = dataclasses.replace(place, x=place.x + column * grid.cell_x, y=place.y - row * grid.cell_y)
    return placement, score, second


def _peaks(
    correlation: Float64, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp], grid: Grid, size: float
) -> tuple[int, int, float]:
    """Return rows and columns of the best shift, and the correlation of the second best.

    The second best shift is farther away than half the ``size`` of an aperture [m]; its correlation is 0 or more.
    """
    row, column = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
    best_row, best_column = int(rows[row, 0]), int(columns[0, column])
    distance = np.hypot((rows - best_row) * grid.cell_y, (columns - best_column) * grid.cell_x)
    is_near = distance <= max(size / 2, 2 * max(grid.cell_x, grid.cell_y))
    return best_row, best_column, max(float(np.max(np.where(is_near, -np.inf, correlation))), 0.0)


def _turned(placement: BoardPlacement, middle: Float64, turn: float) -> BoardPlacement:
    """Return a placement that is turned about a point (2,) of the board."""
    turned = dataclasses.replace(placement, theta=placement.theta + turn)
    shift = placement.to_map(middle) - turned.to_map(middle)
    return dataclasses.replace(turned, x=placement.x + float(shift[0]), y=placement.y + float(shift[1]))


def _pattern(grid: Grid, apertures: Sequence[Aperture], placement: BoardPlacement) -> Float64:
    """Return 1 where cells lie in an aperture, 0 elsewhere."""
    pattern = np.zeros(grid.shape)
    x, y = grid.x, grid.y
    for each in apertures:
        moved = each.moved(placement)
        (left, bottom), (right, top) = moved.bounds
        columns = slice(*np.searchsorted(x, [left, right]))
        rows = slice(*np.searchsorted(-y, [-top, -bottom]))
        if columns.stop > columns.start and rows.stop > rows.start:
            pattern[rows, columns] += covered(moved.shapes, x[columns], y[rows])
    return np.minimum(pattern, 1.0)


def _fit_rigid(found: Deposits, placement: BoardPlacement) -> _RigidFit:
    """Fit a shift and a rotation to the offsets of deposits, robustly."""
    known = np.isfinite(found.offset).all(axis=1)
    if np.count_nonzero(known) < 2:
        raise ValueError(
            "the board was not found in the height map: fewer than two deposits of its paste layer; give another "
            "initial pose, a larger search range, or the pose"
        )
    offset = found.offset[known] @ placement.matrix.T  # in the height map
    at = found.centre[known]
    centre = at.mean(axis=0)
    arm = at - centre
    # offset = shift + turn * (-arm_y, arm_x)
    design = np.zeros((len(at), 2, 3))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    design[:, 0, 2], design[:, 1, 2] = -arm[:, 1], arm[:, 0]
    weights = np.ones(len(at))
    motion = np.zeros(3)
    scale = 0.0
    for _ in range(30):
        normal = np.einsum("i,ijk,ijl->kl", weights, design, design)
        motion = np.linalg.lstsq(normal, np.einsum("i,ijk,ij->k", weights, design, offset), rcond=None)[0]
        residual = np.hypot(*(offset - design @ motion).T)
        # The length of a residual of two normal coordinates has the median 1.1774 sigma.
        scale = max(float(np.median(residual)) / 1.1774, 1e-12)
        weights = np.maximum(1.0 - (residual / (_TUKEY * scale)) ** 2, 0.0) ** 2
    turned = dataclasses.replace(placement, theta=placement.theta + float(motion[2]))
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    origin = np.array([placement.x, placement.y]) - centre
    moved = np.array([[cos, -sin], [sin, cos]]) @ origin + centre + motion[:2]
    normal = np.einsum("i,ijk,ijl->kl", weights, design, design)
    # The fit of three parameters shrinks the residuals of the 2 n coordinates. n is 1.75 at least: of two deposits or
    # more, two have a residual up to the median, whose weight is 0.877.
    coordinates = 2.0 * float(weights.sum())
    covariance = scale**2 * coordinates / (coordinates - 3.0) * np.linalg.pinv(normal)
    turned = dataclasses.replace(turned, x=float(moved[0]), y=float(moved[1]))
    moved_by = float(np.max(np.hypot(*(design @ motion).T)))
    return _RigidFit(turned, covariance, scale, int(np.count_nonzero(weights > 0)), centre, motion, moved_by)
