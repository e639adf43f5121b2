"""Plans of placements against truth: ``python -m gpuvision.profiling.placement_plans``.

Each job is a machine over a random board: camera, light, delay, axes, calibration, landing zone, release rule, a
tolerance and a rate. The true error of a setting is that of placements with rendered images, with other start errors
and other noise than in the plan, and with the covariance of calibration and drift. Each placement has another sensor.
Placements follow, up to 384 of the chosen setting and up to 24 of another one, until error and time are clearly above
or below the asked ones. A plan holds if the root mean square error is at most the tolerance, if each part is released,
and if the mean time keeps up with the rate. Its cost is its true time over that of the fastest setting that truly meets
the tolerance. The search goes through all settings that `try_placements` returns, and those that it left out by theory,
in the order of their times in runs without images, until the next one takes 1.25 times as long as the
fastest one found. No setting is passed over by its predicted error. The loops that `PlacementSettings` does not yield,
because a small error of their model makes them unstable, are not in the search. It ends after 60 settings: the best one
is then unknown. A board without features in view is drawn again; other refusals are counted, with their reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from gpuvision.accuracy.plan import PlanError
from gpuvision.formats.cmos_sensor_file import read_cmos_sensor
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.board.view_features import select_features_in_view
from gpuvision.profiling.location_plans import random_board
from gpuvision.profiling.plan_outcomes import Outcome, run_jobs
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.frames import CAMERA, PIPETTE, Transform, compose_poses, invert_pose
from gpuvision.servoing.placement.control import Settling
from gpuvision.servoing.placement.machine import Machine, PlacementCamera, ThermalDrift, Tolerance
from gpuvision.servoing.placement.plan import tracking_imaging
from gpuvision.workflows.placement_plan import PlacementTrial, usable_settings
from gpuvision.workflows.placement_settings import Setting
from gpuvision.workflows.placing import simulate_placements
from gpuvision.workflows.planning_placement import TriedPlacements, choose_placement, rehearse, try_placements

Float64 = npt.NDArray[np.float64]

_SIZE = (16e-3, 12e-3)  # of a board [m]
_PLACEMENTS = (24, 96, 384)  # of the truth of the chosen setting, all together, until it is clear
_FEW = (4, 8, 24)  # of another setting
_CLEARLY = 3.0  # standard errors by which error and time differ from the asked ones (chosen)
_SURELY = 0.99865  # probability of as much in one direction
_SLOWER = 1.25  # a setting that is predicted slower than this part of the longest time is not fast enough (chosen)
# Settings after which the search of a job ends. In a job with 105 settings the search placed 22, each in 0.2 to 2 s of
# processor time. If settings of other jobs take as long, 60 take at most two minutes.
_PLACED = 60
_LARGEST = math.sqrt(2.0)  # side of the largest camera window that a plan tries, relative to the machine's
_RUNS = 8  # without images, for the times of settings that the plan left out
_RULES, _SHARES = ("response", "fixed", "vibration"), (0.5, 0.3, 0.2)  # release rules of the jobs


class Job(NamedTuple):
    """Machine over a board, and what is asked of its placements.

    Attributes
    ----------
    artwork : Artwork
        The board.
    target : (float, float, float)
        Place of the part [m], [m], [rad].
    machine : Machine
        The machine.
    part_radius : float
        Distance from the nozzle at which the errors count [m].
    tolerance : float
        Largest error, as a multiple of the smallest predicted one.
    rate : float
        Placements per second, as a fraction of the rate of the fastest setting.
    """

    artwork: Artwork
    target: tuple[float, float, float]
    machine: Machine
    part_radius: float
    tolerance: float
    rate: float


class Measured(NamedTuple):
    """True error and time of a setting.

    Attributes
    ----------
    error, seconds : float
        Root mean square error [m] and mean time [s]; infinite if a part is not released.
    error_sigma, seconds_sigma : float
        Their standard errors.
    """

    error: float
    seconds: float
    error_sigma: float = 0.0
    seconds_sigma: float = 0.0

    def is_within(self, tolerance: float, longest: float) -> bool:
        """Return whether error and time are within their limits."""
        return self.error <= tolerance and self.seconds <= longest

    def is_clear(self, tolerance: float, longest: float) -> bool:
        """Return whether error and time are clearly below or above their limits."""
        away = abs(self.error - tolerance), abs(self.seconds - longest)
        return away[0] >= _CLEARLY * self.error_sigma and away[1] >= _CLEARLY * self.seconds_sigma


def random_job(rng: np.random.Generator) -> Job:
    """Draw a board, a machine, a target, a tolerance and a rate."""
    sensor = read_cmos_sensor("pb1024")
    away = rng.uniform(-1e-3, 1e-3, 2)
    camera = PlacementCamera(
        sensor=sensor,
        pixel=float(rng.uniform(12e-6, 25e-6)),
        window=(int(rng.integers(160, 321)), int(rng.integers(160, 321))),
        exposure=0.2e-3,
        electrons=float(sensor.saturation * math.exp(rng.uniform(math.log(0.05), math.log(0.8)))),
        blur_px=float(rng.uniform(0.4, 1.0)),
    )
    sigma, turn = rng.uniform(0.05e-6, 0.5e-6), rng.uniform(0.01e-3, 0.1e-3)
    lag = float(rng.choice([0.0, rng.uniform(0.3e-3, 3e-3)]))
    position = float(rng.uniform(2e-6, 8e-6))
    zone = float(rng.uniform(50e-6, 120e-6))
    settling, resonance = _random_rule(rng)
    axis = Axis(lag=lag, encoder=0.05e-6, resonance=resonance, damping=float(rng.uniform(0.03, 0.1)))
    swing = float(rng.uniform(0.05, 0.4)) * zone if resonance else 0.0
    machine = Machine(
        camera=camera,
        pipette_in_camera=Transform.rigid(PIPETTE, CAMERA, (*away, 0.0), np.diag([sigma, sigma, turn]) ** 2),
        tolerance=Tolerance(
            position=position, angle=position / 3e-3, landing_zone=zone, landing_angle=float(rng.uniform(2e-3, 6e-3))
        ),
        axes=(axis, axis, Axis(lag=lag, encoder=1e-5)),
        rate=float(rng.uniform(500.0, 2000.0)),
        transfer=0.1e-3,
        stages={"vision": float(rng.uniform(0.2e-3, 1.5e-3)), "control": 0.1e-3},
        landing=float(rng.uniform(5e-3, 20e-3)),
        drift=ThermalDrift(expansion=(0.3e-6, 0.3e-6), temperature_sigma=float(rng.uniform(0.0, 1.0))),
        settling=settling,
        swing=(swing, swing, 0.0),
    )
    target = np.array(_SIZE) * rng.uniform(0.35, 0.65, 2) + away
    tolerance, rate = math.exp(rng.uniform(math.log(0.9), math.log(4.0))), float(rng.uniform(0.05, 0.9))
    place = (float(target[0]), float(target[1]), float(rng.uniform(-math.pi, math.pi)))
    return Job(random_board(rng), place, machine, float(rng.uniform(0.0, 4e-3)), tolerance, rate)


def _random_rule(rng: np.random.Generator) -> tuple[Settling, float]:
    """Draw a release rule, and the resonance of the axes x and y [rad/s], which the rule "vibration" needs."""
    rule = _RULES[int(rng.choice(len(_RULES), p=_SHARES))]
    if rule == "fixed":
        return Settling(rule="fixed", wait=math.exp(rng.uniform(math.log(2e-3), math.log(40e-3)))), 0.0
    if rule == "response":
        return Settling(), 0.0
    return Settling(rule="vibration"), 2.0 * math.pi * float(rng.uniform(80.0, 250.0))


def judge(rng: np.random.Generator, device: Device) -> Outcome:
    """Plan a random job and measure the plan against truth; a job without features is drawn again."""
    while True:
        job = random_job(rng)
        try:
            found = try_placements(job.artwork, job.target, job.machine, part_radius=job.part_radius, device=device)
        except ValueError as refused:
            if _has_features(job):
                return Outcome(None, math.nan, is_known=False, note=str(refused))
        else:
            return _judge_settings(job, found, device)


def _has_features(job: Job) -> bool:
    """Return whether the largest camera window of a plan shows features that determine the pose at the target."""
    camera, calibrated = job.machine.camera, job.machine.pipette_in_camera.pose
    sides = [min(round(_LARGEST * each), most) for each, most in zip(camera.window, camera.sensor.shape, strict=True)]
    view = replace(camera, window=(sides[0], sides[1])).view(
        compose_poses(np.array(job.target), invert_pose(calibrated))
    )
    try:
        select_features_in_view(job.artwork, view, tracking_imaging(job.machine), with_hint=False)
    except ValueError:
        return False
    return True


def _judge_settings(job: Job, found: TriedPlacements, device: Device) -> Outcome:
    """Choose one of the settings of a job, and compare it with the fastest one that truly meets the tolerance."""
    trials, check = found.trials, found.check
    ordered = _in_order(trials, found.left_out, job.part_radius)
    usable = usable_settings(trials) or usable_settings(ordered)
    if not usable:
        return Outcome(None, math.nan, is_known=False, note="no setting releases the part in each run without images")
    tolerance, rate = job.tolerance * min(each.error for each in usable), job.rate / usable[0].seconds
    measured: dict[str, Measured] = {}

    def true(trial: PlacementTrial, counts: Sequence[int] = _FEW) -> Measured:
        if trial.name not in measured:
            seed = 1000 * (1 + len(measured))
            limits = {"tolerance": tolerance, "longest": 1.0 / rate}
            measured[trial.name] = measure(job, trial, device, counts=counts, seed=seed, **limits)
        return measured[trial.name]

    try:
        plan = choose_placement(trials, check, tolerance=tolerance, rate=rate)
    except PlanError:
        quick = [each for each in ordered if each.seconds * rate <= _SLOWER]
        truths = (true(each) for each in sorted(quick, key=lambda each: each.error)[:_PLACED])
        possible = any(each.is_within(tolerance, 1.0 / rate) for each in truths)
        return Outcome(None, tolerance, possible=possible, is_known=possible or len(quick) <= _PLACED)
    chosen = true(plan.chosen, _PLACEMENTS)
    best = _fastest(ordered, true, tolerance, chosen.seconds if chosen.error <= tolerance else math.inf)
    cost = chosen.seconds / best if math.isfinite(best) else math.nan
    keeps_up, is_known = chosen.seconds * rate <= 1.0, not math.isnan(best)
    return Outcome(plan, tolerance, chosen.error, best * rate <= 1.0, cost, keeps_up, is_known=is_known)


def _in_order(trials: Iterable[PlacementTrial], others: Iterable[Setting], part_radius: float) -> list[PlacementTrial]:
    """Return all settings of the search, fastest first. Settings that never release the part have no time."""
    found = [*trials, *(rehearse(each, part_radius, _RUNS) for each in others)]
    return sorted((each for each in found if each.aborted < 1.0), key=lambda each: each.seconds)


def _fastest(
    ordered: Iterable[PlacementTrial], true: Callable[[PlacementTrial], Measured], tolerance: float, best: float
) -> float:
    """Return the true time of the fastest setting that truly meets the tolerance, at most a given time.

    NaN if more than `_PLACED` settings have to be placed.
    """
    for placed, trial in enumerate(ordered):
        if trial.seconds >= _SLOWER * best:
            break
        if placed == _PLACED:
            return math.nan
        found = true(trial)
        if found.error <= tolerance:
            best = min(best, found.seconds)
    return best


def measure(
    job: Job,
    trial: PlacementTrial,
    device: Device,
    *,
    tolerance: float,
    longest: float,
    counts: Sequence[int] = _PLACEMENTS,
    seed: int,
) -> Measured:
    """Measure a setting in placements with rendered images, apart from the planner.

    The numbers of placements in ``counts`` follow each other until error and time are clear, or the error alone is
    clearly too large.

    Calibration and drift move the nozzle independently of the loop: their covariance is that of the job, and needs no
    samples.
    """
    weights = np.array([1.0, 1.0, job.part_radius**2])
    fixed = float(np.diag(job.machine.pipette_in_camera.pose_covariance + job.machine.drift.covariance) @ weights)
    left = tolerance**2 - fixed  # square of the error by vision and servo that the tolerance leaves
    squares, times, found = np.zeros(0), np.zeros(0), Measured(math.inf, math.inf)
    for total in counts:
        result = simulate_placements(
            job.artwork,
            job.target,
            trial.machine,
            count=total - len(times),
            budget=trial.budget,
            seed=seed + total,
            device=device,
        )
        if not all(each.released for each in result.placements):
            return Measured(math.inf, math.inf)
        squares = np.append(squares, result.sources["vision and servo"] ** 2 @ weights)
        times = np.append(times, [each.record.time[-1] for each in result.placements])
        found = _measured(squares, fixed, times + trial.machine.delay.latency + trial.machine.settling.lead)
        if _is_too_large(squares, left) or (total >= _PLACEMENTS[0] and found.is_clear(tolerance, longest)):
            break
    return found


def _is_too_large(squares: Float64, limit: float) -> bool:
    """Return whether the mean of squares of errors is clearly above a limit.

    The sum of n squares of normal errors in one direction over their variance has the chi-square distribution of n
    degrees of freedom; errors in two directions scatter less.
    """
    return bool(np.sum(squares) > limit * chi2.ppf(_SURELY, len(squares))) if limit > 0.0 else True


def _measured(squares: Float64, fixed: float, times: Float64) -> Measured:
    """Return error and time by the squares of the errors of placements, the square of a common error, and the times."""
    count, mean = len(times), float(np.mean(squares))
    error = math.sqrt(mean + fixed)
    # At least the standard error of normal errors in one direction: the scatter of few squares is often too small.
    sigma = max(float(np.std(squares, ddof=1)), math.sqrt(2.0) * mean) / math.sqrt(count)
    spread = float(np.std(times, ddof=1)) / math.sqrt(count)
    return Measured(error, float(np.mean(times)), sigma / (2.0 * error), spread)


if __name__ == "__main__":
    raise SystemExit(run_jobs(judge, (__doc__ or "").partition("\n\n")[2]))
