"""Light of lit segments on what a sensor sees, as much of it as a tolerance of the range requires."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Bound, Device
from gpuvision.simulation.clustering.light_clustering import LightClustering, LightCut
from gpuvision.simulation.errors.range_error import StripErrorModel
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance

Reals = npt.NDArray[np.float64]

# Shapes go by powers of two, from these on, so that few of them are ever bound.
_LEAST_SEGMENTS, _LEAST_PICKS = 64, 4096
# A plan goes over all pairs, which takes about as long as to compute a quarter of them, and has its overhead; what does
# not face each other costs next to nothing without one.
_OF_ALL, _LEAST_FACING = 4, 1 << 16
# Receivers and segments among which those that face each other are counted; primes, to meet no period of theirs.
_RECEIVERS, _SEGMENTS = 127, 61


class BoundedIrradiance(NamedTuple):
    """What receivers get, as far as the readings need it.

    Attributes
    ----------
    irradiance
        (strips, n), W/m^2: readings made of it are off by the plan's bound at most; single values may be further off.
    plan
        What was modelled.
    """

    irradiance: Reals
    plan: LightCut


@dataclass(frozen=True, kw_only=True, eq=False)
class ClusteredIrradiance:
    """Plans each profile where that pays, and computes what is left, by `OccludedIrradiance`; compared by identity.

    Parameters
    ----------
    scene
        What may lie between.
    tolerance
        Metres of range; 0 leaves out only what is zero.
    least
        What is planned: profiles whose `facing_pairs`, less a quarter of all pairs, are so many at least. Others take
        less time without a plan, and so does a tolerance of 0. None: every profile.
    clearance
        As of `OccludedIrradiance`.
    device
        None: `Device.best`.
    """

    scene: Scene
    tolerance: float
    least: int | None = _LEAST_FACING
    clearance: float | None = None
    device: Device | None = None
    _planner: LightClustering = field(init=False, repr=False)
    _bound: dict[Any, Bound[Any]] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "device", Device.best() if self.device is None else self.device)
        object.__setattr__(self, "_planner", self._new_planner())

    def __call__(
        self,
        segments: npt.NDArray[Any],
        receivers: npt.NDArray[Any],
        weights: npt.NDArray[Any],
        reading: StripErrorModel,
        *,
        tolerance: float | None = None,
    ) -> BoundedIrradiance:
        """Return the light of a profile; arguments as of `LightClustering`."""
        asked = self._planner.asked(tolerance)
        if not self._pays(asked, segments, receivers, weights):
            plan = LightCut.of_all(segments, receivers.shape, reading, asked)
            return BoundedIrradiance(self.exactly(segments, receivers), plan)
        plan = self._planner(segments, receivers, weights, reading, tolerance=asked, device=self.device)
        if not plan.modelled:
            return BoundedIrradiance(np.zeros(receivers.shape[:2]), plan)
        return BoundedIrradiance(self._light(receivers, *plan.tables(self._real, _LEAST_SEGMENTS, _LEAST_PICKS)), plan)

    def exactly(self, segments: npt.NDArray[Any], receivers: npt.NDArray[Any]) -> Reals:
        """Return the irradiance by all segments, (strips, n), W/m^2, without a plan."""
        # Rows that are empty are read all the same: by eighths of a power of two, no more of them than that.
        step = max(_LEAST_SEGMENTS // 2, (1 << max(len(segments) - 1, 0).bit_length()) // 8)
        rows = np.zeros((max(-(-len(segments) // step), 1) * step, 10), self._real)
        rows[: len(segments)] = segments
        return self._light(receivers, rows)

    def _pays(
        self, tolerance: float, segments: npt.NDArray[Any], receivers: npt.NDArray[Any], weights: npt.NDArray[Any]
    ) -> bool:
        if self.least is None:
            return True
        pairs = len(segments) * len(_counting(weights))
        # Not even if all of them faced each other.
        if tolerance == 0.0 or pairs - pairs // _OF_ALL < self.least:
            return False
        return facing_pairs(segments, receivers, weights) - pairs // _OF_ALL >= self.least

    def _light(self, receivers: npt.NDArray[Any], rows: npt.NDArray[Any], *picked: npt.NDArray[Any]) -> Reals:
        """Return the irradiance by rows of segments; by those of starts and picks, if given."""
        bound = self._bound_for(receivers.shape, len(rows), len(picked[1]) if picked else None)
        # What would be summed up behind the receivers is not needed.
        nothing = np.zeros((*receivers.shape[:2], 2), self._real)
        light = bound.on_host([np.ascontiguousarray(receivers, self._real), nothing, rows, *picked])
        return np.asarray(light.irradiance, np.float64)

    def _new_planner(self) -> LightClustering:
        return LightClustering(tolerance=self.tolerance, scene=self.scene, clearance=self.clearance or 0.0)

    def _bound_for(self, shape: tuple[int, ...], segments: int, picks: int | None) -> Bound[Any]:
        key = (shape, segments, picks)
        if key not in self._bound:
            operation = OccludedIrradiance(
                scene=self.scene, segments=segments, picks=picks, clearance=self.clearance, precision="single"
            )
            self._bound[key] = operation.bind(self.device, shape, self._real)
        return self._bound[key]

    @property
    def _real(self) -> np.dtype[Any]:
        assert self.device is not None
        return np.dtype(np.float64 if self.device.has_double else np.float32)


def facing_pairs(segments: npt.NDArray[Any], receivers: npt.NDArray[Any], weights: npt.NDArray[Any]) -> int:
    """Return about how many pairs of a receiver with weight and a segment's middle face each other.

    Counted among 127 receivers and 61 segments, evenly spread; among all where there are no more.
    """
    counting = _counting(weights)
    got = receivers.reshape(-1, 6)[_spread(counting, _RECEIVERS)].astype(np.float64)
    lit = _spread(np.asarray(segments, np.float64), _SEGMENTS)
    middle, normal = 0.5 * (lit[:, :3] + lit[:, 3:6]), lit[:, 6:9]
    arrives = got[:, 3:] @ middle.T > np.sum(got[:, 3:] * got[:, :3], axis=1)[:, None]
    leaves = got[:, :3] @ normal.T > np.sum(normal * middle, axis=1)
    share = np.count_nonzero(arrives & leaves) / max(arrives.size, 1)
    return int(share * len(counting) * len(segments))


def _counting(weights: npt.NDArray[Any]) -> npt.NDArray[np.intp]:
    return np.flatnonzero((weights[..., 0] != 0.0) | (weights[..., 1] != 0.0))


def _spread(values: npt.NDArray[Any], most: int) -> npt.NDArray[Any]:
    """Return at most so many of them, evenly."""
    if len(values) <= most:
        return values
    return values[(2 * np.arange(most) + 1) * len(values) // (2 * most)]
