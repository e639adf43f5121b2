"""Planning of a simulation: try light paths and discretisations on a sample of the profiles, and choose the fastest.

The light of each path is computed once for each of its discretisations. Exposures of paths add up, so that the reading
of every combination follows without more light.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence

import numpy.typing as npt

from gpuvision.accuracy.plan import PlanError, check_time, fastest_within, time_limit
from gpuvision.host import Device
from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import PATHS
from gpuvision.validation import finite
from gpuvision.workflows.light_cache import SimulationTask
from gpuvision.workflows.simulating import prepare_simulation
from gpuvision.workflows.simulation_errors import ErrorPart, PartEstimate, scene_paths, total_error
from gpuvision.workflows.simulation_options import LightOptions, Option, light_of_options
from gpuvision.workflows.simulation_plan import (
    SettingsTrial,
    SimulationPlan,
    SimulationPlanLimits,
    largest_part,
    usable_settings,
)
from gpuvision.workflows.simulation_sample import Difference, ProfileSample

Progress = Callable[[int, int | None], object]

# Profiles of a part up to which planning takes longer than it saves, with and without multi-bounce light. Measured on
# PoCL: planning took the time of 115 profiles with it (one part), and of 279 to 402 profiles without it (two parts).
_WORTH_BOUNCES, _WORTH = 120, 300


def plan_simulation(
    part: Scene,
    materials: Sequence[Material],
    sensor: Sensor,
    *,
    tolerance: float,
    paths: Sequence[str] = PATHS,
    patch_size: float | None = None,
    profiles: int | None = None,
    transports: npt.ArrayLike | None = None,
    rate: float | None = None,
    latency: float | None = None,
    device: Device | None = None,
    limits: SimulationPlanLimits = SimulationPlanLimits(),
    progress: Progress = lambda done, of: None,
) -> SimulationPlan:
    """Choose the fastest light paths and discretisations of a simulation whose predicted error meets a tolerance.

    Light paths are left out, and slabs of the sheet, rays per bin, patches and the tolerance of clustered pairs are
    tried, from 1 slab to twice the slabs of the sensor file, and from its rays per bin to eight times as many.

    Parameters
    ----------
    part, materials
        Scene in the sensor's coordinates, and a material for every number in `Scene.material`.
    sensor
        Sensor with a light and a straight transport.
    tolerance
        Largest error of the predicted range [m], above 0, root mean square over the samples.
    paths
        Light paths that may be needed, out of `gpuvision.simulation.sensors.readings.PATHS`. Light of others is not in
        the error. Default: all.
    patch_size, profiles, transports
        As in `gpuvision.workflows.simulating.prepare_simulation`; the patch size is the smallest that is tried.
    rate
        Number of profiles per second that the simulation must reach [1/s]. Default: any.
    latency
        Longest time of a profile [s]; needs a rate.
    device
        Default `Device.best`.
    limits
        Margins of the choice, and the size of the sample.
    progress
        Called with the number of discretisations done and the number of all.

    Returns
    -------
    SimulationPlan

    Raises
    ------
    PlanError
        No setting meets the tolerance, or none of them keeps up with the rate.
    ValueError
        As `prepare_simulation`; the tolerance is not above 0, a latency has no rate, or nothing is read in the sample.

    Notes
    -----
    The noiseless readings of each setting are compared with the readings of a reference. The range error is the
    distance of the readings on the sensor times the derivative dH/du of the height. The reference has the finest
    options, and diffuse light with four times as many rays, which are spread (see `ViewRays`). The error of the
    reference is added to the error of every setting. It is estimated from the change by the last refinement. The error
    of its rays per bin is often the largest part; `Combinations.ray_error` estimates it. Estimates add up as squares.
    The change and the error of the reference's rays may have the same sign, and add up linearly.
    Proven bounds add up linearly: the bound of clustered pairs, and the bound of multi-bounce light, which is left out
    for a PSD if this bound in the sample is a tenth of the tolerance or less. The mean square error over the profiles
    is raised by twice its standard error. The chosen setting is compared with the reference on other profiles, with all
    light computed as the simulation does; a setting whose error there exceeds the tolerance, or that reads other lines
    there, is not chosen. Not covered:
    samples that are flagged as ambiguous, light paths that are not in ``paths`` or not modelled, and edges that no
    sampled profile meets.
    """
    task = prepare_simulation(
        part, materials, sensor, paths=paths, patch_size=patch_size, profiles=profiles, transports=transports
    )
    return plan_task(
        task, tolerance=tolerance, rate=rate, latency=latency, device=device, limits=limits, progress=progress
    )


def plan_task(
    task: SimulationTask,
    *,
    tolerance: float,
    rate: float | None = None,
    latency: float | None = None,
    device: Device | None = None,
    limits: SimulationPlanLimits = SimulationPlanLimits(),
    progress: Progress = lambda done, of: None,
) -> SimulationPlan:
    """Choose the settings of a prepared task, as `plan_simulation`.

    Parameters
    ----------
    task
        From `gpuvision.workflows.simulating.prepare_simulation`.
    tolerance
        Largest error of the predicted range [m], above 0, root mean square over the samples.
    rate, latency, device, limits, progress
        As in `plan_simulation`.

    Raises
    ------
    PlanError, ValueError
        As `plan_simulation`.
    """
    finite(tolerance, "tolerance", above=0.0)
    limit = time_limit(rate, latency, limits.rate_margin, SimulationPlan.unit)  # refuses wrong values before the work
    start = time.perf_counter()
    device = Device.best() if device is None else device
    sample = ProfileSample.of(task, limits.profiles, device, others=limits.checked)
    tried = Combinations(LightOptions(sample, tolerance, progress), limits.max_moved)
    trials = tried.trials()
    while True:
        usable = usable_settings(trials, limits)
        if not usable:
            message = "each setting reads other lines than the finest one; raise SimulationPlanLimits.max_moved"
            raise PlanError(message, trials, usable)
        try:
            chosen = fastest_within(trials, usable, tolerance, limits.margin, SimulationPlan.kind)
        except PlanError as refusal:
            best = min(usable, key=lambda each: each.error)
            reason = f"the largest part is {largest_part(best, tried.finest)}"
            raise PlanError(f"{refusal}; {reason}", trials, usable) from None
        check_time(chosen, trials, usable, limit, limits.margin, SimulationPlan.kind)
        checked, moved = tried.check(chosen)
        if not checked > tolerance and moved <= limits.max_moved:
            break
        trials = [
            each._replace(error=max(each.error, checked), moved=max(each.moved, moved)) if each == chosen else each
            for each in trials
        ]
    return SimulationPlan(
        chosen=chosen,
        trials=tuple(trials),
        tolerance=tolerance,
        task=chosen.settings.applied(task),
        finest=tried.finest,
        checked=checked,
        seconds=time.perf_counter() - start,
        limits=limits,
    )


def is_worth_planning(task: SimulationTask) -> bool:
    """Return whether a part has enough profiles for planning to save time."""
    has_bounces = "multi-bounce" in task.paths and "multi-bounce" in scene_paths(task)
    return len(task.transports) > (_WORTH_BOUNCES if has_bounces else _WORTH)


class Combinations:
    """Combinations of options of the light paths, with their errors and times.

    Parameters
    ----------
    options : LightOptions
        Light of the options.
    max_moved : float
        Largest fraction of the samples that a usable combination may read on another line.
    """

    def __init__(self, options: LightOptions, max_moved: float) -> None:
        self._max_moved = max_moved
        self._options, self._axes, self._sample = options, options.axes, options.sample
        finest = [axis[-1] for axis in self._axes]
        self._estimate = PartEstimate(self._sample, options.settings_of(finest), options.reference())
        self._checked = self._sample.reader.read(options.checks) if len(self._sample.others) else None
        self.finest = self._finest_errors()

    def trials(self) -> list[SettingsTrial]:
        """Return the combinations that no usable one beats in time and error, fastest first.

        They are selected by the errors of their options, and then read.
        """
        errors = {id(each): found for axis in self._axes for each, found in self._errors_of(axis)}
        rated = []
        for options in self._options.combinations():
            found = [errors[id(each)] for each in options]
            error = math.hypot(*(each.error for each in found)) + sum(each.pairs for each in options)
            moved = sum(each.changed for each in found)
            rated.append((self._options.seconds_of(options), error, moved, options))
        kept, least = [], math.inf
        for _, error, moved, options in sorted(rated, key=lambda each: each[:2]):
            if error < least:
                kept.append(self.trial(options))
                least = error if moved <= self._max_moved else least
        return kept

    def trial(self, options: Sequence[Option]) -> SettingsTrial:
        """Read a combination of options."""
        reader = self._sample.reader
        difference = reader.compare(reader.read(light_of_options(options)), self._estimate.reading)
        pairs = sum(each.pairs for each in options)
        bound = ErrorPart(pairs, math.nan, is_bound=True)
        return SettingsTrial(
            settings=self._options.settings_of(options),
            seconds=self._options.seconds_of(options),
            error=total_error([*self._with_finest(difference), bound]),
            change=difference.error,
            pairs=pairs,
            finest=total_error(self.finest.values()),
            worst=difference.worst,
            signal=difference.signal,
            moved=difference.changed,
        )

    def check(self, trial: SettingsTrial) -> tuple[float, float]:
        """Return error [m] and moved fraction of settings on the other profiles, as the simulation computes them.

        The error is NaN where nothing is read.
        """
        if self._checked is None:
            return math.nan, 0.0
        reader = self._sample.reader
        found = reader.read(self._sample.light(trial.settings, self._sample.others, runs=1).exposures)
        difference = reader.compare(found, self._checked)
        return total_error(self._with_finest(difference)), difference.changed

    def _with_finest(self, difference: Difference) -> list[ErrorPart]:
        """Return the errors of settings: the difference from the reference, and the errors of the reference.

        The error of the reference's rays may have the sign of the difference: these add up linearly.
        """
        finest = dict(self.finest)
        rays = finest.pop("nodes", ErrorPart(0.0, 0.0))
        return [*finest.values(), ErrorPart(difference.error + rays.error, difference.signal)]

    def _errors_of(self, axis: Sequence[Option]) -> Iterator[tuple[Option, Difference]]:
        """Yield the change of the reading by each option of an axis, with the reference's light of the others."""
        paths, reader = axis[-1].exposures, self._sample.reader
        others = {name: each for name, each in self._options.reference().items() if name not in paths}
        for each in axis:
            reading = reader.read(others | each.exposures)
            yield each, reader.compare(reading, self._estimate.reading)

    def _finest_errors(self) -> dict[str, ErrorPart]:
        """Return the errors of the reference: of first order, the change by the last refinement at most."""
        found = dict(self._options.proven)
        for name, part, factor in (
            ("sub_sheets", "slabs", 1.0),
            # From a quarter of the rays. Measured on four parts: 0.19 to 0.30 of the change.
            ("nodes", "nodes of multi-bounce light", 0.5),
            ("patch_size", "patches", 1.0),
        ):
            light = light_of_options([each for axis in self._axes for each in _last_coarser(axis, name)])
            light.pop("diffuse-diffuse", None)
            if light:
                found[part] = self._estimate.change(light, factor)
        if self._options.rays:
            found["nodes"] = self.ray_error()
        return found | self._estimate.others()

    def ray_error(self) -> ErrorPart:
        """Return the error by the reference's rays per bin.

        It is half of the smaller change from the two finest options. Errors of spread rays are independent: then the
        reference, with four times the rays of the finest option and half of its error (measured: a half to a quarter),
        has 0.45 of that change. A change from an option is large also if one of its rays lies beside a lit line; so the
        smaller change counts.
        """
        changes = [self._estimate.change({"diffuse-diffuse": each}, 0.5) for each in self._options.rays[-3:-1]]
        return min(changes)


def _last_coarser(axis: Sequence[Option], name: str) -> list[Option]:
    """Return the last option of an axis that differs from the finest one only in the field `name`, if there is any."""
    finest = axis[-1].changes
    coarser = [each for each in axis if not each.pairs and each.changes.keys() == finest.keys()]
    return [each for each in coarser if {key for key in finest if each.changes[key] != finest[key]} == {name}][-1:]
