"""Masks before a sensor: transmission of light, and optimisation of a mask for a part.

A PSD reads the centroid of all light on its strip. Weak secondary light far from the line shifts this centroid. A mask
keeps such light from the strip. The secondary light in a corner falls off slowly with the distance, so the error
depends on the length of the mask's window.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 4.6.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host.errors import ReadError
from gpuvision.host.files import atomic_write
from gpuvision.host.reading import reading
from gpuvision.simulation.sensors.readings import (
    GroundTruth,
    dark_exposure,
    height_secant,
    height_slope,
    total_exposure,
)
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.status import Status
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

# Candidates for each end of a window in one step of the grid search (speed only: the search continues to single bins).
_CANDIDATES = 16
# Pairs of window ends per batch: bounds the memory of a batch, 8 bytes a pair.
_PAIRS_PER_BATCH = 4_000_000


@dataclass(frozen=True, kw_only=True)
class MaskLimits:
    """Limits of the windows of a mask around a profile.

    Attributes
    ----------
    iterations : int
        Number of fixed-point iterations for the ends of a window. Each one reduces the error by the relative change of
        the slope between the profile and the end of the window. Chosen. Default 30.
    """

    iterations: int = 30


@dataclass(frozen=True, kw_only=True, eq=False)
class Mask:
    """Mask before a sensor: a window along u for every sample, a transmission for every bin, or both.

    Parameters
    ----------
    windows : numpy.ndarray, optional
        Lower and upper end of each window [sensor unit], float64 (samples, 2), or (profiles, samples, 2) for a mask
        that follows the part. None: no windows. A window with equal ends is closed.
    leak : float
        Fraction of the light outside the window that passes, 0 to 1. Default 0.0.
    transmission : numpy.ndarray, optional
        Transmission of each bin, float64 (samples, bins), 0 to 1. None: 1.

    Raises
    ------
    ValueError
        A shape or a number is out of its range.
    """

    windows: Float64 | None = None
    leak: float = 0.0
    transmission: Float64 | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= finite(self.leak, "Mask.leak") <= 1.0:
            raise ValueError(f"Mask.leak is {self.leak:g}, expected a share from 0 to 1")
        if self.windows is not None:
            windows = np.array(self.windows, np.float64)
            if windows.ndim < 2 or windows.shape[-1] != 2 or not np.all(windows[..., 0] <= windows[..., 1]):
                raise ValueError("Mask.windows: expected (..., samples, 2), the lower end first, neither NaN")
            object.__setattr__(self, "windows", windows)
        if self.transmission is not None:
            shares = np.array(self.transmission, np.float64)
            if shares.ndim < 2 or not np.all((shares >= 0.0) & (shares <= 1.0)):
                raise ValueError("Mask.transmission: expected (..., samples, bins) shares from 0 to 1")
            object.__setattr__(self, "transmission", shares)

    @classmethod
    def around_profile(
        cls, view: SensorView, truth: GroundTruth, half_height: float, *, limits: MaskLimits = MaskLimits()
    ) -> Mask:
        """Return a mask that follows an expected profile, with windows of constant height in the sheet.

        Parameters
        ----------
        view : SensorView
            View of the sensor.
        truth : GroundTruth
            Expected points, (samples,) or (profiles, samples). Samples without a point have a closed window.
        half_height : float
            Height above and below the profile that passes [m], > 0. Windows are clipped to the sensor.
        limits : MaskLimits
            Limits of the iteration.

        Raises
        ------
        ValueError
            The half height is not positive.
        """
        if not finite(half_height, "half_height") > 0.0:
            raise ValueError(f"half_height is {half_height:g} m, expected a number > 0")
        u, _ = height_slope(view, truth)
        low, high = view.u_edges[0], view.u_edges[-1]
        ends = np.stack([u, u], axis=-1)
        rise = np.array([-half_height, half_height])
        for _ in range(limits.iterations):
            slope = height_secant(view.triangulation, u[..., None], ends, view.v_centres[:, None])
            with np.errstate(invalid="ignore", divide="ignore"):
                ends = np.clip(u[..., None] + rise / slope, low, high)
        ends.sort(axis=-1)
        return cls(windows=np.where(np.isnan(ends), low, ends))

    def apply(self, exposure: Exposure, u_edges: npt.ArrayLike) -> Exposure:
        """Return the light that passes the mask.

        Where a window ends within a bin, the light of the bin is assumed uniform over the widest interval of the bin
        that is centred on the centroid of the bin's light.

        Parameters
        ----------
        exposure : Exposure
            (..., samples, bins).
        u_edges : array_like
            Edges of the bins, (bins + 1,) [sensor unit].

        Raises
        ------
        ValueError
            The shapes of mask and exposure do not fit.

        Notes
        -----
        The result is exact for uniform light, and for windows that end at edges of bins. Otherwise the error is at
        most the power of the two bins in which the window ends.
        """
        edges = np.asarray(u_edges, np.float64)
        try:
            if self.transmission is not None:
                exposure = Exposure(exposure.power * self.transmission, exposure.moment * self.transmission)
            if self.windows is None:
                return exposure
            passing = _through_windows(exposure, self.windows, edges)
        except ValueError:
            raise ValueError(
                f"this mask does not fit light of shape {exposure.power.shape} (..., samples, bins)"
            ) from None
        if self.leak == 0.0:
            return passing
        kept, leak = 1.0 - self.leak, self.leak
        return Exposure(kept * passing.power + leak * exposure.power, kept * passing.moment + leak * exposure.moment)

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the windows as a text file with one line "lower, upper" for each sample.

        Parameters
        ----------
        path : str or Path
            Output file; its folder must exist.
        overwrite : bool
            Whether an existing file may be replaced. Default False.

        Raises
        ------
        ValueError
            The mask is not of one window per sample, or has a transmission or a leak.
        OSError
            The file cannot be written.
        """
        if self.windows is None or self.windows.ndim != 2 or self.transmission is not None or self.leak:
            raise ValueError("only a mask of one window per sample (samples, 2) without leak is written as text")
        with atomic_write(path, overwrite=overwrite) as file:
            np.savetxt(file, self.windows, fmt="%.17g", delimiter=", ", header="lower, upper end along u [sensor unit]")

    @classmethod
    def load(cls, path: str | Path) -> Mask:
        """Read a file that `save` wrote.

        Raises
        ------
        ReadError
            The file does not hold two numbers in each line.
        OSError
            The file cannot be read.
        """
        expected = f"{path}: expected two numbers a line, the lower and the upper end of a sample's window"
        with reading(path, "mask"):
            try:
                windows = np.loadtxt(path, delimiter=",", ndmin=2)
            except ValueError:
                raise ReadError(expected) from None
            if windows.shape[1:] != (2,):
                raise ReadError(expected)
            return cls(windows=windows)


def _through_windows(exposure: Exposure, windows: Float64, edges: Float64) -> Exposure:
    """Return the light inside windows (..., samples, 2) over bins with the given edges."""
    low, high = windows[..., :1], windows[..., 1:]
    left, right = edges[:-1], edges[1:]
    is_inside, _ = np.broadcast_arrays((low <= left) & (right <= high), exposure.power)
    power, moment = np.where(is_inside, exposure.power, 0.0), np.where(is_inside, exposure.moment, 0.0)
    cut = np.nonzero(~is_inside & np.broadcast_to((low < right) & (left < high), is_inside.shape))
    low, high = (np.broadcast_to(each, (*is_inside.shape[:-1], 1))[(*cut[:-1], 0)] for each in (low, high))
    light = np.broadcast_to(exposure.power, is_inside.shape)[cut]
    left, right = left[cut[-1]], right[cut[-1]]
    middle, half = 0.5 * (left + right), 0.5 * (right - left)
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = np.clip(np.broadcast_to(exposure.moment, is_inside.shape)[cut] / light, -half, half)
        reach = half - np.abs(centre)
        first, last = (np.clip(each - middle, centre - reach, centre + reach) for each in (low, high))
        share = np.where(
            reach > 0.0, (last - first) / (2.0 * reach), (low <= middle + centre) & (middle + centre < high)
        )
    lit = light > 0.0
    power[cut] = np.where(lit, light * share, 0.0)
    moment[cut] = np.where(lit, light * share * 0.5 * (first + last), 0.0)
    return Exposure(power, moment)


def apply_mask(mask: Mask | None, view: SensorView, exposures: Mapping[str, Exposure]) -> dict[str, Exposure]:
    """Return the light of each path that passes a mask; None: all of it."""
    if mask is None:
        return dict(exposures)
    return {name: mask.apply(each, view.u_edges) for name, each in exposures.items()}


class MaskOptimisation(NamedTuple):
    """An optimised mask and its effect on the part for which it was optimised.

    Attributes
    ----------
    mask
        Mask with a window for every sample.
    error_before, error_after
        Error of the light's centroid without and with the mask, (profiles, samples) [m of height]; NaN where there is
        no valid light.
    passed_fraction
        Fraction of the valid light that passes, (profiles, samples); NaN where there is no valid light.
    """

    mask: Mask
    error_before: Float64
    error_after: Float64
    passed_fraction: Float64


def optimise_mask(
    view: SensorView,
    exposures: Mapping[str, Exposure],
    truth: GroundTruth,
    *,
    fixed: bool = True,
    objective: Literal["max", "rms"] = "rms",
    min_passed_fraction: float = 0.999,
    margin: float = 0.0,
) -> MaskOptimisation:
    """Find the windows along u with the least error of the light's centroid on a part.

    Parameters
    ----------
    view : SensorView
        View of the sensor.
    exposures : mapping of str to Exposure
        Light by path, (profiles, samples, bins), before the mask. "direct" is the valid light.
    truth : GroundTruth
        Ground truth, (profiles, samples).
    fixed : bool
        True: one window per sample for all profiles. False: one per sample and profile, a mask that follows the part.
        Default True.
    objective : {"max", "rms"}
        Minimised quantity over the profiles of a sample: ``"rms"`` or ``"max"`` of the errors. With "max", one profile
        that no mask can improve leaves the other profiles as they are.
    min_passed_fraction : float
        Fraction of the valid light that must pass in every profile, > 0 and at most 1. At most half of the rest is cut
        at either end. Default 0.999.
    margin : float
        Distance of the window's ends from the valid light, for a mask with a positioning tolerance [sensor unit], 0
        or more. Default 0.0.

    Returns
    -------
    MaskOptimisation
        Samples that receive no valid light in any profile have a closed window: their readings would be spurious.

    Raises
    ------
    ValueError
        A number is out of its range, or shapes differ.

    Notes
    -----
    Window ends lie at edges of bins. A grid search over all pairs of ends is refined from 16 candidates for each end
    down to single bins. Where the error has several local minima, the search can miss a minimum between two candidates
    of the first grid.
    """
    if objective not in ("max", "rms"):
        raise ValueError(f"objective is {objective!r}, expected 'max' or 'rms'")
    if not 0.0 < min_passed_fraction <= 1.0 or margin < 0.0:
        raise ValueError(
            f"expected 0 < min_passed_fraction <= 1 and margin >= 0, got {min_passed_fraction:g} and {margin:g}"
        )
    direct = exposures.get("direct", dark_exposure(exposures))
    light = total_exposure(exposures)
    if light.power.ndim != 3 or np.shape(truth.h) != light.power.shape[:-1]:
        raise ValueError(f"expected light (profiles, samples, bins) and its truth, got {light.power.shape}")
    true_u, slope = height_slope(view, truth)
    in_range = (np.asarray(truth.status) & Status.OUT_OF_RANGE) == 0
    valid = np.isfinite(true_u) & in_range & (direct.total() > 0.0)
    ends = _widest_cuts(view.u_edges, direct, valid, min_passed_fraction, margin)
    groups = _Groups.of(view, light, np.where(valid, true_u, np.nan), slope, ends, fixed)
    shape = (view.samples, 2) if fixed else (*light.power.shape[:-1], 2)
    mask = Mask(windows=view.u_edges[_best_ends(groups, objective)].reshape(shape))
    masked, passed = (mask.apply(each, view.u_edges) for each in (light, direct))
    with np.errstate(invalid="ignore", divide="ignore"):
        before, after = (
            np.where(valid, (each.first_moment(view.u_edges) / each.total() - true_u) * slope, np.nan)
            for each in (light, masked)
        )
        return MaskOptimisation(mask, before, after, np.where(valid, passed.total() / direct.total(), np.nan))


def _best_ends(groups: _Groups, objective: str) -> npt.NDArray[np.intp]:
    """Return the best pair of bin edges of each group, (groups, 2)."""
    ends = np.empty((len(groups.low), 2), np.intp)
    share = max(_PAIRS_PER_BATCH // (groups.power.shape[1] * _CANDIDATES**2), 1)
    for first in range(0, len(ends), share):
        ends[first : first + share] = np.stack(groups.slice(first, first + share).best(objective), axis=-1)
    return ends


def _widest_cuts(
    edges: Float64, direct: Exposure, valid: npt.NDArray[np.bool_], min_passed_fraction: float, margin: float
) -> tuple[Index, Index]:
    """Return the highest lower end and the lowest upper end that pass enough valid light, (profiles, samples)."""
    below = np.cumsum(direct.power, axis=-1)
    spare = 0.5 * (1.0 - min_passed_fraction) * below[..., -1:]
    low = np.sum(below <= spare, axis=-1)
    # Summed from the upper end: an excess power near 0 would be lost in the rounding of a sum from the lower end.
    high = len(edges) - 1 - np.sum(np.cumsum(direct.power[..., ::-1], axis=-1) <= spare, axis=-1)
    if margin:
        low = np.searchsorted(edges, edges[np.minimum(low, len(edges) - 1)] - margin, side="right") - 1
        high = np.searchsorted(edges, edges[np.maximum(high, 0)] + margin, side="left")
    last = len(edges) - 1
    # A profile without valid light does not constrain the window.
    return np.where(valid, np.clip(low, 0, last), last), np.where(valid, np.clip(high, 0, last), 0)


class _Groups(NamedTuple):
    """Samples that share a window: power and first moment below each edge, (groups, profiles, edges)."""

    power: Float64
    moment: Float64
    true_u: Float64
    slope: Float64
    low: Index
    high: Index

    @classmethod
    def of(
        cls, view: SensorView, light: Exposure, true_u: Float64, slope: Float64, ends: tuple[Index, Index], fixed: bool
    ) -> _Groups:
        zero = np.zeros((*light.power.shape[:-1], 1))
        first = light.moment + light.power * view.u_centres
        sums = [np.concatenate([zero, np.cumsum(each, axis=-1)], axis=-1) for each in (light.power, first)]
        arrays = [*sums, true_u, slope, *ends]
        if fixed:
            arrays = [np.swapaxes(each, 0, 1) for each in arrays]
        else:
            arrays = [each.reshape(-1, 1, *each.shape[2:]) for each in arrays]
        power, moment, true_u, slope, low, high = arrays
        return cls(power, moment, true_u, slope, low.min(axis=1), high.max(axis=1))

    def slice(self, first: int, last: int) -> _Groups:
        some = slice(first, last)
        return _Groups(
            self.power[some], self.moment[some], self.true_u[some], self.slope[some], self.low[some], self.high[some]
        )

    def best(self, objective: str) -> tuple[Index, Index]:
        """Return the lower and upper end of the best window of each group, (groups,) indices of edges."""
        last = self.power.shape[-1] - 1
        closed = self.low >= self.high
        ranges = [np.zeros_like(self.low), self.low, self.high, np.full_like(self.high, last)]
        while True:
            low, high = _candidates(ranges[0], ranges[1]), _candidates(ranges[2], ranges[3])
            cost = self._cost(low, high, objective)
            # Of equal costs, the narrowest window: the last of the lower ends, the first of the upper ends.
            flat = cost[:, ::-1].reshape(len(cost), -1).argmin(axis=1)
            at_low, at_high = _CANDIDATES - 1 - flat // _CANDIDATES, flat % _CANDIDATES
            chosen = [np.take_along_axis(a, b[:, None], axis=1)[:, 0] for a, b in ((low, at_low), (high, at_high))]
            steps = [-(-(ranges[1] - ranges[0]) // (_CANDIDATES - 1)), -(-(ranges[3] - ranges[2]) // (_CANDIDATES - 1))]
            if max(int(each.max(initial=0)) for each in steps) <= 1:
                break
            ranges = [
                np.maximum(chosen[0] - steps[0] + 1, 0),
                np.minimum(chosen[0] + steps[0] - 1, self.low),
                np.maximum(chosen[1] - steps[1] + 1, self.high),
                np.minimum(chosen[1] + steps[1] - 1, last),
            ]
            ranges[0], ranges[2] = np.minimum(ranges[0], ranges[1]), np.minimum(ranges[2], ranges[3])
        return np.where(closed, 0, chosen[0]), np.where(closed, 0, chosen[1])

    def _cost(self, low: Index, high: Index, objective: str) -> Float64:
        """Return the objective for all pairs of ends, (groups, candidates, candidates)."""
        below, above = (
            [
                np.take_along_axis(each, np.broadcast_to(ends[:, None], (*each.shape[:2], _CANDIDATES)), axis=-1)
                for each in (self.power, self.moment)
            ]
            for ends in (low, high)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            centre = (above[1][:, :, None, :] - below[1][..., None]) / (above[0][:, :, None, :] - below[0][..., None])
            error = np.abs((centre - self.true_u[..., None, None]) * self.slope[..., None, None])
        error = np.where(np.isnan(error), 0.0, error)
        if objective == "max":
            return np.asarray(error.max(axis=1))
        return np.asarray(np.sqrt(np.mean(error**2, axis=1)))


def _candidates(first: Index, last: Index) -> Index:
    """Return integers evenly spaced from first to last, both included, (groups, candidates)."""
    return first[:, None] + ((last - first)[:, None] * np.arange(_CANDIDATES)) // (_CANDIDATES - 1)
