"""Slabs across a thick sheet of light, and the deposit of their light on a sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.transport.sheet_cut import concatenated_ranges

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Least distance of an outer slab from the last division [sigmas]; chosen.
_OUTER_GAP = 0.05


class Slabs(NamedTuple):
    """Slabs across a sheet with a Gaussian profile, in units of its sigma.

    Attributes
    ----------
    low, high
        float64 (n,): ends of each slab; the first begins at -inf, the last ends at inf.
    share
        float64 (n,): share of the sheet's light.
    middle
        float64 (n,): mean position of the light in the slab.
    """

    low: Float64
    high: Float64
    share: Float64
    middle: Float64

    @classmethod
    def from_cuts(cls, cuts: npt.ArrayLike) -> Slabs:
        """Return the slabs between ascending cuts (n - 1,), in sigmas."""
        cuts = np.asarray(cuts, np.float64)
        low, high = np.append(-np.inf, cuts), np.append(cuts, np.inf)
        share = _normal_share(low, high)
        return cls(low, high, share, np.clip((_normal_density(low) - _normal_density(high)) / share, low, high))

    @classmethod
    def uniform(cls, count: int) -> Slabs:
        """Return ``count`` slabs; all but the outer two have the same width."""
        # With the range sqrt(2 ln n), the light in the outer slabs and the width of the inner slabs decrease at about
        # the same rate with n.
        reach = math.sqrt(2.0 * math.log(count)) if count > 2 else 0.0
        return cls.from_cuts(np.linspace(-reach, reach, count - 1))

    def with_outer(self, place: float) -> Slabs:
        """Return the slabs plus two outer slabs for the light beyond +-``place`` [sigmas].

        The other slabs keep their mean positions.
        """
        cuts = self.high[:-1]
        first = min(-place, float(cuts[0]) - _OUTER_GAP)
        last = max(place, float(cuts[-1]) + _OUTER_GAP)
        outer = Slabs.from_cuts([first, last])
        low, high = np.maximum(self.low, first), np.minimum(self.high, last)
        inner = Slabs(low, high, _normal_share(low, high), self.middle)
        return Slabs(*(np.concatenate([a[:1], b, a[2:]]) for a, b in zip(outer, inner, strict=True)))


class SlabImage(NamedTuple):
    """Deposit of the slabs' light on the sensor; each slab belongs to one of ``profiles`` profiles."""

    view: SensorView
    slabs: Slabs
    profile: Integers
    profiles: int
    tail_sigmas: float

    def deposit(
        self,
        uv: Float64,
        spread: Float64,
        slab: Integers,
        lights: Mapping[str, Float64],
        limits: tuple[Float64, Float64] | None = None,
    ) -> dict[str, Exposure]:
        """Return the exposures by points of the slabs' light.

        Parameters
        ----------
        uv
            (n, 2): image of the slab's mean.
        spread
            (n,): displacement along u per sigma of the sheet [sensor unit].
        slab
            (n,): index of the slab.
        lights
            Power (n,) [W] by name, if all of the slab arrives.
        limits
            Lower and upper limit of the light across the sheet (n,), (n,) [sigmas]. Default: the limits of the slab.
        """
        view, slabs = self.view, self.slabs
        sample = view.sample_of(uv[:, 1])
        on = np.flatnonzero(sample >= 0)
        sample, u, slab = sample[on], uv[on, 0], slab[on]
        least = 1e-9 * float(np.diff(view.u_edges).min())
        spread = np.where(np.abs(spread[on]) < least, least, spread[on])
        low, high = (slabs.low[slab], slabs.high[slab]) if limits is None else (limits[0][on], limits[1][on])
        middle = slabs.middle[slab]
        reach = u + spread * (np.clip([low, high], -self.tail_sigmas, self.tail_sigmas) - middle)
        first = np.maximum(np.searchsorted(view.u_edges, reach.min(axis=0), side="right") - 1, 0)
        last = np.minimum(np.searchsorted(view.u_edges, reach.max(axis=0), side="left"), view.bins)
        count = last - first
        of, place = np.repeat(np.arange(len(u)), count), concatenated_ranges(first, count)
        # Edges of the bins in sigmas of the sheet.
        ends = middle[of] + (np.stack([view.u_edges[place], view.u_edges[place + 1]]) - u[of]) / spread[of]
        ends = np.clip(np.sort(ends, axis=0), low[of], high[of])
        share = _normal_share(*ends)
        moment = (u - spread * middle)[of] - view.u_centres[place]
        moment = moment * share + spread[of] * (_normal_density(ends[0]) - _normal_density(ends[1]))
        row = self.profile[slab] * view.samples + sample
        at, per = row[of] * view.bins + place, 1.0 / slabs.share[slab[of]]
        shape = (self.profiles, view.samples, view.bins)
        made = {}
        for name, power in lights.items():
            part_power = power[on][of] * per
            sums = [np.bincount(at, part_power * each, minlength=math.prod(shape)) for each in (share, moment)]
            made[name] = Exposure(*(np.asarray(each, np.float64).reshape(shape) for each in sums))
        return made


def concatenated_slabs(by_profile: Sequence[Slabs]) -> tuple[Slabs, Integers]:
    """Return the slabs of all profiles, and the profile of each."""
    columns = zip(*by_profile, strict=True) if by_profile else ([], [], [], [])
    slabs = Slabs(*(np.concatenate([*each, np.zeros(0)]) for each in columns))
    return slabs, np.repeat(np.arange(len(by_profile)), [len(each.share) for each in by_profile])


def read_sub_sheets(given: int | Sequence[float]) -> Slabs:
    """Return the slabs for `DirectLight.sub_sheets`: a number of slabs, or ascending divisions [sigmas].

    Raises
    ------
    ValueError
        The number is below 1, or the divisions do not ascend or are not finite.
    """
    if isinstance(given, int):
        if given < 1:
            raise ValueError(f"DirectLight.sub_sheets is {given}, expected 1 or more")
        return Slabs.uniform(given)
    cuts = np.asarray(given, np.float64)
    if cuts.ndim != 1 or not np.isfinite(cuts).all() or np.any(np.diff(cuts) <= 0.0):
        raise ValueError("DirectLight.sub_sheets: expected a number of slabs, or ascending places in sigmas")
    return Slabs.from_cuts(cuts)


def _normal_density(x: Float64) -> Float64:
    return np.asarray(np.exp(-0.5 * x * x) / math.sqrt(math.tau))


def _normal_share(low: Float64, high: Float64) -> Float64:
    """Return the share of a Gaussian between two positions; accurate in both tails."""
    return np.asarray(np.where(low > 0.0, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low)))
