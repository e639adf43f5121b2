"""Placement of a part: the loop from the landing zone to the release, with its settling and abort rules.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 5.4.4 and
   8.7.2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.controllers import PidController, SmithPredictor
from gpuvision.servoing.guard import LoopLimits, Outcome
from gpuvision.servoing.loop import Clock, LoopRecord, Plant, PoseSensor, ServoLoop
from gpuvision.servoing.observer import LatestPose, MotionModel, PoseMeasurement, PoseObserver, Verdict
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.settling import VibrationSettling

Float64 = npt.NDArray[np.float64]

REMAINDER = 0.2
"""Rest of the step response at the release as a fraction of the tolerance (chosen: a twenty-fifth of its variance)."""


# Standard deviation of the pose before the first measurement, relative to the landing zone (chosen): the first measured
# pose then counts alone, by 1 part in 1e6 or better.
_PRIOR = 10.0

PoseEstimator = LatestPose | SmithPredictor | PoseObserver


def make_observer(machine: Machine, target: npt.ArrayLike, start: float) -> PoseEstimator:
    """Return the observer of a machine, ready for the first measured pose.

    Parameters
    ----------
    machine : Machine
        Machine; `Control.observer` is the kind of the observer.
    target : array_like
        (3,): expected pose of the nozzle.
    start : float
        Time of the start of the loop [s].
    """
    zone = machine.tolerance
    lags = (machine.axes[0].lag, machine.axes[1].lag, machine.axes[2].lag)
    prior = np.diag(_PRIOR * np.array([zone.landing_zone, zone.landing_zone, zone.landing_angle])) ** 2
    if machine.control.motion_sigma is not None:
        x, y, theta = (each**2 * machine.rate for each in machine.control.motion_sigma)
        history = 256 + 4 * math.ceil(machine.response_frames)
        kalman = PoseObserver(MotionModel(lag=lags, position_noise=(x, y, theta)), history=history)
        kalman.reset(start - machine.delay.latency - machine.period, target, prior)
        return kalman
    if machine.control.observer == "smith":
        delay = machine.delay
        observer = SmithPredictor(delay.frames * machine.period, lag=lags, history=256 + math.ceil(delay.frames))
        observer.reset(-math.inf, target, prior)
        return observer
    latest = LatestPose()
    latest.reset(-math.inf, target, prior)
    return latest


class ReleaseRule:
    """Settling rule: release the part by the predicted number of frames, by the residual vibration, or after a time.

    The rule "response" takes the first measured error and the step response of the loop, which give the number of
    frames after which the rest of the error is `REMAINDER` of the tolerance; from then on the first measured error
    within the tolerance releases. If an axis has a lag, all new errors of a latency and a lag must be within the
    tolerance. The rule "vibration" hands the errors from then on to `VibrationSettling`. The rule "fixed" waits for a
    fixed time from the first measured pose; see `Settling`.

    Parameters
    ----------
    machine : Machine
        Delay, lag, gains, tolerance and rule.
    observer : LatestPose, SmithPredictor or PoseObserver
        Observer of the loop. An error releases only if its pose is new: not while poses are missing or refused.

    Raises
    ------
    ValueError
        The rule is "vibration", and the frequencies of the vibration are not known.

    Notes
    -----
    Implements `gpuvision.servoing.loop.SettlingRule`. A start near the target waits for fewer frames. The rule waits
    for the predicted number of frames, so that agreement with this number is no check of the prediction:
    `settled_frames` of the true error against `predicted_settling` is one.
    """

    def __init__(self, machine: Machine, observer: PoseEstimator) -> None:
        self._machine, self._observer = machine, observer
        self._within = math.ceil(machine.response_frames) + 1 if machine.lag else 1
        self._row, self._exposed = 0, -math.inf
        self.start: Float64 | None = None
        """Error (3,) of the first measured pose; None before it."""
        self.frames = 0
        """Number of frames from the first measured pose to the release by theory."""
        self._first = math.inf
        self._vibration = _vibration_rule(machine) if machine.settling.rule == "vibration" else None

    def __call__(self, time: float, error: Float64, covariance: Float64) -> bool:
        """Return whether to release the part at an error (3,) with a covariance (3, 3)."""
        if self._observer.exposed == self._exposed:
            return False  # no pose was measured yet, or no new pose
        self._exposed = self._observer.exposed
        machine = self._machine
        if self.start is None:
            self.start, self._first = error.copy(), time
            self.frames = rule_frames(machine, error)
        self._row = self._row + 1 if error_share(machine, error) <= 1.0 else 0
        if time - self._first < (self.frames - 0.5) * machine.period:
            return False
        if self._vibration is not None:
            return self._vibration(time, error, covariance)
        return machine.settling.rule == "fixed" or self._row >= self._within


def _vibration_rule(machine: Machine) -> VibrationSettling:
    settling = machine.settling
    if settling.frequency is None or settling.damping is None:
        raise ValueError("settling.frequency and settling.damping are missing; find them by vibration_of_loop")
    return VibrationSettling(
        swing_limit(machine),
        frequency=settling.frequency,
        damping=settling.damping,
        miss_probability=settling.miss_probability,
        window=settling.window,
        lead=settling.lead,
        is_filtered=machine.control.observer == "kalman",
    )


def swing_limit(machine: Machine) -> Float64:
    """Return the largest amplitudes (3,) of x, y [m] and theta [rad] at which the rule "vibration" releases.

    Where both x and y swing, amplitudes at their limits reach the largest distance together.
    """
    x, y, _ = machine.settling.frequency or (0.0, 0.0, 0.0)
    side = machine.tolerance.position / math.sqrt(2.0 if min(x, y) > 0.0 else 1.0)
    return np.array([side, side, machine.tolerance.angle])


def rule_frames(machine: Machine, error: npt.ArrayLike) -> int:
    """Return the least number of frames from the first measured error (3,) to the release, by the rule of a machine."""
    if machine.settling.wait is not None:
        return math.ceil(machine.settling.wait * machine.rate - 1e-9)
    return predicted_frames(machine, error)


def predicted_frames(machine: Machine, error: npt.ArrayLike, fraction: float = REMAINDER) -> int:
    """Return the number of frames in which the loop reduces an error (3,) to a fraction of the tolerance, by theory.

    Both x and y take the frames of the distance: an upper bound if their axes have different lags.
    """
    distance, angle = _shares(machine, error)
    shares = np.array([distance, distance, angle]) / fraction
    return machine.frames_to(1.0 / np.maximum(shares, 1.0))


def _shares(machine: Machine, error: npt.ArrayLike) -> tuple[float, float]:
    """Return distance and angle of an error (3,) as fractions of their tolerances."""
    x, y, theta = (float(each) for each in np.asarray(error))
    return math.hypot(x, y) / machine.tolerance.position, abs(theta) / machine.tolerance.angle


def error_share(machine: Machine, error: npt.ArrayLike) -> float:
    """Return an error (3,) as a fraction of the tolerance: the larger one of distance and angle."""
    return max(_shares(machine, error))


def settled_frames(motion: Float64, band: Float64, *, released: bool) -> int | None:
    """Return the frame from which on an error stays within a band.

    Parameters
    ----------
    motion : numpy.ndarray
        (frames, 3): error in each frame [m], [m], [rad], such as the true error of a simulation.
    band : numpy.ndarray
        (3,): largest errors [m], [m], [rad].
    released : bool
        Whether the part was released: an aborted run is not settled, even if its errors are small.

    Returns
    -------
    int or None
        Number of the frame from 0; None if the last error is larger, or if the part was not released.
    """
    if not released:
        return None
    outside = np.flatnonzero(np.any(np.abs(motion) > band, axis=1))
    first = int(outside[-1]) + 1 if outside.size else 0
    return first if first < len(motion) else None


def predicted_settling(machine: Machine, start: Float64, band: Float64) -> int:
    """Return the number of frames after which a start error (3,) stays within a band (3,), by theory."""
    return machine.frames_to(1.0 / np.maximum(np.abs(start) / band, 1.0))


def count_commands(machine: Machine) -> int:
    """Return the largest number of commands of a run: ``history`` of a `SimulatedPlant` that keeps all poses."""
    # One command a frame, the start, and the stop at the end.
    return math.ceil(machine.tolerance.max_time * machine.rate) + 2


class Placement(NamedTuple):
    """Run of the loop for one part.

    Attributes
    ----------
    record : LoopRecord
        History of the loop.
    released : bool
        Whether the part was released.
    reason : str
        Reason of an abort; empty if the part was released.
    start_error : numpy.ndarray
        (3,): first measured error [m], [m], [rad]; NaN if no pose was measured.
    predicted_frames : int
        Least number of frames from the first measured pose to the release, and the frames of the coarse registration.
        The step response gives it by theory, unless the rule is "fixed".
    """

    record: LoopRecord
    released: bool
    reason: str
    start_error: Float64
    predicted_frames: int

    @property
    def frames(self) -> int:
        """Number of frames to the release or to the abort."""
        return len(self.record.time)

    @property
    def measurements(self) -> tuple[PoseMeasurement, ...]:
        """Measured poses in the order of arrival."""
        return tuple(measurement for measurement, _ in self.record.measurements)

    @property
    def first_pose(self) -> float:
        """Arrival of the first accepted pose [s]; infinite without one. A refused coarse registration is no pose."""
        accepted = (each.arrived for each, verdict in self.record.measurements if verdict is Verdict.ACCEPTED)
        return min(accepted, default=math.inf)

    @property
    def steered_frames(self) -> int:
        """Number of frames after the one of the first accepted pose."""
        return int(np.count_nonzero(self.record.time > self.first_pose))


def place_part(
    machine: Machine, target: npt.ArrayLike, plant: Plant, sensor: PoseSensor, clock: Clock, *, landing: float = 0.0
) -> Placement:
    """Steer the nozzle from the landing zone to a target and release the part.

    Parameters
    ----------
    machine : Machine
        Delay, gain and limits.
    target : array_like
        (3,): pose of the nozzle on the board at the release, x, y [m], theta [rad].
    plant : Plant
        Axes of the machine, or their simulation. They move in the frame of the board.
    sensor : PoseSensor
        Poses of the nozzle on the board, such as `BoardPoseSensor`.
    clock : Clock
        Wall clock or simulated clock, at the start of a frame.
    landing : float
        Time of the coarse registration of the first frame [s], default 0: without one.

    Returns
    -------
    Placement
        The part is not released if no pose is valid for `Tolerance.max_refused` frames, if the loop gives up, or after
        `Tolerance.max_time`; ``reason`` says why.

    Notes
    -----
    A guard bounds the travel since the newest measured pose by the error of this pose, three standard deviations, and
    the overshoot of the step response from the edge of the landing zone: from a start in the zone the loop follows the
    theory (`Machine.error_after`). The overshoot is allowed only in frames with a new trusted pose. When poses are
    missing, the head moves at most to the target and three standard deviations beyond it, or stands still where it is.
    With an integral part, and with a gain that oscillates, it may already have passed the target by `Machine.overshoot`
    times the landing zone at most, by commands that answered trusted poses.
    """
    x, y, theta = (axis.lag for axis in machine.axes)
    zone = machine.tolerance
    away = machine.overshoot * np.array([zone.landing_zone, zone.landing_zone, zone.landing_angle])
    goal = np.asarray(target, np.float64)
    observer = make_observer(machine, goal, clock.now())
    blind = landing + machine.delay.latency + machine.tolerance.max_refused * machine.period
    loop = ServoLoop(
        plant,
        sensor,
        observer,
        PidController(machine.gains),
        clock,
        period=machine.period,
        limits=LoopLimits(
            hold_after=blind,
            abort_after=blind,
            overshoot=(float(away[0]), float(away[1]), float(away[2])),
            lag=(x, y, theta),
            watchdog=machine.control.watchdog * machine.period,
        ),
    )
    rule = ReleaseRule(machine, observer)
    record = loop.run(goal, machine.tolerance.max_time, settling=rule)
    released = record.outcome is Outcome.ARRIVED
    waited = math.ceil(landing * machine.rate - 1e-9)
    start = np.full(3, math.nan) if rule.start is None else rule.start
    return Placement(record, released, "" if released else record.outcome.value, start, waited + rule.frames)
