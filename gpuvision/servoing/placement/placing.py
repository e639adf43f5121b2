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

from gpuvision.servoing.controllers import PidController, PidGains
from gpuvision.servoing.delay_response import settling_frames
from gpuvision.servoing.guard import LoopLimits, Outcome
from gpuvision.servoing.loop import Clock, LoopRecord, Plant, PoseSensor, ServoLoop
from gpuvision.servoing.observer import LatestPose, PoseMeasurement
from gpuvision.servoing.placement.machine import Machine

Float64 = npt.NDArray[np.float64]

REMAINDER = 0.2
"""Rest of the step response at the release as a fraction of the tolerance (chosen: a twenty-fifth of its variance)."""


class ReleaseRule:
    """Settling rule: release the part when the predicted number of frames has passed and the error is within tolerance.

    The first measured error and the gain of the loop give the number of frames after which the rest of the step
    response is `REMAINDER` of the tolerance; from then on the first measured error within the tolerance releases. If an
    axis has a lag, all new errors of a latency and a lag must be within the tolerance.

    Parameters
    ----------
    machine : Machine
        Delay, lag, gain and tolerance.
    observer : LatestPose
        Observer of the loop. An error releases only if its pose is new: not while poses are missing or refused.

    Notes
    -----
    Implements `gpuvision.servoing.loop.SettlingRule`. A start near the target waits for fewer frames. The rule waits
    for the predicted number of frames, so that agreement with this number is no check of the prediction. A placement
    that takes many more frames shows that the machine settles more slowly than predicted.
    """

    def __init__(self, machine: Machine, observer: LatestPose) -> None:
        self._machine, self._observer = machine, observer
        self._within = math.ceil(machine.response_frames) + 1 if machine.lag else 1
        self._row, self._exposed = 0, -math.inf
        self.start: Float64 | None = None
        """Error (3,) of the first measured pose; None before it."""
        self.frames = 0
        """Number of frames from the first measured pose to the release by theory."""
        self._first = math.inf

    def __call__(self, time: float, error: Float64, covariance: Float64) -> bool:
        """Return whether to release the part at an error (3,) with a covariance (3, 3)."""
        if self.start is None:
            if not np.all(np.isfinite(covariance)):
                return False  # no pose was measured yet
            self.start, self._first = error.copy(), time
            self.frames = predicted_frames(self._machine, error)
        if self._observer.exposed == self._exposed:
            return False  # no new pose
        self._exposed = self._observer.exposed
        self._row = self._row + 1 if _share(self._machine, error) <= 1.0 else 0
        waited = time - self._first >= (self.frames - 0.5) * self._machine.period
        return waited and self._row >= self._within


def predicted_frames(machine: Machine, error: npt.ArrayLike, fraction: float = REMAINDER) -> int:
    """Return the number of frames in which the loop reduces an error (3,) to a fraction of the tolerance, by theory."""
    share = _share(machine, np.asarray(error, np.float64)) / fraction
    return settling_frames(machine.response_frames, machine.loop_gain, 1.0 / share) if share > 1.0 else 0


def _share(machine: Machine, error: Float64) -> float:
    """Return an error (3,) as a fraction of the tolerance: the larger one of distance and angle."""
    x, y, theta = (float(each) for each in error)
    return max(math.hypot(x, y) / machine.tolerance.position, abs(theta) / machine.tolerance.angle)


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
        Frames from the first measured pose to the release by theory, and the frames of the coarse registration.
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
        Axes of the machine, or their simulation. Their frame is that of the board.
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
    """
    x, y, theta = (axis.lag for axis in machine.axes)
    goal = np.asarray(target, np.float64)
    observer = LatestPose()
    observer.reset(-math.inf, goal, np.full((3, 3), math.inf))
    blind = landing + machine.delay.latency + machine.tolerance.max_refused * machine.period
    loop = ServoLoop(
        plant,
        sensor,
        observer,
        PidController(PidGains(proportional=machine.loop_gain * machine.rate)),
        clock,
        period=machine.period,
        limits=LoopLimits(hold_after=blind, abort_after=blind, lag=(x, y, theta)),
    )
    rule = ReleaseRule(machine, observer)
    record = loop.run(goal, machine.tolerance.max_time, settling=rule)
    released = record.outcome is Outcome.ARRIVED
    waited = math.ceil(landing * machine.rate - 1e-9)
    start = np.full(3, math.nan) if rule.start is None else rule.start
    return Placement(record, released, "" if released else record.outcome.value, start, waited + rule.frames)
