"""Planning of placements: try settings of a machine, and choose the fastest that meets a tolerance.

Errors and times come from theory, then from runs of the loop without images, then from rendered images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.accuracy.plan import PlanError, TimeLimit, check_time, fastest_within, time_limit
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.rehearsal import (
    check_resonances,
    identify_vibration,
    rehearse_placements,
    start_zone,
)
from gpuvision.validation import finite, integer
from gpuvision.workflows.placement_plan import (
    PlacementPlanLimits,
    PlacementSettingsPlan,
    PlacementTrial,
    placement_error,
    usable_settings,
)
from gpuvision.workflows.placement_settings import PlacementSettings, Setting, best_fronts
from gpuvision.workflows.placing import simulate_placements

Float64 = npt.NDArray[np.float64]
Progress = Callable[[int, int | None], object]
Check = Callable[[PlacementTrial], PlacementTrial]

_TRIED = 24  # settings that run without images: the best by theory (chosen: a few seconds)
# Least ratio of the error in images to the predicted one (measured: 0.4 where few rulers have most of the sampling).
_LEAST = 0.4
_CHECKED = 6  # settings that run with images before a refusal (chosen: a few seconds)
# The predicted error is at most the error in images plus this number of its standard errors. Chosen: up to six settings
# run, with 24 placements each. The true error exceeds that limit in 1.5 % of the runs (simulated, normal errors in one
# direction).
_SURE = 3.0
_NO_RELEASE = (
    "no setting releases the part in each run; raise tolerance.max_time, or give a more precise camera or axes that "
    "swing less"
)
_RUNS_SEED, _IMAGES_SEED = 1, 2  # of the runs without images, and of the rendered ones


class TriedPlacements(NamedTuple):
    """Settings for placements at a target.

    Attributes
    ----------
    trials : tuple of PlacementTrial
        Settings that ran without images, fastest first.
    left_out : tuple of Setting
        Settings that theory left out.
    check : callable
        Function that runs a trial with rendered images.
    """

    trials: tuple[PlacementTrial, ...]
    left_out: tuple[Setting, ...]
    check: Check


def plan_placement_settings(
    artwork: Artwork,
    target: npt.ArrayLike,
    machine: Machine,
    *,
    tolerance: float,
    rate: float | None = None,
    latency: float | None = None,
    part_radius: float | None = None,
    max_rate: float | None = None,
    budget: int = 60,
    times_vision: bool = False,
    device: Device | None = None,
    limits: PlacementPlanLimits = PlacementPlanLimits(),
    progress: Progress = lambda done, of: None,
) -> PlacementSettingsPlan:
    """Choose the settings of a machine with the shortest placements whose error meets a tolerance.

    Camera windows, each with its highest frame rate, observers with different averaging, and tolerances of the release
    are tried; with the release rule "fixed" its waits. All other settings are the machine's.

    Parameters
    ----------
    artwork : Artwork
        Side of the board on which parts are placed, read with the clearance of `placement_imaging`.
    target : array_like
        (3,): pose of the part in the frame of the board's files, x, y [m], theta [rad].
    machine : Machine
        Machine. `Machine.for_side` turns it to the side of the artwork.
    tolerance : float
        Largest error of the placement [m], above 0: distance of a point of the part from its place, root mean square
        over placements and over points at ``part_radius`` from the nozzle.
    rate : float, optional
        Placements per second under the camera [1/s], without the long move: the mean time must keep up with it.
    latency : float, optional
        Longest acceptable mean time of a placement [s]; needs a rate.
    part_radius : float, optional
        Distance from the nozzle at which the errors count [m], 0 or more. Default: the tolerances of the machine,
        position over angle.
    max_rate : float, optional
        Largest frame rate of the camera link and the drives [Hz]. Default: the frame rate of the machine.
    budget : int
        Largest number of rulers, 3 or more; default 60. The stage "vision" of the machine is the time for this number.
    times_vision : bool
        Measure the time of the vision on the device instead, for this number of rulers, a half and a quarter of it. The
        frame rate of the machine must then hold for its camera link and drives only. Default False.
    device : Device, optional
        Where to render and measure. Default `Device.best`.
    limits : PlacementPlanLimits
        Margins of the choice.
    progress : callable, optional
        Called with the number of tried settings and the number of all.

    Returns
    -------
    PlacementSettingsPlan

    Raises
    ------
    PlanError
        No setting meets the tolerance, or none of them keeps up with the rate.
    ValueError
        A number is out of its range, a latency has no rate, or the features of no window guide the placement.

    Notes
    -----
    Theory (`predict_budget`, `predicted_frames`) orders all settings; loops that are unstable with a small error of
    their model are left out. The best 24 or more run without images: on the simulated axes, with poses of the predicted
    covariance (`rehearse_placements`). A setting that does not release each part is not used. The fastest setting that
    meets the tolerance then runs with rendered images and other seeds (`simulate_placements`). If its true error there
    is above the tolerance, or its time is longer than that of another one, the next setting is taken. Before a refusal
    up to six settings run with images whose error may be smaller than predicted: they are taken if their error in
    images, three standard errors above it at most, is within the tolerance. The time counts from the exposure of the
    first frame to the contact. Not covered: boards that differ from the artwork other than by etch bias, and jitter of
    the delay.
    """
    finite(tolerance, "tolerance", above=0.0)
    time_limit(rate, latency, limits.rate_margin, PlacementSettingsPlan.unit)  # refuses wrong values before the work
    found = try_placements(
        artwork,
        target,
        machine,
        part_radius=part_radius,
        max_rate=max_rate,
        budget=budget,
        times_vision=times_vision,
        device=device,
        limits=limits,
        progress=progress,
    )
    return choose_placement(found.trials, found.check, tolerance=tolerance, rate=rate, latency=latency, limits=limits)


def try_placements(
    artwork: Artwork,
    target: npt.ArrayLike,
    machine: Machine,
    *,
    part_radius: float | None = None,
    max_rate: float | None = None,
    budget: int = 60,
    times_vision: bool = False,
    device: Device | None = None,
    limits: PlacementPlanLimits = PlacementPlanLimits(),
    progress: Progress = lambda done, of: None,
) -> TriedPlacements:
    """Try settings at a target, for `choose_placement`.

    Parameters and errors are those of `plan_placement_settings`.
    """
    device = Device.best() if device is None else device
    machine = machine.for_side(artwork.side)
    start_zone(machine)  # refuses a vibration that leaves no room
    tolerance = machine.tolerance
    radius = tolerance.position / tolerance.angle if part_radius is None else part_radius
    finite(radius, "part_radius", minimum=0.0)
    choices = PlacementSettings(
        artwork,
        target,
        machine,
        part_radius=radius,
        max_rate=machine.rate if max_rate is None else finite(max_rate, "max_rate", above=0.0),
        budget=integer(budget, "budget", minimum=3),
        times_vision=times_vision,
        device=device,
        limits=limits,
    )
    settings = [one for each in choices.machines() for one in choices.settings(each)]
    if not settings:
        raise ValueError(f"no settings to plan from: {choices.refusal or 'each loop is too sensitive to its model'}")
    tried = best_fronts(settings, _TRIED)
    trials = []
    for number, each in enumerate(tried):
        trials.append(rehearse(each, radius, limits.runs))
        progress(number + 1, len(tried))

    def check(trial: PlacementTrial) -> PlacementTrial:
        return check_with_images(trial, artwork, radius, limits.placements, device, seed=_IMAGES_SEED)

    chosen = {id(each) for each in tried}
    left_out = tuple(each for each in settings if id(each) not in chosen)
    return TriedPlacements(tuple(sorted(trials, key=_by_time)), left_out, check)


def choose_placement(
    trials: Sequence[PlacementTrial],
    check: Check,
    *,
    tolerance: float,
    rate: float | None = None,
    latency: float | None = None,
    limits: PlacementPlanLimits = PlacementPlanLimits(),
) -> PlacementSettingsPlan:
    """Choose the fastest of the settings that were tried, checked with rendered images.

    Parameters
    ----------
    trials, check
        Result of `try_placements`.
    tolerance : float
        Largest error of the placement [m], above 0.
    rate, latency, limits
        As in `plan_placement_settings`.

    Raises
    ------
    PlanError, ValueError
        As `plan_placement_settings`.
    """
    finite(tolerance, "tolerance", above=0.0)
    limit = time_limit(rate, latency, limits.rate_margin, PlacementSettingsPlan.unit)
    left = list(trials)
    while math.isnan((chosen := _next(left, tolerance, limit, limits.margin)).images):
        checked = check(chosen)  # a larger error takes the setting out of the choice, a longer time may
        left = [checked if each is chosen else each for each in left]
    left.sort(key=_by_time)
    return PlacementSettingsPlan(chosen=chosen, trials=tuple(left), tolerance=tolerance, limit=limit, limits=limits)


def _next(trials: Sequence[PlacementTrial], tolerance: float, limit: TimeLimit | None, margin: float) -> PlacementTrial:
    """Return the fastest usable setting within the tolerance and the time limit, to be checked with images.

    An error that was measured in images needs no margin. Without such a setting, the one with the smallest predicted
    error is returned that images may still show to be within the tolerance: the prediction is often an upper estimate.
    """
    usable = usable_settings(trials)
    if not usable:
        raise PlanError(_NO_RELEASE, trials, usable)
    met = [each for each in usable if (margin if math.isnan(each.images) else 1.0) * each.error <= tolerance]
    chosen = min(met, key=_by_time, default=None)
    if chosen is not None and (limit is None or chosen.seconds <= limit.seconds):
        return chosen
    in_time = [each for each in usable if limit is None or each.seconds <= limit.seconds]
    hopeful = [each for each in in_time if math.isnan(each.images) and _least_error(each) <= tolerance]
    if hopeful and sum(not math.isnan(each.images) for each in trials) < _CHECKED:
        return min(hopeful, key=lambda each: each.error)
    if chosen is None:
        return fastest_within(trials, usable, tolerance, margin, PlacementSettingsPlan.kind)  # raises the refusal
    check_time(chosen, trials, usable, limit, margin, PlacementSettingsPlan.kind)  # raises the refusal
    return chosen


def _least_error(trial: PlacementTrial) -> float:
    """Return the smallest error that images may show for a setting [m]."""
    return math.hypot(trial.fixed, _LEAST * max(trial.vision, trial.loop))


def _by_time(trial: PlacementTrial) -> tuple[bool, float, float]:
    """Return the key that sorts settings by time, then by error; those that released no part are last."""
    return math.isnan(trial.seconds), trial.seconds, trial.error


def rehearse(setting: Setting, part_radius: float, runs: int) -> PlacementTrial:
    """Return a setting with the errors and times of runs without images."""
    machine, plan = setting.machine, setting.plan
    fixed, vision = setting.fixed, setting.vision
    try:
        check_resonances(machine)
        if machine.settling.rule == "vibration":  # the frequencies depend on the control loop
            machine = identify_vibration(machine, plan)
    except ValueError:  # a resonance swings up
        return PlacementTrial(machine, setting.budget, plan, math.nan, math.nan, fixed, vision, math.nan, math.nan, 1.0)
    found = rehearse_placements(machine, plan, count=runs, seed=_RUNS_SEED)
    loop, seconds, aborted = _runs(found.error, found.seconds, part_radius)
    error = math.nan if math.isnan(loop) else math.hypot(fixed, max(vision, loop))
    return PlacementTrial(machine, setting.budget, plan, seconds, error, fixed, vision, loop, math.nan, aborted)


def check_with_images(
    trial: PlacementTrial, artwork: Artwork, part_radius: float, placements: int, device: Device, *, seed: int
) -> PlacementTrial:
    """Return a setting with the errors and times of placements with rendered images.

    Parameters
    ----------
    trial : PlacementTrial
        Result of `rehearse`.
    artwork, part_radius, device
        As in `plan_placement_settings`.
    placements : int
        Number of placements.
    seed : int
        Seed of start errors and noise.
    """
    machine, settling = trial.machine, trial.machine.settling
    result = simulate_placements(
        artwork, trial.plan.target, machine, count=placements, budget=trial.budget, seed=seed, device=device
    )
    waits = [each.record.time[-1] if each.released else math.nan for each in result.placements]
    seconds = machine.delay.latency + np.array(waits) + settling.lead
    errors = result.sources["vision and servo"]
    images, mean, aborted = _runs(errors, seconds, part_radius)
    sigma = _standard_error(errors[np.isfinite(seconds)], part_radius)
    predicted = min(max(trial.vision, trial.loop), images + _SURE * sigma)
    return trial._replace(
        images=images,
        images_sigma=sigma,
        error=math.hypot(trial.fixed, max(images, predicted)),
        seconds=max(trial.seconds, mean),
        aborted=max(trial.aborted, aborted),
    )


def _standard_error(error: Float64, part_radius: float) -> float:
    """Return the standard error of the root mean square of errors (n, 3) [m]; NaN of fewer than two."""
    if len(error) < 2:
        return math.nan
    squares = np.array([placement_error(np.outer(each, each), part_radius) ** 2 for each in error])
    mean = float(np.mean(squares))
    # At least that of normal errors in one direction: the scatter of few squares is often too small.
    scatter = max(float(np.std(squares, ddof=1)), math.sqrt(2.0) * mean)
    return scatter / math.sqrt(len(squares)) / (2.0 * math.sqrt(mean))


def _runs(error: Float64, seconds: Float64, part_radius: float) -> tuple[float, float, float]:
    """Return the root mean square error [m] and the mean time [s] of released parts, and the fraction of the others."""
    released = np.isfinite(seconds)
    if not released.any():
        return math.nan, math.nan, 1.0
    found = error[released]
    square = placement_error(found.T @ found / len(found), part_radius)
    return square, float(np.mean(seconds[released])), float(np.mean(~released))
