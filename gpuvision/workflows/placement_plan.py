"""Plan of placements: settings of a machine that were tried, with errors and times, and the chosen one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.accuracy.plan import AccuracyLimits, AccuracyPlan, TimeLimit
from gpuvision.accuracy.trial import micrometres, millionths
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.plan import PlacementPlan
from gpuvision.validation import finite, integer
from gpuvision.workflows.plan_files import write_plan

Float64 = npt.NDArray[np.float64]

_LEGEND = """errors of the placement in um; machine: calibration, drift and etch bias; vision: by its covariance;
loop: vision and servo in runs without images; images: vision and servo in rendered images
- does not release each part"""


@dataclass(frozen=True, kw_only=True)
class PlacementPlanLimits(AccuracyLimits):
    """Limits of `gpuvision.workflows.planning_placement.plan_placement_settings`; extends `AccuracyLimits`.

    Attributes
    ----------
    rate_margin : float
        Least ratio of the time that rate and latency allow to the mean time of a placement, at least 1. Default 1.05:
        the mean of 24 placements has a standard error of 1 to 2 % (measured).
    plant_gain : float
        Least motion of the head over its commanded motion with which a loop must be stable, above 1. Default 1.25.
    longer_delay : float
        Least delay above the one of the machine with which a loop must be stable [frames], 0 or more. Default 0.5.
    runs : int
        Number of runs without images of each setting, 8 or more. Default 32.
    placements : int
        Number of placements with rendered images that check a setting, 4 or more. Default 24.
    """

    rate_margin: float = 1.05
    plant_gain: float = 1.25
    longer_delay: float = 0.5
    runs: int = 32
    placements: int = 24

    def __post_init__(self) -> None:
        super().__post_init__()
        finite(self.plant_gain, "PlacementPlanLimits.plant_gain", above=1.0)
        finite(self.longer_delay, "PlacementPlanLimits.longer_delay", minimum=0.0)
        integer(self.runs, "PlacementPlanLimits.runs", minimum=8)
        integer(self.placements, "PlacementPlanLimits.placements", minimum=4)


class PlacementTrial(NamedTuple):
    """Settings of a machine that were tried.

    Attributes
    ----------
    machine : Machine
        The machine with the settings: camera window, frame rate, observer, gain, tolerance or wait of the release.
    budget : int
        Number of rulers, for `plan_placement`.
    plan : PlacementPlan
        Features of the placement.
    seconds : float
        Mean time from the exposure of the first frame to the contact of the part [s]: the larger one of the runs
        without images and of the rendered ones. NaN if no run without images releases the part.
    error : float
        Error of the placement [m], root mean square: ``fixed`` with the larger one of ``vision`` and ``loop``. With
        rendered images it is at least ``fixed`` with ``images``, and at most three standard errors above. NaN if no run
        without images releases the part.
    fixed : float
        Error by calibration, drift and etch bias [m].
    vision : float
        Error by noise and sampling, by the covariance of the pose and the averaging of the loop [m].
    loop : float
        Error by vision and servo in runs without images [m].
    images : float
        The same in rendered images [m]; NaN if they were not needed.
    aborted : float
        Fraction of the runs that did not release the part.
    images_sigma : float
        Standard error of ``images`` [m]; NaN if they were not needed.
    """

    machine: Machine
    budget: int
    plan: PlacementPlan
    seconds: float
    error: float
    fixed: float
    vision: float
    loop: float
    images: float
    aborted: float
    images_sigma: float = math.nan

    @property
    def rulers(self) -> int:
        """Number of rulers."""
        return len(self.plan.features.length)

    @property
    def observer(self) -> str:
        """Observer with its gain, and the random motion of a Kalman filter in standard deviations of a pose."""
        control = self.machine.control
        parts: list[str] = [control.observer]
        if control.controller != "p":
            parts.append(control.controller)
        parts.append(f"{self.machine.loop_gain:.2g}")
        if control.motion_sigma is not None:
            ratio = control.motion_sigma[0] / math.sqrt(self.plan.reported[0, 0])
            parts.append(f"sigma {ratio:.2g}")
        return " ".join(parts)

    @property
    def name(self) -> str:
        """Camera window, frame rate, number of rulers, observer with gain, and tolerance or wait of the release."""
        rows, columns = self.machine.camera.window
        window = f"{rows}x{columns} at {self.machine.rate:.5g}/s"
        return f"{window}, {self.rulers} rulers, {self.observer}, release {self._release}"

    @property
    def _release(self) -> str:
        """Fixed wait, or else tolerance of the release."""
        wait = self.machine.settling.wait
        return micrometres(self.machine.tolerance.position) if wait is None else f"after {1e3 * wait:.3g} ms"

    @property
    def error_parts(self) -> dict[str, float]:
        """Parts of the error by name [m]; the images only if they were rendered."""
        parts = {"calibration, drift and etch bias": self.fixed, "vision": self.vision, "loop": self.loop}
        return parts if math.isnan(self.images) else parts | {"images": self.images}

    @property
    def legend(self) -> str:
        """Explanation of the columns."""
        return _LEGEND

    def cells(self) -> dict[str, str]:
        """Return the texts of a row of a table by the headings of their columns; the name is the first."""
        headings = ("us/part", "error", "machine", "vision", "loop")
        numbers = map(millionths, (self.seconds, self.error, self.fixed, self.vision, self.loop))
        texts = dict(zip(headings, numbers, strict=True))
        images = "" if math.isnan(self.images) else millionths(self.images)
        return {"settings": self.name, **texts, "images": images, "aborted": f"{self.aborted:.0%}"}

    def to_dict(self) -> dict[str, Any]:
        """Return the columns by name, for JSON."""
        machine, control = self.machine, self.machine.control
        numbers = {name: getattr(self, name) for name in self._fields if name not in ("machine", "plan")}
        return {
            "settings": self.name,
            "window": list(machine.camera.window),
            "rate": machine.rate,
            "rulers": self.rulers,
            "observer": control.observer,
            "controller": control.controller,
            "gain": machine.loop_gain,
            "motion_sigma": None if control.motion_sigma is None else list(control.motion_sigma),
            "release_position": machine.tolerance.position,
            "release_angle": machine.tolerance.angle,
            "wait": machine.settling.wait,
            "stages": dict(machine.stages),
            **numbers,
        }


@dataclass(frozen=True, kw_only=True)
class PlacementSettingsPlan(AccuracyPlan[PlacementTrial]):
    """Plan of placements on a board. ``str(plan)`` states it in one line.

    ``simulate_placements(artwork, target, plan.chosen.machine, budget=plan.chosen.budget)`` carries it out.

    Attributes
    ----------
    chosen : PlacementTrial
        Fastest settings that meet the tolerance, checked with rendered images.
    trials : tuple of PlacementTrial
        All settings that were tried, fastest first.
    tolerance : float
        Asked error of the placement [m].
    limit : TimeLimit or None
        Longest time of a placement by rate and latency; None without a rate.
    limits : PlacementPlanLimits
        Limits of the plan.
    """

    kind: ClassVar[str] = "setting"
    unit: ClassVar[str] = "placement"

    limit: TimeLimit | None
    limits: PlacementPlanLimits

    @property
    def usable(self) -> list[PlacementTrial]:
        """Settings that may be chosen."""
        return usable_settings(self.trials)

    @property
    def binding(self) -> str:
        """Constraint that keeps the plan from better settings, in words."""
        constraints = []
        if self.faster is not None:
            constraints.append("the tolerance keeps it from a shorter time")
        finer = self.finer
        if finer is not None and self.limit is not None and finer.seconds > self.limit.seconds:
            constraints.append(f"{self.limit.reason} keeps it from a smaller error")
        name, largest = max(self.chosen.error_parts.items(), key=lambda each: each[1])
        constraints.append(f"the largest part of the error is {name}, {micrometres(largest)}")
        return ", ".join(constraints)

    def sentences(self) -> list[str]:
        """Return error and time of the chosen settings, the binding constraint, and what other tolerances give."""
        first, *others = super().sentences()
        return [first, self.binding, *others]

    def write(
        self,
        folder: str | Path,
        *,
        title: str = "Plan",
        overwrite: bool = False,
        more: Mapping[str, Callable[[Path], object]] = MappingProxyType({}),
    ) -> None:
        """Write ``plan.png``, the predicted errors over the times, into a folder, which is created if it is missing.

        Parameters
        ----------
        folder : str or Path
            Output folder.
        title : str
            Title of the picture. Default ``"Plan"``.
        overwrite : bool
            Whether a file may be replaced that no earlier plan wrote. Default False.
        more : mapping of str to callable
            Functions that write other files, by the name of the file. Default: none.

        Raises
        ------
        FileExistsError
            The file exists, and is not an unchanged output of an earlier plan.
        OSError
            The folder cannot be written.
        """
        write_plan(self, folder, error_of="the placement", title=title, overwrite=overwrite, more=more)

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as dictionaries, lists and numbers for JSON."""
        return super().to_dict() | {"binding": self.binding}


def usable_settings(trials: Sequence[PlacementTrial]) -> list[PlacementTrial]:
    """Return the settings that released the part in each run."""
    return [each for each in trials if each.error > 0.0 and not each.aborted]


def placement_error(covariance: Float64, part_radius: float) -> float:
    """Return the root mean square distance by which errors of a placement move the points of a part [m].

    Parameters
    ----------
    covariance : numpy.ndarray
        (3, 3): covariance of x, y [m] and theta [rad] of the nozzle, of errors about 0.
    part_radius : float
        Distance of the points from the nozzle [m], evenly in all directions.
    """
    # A turn t moves a point at (x, y) by t (-y, x): products with a shift vanish over all directions.
    return math.sqrt(covariance[0, 0] + covariance[1, 1] + part_radius**2 * covariance[2, 2])
