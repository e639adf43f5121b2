"""Servo loop of measured poses, observer, controller and guards; plant, sensor and clock are real or simulated.

In each frame the loop takes the poses that have arrived, corrects the observer, and commands a velocity until the next
frame. `TravelGuard` and `Outcome` describe the reaction to faults.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 5.4.4 and
   8.7.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.controllers import Controller
from gpuvision.servoing.frames import pose_difference
from gpuvision.servoing.guard import FaultCounter, LoopLimits, Outcome, TravelGuard
from gpuvision.servoing.observer import SAME_TIME, MotionEstimate, Observer, PoseMeasurement, PosePrediction, Verdict
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]


class PlantReading(NamedTuple):
    """State that the encoders of a plant report.

    Attributes
    ----------
    time : float
        Time of the reading [s].
    position : numpy.ndarray
        (3,): x [m], y [m], theta [rad] by the encoders; NaN for an axis without encoder.
    at_limit : numpy.ndarray
        (3,) int8: -1 or 1 for an axis at its lower or upper limit, otherwise 0.
    """

    time: float
    position: Float64
    at_limit: npt.NDArray[np.int8]


class Plant(Protocol):
    """Axes of a machine that move the head: a motion controller or its simulation."""

    def command(self, time: float, velocity: Float64) -> None:
        """Move with a velocity (3,) [m/s], [m/s], [rad/s] from a time on, until the next command.

        A plant with a watchdog stops by itself a fixed time after its last command, so that the head stops when the
        computer hangs. Give this time as `LoopLimits.watchdog`: one frame or a little more.
        """

    def read(self, time: float) -> PlantReading:
        """Return the reading of the encoders at a time, not before the last command."""


class PoseSensor(Protocol):
    """Source of measured poses: a camera with its image processing, or their simulation."""

    def __call__(self, time: float, predicted: PosePrediction) -> Sequence[PoseMeasurement]:
        """Return the measurements that arrived since the last call, up to a time [s].

        A sensor that searches near an expected pose calls ``predicted`` with the time of each exposure.
        """


class Clock(Protocol):
    """Clock of the loop: wall clock or simulated clock."""

    def now(self) -> float:
        """Return the time [s]."""

    def wait_until(self, time: float) -> float:
        """Wait until a time [s] and return the time; return at once if it is past."""


class SimulatedClock:
    """Simulated clock: waiting sets it to the requested time at once."""

    def __init__(self) -> None:
        self._time = 0.0

    def now(self) -> float:
        """Return the time [s]; 0 at first."""
        return self._time

    def wait_until(self, time: float) -> float:
        """Set the clock to a time [s], unless it is past, and return the time."""
        self._time = max(self._time, time)
        return self._time


class WallClock:
    """Wall clock from 0 at its construction; it waits by sleeping, and by polling at the end.

    Parameters
    ----------
    spin : float
        Time of polling at the end of a wait [s]: the operating system may end a sleep late. Default 0.2 ms. Range: 0 or
        more.

    Attributes
    ----------
    start : float
        Time 0 of the clock, in seconds of `time.perf_counter`. Give it to `streamed_pose`: the measurements then have
        the times of this clock.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.
    """

    def __init__(self, spin: float = 2e-4) -> None:
        self.start, self._spin = time.perf_counter(), finite(spin, "spin", minimum=0.0)

    def now(self) -> float:
        """Return the time [s]."""
        return time.perf_counter() - self.start

    def wait_until(self, until: float) -> float:
        """Wait until a time [s] and return the time; return at once if it is past."""
        while (left := until - self.now()) > 0.0:
            if left > self._spin:
                time.sleep(left - self._spin)
        return self.now()


class SettlingRule(Protocol):
    """Decision whether the head may place its part; see `gpuvision.servoing.settling`."""

    def __call__(self, time: float, error: Float64, covariance: Float64) -> bool:
        """Return whether an error (3,) with a covariance (3, 3) at a time [s] allows the placement."""


Target = Callable[[float], tuple[Float64, Float64]]
"""Function of the time [s] that returns the target's pose (3,) and velocity (3,)."""


class LoopRecord(NamedTuple):
    """History of a run of the loop, one row for each frame.

    Attributes
    ----------
    outcome : Outcome
        Reason why the loop ended.
    time : numpy.ndarray
        (n,): begin of the frames [s].
    target, pose, velocity : numpy.ndarray
        (n, 3): target, and estimated pose and velocity [m], [m], [rad], per second.
    sigma : numpy.ndarray
        (n, 3): standard deviations of the estimated pose.
    command : numpy.ndarray
        (n, 3): commanded velocities.
    encoder : numpy.ndarray
        (n, 3): readings of the encoders.
    computing : numpy.ndarray
        (n,): time from the begin of the frame to its command [s]; 0 with a simulated clock.
    measurements : tuple of (PoseMeasurement, Verdict)
        Measurements in the order of arrival.
    missed : int
        Number of frames that began late by a frame or more.
    glitches : int
        Number of readings whose encoders contradicted the commands.
    """

    outcome: Outcome
    time: Float64
    target: Float64
    pose: Float64
    velocity: Float64
    sigma: Float64
    command: Float64
    encoder: Float64
    computing: Float64
    measurements: tuple[tuple[PoseMeasurement, Verdict], ...]
    missed: int
    glitches: int


class ServoLoop:
    """Loop that steers a plant to a target by measured poses.

    A run resets the controller. The loop refuses a measurement that was exposed after the begin of the frame: its times
    belong to another clock. With a `WallClock`, run the loop inside `low_latency`.

    Parameters
    ----------
    plant : Plant
        Axes of the machine.
    sensor : PoseSensor
        Source of measured poses of the head.
    observer : Observer
        Estimate of the pose, such as a `PoseObserver`. The caller resets it to the first known pose.
    controller : Controller
        Rule from error to velocity, such as a `PidController`.
    clock : Clock
        `WallClock`, or `SimulatedClock` for a simulation.
    period : float
        Frame time [s]. Range: above 0.
    limits : LoopLimits, optional
        Thresholds of the guards. None switches them off: the loop may then diverge. Default: `LoopLimits()`.

    Raises
    ------
    ValueError
        The frame time is not above 0.
    """

    def __init__(
        self,
        plant: Plant,
        sensor: PoseSensor,
        observer: Observer,
        controller: Controller,
        clock: Clock,
        *,
        period: float,
        limits: LoopLimits | None = LoopLimits(),
    ) -> None:
        self.plant, self.sensor, self.observer = plant, sensor, observer
        self.controller, self.clock = controller, clock
        self.period, self.limits = finite(period, "period", above=0.0), limits

    def run(
        self,
        target: npt.ArrayLike | Target,
        duration: float,
        *,
        settling: SettlingRule | None = None,
    ) -> LoopRecord:
        """Steer the head to a target until it has settled, the time is over, or a guard gives up; then stop it.

        Parameters
        ----------
        target : array_like or function
            (3,): x [m], y [m], theta [rad]; or a function of the time [s] that returns pose and velocity.
        duration : float
            Longest time [s]. Range: above 0.
        settling : SettlingRule, optional
            Rule that ends the loop. Default: the loop runs for the duration.

        Raises
        ------
        ValueError
            The duration is not above 0; or the target's function or the controller returns a number that is not finite:
            the head is then stopped.
        """
        goal = target if callable(target) else _resting(target)
        return _Run(self, goal, settling, finite(duration, "duration", above=0.0)).finish()


def _resting(target: npt.ArrayLike) -> Target:
    pose, rest = np.array(numbers(target, (3,), "target")), np.zeros(3)
    return lambda _: (pose, rest)


class _Run:
    """State of one run of a loop."""

    def __init__(self, loop: ServoLoop, goal: Target, settling: SettlingRule | None, duration: float) -> None:
        self.loop, self.goal, self.settling = loop, goal, settling
        self.limits = loop.limits or LoopLimits()
        self.guard = TravelGuard(self.limits.margin_sigmas, self.limits.lag, self.limits.overshoot)
        self.faults = FaultCounter(self.limits)
        loop.controller.reset()
        self.start = loop.clock.now()
        self.count = max(math.ceil(duration / loop.period - 1e-9), 1)
        self.columns = np.zeros((6, self.count, 3))  # target, pose, velocity, sigma, command, encoder
        self.times, self.computing = np.zeros(self.count), np.zeros(self.count)
        self.measurements: list[tuple[PoseMeasurement, Verdict]] = []
        self.missed = 0
        self.commanded, self.last = np.zeros(3), (self.start, np.zeros(3))

    def finish(self) -> LoopRecord:
        """Run all frames and return the record; stop the head at the end and after any error."""
        try:
            outcome, row = self._frames()
        finally:
            stopped = self.loop.clock.now()
            self.loop.plant.command(stopped, np.zeros(3))
            self._watch(stopped)
            self.loop.observer.command(stopped, np.zeros(3))
        target, pose, velocity, sigma, command, encoder = self.columns[:, :row]
        return LoopRecord(
            outcome,
            self.times[:row],
            target,
            pose,
            velocity,
            sigma,
            command,
            encoder,
            self.computing[:row],
            tuple(self.measurements),
            self.missed,
            self.faults.glitches,
        )

    def _frames(self) -> tuple[Outcome, int]:
        """Run all frames; return the reason of the end and the number of recorded frames."""
        loop, frame, row = self.loop, 0, 0
        while frame < self.count:
            due = self.start + frame * loop.period
            now = loop.clock.wait_until(due)
            late = max(int((now - due) / loop.period), 0)
            self.missed += late
            self.faults.tick(late > 0)
            outcome = self._frame(row, now, loop.period * (1 + late))
            self.computing[row] = loop.clock.now() - now
            frame, row = frame + 1 + late, row + 1
            if outcome is not None:
                return outcome, row
        loop.clock.wait_until(self.start + self.count * loop.period)  # the last command lasts for a frame
        return Outcome.TIME_OVER, row

    def _frame(self, row: int, now: float, elapsed: float) -> Outcome | None:
        """Do one frame, ``elapsed`` seconds after the last one; return the reason to end the loop, or None."""
        loop = self.loop
        self._watch(now)
        for measurement in loop.sensor(now, loop.observer.predicted_pose):
            is_future = measurement.exposed > now + SAME_TIME
            verdict = Verdict.REFUSED if is_future else loop.observer.add(measurement)
            self.measurements.append((measurement, verdict))
            self.faults.verdict(verdict)
            if verdict is Verdict.ACCEPTED:
                self.guard.trust(measurement)
        reading = loop.plant.read(now)
        state = loop.observer.estimate(now)
        target, speed = self.goal(now)
        error = pose_difference(target, state.pose)
        self.commanded += self.last[1] * (now - self.last[0])
        self.faults.reading(reading.position, reading.at_limit, self.commanded, error)
        self._record(row, now, target, state, reading.position)
        outcome = self.faults.outcome(now - max(self.guard.exposed, self.start)) if loop.limits else None
        if outcome is None and self.settling is not None and self.settling(now, error, state.covariance):
            outcome = Outcome.ARRIVED
        if outcome is None:
            velocity = loop.controller(error, speed - state.velocity, elapsed, speed)
            self._command(row, now, velocity, target + loop.period * speed)
        return outcome

    def _watch(self, now: float) -> None:
        """Tell observer and guard that the watchdog of the plant stopped the head, if it did."""
        stopped = self.last[0] + self.limits.watchdog
        if now > stopped + SAME_TIME:
            self.loop.observer.command(stopped, np.zeros(3))
            self.guard.stop(stopped)
            self.commanded += self.last[1] * self.limits.watchdog
            self.last = stopped, np.zeros(3)

    def _command(self, row: int, now: float, velocity: Float64, target: Float64) -> None:
        """Command a velocity, within the guards for a target at the next frame."""
        loop = self.loop
        if loop.limits is not None:
            if now - self.guard.exposed > self.limits.hold_after:
                velocity = np.zeros(3)
            velocity = self.guard.limit(now, velocity, target, loop.period)
        if not np.all(np.isfinite(velocity)):
            raise ValueError(f"the velocity at {now:.6f} s is {velocity}, expected finite numbers from the controller")
        loop.plant.command(now, velocity)
        loop.observer.command(now, velocity)
        loop.controller.applied(velocity)
        self.last = now, velocity
        self.columns[4, row] = velocity

    def _record(self, row: int, now: float, target: Float64, state: MotionEstimate, encoder: Float64) -> None:
        self.times[row] = now
        self.columns[0, row], self.columns[1, row], self.columns[2, row] = target, state.pose, state.velocity
        self.columns[3, row] = np.sqrt(np.diagonal(state.covariance))
        self.columns[5, row] = encoder
