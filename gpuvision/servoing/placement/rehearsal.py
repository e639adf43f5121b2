"""Runs of a placement loop without a camera: whether its axes settle, and error and time by the error model."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.loop import SimulatedClock
from gpuvision.servoing.observer import PoseMeasurement
from gpuvision.servoing.placement.control import Settling
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.placing import Placement, count_commands, place_part, predicted_frames
from gpuvision.servoing.placement.plan import PlacementPlan
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.settling import vibration_of_loop
from gpuvision.servoing.simulated_sensor import SimulatedPoseSensor

Float64 = npt.NDArray[np.float64]

# Time in which the vibration of the steered head is identified [periods of the slowest resonance] (chosen).
_IDENTIFICATION = 12.0
_PERIODS = 10.0  # length of the run beyond the step response [periods of the slowest resonance] (chosen)
_START = 0.5  # start error as a part of the landing zone (chosen)
# Standard deviations of the poses that the observer gets, as a part of the tolerance (chosen): the poses have no error.
_SIGMA = 0.1
_SETTLED = 0.01  # largest error that counts as settled, as a part of the tolerance (chosen)
_HALVINGS = 8  # gains that are tried for the message
_MAX_FRAMES = 20_000  # longest run (chosen: about 6 s of computing)
# Start errors fill this part of the landing zone: the first pose has an error, too (chosen).
_FILLED = 0.9


class Rehearsal(NamedTuple):
    """Placements by the error model of the vision, without images.

    Attributes
    ----------
    error : numpy.ndarray
        (n, 3): true pose of the nozzle at the release less the target [m], [m], [rad], by vision and servo: without
        calibration, drift and etch bias. NaN where the part was not released.
    seconds : numpy.ndarray
        (n,): time from the exposure of the first frame to the contact of the part [s].
    """

    error: Float64
    seconds: Float64


def rehearse_placements(machine: Machine, plan: PlacementPlan, *, count: int, seed: int = 0) -> Rehearsal:
    """Run a placement loop from random start errors, on the simulated axes, with poses of the predicted covariance.

    Parameters
    ----------
    machine : Machine
        Machine.
    plan : PlacementPlan
        Features, with the covariances of the pose.
    count : int
        Number of placements.
    seed : int
        Seed of start errors, vibration and noise. Default 0.

    Raises
    ------
    ValueError
        The vibration of the machine leaves no room in its landing zone.

    Notes
    -----
    Noise that changes from frame to frame is added to each pose. Sampling and the differences between the pixels are
    the same in all frames of a placement. Cost: about 0.2 ms a frame. A pose is the one in the middle of the exposure:
    between two commands an axis moves almost evenly.
    """
    zone, swing = start_zone(machine), np.array(machine.swing)
    rng = np.random.default_rng(seed)
    starts, swings = rng.uniform(-zone, zone, (count, 3)), rng.uniform(-1.0, 1.0, (count, 3)) * swing
    shared = plan.sampling + plan.fixed_pattern * plan.vision
    offsets = rng.multivariate_normal(np.zeros(3), shared, count, method="eigh")
    seeds = rng.integers(1 << 32, size=count).tolist()
    errors, seconds = np.full((count, 3), np.nan), np.full(count, np.nan)
    for number, each in enumerate(zip(starts, swings, offsets, seeds, strict=True)):
        errors[number], seconds[number] = _rehearse(machine, plan, *each)
    return Rehearsal(errors, seconds)


def start_zone(machine: Machine) -> Float64:
    """Return the largest start errors (3,) of simulated placements [m], [m], [rad].

    Raises
    ------
    ValueError
        The vibration of the machine leaves no room in its landing zone.
    """
    tolerance = machine.tolerance
    zone: Float64 = _FILLED * np.array([tolerance.landing_zone] * 2 + [tolerance.landing_angle])
    zone -= np.array(machine.swing)
    if not np.all(zone > 0.0):
        raise ValueError(f"swing is {machine.swing}, expected less than {_FILLED} of the landing zone")
    return zone


class IdentifyingMove(NamedTuple):
    """Move of a head without a release, which shows the vibration of the steered head.

    Attributes
    ----------
    machine : Machine
        Machine that waits until the head only swings, and for twelve periods of the slowest resonance.
    response : float
        Time from the first measured pose after which the head only swings [s].
    """

    machine: Machine
    response: float

    @classmethod
    def of(cls, machine: Machine, start: Float64) -> IdentifyingMove:
        """Return the move of a machine from a start error (3,)."""
        slowest = min((axis.resonance for axis in machine.axes if axis.resonance), default=math.inf)
        response = predicted_frames(machine, start) * machine.period
        wait = response + _IDENTIFICATION * 2.0 * math.pi / slowest
        longest = replace(machine.tolerance, max_time=machine.tolerance.max_time + wait + machine.landing)
        return cls(replace(machine, settling=Settling(rule="fixed", wait=wait), tolerance=longest), response)

    def settling(self, settling: Settling, placement: Placement) -> Settling:
        """Return a rule "vibration" with the frequencies and damping ratios of the move.

        Raises
        ------
        ValueError
            The move was aborted, or is too short.
        """
        if not placement.released:
            raise ValueError(f"the vibration of the head cannot be identified: {placement.reason}")
        found = vibration_of_loop(placement.record, placement.first_pose + self.response)
        (fx, fy, ft), (dx, dy, dt) = (each.tolist() for each in found)
        return replace(settling, frequency=(fx, fy, ft), damping=(dx, dy, dt))


def identify_vibration(machine: Machine, plan: PlacementPlan) -> Machine:
    """Return a machine with the rule "vibration" with the vibration of its steered head, found without images.

    Raises
    ------
    ValueError
        The move that shows the vibration was aborted, or is too short.
    """
    zone = start_zone(machine)
    move = IdentifyingMove.of(machine, zone)
    placement, _ = _steer(move.machine, plan, zone, np.array(machine.swing), np.zeros(3), 0)
    return replace(machine, settling=move.settling(machine.settling, placement))


def _rehearse(
    machine: Machine, plan: PlacementPlan, start: Float64, swing: Float64, offset: Float64, seed: int
) -> tuple[Float64, float]:
    """Return error (3,) and time of a placement; NaN where the part is not released."""
    placement, plant = _steer(machine, plan, start, swing, offset, seed)
    if not placement.released:
        return np.full(3, math.nan), math.nan
    released = placement.record.time[-1]
    error = plant.pose(released) - plan.target
    return error, float(machine.delay.latency + released + machine.settling.lead)


def _steer(
    machine: Machine, plan: PlacementPlan, start: Float64, swing: Float64, offset: Float64, seed: int
) -> tuple[Placement, SimulatedPlant]:
    """Run the loop for a part with poses of the predicted covariance and an offset (3,); return run and plant."""
    plant = SimulatedPlant(
        machine.axes,
        start=plan.target + start,
        history=count_commands(machine),
        watchdog=machine.control.watchdog * machine.period,
        swing=swing,
    )
    landing = 0.0 if plan.landing is None else machine.landing

    def seen(frame: int, measured: PoseMeasurement) -> list[PoseMeasurement]:
        """Return the pose as the observer gets it; none during the coarse registration."""
        waits = frame * machine.period < landing - 0.5 * machine.period
        return [] if waits else [measured._replace(pose=measured.pose + offset, covariance=plan.reported)]

    sensor = SimulatedPoseSensor(
        plant.pose,
        period=machine.period,
        delay=machine.delay.latency,
        covariance=(1.0 - plan.fixed_pattern) * plan.vision,
        fault=seen,
        seed=seed,
    )
    return place_part(machine, plan.target, plant, sensor, SimulatedClock(), landing=landing), plant


def check_resonances(machine: Machine) -> None:
    """Check that the loop settles with the axes of a machine.

    Parameters
    ----------
    machine : Machine
        Machine. Its limit of the gain does not include the resonances of the axes.

    Raises
    ------
    ValueError
        The loop swings up, or it gives up: the message names a gain that settles, where one is found. Or the run would
        take more than 20 000 frames.

    Notes
    -----
    Without a resonance there is nothing to check. With one, the loop runs from a start error on the simulated axes with
    exact poses. After the step response it goes on for ten periods of the slowest resonance: the largest error in the
    second half of this time must be below the one in the first half. Cost: about 0.3 ms a frame.
    """
    if not any(axis.resonance for axis in machine.axes):
        return
    if (frames := _run_frames(machine)) > _MAX_FRAMES:
        slowest = min(axis.resonance for axis in machine.axes if axis.resonance) / (2.0 * math.pi)
        raise ValueError(
            f"the check of the slowest resonance, {slowest:.3g} Hz, takes {frames} frames, more than {_MAX_FRAMES}; "
            "raise the resonance, or leave it out"
        )
    reason = _failure(machine)
    if not reason:
        return
    control = machine.control
    gains = (machine.loop_gain / 2.0**power for power in range(1, _HALVINGS + 1))
    lower = (replace(machine, control=replace(control, gain=gain)) for gain in gains if gain > 1e-3)
    found = next((each.loop_gain for each in lower if _run_frames(each) <= _MAX_FRAMES and not _failure(each)), None)
    advice = "" if found is None else f"; it settles with the gain {found:.2g}"
    raise ValueError(f"the loop of gain {machine.loop_gain:.3g} does not settle with these axes: {reason}{advice}")


def _start(machine: Machine) -> Float64:
    """Return the start error (3,) of the run."""
    zone = machine.tolerance
    return _START * np.array([zone.landing_zone, zone.landing_zone, zone.landing_angle])


def _run_frames(machine: Machine) -> int:
    """Return the number of frames of the run: the step response, and periods of the slowest resonance."""
    slowest = min(axis.resonance for axis in machine.axes if axis.resonance)
    periods = _PERIODS * 2.0 * math.pi / slowest
    return predicted_frames(machine, _start(machine)) + math.ceil(periods * machine.rate)


def _failure(machine: Machine) -> str:
    """Return why the loop does not settle; empty if it does."""
    zone, start = machine.tolerance, _start(machine)
    response, wait = predicted_frames(machine, start), _run_frames(machine) * machine.period
    moved = replace(
        machine, settling=Settling(rule="fixed", wait=wait), tolerance=replace(zone, max_time=2.0 * wait + 1.0)
    )
    plant = SimulatedPlant(machine.axes, start=start, swing=machine.swing, history=count_commands(moved))
    limits = np.array([zone.position, zone.position, zone.angle])
    sensor = SimulatedPoseSensor(
        plant.pose,
        period=machine.period,
        delay=machine.delay.latency,
        covariance=np.diag((_SIGMA * limits) ** 2),
        is_noisy=False,
    )
    placement = place_part(moved, np.zeros(3), plant, sensor, SimulatedClock())
    if not placement.released:
        return placement.reason
    swing = np.abs(plant.pose(placement.record.time[response:])) / limits
    first, last = (float(each.max()) for each in np.array_split(swing, 2))
    return "a resonance swings up" if last > max(first, _SETTLED) else ""
