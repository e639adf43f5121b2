"""Planning of a simulation: try light paths and discretisations on a sample of the profiles, and choose the fastest.

The light of each path is computed once for each of its discretisations. Exposures of paths add up, so that the reading
of every combination follows without more light.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy.typing as npt

from gpuvision.accuracy.plan import PlanError, TimeLimit, check_time, fastest_within, time_limit
from gpuvision.host import Device
from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import PATHS
from gpuvision.validation import finite
from gpuvision.workflows.light_cache import SimulationTask
from gpuvision.workflows.simulating import prepare_simulation
from gpuvision.workflows.simulation_combinations import Combinations
from gpuvision.workflows.simulation_errors import scene_paths
from gpuvision.workflows.simulation_options import LightOptions
from gpuvision.workflows.simulation_plan import (
    SettingsTrial,
    SimulationPlan,
    SimulationPlanLimits,
    largest_part,
    usable_settings,
)
from gpuvision.workflows.simulation_sample import ProfileSample
from gpuvision.workflows.simulation_survey import profile_shares

Progress = Callable[[int, int | None], object]

# Profiles of a part up to which planning takes longer than it saves, with and without multi-bounce light. Measured on
# PoCL beside other work: planning without it took the time of 1815 to 2741 profiles of the sensor file's light (a part
# of 2500 profiles, two sensors, two tolerances). A plan of half of that light's time then saves time from 3630 to 5482
# profiles on. With it, planning took the time of 115 profiles (one part). That was before settings, and the errors of
# the reference, were tried on more profiles: it takes longer now. This limit was not measured again.
_WORTH_BOUNCES, _WORTH = 120, 4000
# A setting whose error is undecided is worth more profiles if the fastest certain setting takes this many times its
# time or more. Chosen: the largest ratio to the best setting that a plan should have, 1.5, less the scatter of times.
_GAIN = 1.25


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
        Called with the number of lights done, one for each discretisation on each group of profiles, and None: their
        number is not known before.

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
    The noiseless readings of each setting are compared with the readings of a reference on the same profiles. The range
    error is the distance of the readings on the sensor times the derivative dH/du of the height. The reference has the
    finest options, and diffuse light with four times as many rays, which are spread (see `ViewRays`). The error of the
    reference is added to the error of every setting. It is estimated from the change by the last refinement, on all
    profiles on which the reference was computed. The error of its rays per bin is often the largest part;
    `gpuvision.workflows.simulation_reference.SimulationReference` estimates it. Estimates add up as squares.
    That error and the change by the rays of a setting may have the same sign: these two add up linearly. Proven bounds
    add up linearly: the bound of clustered pairs, and the bound of multi-bounce light, which is left out for a PSD if
    this bound in the sample is a tenth of the tolerance or less.

    Of a part with more profiles than the plan tries, a survey by coarse light shows where errors may be large
    (`gpuvision.workflows.simulation_survey.profile_shares`): these profiles are tried with larger chances, and count
    with one over their chance.

    The mean square error over the profiles is raised by twice its standard error. Lowered by as much, it is a lower
    limit. A setting is undecided if its lower limit meets the tolerance and its upper limit does not. It is compared
    on more profiles, with all light computed as the simulation does, if the fastest setting that certainly meets the
    tolerance takes 1.25 times its time or more. The chosen setting is compared on all checked profiles. If no setting
    certainly meets the tolerance, undecided ones are compared on added profiles before the plan refuses. A setting that
    reads other lines than the reference is not chosen. The fraction of such samples has limits too. Not covered:
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
    is_sampled = len(task.transports) > limits.profiles + limits.checked
    shares = profile_shares(task, limits.surveyed, device) if is_sampled and limits.surveyed else None
    sample = ProfileSample.of(task, limits.profiles, device, others=_groups(limits), shares=shares)
    tried = Combinations(LightOptions(sample, tolerance, progress), limits.max_moved)
    trials = tried.trials()
    while (closer := _undecided(trials, tried, tolerance, limits, limit)) is not None:
        tried.look_closer(closer)
        trials = tried.trials()
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
    return SimulationPlan(
        chosen=chosen,
        trials=tuple(trials),
        tolerance=tolerance,
        task=chosen.settings.applied(task),
        finest=tried.finest,
        seconds=time.perf_counter() - start,
        limits=limits,
    )


def _groups(limits: SimulationPlanLimits) -> tuple[int, int, int]:
    """Return the sizes of the groups of other profiles: a quarter of the checked ones rejects most settings."""
    return limits.checked // 4, limits.checked - limits.checked // 4, limits.added


def _undecided(
    trials: Sequence[SettingsTrial],
    tried: Combinations,
    tolerance: float,
    limits: SimulationPlanLimits,
    limit: TimeLimit | None,
) -> SettingsTrial | None:
    """Return a setting that more profiles may show to be the one to choose; None if the choice is certain.

    A setting is undecided if the lower limits of its error and of the moved samples are small enough, and it was not
    tried on all checked profiles. Only the fastest setting whose upper limit meets the tolerance matters, and faster
    ones; without such a setting all undecided ones are tried on the added profiles, which takes long, before the plan
    refuses. Settings on few profiles come first, and of these the fastest.
    """
    needed = limits.profiles + limits.checked
    longest = math.inf if limit is None else limit.seconds
    quick = [each for each in trials if each.seconds <= longest]
    certain = [each for each in usable_settings(quick, limits) if limits.margin * each.error <= tolerance]
    fastest = min(certain, key=lambda each: each.seconds, default=None)
    if fastest is not None:
        quick = [fastest, *(each for each in quick if _GAIN * each.seconds <= fastest.seconds)]
    undecided = [
        each
        for each in quick
        if limits.margin * each.least <= tolerance
        and each.least_moved <= limits.max_moved
        and (fastest is None or each.profiles < needed)
        and tried.has_more(each)
    ]
    return min(undecided, key=lambda each: (each.profiles, each.seconds), default=None)


def is_worth_planning(task: SimulationTask) -> bool:
    """Return whether a part has enough profiles for planning to save time."""
    has_bounces = "multi-bounce" in task.paths and "multi-bounce" in scene_paths(task)
    return len(task.transports) > (_WORTH_BOUNCES if has_bounces else _WORTH)
