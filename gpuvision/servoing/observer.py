"""Poses that a camera measures, and the observers that estimate the state of a head from them.

`PoseObserver` is a Kalman filter with a history: a measurement corrects the state at the time of its exposure, and the
later commands and measurements are applied again. A measurement may be late, out of order, repeated or missing.

References
----------
.. [1] Y. Bar-Shalom, X. R. Li and T. Kirubarajan, *Estimation with Applications to Tracking and Navigation*, Wiley
   2001, chapters 5 (gating, consistency) and 6 (models of motion).
.. [2] M. Bak, T. D. Larsen, M. Norgaard, N. A. Andersen, N. K. Poulsen and O. Ravn, *Location estimation using delayed
   measurements*, 5th International Workshop on Advanced Motion Control, 1998.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.frames import pose_difference
from gpuvision.validation import finite, integer, numbers

Float64 = npt.NDArray[np.float64]

SAME_TIME = 1e-9
"""Two times that differ by less are the same time [s] (chosen): far above rounding, far below a frame time."""


class PoseMeasurement(NamedTuple):
    """Pose of the head that was measured in one frame of the camera.

    Attributes
    ----------
    exposed : float
        Middle of the exposure [s]: the time at which the head had this pose.
    arrived : float
        Time at which the pose was available to the controller [s].
    pose : numpy.ndarray
        (3,): x [m], y [m], theta [rad]; NaN if the pose was refused.
    covariance : numpy.ndarray
        (3, 3): covariance of the pose, in these units; NaN if the pose was refused.
    status : int
        Flags of `Status`; 0 for a valid pose.
    """

    exposed: float
    arrived: float
    pose: Float64
    covariance: Float64
    status: int


PosePrediction = Callable[[float], Float64 | None]
"""Function of the time of an exposure [s] that returns the predicted pose (3,) of the head, or None without one; see
`Observer.predicted_pose`."""


class MotionEstimate(NamedTuple):
    """State of the head at one time.

    Attributes
    ----------
    time : float
        Time of the state [s].
    pose : numpy.ndarray
        (3,): x [m], y [m], theta [rad].
    velocity : numpy.ndarray
        (3,): velocity [m/s], [m/s], [rad/s].
    covariance : numpy.ndarray
        (3, 3): covariance of the pose.
    """

    time: float
    pose: Float64
    velocity: Float64
    covariance: Float64


class Verdict(enum.Enum):
    """Decision of an observer about a measurement."""

    ACCEPTED = "accepted"
    """The measurement corrected the state."""
    REFUSED = "refused"
    """Its status is not 0, its pose or covariance is not finite, its covariance is not positive definite,
    or it was exposed after it arrived. A `ServoLoop` also refuses an exposure after the begin of the frame."""
    DUPLICATE = "duplicate"
    """A measurement of the same exposure was accepted before."""
    TOO_OLD = "too old"
    """It was exposed before the first state that the history still has."""
    GATED = "gated"
    """Its squared Mahalanobis distance from the predicted pose exceeds the gate."""


class Observer(Protocol):
    """Estimate of the pose of the head from commands and measurements; see `PoseObserver`."""

    def reset(self, time: float, pose: npt.ArrayLike, covariance: npt.ArrayLike) -> None:
        """Forget everything and start from a pose at rest."""

    def command(self, time: float, velocity: Float64) -> None:
        """Take the velocity (3,) that the head is commanded from a time on."""

    def add(self, measurement: PoseMeasurement) -> Verdict:
        """Take a measurement, in any order of exposure."""

    def estimate(self, time: float) -> MotionEstimate:
        """Return the state at a time, not before the last command."""

    def predicted_pose(self, time: float) -> Float64 | None:
        """Return the predicted pose (3,) of the head at the time of an exposure, which may be before the last command.

        None before the first accepted measurement.
        """


@dataclass(frozen=True, kw_only=True)
class MotionModel:
    """Model of the motion between two measurements, for each of x, y and theta.

    Parameters
    ----------
    lag : tuple of float, optional
        Time constants [s] with which the velocity follows the commanded velocity; 0 follows at once. None (default):
        the commands are not known, and the velocity is constant but for random accelerations.
    acceleration_noise : tuple of float
        Spectral densities of the random acceleration [m^2/s^3], [m^2/s^3], [rad^2/s^3]. No effect on an axis with
        lag 0. Default ``(0.0, 0.0, 0.0)``.
    position_noise : tuple of float
        Spectral densities of the random motion [m^2/s], [m^2/s], [rad^2/s]. Default 0.

    Raises
    ------
    ValueError
        A number is negative or not finite.
    """

    lag: tuple[float, float, float] | None = None
    acceleration_noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position_noise: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("lag", "acceleration_noise", "position_noise"):
            if getattr(self, name) is not None:
                for each in numbers(getattr(self, name), (3,), name):
                    finite(each, name, minimum=0.0)

    def transition(self, step: float) -> tuple[Float64, Float64, Float64]:
        """Return the transition of the state (pose, velocity) over a time step [s].

        Returns
        -------
        state : numpy.ndarray
            (6, 6) matrix F of the state.
        command : numpy.ndarray
            (6, 3) matrix G of the commanded velocity.
        noise : numpy.ndarray
            (6, 6) covariance that the random motion adds.
        """
        state, command, noise = np.eye(6), np.zeros((6, 3)), np.zeros((6, 6))
        for k in range(3):
            moved, kept, p, pv, v = _axis_transition(step, None if self.lag is None else self.lag[k])
            state[k, k + 3], state[k + 3, k + 3] = moved, kept
            if self.lag is not None:
                command[k, k], command[k + 3, k] = step - moved, 1.0 - kept
            density = self.acceleration_noise[k]
            noise[k, k] = density * p + self.position_noise[k] * step
            noise[k, k + 3] = noise[k + 3, k] = density * pv
            noise[k + 3, k + 3] = density * v
        return state, command, noise


def _axis_transition(step: float, lag: float | None) -> tuple[float, float, float, float, float]:
    """Return the gain of the velocity on position and velocity, and the integrals of the noise (p, pv, v)."""
    if lag is None:
        return step, 1.0, step**3 / 3.0, step**2 / 2.0, step
    if lag == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    ratio = step / lag
    one, two = -math.expm1(-ratio), -math.expm1(-2.0 * ratio)
    # The difference loses all digits for small ratios; its series is x^3 / 3 - x^4 / 4 + 7 x^5 / 60.
    series = ratio**3 * (1.0 / 3.0 - ratio / 4.0 + 7.0 * ratio**2 / 60.0)
    p = series if ratio < 1e-2 else ratio - 2.0 * one + 0.5 * two
    return lag * one, 1.0 - one, lag**3 * p, 0.5 * (lag * one) ** 2, 0.5 * lag * two


# Squared Mahalanobis distance that a valid measurement exceeds with a probability of 0.001 (chi square, 3 degrees).
_GATE = 16.266
# Smallest diagonal of the Cholesky factor of a correlation matrix that is not singular (chosen): the root of the
# rounding errors is 1e-8.
_SINGULAR = 1e-6
# Transitions that are kept for time steps that occur again (chosen: more than the entries that a late measurement
# propagates). A loop with jitter makes new ones all the time; they are dropped one by one, because freeing thousands at
# once would stop the loop for milliseconds.
_MAX_TRANSITIONS = 256


class PoseObserver:
    """Kalman filter of the pose of a head that takes delayed measurements in any order.

    Parameters
    ----------
    model : MotionModel
        Model of the motion.
    history : int
        Number of commands and measurements that are kept, 2 or more. Default 256. A measurement that was exposed before
        the oldest of them is refused.
    gate : float
        Squared Mahalanobis distance above which a measurement is not taken. Default 16.27: a valid measurement
        exceeds it with a probability of 0.001. Range: above 0.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.

    Notes
    -----
    Memory is allocated once. A measurement costs one prediction and one correction, one prediction for each later
    command in the history, and one prediction and one correction for each later measurement.

    The errors of different frames are taken as independent. Where they are correlated, the covariance is too small:
    with a correlation of 0.5 from frame to frame the standard deviations were too small by a factor of 1.4, with 0.9 by
    1.8 (simulated: frames of 2 ms, noise of 1 um, acceleration noise of 1e-6 m^2/s^3).
    """

    def __init__(self, model: MotionModel, *, history: int = 256, gate: float = _GATE) -> None:
        self.model, self.gate = model, finite(gate, "gate", above=0.0)
        self._size = integer(history, "history", minimum=2)
        room = 2 * self._size  # the kept half moves to the front when the arrays are full
        self._times = np.zeros(room)
        self._commands, self._poses = np.zeros((room, 3)), np.zeros((room, 3))
        self._noises = np.zeros((room, 3, 3))
        self._measured = np.zeros(room, bool)
        self._states, self._covariances = np.zeros((room, 6)), np.zeros((room, 6, 6))
        self._arrays = (
            self._times,
            self._commands,
            self._poses,
            self._noises,
            self._measured,
            self._states,
            self._covariances,
        )
        self._transitions: dict[int, tuple[Float64, Float64, Float64]] = {}
        self.reset(0.0, np.zeros(3), np.zeros((3, 3)))

    def reset(self, time: float, pose: npt.ArrayLike, covariance: npt.ArrayLike) -> None:
        """Forget everything and start from a pose at rest.

        Parameters
        ----------
        time : float
            Time of the pose [s].
        pose : array_like
            (3,): x [m], y [m], theta [rad].
        covariance : array_like
            (3, 3): covariance of the pose.
        """
        self._first, self._end = 0, 1
        self._times[0], self._measured[0] = finite(time, "time"), False
        self._states[0], self._commands[0], self._covariances[0] = 0.0, 0.0, 0.0
        self._states[0, :3] = numbers(pose, (3,), "pose")
        self._covariances[0, :3, :3] = numbers(covariance, (3, 3), "covariance")
        self._exposed = -math.inf

    @property
    def exposed(self) -> float:
        """Time of the newest accepted exposure [s]; minus infinity before the first one."""
        return self._exposed

    def command(self, time: float, velocity: Float64) -> None:
        """Take the velocity (3,) that the head is commanded from a time on.

        Raises
        ------
        ValueError
            The time is before the last command or measurement, or the time or the velocity is not finite.
        """
        if not math.isfinite(time) or not all(map(math.isfinite, velocity)):
            raise ValueError(f"a command at {time} s has the velocity {velocity}, expected finite numbers")
        last = self._end - 1
        if time < self._times[last] - SAME_TIME:
            raise ValueError(f"a command at {time:.6f} s is before the last entry at {self._times[last]:.6f} s")
        if time > self._times[last] + SAME_TIME:
            last = self._insert(self._end, time)
            self._propagate(last)
        self._commands[last] = velocity

    def add(self, measurement: PoseMeasurement) -> Verdict:
        """Take a measurement, in any order of exposure, and return whether it corrected the state.

        A measurement in the history stays accepted when an earlier one is added later.
        """
        if not _is_valid(measurement):
            return Verdict.REFUSED
        time = measurement.exposed
        if time < self._times[self._first] - SAME_TIME:
            return Verdict.TOO_OLD
        place = self._first + int(np.searchsorted(self._times[self._first : self._end], time + SAME_TIME, "right"))
        for k in range(place - 1, self._first - 1, -1):
            if self._times[k] < time - SAME_TIME:
                break
            if self._measured[k]:
                return Verdict.DUPLICATE
        predicted = self._predict(place - 1, time)
        innovation = _innovation(*predicted, measurement.pose, measurement.covariance)
        if not innovation.distance <= self.gate:
            return Verdict.GATED
        node = self._insert(place, time)
        self._commands[node] = self._commands[node - 1]
        self._measured[node] = True
        self._poses[node], self._noises[node] = measurement.pose, measurement.covariance
        self._states[node], self._covariances[node] = _correct(*predicted, innovation)
        for k in range(node + 1, self._end):
            self._propagate(k)
        self._exposed = max(self._exposed, time)
        return Verdict.ACCEPTED

    def estimate(self, time: float) -> MotionEstimate:
        """Return the state at a time, not before the last command or measurement.

        Raises
        ------
        ValueError
            The time is before the last command or measurement.
        """
        last = self._end - 1
        if time < self._times[last] - SAME_TIME:
            raise ValueError(f"the time {time:.6f} s is before the last entry at {self._times[last]:.6f} s")
        state, covariance = self._predict(last, time)
        return MotionEstimate(time, state[:3].copy(), state[3:].copy(), covariance[:3, :3].copy())

    def predicted_pose(self, time: float) -> Float64 | None:
        """Return the predicted pose (3,) at the time of an exposure, which may be before the last command.

        The prediction starts at the last entry of the history up to this time, as in `add`. None before the first
        accepted measurement, and for a time before the history.
        """
        if math.isinf(self._exposed) or time < self._times[self._first] - SAME_TIME:
            return None
        place = self._first + int(np.searchsorted(self._times[self._first : self._end], time + SAME_TIME, "right"))
        return self._predict(place - 1, time)[0][:3].copy()

    def _insert(self, place: int, time: float) -> int:
        """Make room for an entry, drop the oldest one if the history is full, and return the index of the new entry."""
        if self._end == len(self._times):
            kept = slice(self._end - self._size, self._end)
            for each in self._arrays:
                each[: self._size] = each[kept]
            place -= kept.start
            self._first, self._end = max(self._first - kept.start, 0), self._size
        if place < self._end:
            for each in self._arrays:
                each[place + 1 : self._end + 1] = each[place : self._end].copy()
        self._end += 1
        if self._end - self._first > self._size:
            self._first += 1
        self._times[place], self._measured[place] = time, False
        return place

    def _predict(self, node: int, time: float) -> tuple[Float64, Float64]:
        """Return state and covariance at a time after an entry."""
        step = max(round(1e12 * (time - self._times[node])), 0)  # [ps]: equal frame times differ by rounding
        found = self._transitions.get(step)
        if found is None:
            if len(self._transitions) == _MAX_TRANSITIONS:
                del self._transitions[next(iter(self._transitions))]
            found = self._transitions[step] = self.model.transition(1e-12 * step)
        matrix, command, noise = found
        state = matrix @ self._states[node] + command @ self._commands[node]
        return state, matrix @ self._covariances[node] @ matrix.T + noise

    def _propagate(self, node: int) -> None:
        """Compute an entry from the one before it."""
        state, covariance = self._predict(node - 1, self._times[node])
        if self._measured[node]:
            innovation = _innovation(state, covariance, self._poses[node], self._noises[node])
            state, covariance = _correct(state, covariance, innovation)
        self._states[node], self._covariances[node] = state, covariance


def _is_valid(measurement: PoseMeasurement) -> bool:
    """Return whether all numbers are finite and the covariance is positive definite, judged by its lower triangle."""
    covariance = measurement.covariance.ravel().tolist()
    values = (measurement.exposed, measurement.arrived, *measurement.pose.tolist(), *covariance)
    if measurement.status != 0 or not all(map(math.isfinite, values)) or measurement.exposed > measurement.arrived:
        return False
    xx, _, _, xy, yy, _, xt, yt, tt = covariance
    if min(xx, yy, tt) <= 0.0:
        return False
    # Rows 2 and 3 of the Cholesky factor of the correlation matrix.
    x, y, t = math.sqrt(xx), math.sqrt(yy), math.sqrt(tt)
    second = xy / x / y
    square = 1.0 - second * second
    if square <= _SINGULAR**2:
        return False
    third = xt / x / t
    last = (yt / y / t - third * second) / math.sqrt(square)
    return 1.0 - third * third - last * last > _SINGULAR**2


class _Innovation(NamedTuple):
    distance: float  # squared Mahalanobis distance of the measured pose
    residual: Float64
    inverse: Float64  # of the covariance of the residual


def _innovation(state: Float64, covariance: Float64, pose: Float64, noise: Float64) -> _Innovation:
    residual = pose_difference(pose, state[:3])
    inverse = np.asarray(np.linalg.inv(covariance[:3, :3] + noise), np.float64)
    return _Innovation(float(residual @ inverse @ residual), residual, inverse)


def _correct(state: Float64, covariance: Float64, innovation: _Innovation) -> tuple[Float64, Float64]:
    """Return the state and the covariance after a measurement."""
    gain = covariance[:, :3] @ innovation.inverse
    corrected = covariance - gain @ covariance[:3]
    return state + gain @ innovation.residual, 0.5 * (corrected + corrected.T)


class LatestPose:
    """Observer without a model: the estimate is the measured pose of the latest exposure.

    Nothing compensates the delay: the gain of the loop must stay below `gain_limit`.
    """

    def __init__(self) -> None:
        self.reset(-math.inf, np.zeros(3), np.zeros((3, 3)))

    def reset(self, time: float, pose: npt.ArrayLike, covariance: npt.ArrayLike) -> None:
        """Forget everything and start from a pose (3,) with a covariance (3, 3)."""
        self._exposed = time
        self._pose, self._covariance = np.array(pose, np.float64), np.array(covariance, np.float64)

    @property
    def exposed(self) -> float:
        """Time of the exposure of the pose [s]."""
        return self._exposed

    def command(self, time: float, velocity: Float64) -> None:
        """Ignore a command."""

    def add(self, measurement: PoseMeasurement) -> Verdict:
        """Take a measurement that was exposed after all earlier ones."""
        if not _is_valid(measurement):
            return Verdict.REFUSED
        if measurement.exposed <= self._exposed:
            return Verdict.DUPLICATE if measurement.exposed == self._exposed else Verdict.TOO_OLD
        self._exposed, self._pose, self._covariance = measurement.exposed, measurement.pose, measurement.covariance
        return Verdict.ACCEPTED

    def estimate(self, time: float) -> MotionEstimate:
        """Return the latest pose at rest."""
        return MotionEstimate(time, self._pose.copy(), np.zeros(3), self._covariance.copy())

    def predicted_pose(self, time: float) -> Float64 | None:
        """Return the latest pose (3,), because this observer has no model of the motion; None before the first one."""
        return None if math.isinf(self._exposed) else self._pose.copy()
