"""Settings of a placement machine to try in a plan, with their errors and times by theory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.servoing.placement.budget import ModelTolerance, model_tolerance, predict_budget
from gpuvision.servoing.placement.control import Control
from gpuvision.servoing.placement.machine import Machine, PlacementCamera
from gpuvision.servoing.placement.placing import rule_frames
from gpuvision.servoing.placement.plan import PlacementPlan, plan_placement, tracking_imaging
from gpuvision.servoing.placement.rehearsal import start_zone
from gpuvision.workflows.placement_cell import PlacementCell
from gpuvision.workflows.placement_plan import PlacementPlanLimits, placement_error

Float64 = npt.NDArray[np.float64]

# Sides of the camera windows to try, relative to the machine's: areas a factor of 2 or 4 apart.
_WINDOWS = (0.25, 0.5, math.sqrt(0.5), 1.0, math.sqrt(2.0))
# Least side of a window, and step of the sides [px] (chosen: rulers are 10 to 30 px long).
_MIN_WINDOW, _STEP = 64, 16
_MIN_RULERS = 3  # a pose has three unknowns
# Numbers of rulers to try, relative to the largest one: a factor of 2 apart.
_RULERS = (0.25, 0.5, 1.0)
# Gains, relative to the default of the observer: half the gain averages about twice as many frames.
_GAINS = {"latest": (1.0, 0.5), "smith": (1.0, 0.5)}
# Random motion in a frame of the Kalman filter, in standard deviations of a pose: 0.1 averages about ten frames.
_MOTIONS = (1.0, 0.3, 0.1)
# Tolerances of the release, or waits of the rule "fixed", relative to the machine's: a factor of 2 in the tolerance
# costs a frame or a few.
_RELEASES = (0.25, 0.5, 1.0, 2.0, 4.0)
# Start errors for the mean time by theory, as parts of the landing zone: middles of equal parts of a half axis.
_STARTS = (0.125, 0.375, 0.625, 0.875)

_SAME = 0.01  # relative difference of times and errors that theory cannot tell apart (chosen)


class Setting(NamedTuple):
    """Settings of a machine to try.

    Attributes
    ----------
    machine : Machine
        Machine with the settings.
    budget : int
        Number of rulers asked from `plan_placement`.
    plan : PlacementPlan
        Features.
    seconds, error : float
        Mean time [s] and error [m] of a placement by theory.
    fixed, vision : float
        Parts of the error [m]: calibration, drift and etch bias; noise and sampling.
    """

    machine: Machine
    budget: int
    plan: PlacementPlan
    seconds: float
    error: float
    fixed: float
    vision: float


class PlacementSettings:
    """Settings to try for placements at a target.

    Parameters
    ----------
    artwork, target, machine, budget, device
        As in `plan_placement`; the machine over the side of the artwork.
    part_radius : float
        Distance from the nozzle at which the errors count [m].
    max_rate : float
        Largest frame rate of the camera link and the drives [Hz].
    times_vision : bool
        Measure the time of the vision, for several numbers of rulers.
    limits : PlacementPlanLimits
        Robustness of the loops.
    """

    def __init__(
        self,
        artwork: Artwork,
        target: npt.ArrayLike,
        machine: Machine,
        *,
        part_radius: float,
        max_rate: float,
        budget: int,
        times_vision: bool,
        device: Device,
        limits: PlacementPlanLimits,
    ) -> None:
        self._artwork, self._target, self._machine, self._device = artwork, target, machine, device
        self._part_radius, self._max_rate, self._budget, self._limits = part_radius, max_rate, budget, limits
        self._times_vision = times_vision
        self._plans: dict[tuple[object, ...], PlacementPlan | str] = {}
        self.refusal = ""
        """Reason of the last refused window."""

    def machines(self) -> list[Machine]:
        """Return the machine with the camera windows and frame rates to try, smallest window first."""
        found: dict[tuple[int, int], Machine] = {}
        for factor in _WINDOWS:
            window = self._window(factor)
            try:
                found.setdefault(window, self._with_window(window))
            except ValueError as refused:  # the window or its rate does not suit the machine
                self.refusal = str(refused)
        return list(found.values())

    def _window(self, factor: float) -> tuple[int, int]:
        """Return a window relative to the machine's, in whole steps, within the sensor."""
        machine = self._machine.camera
        if factor == 1.0:
            return machine.window
        (rows, columns), (most_rows, most_columns) = machine.window, machine.sensor.shape
        return _side(factor * rows, most_rows), _side(factor * columns, most_columns)

    def _with_window(self, window: tuple[int, int]) -> Machine:
        """Return the machine with a window, at the highest frame rate of camera, stages and drives."""
        camera = replace(self._machine.camera, window=window)
        return _changed(self._machine, camera=camera, rate=self._rate(camera, self._machine.stages))

    def _rate(self, camera: PlacementCamera, stages: Mapping[str, float]) -> float:
        """Return the highest frame rate of camera, stages and drives.

        Each stage works on another frame. With the stages of the machine file, its frame rate is possible.
        """
        timing = camera.sensor.timing(camera.window, exposure=camera.exposure)
        longest = max([self._machine.transfer, *stages.values()])
        rate = 1.0 / longest if longest else math.inf
        if stages == self._machine.stages:
            rate = max(rate, self._machine.rate)
        return min(self._max_rate, timing.rate, rate)

    def settings(self, machine: Machine) -> Iterator[Setting]:
        """Yield the settings of a machine with a camera window: rulers, controls, and tolerances of the release."""
        rulers = 0
        for budget in self._budgets():
            plan = self._planned(_with_tolerance(machine, max(_RELEASES)), budget)
            if plan is None or len(plan.features.length) == rulers:  # refused, or no more rulers have room
                continue
            rulers = len(plan.features.length)
            yield from self._controlled(self._timed(machine, plan), budget, plan)

    def _budgets(self) -> list[int]:
        """Return the numbers of rulers to try: without a measured time, fewer rulers take as long and see less."""
        if not self._times_vision:
            return [self._budget]
        return sorted({max(round(part * self._budget), _MIN_RULERS) for part in _RULERS})

    def _timed(self, machine: Machine, plan: PlacementPlan) -> Machine:
        """Return the machine with the measured time of the vision."""
        if not self._times_vision:
            return machine
        seconds = PlacementCell(self._artwork, machine, plan, self._device, seed=0).vision_seconds()
        stages = {**machine.stages, "vision": seconds}
        return _changed(machine, stages=stages, rate=self._rate(machine.camera, stages))

    def _controlled(self, machine: Machine, budget: int, plan: PlacementPlan) -> Iterator[Setting]:
        """Yield the settings of a machine with rulers: controls, and tolerances of the release."""
        robust: dict[Control, bool] = {}
        for control in controls(self._machine.control, machine, plan):
            for release in _RELEASES:
                try:
                    controlled = replace(_released(machine, release), control=control)
                except ValueError:  # unstable with this delay, or a wait above the longest time
                    continue
                features = self._planned(controlled, budget, plan)
                if features is None:
                    continue
                if control not in robust:
                    robust[control] = self._is_robust(model_tolerance(controlled, features), controlled)
                if robust[control]:
                    yield self._by_theory(controlled, budget, features)

    def _is_robust(self, tolerance: ModelTolerance | None, machine: Machine) -> bool:
        """Return whether a loop stays stable with the errors of the model that the limits ask for."""
        if tolerance is None:
            return True
        longer = self._limits.longer_delay * machine.period
        return tolerance.plant_gain >= self._limits.plant_gain and tolerance.longer_delay >= longer

    def _planned(self, machine: Machine, budget: int, wide: PlacementPlan | None = None) -> PlacementPlan | None:
        """Return the plan of features for a machine; None if no features suffice.

        ``wide`` is the plan for a larger release tolerance. It is returned if it is precise enough.
        """
        if wide is not None and wide.landing is None and _is_precise(wide, machine):
            return wide
        imaging = tracking_imaging(machine)
        key = (machine.camera.window, budget, imaging, wide is None or _is_precise(wide, machine))
        if key not in self._plans:
            try:
                self._plans[key] = plan_placement(
                    self._artwork, self._target, machine, budget=budget, device=self._device, advises=False
                )
            except ValueError as refused:
                self._plans[key] = str(refused)
        found = self._plans[key]
        if isinstance(found, str):
            self.refusal = found
            return None
        return found

    def _by_theory(self, machine: Machine, budget: int, plan: PlacementPlan) -> Setting:
        """Return a setting with its error budget and the mean number of frames of the step response."""
        zone = start_zone(machine)
        frames = [rule_frames(machine, part * zone) for part in _STARTS]
        errors = predict_budget(machine, plan, frames)
        fixed, vision, total = (
            placement_error(np.sum([errors.sources[name] for name in names], axis=0), self._part_radius)
            for names in (("calibration", "drift", "etch bias"), ("vision", "sampling"), tuple(errors.sources))
        )
        landing = 0.0 if plan.landing is None else machine.landing
        wait = landing + float(np.mean(frames)) * machine.period
        seconds = machine.delay.latency + wait + machine.settling.lead
        return Setting(machine, budget, plan, seconds, total, fixed, vision)


def controls(given: Control, machine: Machine, plan: PlacementPlan) -> list[Control]:
    """Return the controls to try: the given one, and each observer with different averaging.

    Parameters
    ----------
    given : Control
        Control of the machine; all others have its watchdog.
    machine : Machine
        Camera window and frame rate.
    plan : PlacementPlan
        Features, with the covariance of a pose.
    """
    found = [given]
    for observer, gains in _GAINS.items():
        base = Control(observer="smith" if observer == "smith" else "latest", watchdog=given.watchdog)
        largest = replace(machine, control=base).loop_gain
        found += [base, *(replace(base, gain=gain * largest) for gain in gains if gain != 1.0)]
    x, y, theta = np.sqrt(np.diag(plan.reported)).tolist()
    for ratio in _MOTIONS:
        sigmas = (ratio * x, ratio * y, ratio * theta)
        found.append(Control(observer="kalman", motion_sigma=sigmas, watchdog=given.watchdog))
    return list(dict.fromkeys(found))


def best_fronts(settings: Sequence[Setting], count: int) -> list[Setting]:
    """Return the settings that few others beat in both time and error: front by front, until there are enough.

    Of settings with one observer that theory cannot tell apart, the first is taken.

    Parameters
    ----------
    settings : sequence of Setting
        All settings.
    count : int
        Least number of settings to return, if there are as many.
    """
    left, found = sorted(settings, key=lambda each: (each.seconds, each.error)), list[Setting]()
    while left and len(found) < count:
        front, least = [], math.inf
        for each in left:
            if each.error < least:
                front.append(each)
                least = each.error
        found += front
        chosen = {id(each) for each in front}
        left = [each for each in left if id(each) not in chosen and not any(_is_equal(each, one) for one in front)]
    return found


def _is_equal(one: Setting, other: Setting) -> bool:
    """Return whether two settings have the same observer, time and error by theory."""
    is_close = math.isclose(one.seconds, other.seconds, rel_tol=_SAME) and math.isclose(
        one.error, other.error, rel_tol=_SAME
    )
    return is_close and one.machine.control.observer == other.machine.control.observer


def _side(size: float, most: int) -> int:
    return min(max(_STEP * round(size / _STEP), _MIN_WINDOW), most)


def _changed(machine: Machine, **changes: Any) -> Machine:
    """Return the machine with changes; with the default control if the changes make its control unstable."""
    try:
        return replace(machine, **changes)
    except ValueError:
        return replace(machine, **changes, control=Control(watchdog=machine.control.watchdog))


def _released(machine: Machine, factor: float) -> Machine:
    """Return the machine with its fixed wait, or else its release tolerance, multiplied by a factor."""
    settling = machine.settling
    if settling.wait is not None:
        return replace(machine, settling=replace(settling, wait=factor * settling.wait))
    return _with_tolerance(machine, factor)


def _with_tolerance(machine: Machine, factor: float) -> Machine:
    """Return the machine with its release tolerance multiplied by a factor."""
    tolerance = machine.tolerance
    looser = replace(tolerance, position=factor * tolerance.position, angle=factor * tolerance.angle)
    return replace(machine, tolerance=looser)


def _is_precise(plan: PlacementPlan, machine: Machine) -> bool:
    """Return whether three standard deviations of the noise of a frame are within the tolerance of the release."""
    limit = np.array([machine.tolerance.position] * 2 + [machine.tolerance.angle])
    return bool(np.all(3.0 * np.sqrt(np.diag(plan.vision)) <= limit))
