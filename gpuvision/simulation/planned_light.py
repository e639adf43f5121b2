"""Light of lit segments on what a sensor sees, as much of it as a tolerance of the range requires."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Bound, Device
from gpuvision.simulation.range_error import StripReading
from gpuvision.simulation.scene import Scene
from gpuvision.simulation.tolerance import LightPlan, LightPlanner
from gpuvision.simulation.visible_light import VisibleLight

Reals = npt.NDArray[np.float64]

# Shapes go by powers of two, from these on, so that few of them are ever bound.
_LEAST_SEGMENTS, _LEAST_PICKS = 64, 4096


class PlannedIrradiance(NamedTuple):
    """What receivers get, as far as the readings need it.

    Attributes
    ----------
    irradiance
        (strips, n), W/m^2: readings made of it are off by the plan's bound at most; single values may be further off.
    plan
        What was modelled.
    """

    irradiance: Reals
    plan: LightPlan


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedLight:
    """Plans each profile, and computes what the plan leaves, by `VisibleLight`; compared by identity.

    Parameters
    ----------
    scene
        What may lie between.
    tolerance
        Metres of range; 0 leaves out only what is zero.
    clearance
        As of `VisibleLight`.
    device
        None: `Device.best`.
    """

    scene: Scene
    tolerance: float
    clearance: float | None = None
    device: Device | None = None
    _planner: LightPlanner = field(init=False, repr=False)
    _bound: dict[Any, Bound[Any]] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "device", Device.best() if self.device is None else self.device)
        object.__setattr__(self, "_planner", self._new_planner())

    def __call__(
        self,
        segments: npt.NDArray[Any],
        receivers: npt.NDArray[Any],
        weights: npt.NDArray[Any],
        reading: StripReading,
        *,
        tolerance: float | None = None,
    ) -> PlannedIrradiance:
        """Return the light of a profile; arguments as of `LightPlanner`."""
        plan = self._planner(segments, receivers, weights, reading, tolerance=tolerance, device=self.device)
        if not plan.modelled:
            return PlannedIrradiance(np.zeros(receivers.shape[:2]), plan)
        rows, starts, picks = plan.tables(self._real, _LEAST_SEGMENTS, _LEAST_PICKS)
        bound = self._bound_for(receivers.shape, len(rows), len(picks))
        # What would be summed up behind the receivers is not needed.
        nothing = np.zeros((*receivers.shape[:2], 2), self._real)
        light = bound.on_host([np.ascontiguousarray(receivers, self._real), nothing, rows, starts, picks])
        return PlannedIrradiance(np.asarray(light.irradiance, np.float64), plan)

    def _new_planner(self) -> LightPlanner:
        return LightPlanner(tolerance=self.tolerance, scene=self.scene, clearance=self.clearance or 0.0)

    def _bound_for(self, shape: tuple[int, ...], segments: int, picks: int) -> Bound[Any]:
        key = (shape, segments, picks)
        if key not in self._bound:
            operation = VisibleLight(
                scene=self.scene, segments=segments, picks=picks, clearance=self.clearance, precision="single"
            )
            self._bound[key] = operation.bind(self.device, shape, self._real)
        return self._bound[key]

    @property
    def _real(self) -> np.dtype[Any]:
        assert self.device is not None
        return np.dtype(np.float64 if self.device.has_double else np.float32)
