"""Irradiance by lit segments, computed only as far as a tolerance of the range requires."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Bound, Device
from gpuvision.simulation.clustering.light_clustering import LightClustering
from gpuvision.simulation.clustering.light_cut import LightCut
from gpuvision.simulation.errors.range_error import StripErrorModel
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance

Reals = npt.NDArray[np.float64]

# Smallest input sizes [rows]. Sizes are rounded up to powers of two from there, so that few kernels are bound.
_MIN_SEGMENTS, _MIN_SELECTED = 64, 4096
# Measured: the traversal of the tree takes as long as the exact computation of a quarter of all pairs, plus an overhead
# of 2^16 pairs. Pairs that do not face each other cost almost no time in the exact computation.
_TRAVERSAL_COST, _MIN_FACING_PAIRS = 4, 1 << 16
# In a groove, half of the pairs face each other, the most of the measured scenes. Profiles for which half of the pairs
# would not reach the limit are not estimated: the estimate takes a tenth of the time of so few pairs. In a bowl, more
# pairs face each other; one with few pairs is computed in full (speed only).
_MOST_FACING = 2
# Sample sizes of `estimate_pairs`. With twice as many receivers and segments the estimate takes 1.6 times as long.
_SAMPLED_RECEIVERS, _SAMPLED_SEGMENTS = 61, 31


class BoundedIrradiance(NamedTuple):
    """Irradiance of receivers, and the cut of the light tree that it was computed with.

    Attributes
    ----------
    irradiance
        float64 (strips, n), W/m^2. The reading of a strip that is computed from it keeps the bound of the cut
        (`LightCut.bound`); the irradiance of a single receiver may be further off.
    cut
        Pairs that were computed, and the bound of the error by all other pairs.
    """

    irradiance: Reals
    cut: LightCut


@dataclass(frozen=True, kw_only=True, eq=False)
class ClusteredIrradiance:
    """Irradiance by lit segments with error-bounded clustering (lightcuts) where it saves time.

    Each profile is first cut by `LightClustering`; `OccludedIrradiance` computes the pairs that the cut keeps.
    Instances are compared by identity.

    Parameters
    ----------
    scene
        Triangles that may occlude.
    tolerance
        Range error that clustering may make [m], 0 or more; 0 omits only pairs without light.
    min_facing_pairs
        The tree is traversed for profiles whose `estimate_pairs` of facing pairs, less a quarter of all pairs, reaches
        this number, and of which a quarter of all pairs reaches it, too. All pairs are computed for other profiles, and
        with a tolerance of 0, because that is faster. None: the tree is traversed for every profile.
    clearance
        Distance from a surface within which nothing occludes [m], as in `OccludedIrradiance`.
    device
        Device of both steps; None: `Device.best`.

    Notes
    -----
    The pairs that are kept are computed in single precision; that rounding is not part of the bound.

    References
    ----------
    B. Walter et al., *Lightcuts: a scalable approach to illumination*, ACM Transactions on Graphics 24(3), 2005.
    """

    scene: Scene
    tolerance: float
    min_facing_pairs: int | None = _MIN_FACING_PAIRS
    clearance: float | None = None
    device: Device | None = None
    _clustering: LightClustering = field(init=False, repr=False)
    _bound: dict[Any, tuple[Bound[Any], npt.NDArray[Any]]] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "device", Device.best() if self.device is None else self.device)
        object.__setattr__(self, "_clustering", self._make_clustering())

    def __call__(
        self,
        segments: npt.NDArray[Any],
        receivers: npt.NDArray[Any],
        weights: npt.NDArray[Any],
        reading: StripErrorModel,
        *,
        tolerance: float | None = None,
    ) -> BoundedIrradiance:
        """Return the irradiance of a profile within the tolerance.

        Parameters
        ----------
        segments, receivers, weights, reading, tolerance
            As of `LightClustering.__call__`.
        """
        tolerance = self._clustering.tolerance_of(tolerance)
        if not self._is_worthwhile(tolerance, segments, receivers, weights):
            cut = LightCut.full(segments, receivers.shape, reading, tolerance)
            return BoundedIrradiance(self.compute_all(segments, receivers), cut)
        receivers = np.ascontiguousarray(receivers, self._real)
        cut = self._clustering(segments, receivers, weights, reading, tolerance=tolerance, device=self.device)
        if not cut.has_pairs:
            return BoundedIrradiance(np.zeros(receivers.shape[:2]), cut)
        return BoundedIrradiance(
            self._light(receivers, *cut.padded_tables(self._real, _MIN_SEGMENTS, _MIN_SELECTED)), cut
        )

    def compute_all(self, segments: npt.NDArray[Any], receivers: npt.NDArray[Any]) -> Reals:
        """Return the irradiance by all pairs of segments and receivers, (strips, n), W/m^2, without clustering.

        Parameters
        ----------
        segments
            (m, 10): start, end [m], normal, exitance [W/m], as `segment_rows` returns them.
        receivers
            (strips, n, 6): position [m] and normal.
        """
        # The kernel also reads empty rows. Rounding up to eighths of a power of two limits them to an eighth.
        step = max(_MIN_SEGMENTS // 4, (1 << max(len(segments) - 1, 0).bit_length()) // 8)
        rows = np.zeros((max(-(-len(segments) // step), 1) * step, 10), self._real)
        rows[: len(segments)] = segments
        return self._light(receivers, rows)

    def _is_worthwhile(
        self, tolerance: float, segments: npt.NDArray[Any], receivers: npt.NDArray[Any], weights: npt.NDArray[Any]
    ) -> bool:
        if self.min_facing_pairs is None:
            return True
        # The estimate is not needed if half of the pairs would not reach the limit.
        most = len(segments) * (receivers.size // 6)
        if tolerance == 0.0 or most // _MOST_FACING - most // _TRAVERSAL_COST < self.min_facing_pairs:
            return False
        facing, pairs = estimate_pairs(segments, receivers, weights)
        return facing - pairs // _TRAVERSAL_COST >= self.min_facing_pairs

    def _light(self, receivers: npt.NDArray[Any], rows: npt.NDArray[Any], *lists: npt.NDArray[Any]) -> Reals:
        """Return the irradiance by rows of segments; ``lists`` holds the starts and selected segments of a cut."""
        bound, weights = self._bound_for(receivers.shape, len(rows), len(lists[1]) if lists else None)
        light = bound.on_host([np.ascontiguousarray(receivers, self._real), weights, rows, *lists])
        return np.asarray(light.irradiance, np.float64)

    def _make_clustering(self) -> LightClustering:
        return LightClustering(tolerance=self.tolerance, scene=self.scene, clearance=self.clearance or 0.0)

    def _bound_for(
        self, shape: tuple[int, ...], segments: int, selected: int | None
    ) -> tuple[Bound[Any], npt.NDArray[Any]]:
        """Return the bound operation, and weights of 0: the weighted sums of the kernel are not used."""
        key = (shape, segments, selected)
        if key not in self._bound:
            operation = OccludedIrradiance(
                scene=self.scene, segments=segments, selected=selected, clearance=self.clearance, precision="single"
            )
            zeros = np.zeros((*shape[:2], 2), self._real)
            self._bound[key] = operation.bind(self.device, shape, self._real), zeros
        return self._bound[key]

    @property
    def _real(self) -> np.dtype[Any]:
        assert self.device is not None
        return np.dtype(np.float64 if self.device.has_double else np.float32)


class PairCounts(NamedTuple):
    """Estimated numbers of pairs of a receiver with weight and a segment.

    Attributes
    ----------
    facing
        Pairs that face each other.
    all
        All pairs.
    """

    facing: int
    all: int


def estimate_pairs(segments: npt.NDArray[Any], receivers: npt.NDArray[Any], weights: npt.NDArray[Any]) -> PairCounts:
    """Estimate how many pairs of a receiver with weight and a segment face each other, and how many there are.

    A segment is represented by its midpoint. The pairs are counted in a sample at equal steps: 61 to 121 receivers, or
    fewer with a longer step, and 31 to 61 segments; all of them where there are fewer. The step of the receivers and
    the length of a strip have no common divisor, so that the sample has receivers from all parts of a strip.

    Parameters
    ----------
    segments
        (m, 10): start, end, normal, exitance.
    receivers
        (strips, n, 6): position and normal.
    weights
        (strips, n, 2); receivers whose weights are both 0 are not counted.
    """
    if not receivers.size:
        return PairCounts(0, 0)
    count, each = receivers.size // 6, receivers.shape[1]
    step, skip = max(count // _SAMPLED_RECEIVERS, 1), max(len(segments) // _SAMPLED_SEGMENTS, 1)
    while math.gcd(step, each) > 1:
        step += 1
    got, got_weights = (values.reshape(count, -1)[step // 2 :: step] for values in (receivers, weights))
    lit = segments[skip // 2 :: skip]
    place, facing, normal = got[:, :3], got[:, 3:], lit[:, 6:9]
    middle = 0.5 * (lit[:, :3] + lit[:, 3:6])
    arrives = facing @ middle.T > np.vecdot(facing, place)[:, None]
    leaves = place @ normal.T > np.vecdot(normal, middle)
    has_weight = got_weights.any(axis=1)
    per_sample = count * len(segments) / max(arrives.size, 1)
    return PairCounts(
        round(np.count_nonzero((arrives & leaves)[has_weight]) * per_sample),
        round(np.count_nonzero(has_weight) * len(lit) * per_sample),
    )
