"""Masks before a sensor: what light they let pass, and the one that suits a part best.

A PSD reads the centre of gravity of all light on its strip, so that a faint glow far from the line moves it; what a
mask keeps from the strip cannot. The glow in a corner falls off so slowly that the error depends on the mask's length
(F. de Jong, 4.6.3).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.sensors.readings import Truth, dark_exposure, height_secant, height_slope, lit_by
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

_CHOICES = 16  # ends of a window that are tried at once
_PAIRS_AT_ONCE = 4_000_000
_ROUNDS = 30  # to the end of a window; each closes in by the share that the slope changes on the way


@dataclass(frozen=True, kw_only=True, eq=False)
class Mask:
    """What passes to a sensor: a window along u for every sample, a transmission for every bin, or both.

    Parameters
    ----------
    windows
        (samples, 2) lower and upper end [sensor unit], or (profiles, samples, 2) for a mask that follows the part.
        None: no window. A window whose ends are equal lets nothing pass.
    leak
        Share of the light that passes beside the window.
    transmission
        (samples, bins) shares from 0 to 1; None: 1.

    Raises
    ------
    ValueError
        Shapes or numbers are not these.
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
    def about(cls, view: SensorView, truth: Truth, reach: float) -> Mask:
        """Return the mask that follows an expected profile: windows up to so much above and below it.

        Parameters
        ----------
        view
            Of the sensor.
        truth
            Expected points, (samples,) or (profiles, samples). Where there is none the mask is closed.
        reach
            In height [m]; a window ends with the sensor at the latest.

        Raises
        ------
        ValueError
            The reach is not positive.
        """
        if not finite(reach, "reach") > 0.0:
            raise ValueError(f"reach is {reach:g} m, expected a number > 0")
        u, _ = height_slope(view, truth)
        low, high = view.u_edges[0], view.u_edges[-1]
        ends = np.stack([u, u], axis=-1)
        rise = np.array([-reach, reach])
        for _ in range(_ROUNDS):
            slope = height_secant(view.triangulation, u[..., None], ends, view.v_middles[:, None])
            with np.errstate(invalid="ignore", divide="ignore"):
                ends = np.clip(u[..., None] + rise / slope, low, high)
        ends.sort(axis=-1)
        return cls(windows=np.where(np.isnan(ends), low, ends))

    def apply(self, exposure: Exposure, u_edges: npt.ArrayLike) -> Exposure:
        """Return the light that passes.

        Where a window ends within a bin, the bin's light is taken to lie evenly over the widest interval in the bin
        about its centre of gravity: exact for even light and wherever windows end at the bins' edges, never off by
        more than the power of the two bins that are cut.

        Parameters
        ----------
        exposure
            Of shape (..., samples, bins).
        u_edges
            (bins + 1,) of it.

        Raises
        ------
        ValueError
            The mask is one for another sensor.
        """
        edges = np.asarray(u_edges, np.float64)
        try:
            if self.transmission is not None:
                exposure = Exposure(exposure.power * self.transmission, exposure.moment * self.transmission)
            if self.windows is None:
                return exposure
            passing = _through(exposure, self.windows, edges)
        except ValueError:
            raise ValueError(
                f"this mask does not fit light of shape {exposure.power.shape} (..., samples, bins)"
            ) from None
        if self.leak == 0.0:
            return passing
        kept, leak = 1.0 - self.leak, self.leak
        return Exposure(kept * passing.power + leak * exposure.power, kept * passing.moment + leak * exposure.moment)

    def save(self, path: str | Path) -> None:
        """Write the windows as text, a line "lower, upper" for every sample.

        Raises
        ------
        ValueError
            The mask has more or other than one window a sample: that does not fit into such a file.
        """
        if self.windows is None or self.windows.ndim != 2 or self.transmission is not None or self.leak:
            raise ValueError("only a mask of one window per sample (samples, 2) without leak is written as text")
        np.savetxt(path, self.windows, fmt="%.17g", delimiter=", ", header="lower, upper end along u [sensor unit]")

    @classmethod
    def load(cls, path: str | Path) -> Mask:
        """Read what `save` wrote.

        Raises
        ------
        ValueError
            The file holds anything else.
        """
        expected = f"{path}: expected two numbers a line, the lower and the upper end of a sample's window"
        try:
            windows = np.loadtxt(path, delimiter=",", ndmin=2)
        except ValueError:
            raise ValueError(expected) from None
        if windows.shape[1:] != (2,):
            raise ValueError(expected)
        return cls(windows=windows)


def _through(exposure: Exposure, windows: Float64, edges: Float64) -> Exposure:
    low, high = windows[..., :1], windows[..., 1:]
    left, right = edges[:-1], edges[1:]
    whole, _ = np.broadcast_arrays((low <= left) & (right <= high), exposure.power)
    power, moment = np.where(whole, exposure.power, 0.0), np.where(whole, exposure.moment, 0.0)
    cut = np.nonzero(~whole & np.broadcast_to((low < right) & (left < high), whole.shape))
    low, high = (np.broadcast_to(each, (*whole.shape[:-1], 1))[(*cut[:-1], 0)] for each in (low, high))
    light = np.broadcast_to(exposure.power, whole.shape)[cut]
    left, right = left[cut[-1]], right[cut[-1]]
    middle, half = 0.5 * (left + right), 0.5 * (right - left)
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = np.clip(np.broadcast_to(exposure.moment, whole.shape)[cut] / light, -half, half)
        reach = half - np.abs(centre)
        first, last = (np.clip(each - middle, centre - reach, centre + reach) for each in (low, high))
        share = np.where(
            reach > 0.0, (last - first) / (2.0 * reach), (low <= middle + centre) & (middle + centre < high)
        )
    lit = light > 0.0
    power[cut] = np.where(lit, light * share, 0.0)
    moment[cut] = np.where(lit, light * share * 0.5 * (first + last), 0.0)
    return Exposure(power, moment)


def light_behind(mask: Mask | None, view: SensorView, exposures: Mapping[str, Exposure]) -> dict[str, Exposure]:
    """Return what a mask lets pass of every path; None is no mask."""
    if mask is None:
        return dict(exposures)
    return {name: mask.apply(each, view.u_edges) for name, each in exposures.items()}


class MaskPlan(NamedTuple):
    """A mask, and what it does for the part it was made for.

    Attributes
    ----------
    mask
        With a window for every sample.
    before, after
        (profiles, samples) error of the centre of gravity without and with the mask [m of height]; NaN where there
        is no valid light.
    kept
        (profiles, samples) share of the valid light that the mask lets pass.
    """

    mask: Mask
    before: Float64
    after: Float64
    kept: Float64


def optimise_mask(
    view: SensorView,
    exposures: Mapping[str, Exposure],
    truth: Truth,
    *,
    fixed: bool = True,
    objective: Literal["worst", "rms"] = "rms",
    keep: float = 0.999,
    margin: float = 0.0,
) -> MaskPlan:
    """Find the windows along u, ending at edges of bins, under which a part is read best.

    The windows are the best of all pairs of ends on a grid that is narrowed down to the bins; an error that has
    several minima may hide one between the first grid's ends (15 a side).

    Parameters
    ----------
    view
        Of the sensor.
    exposures
        Light by path, each (profiles, samples, bins), without a mask. "direct" is the valid light.
    truth
        Of the same profiles.
    fixed
        One window a sample for all profiles; False: another one for every profile, a mask that follows the part.
    objective
        What of the errors of a sample's profiles counts: the worst, which may be one that no mask can help and then
        leaves the others as they are, or their root mean square.
    keep
        Share of the valid light that must pass, in every profile; at most half of the rest is cut at either end.
    margin
        The window's ends keep this distance from the valid light [sensor unit]: for a mask that is not quite in
        place.

    Returns
    -------
    MaskPlan
        Samples that never get valid light have a window of no width: what they would read is no surface's place.

    Raises
    ------
    ValueError
        A number is not within its limits, or shapes differ.
    """
    if objective not in ("worst", "rms"):
        raise ValueError(f"objective is {objective!r}, expected 'worst' or 'rms'")
    if not 0.0 < keep <= 1.0 or margin < 0.0:
        raise ValueError(f"expected 0 < keep <= 1 and margin >= 0, got {keep:g} and {margin:g}")
    direct = exposures.get("direct", dark_exposure(exposures))
    light = lit_by(exposures)
    if light.power.ndim != 3 or np.shape(truth.h) != light.power.shape[:-1]:
        raise ValueError(f"expected light (profiles, samples, bins) and its truth, got {light.power.shape}")
    true_u, slope = height_slope(view, truth)
    valid = np.isfinite(true_u) & (direct.total() > 0.0)
    ends = _admissible(view.u_edges, direct, valid, keep, margin)
    grouped = _Groups.of(view, light, np.where(valid, true_u, np.nan), slope, ends, fixed)
    shape = (view.samples, 2) if fixed else (*light.power.shape[:-1], 2)
    mask = Mask(windows=view.u_edges[_best_ends(grouped, objective)].reshape(shape))
    behind, passed = (mask.apply(each, view.u_edges) for each in (light, direct))
    with np.errstate(invalid="ignore", divide="ignore"):
        before, after = (
            np.where(valid, (each.first_moment(view.u_edges) / each.total() - true_u) * slope, np.nan)
            for each in (light, behind)
        )
        return MaskPlan(mask, before, after, np.where(valid, passed.total() / direct.total(), np.nan))


def _best_ends(grouped: _Groups, objective: str) -> npt.NDArray[np.intp]:
    """Return the edges of bins between which the light of each group reads best, (groups, 2)."""
    ends = np.empty((len(grouped.low), 2), np.intp)
    share = max(_PAIRS_AT_ONCE // (grouped.power.shape[1] * _CHOICES**2), 1)
    for first in range(0, len(ends), share):
        ends[first : first + share] = np.stack(grouped.part(first, first + share).best(objective), axis=-1)
    return ends


def _admissible(
    edges: Float64, direct: Exposure, valid: npt.NDArray[np.bool_], keep: float, margin: float
) -> tuple[Index, Index]:
    """Return the highest lower end and the lowest upper end that cut no valid light, (profiles, samples)."""
    below = np.cumsum(direct.power, axis=-1)
    spare = 0.5 * (1.0 - keep) * below[..., -1:]
    low = np.sum(below <= spare, axis=-1)
    # From the other end, so that a share of nothing is not lost in the rounding of the sum.
    high = len(edges) - 1 - np.sum(np.cumsum(direct.power[..., ::-1], axis=-1) <= spare, axis=-1)
    if margin:
        low = np.searchsorted(edges, edges[np.minimum(low, len(edges) - 1)] - margin, side="right") - 1
        high = np.searchsorted(edges, edges[np.maximum(high, 0)] + margin, side="left")
    last = len(edges) - 1
    # A profile without valid light asks for nothing.
    return np.where(valid, np.clip(low, 0, last), last), np.where(valid, np.clip(high, 0, last), 0)


class _Groups(NamedTuple):
    """Samples that share a window (group, profile, edge): power and first moment below every edge."""

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
        first = light.moment + light.power * view.u_middles
        sums = [np.concatenate([zero, np.cumsum(each, axis=-1)], axis=-1) for each in (light.power, first)]
        arrays = [*sums, true_u, slope, *ends]
        if fixed:
            arrays = [np.swapaxes(each, 0, 1) for each in arrays]
        else:
            arrays = [each.reshape(-1, 1, *each.shape[2:]) for each in arrays]
        power, moment, true_u, slope, low, high = arrays
        return cls(power, moment, true_u, slope, low.min(axis=1), high.max(axis=1))

    def part(self, first: int, last: int) -> _Groups:
        some = slice(first, last)
        return _Groups(
            self.power[some], self.moment[some], self.true_u[some], self.slope[some], self.low[some], self.high[some]
        )

    def best(self, objective: str) -> tuple[Index, Index]:
        """Return the best ends of every group's window."""
        last = self.power.shape[-1] - 1
        none = self.low >= self.high
        ranges = [np.zeros_like(self.low), self.low, self.high, np.full_like(self.high, last)]
        while True:
            low, high = _spread(ranges[0], ranges[1]), _spread(ranges[2], ranges[3])
            cost = self._cost(low, high, objective)
            # Of equals, the tightest window: the last of the lower ends, the first of the upper ones.
            flat = cost[:, ::-1].reshape(len(cost), -1).argmin(axis=1)
            at_low, at_high = _CHOICES - 1 - flat // _CHOICES, flat % _CHOICES
            chosen = [np.take_along_axis(a, b[:, None], axis=1)[:, 0] for a, b in ((low, at_low), (high, at_high))]
            steps = [-(-(ranges[1] - ranges[0]) // (_CHOICES - 1)), -(-(ranges[3] - ranges[2]) // (_CHOICES - 1))]
            if max(int(each.max(initial=0)) for each in steps) <= 1:
                break
            ranges = [
                np.maximum(chosen[0] - steps[0] + 1, 0),
                np.minimum(chosen[0] + steps[0] - 1, self.low),
                np.maximum(chosen[1] - steps[1] + 1, self.high),
                np.minimum(chosen[1] + steps[1] - 1, last),
            ]
            ranges[0], ranges[2] = np.minimum(ranges[0], ranges[1]), np.minimum(ranges[2], ranges[3])
        return np.where(none, 0, chosen[0]), np.where(none, 0, chosen[1])

    def _cost(self, low: Index, high: Index, objective: str) -> Float64:
        """Return the objective of all pairs of ends, (groups, choices, choices)."""
        below, above = (
            [
                np.take_along_axis(each, np.broadcast_to(ends[:, None], (*each.shape[:2], _CHOICES)), axis=-1)
                for each in (self.power, self.moment)
            ]
            for ends in (low, high)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            centre = (above[1][:, :, None, :] - below[1][..., None]) / (above[0][:, :, None, :] - below[0][..., None])
            error = np.abs((centre - self.true_u[..., None, None]) * self.slope[..., None, None])
        error = np.where(np.isnan(error), 0.0, error)
        if objective == "worst":
            return np.asarray(error.max(axis=1))
        return np.asarray(np.sqrt(np.mean(error**2, axis=1)))


def _spread(first: Index, last: Index) -> Index:
    """Return whole numbers from first to last, both among them, (groups, choices)."""
    return first[:, None] + ((last - first)[:, None] * np.arange(_CHOICES)) // (_CHOICES - 1)
