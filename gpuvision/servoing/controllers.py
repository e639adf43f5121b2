"""Controllers of the pose of a head: P, PI, PD, PID with feed-forward, and the Smith predictor.

A controller turns the error of the pose into a commanded velocity, for the three axes together.

References
----------
.. [1] K. J. Astrom and T. Hagglund, *Advanced PID Control*, ISA 2006, chapters 3 (anti-windup) and 8 (Smith predictor).
.. [2] S. Skogestad, *Simple analytic rules for model reduction and PID controller tuning*, Journal of Process
   Control 13, 2003, table 1 (integrating processes).
.. [3] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 5.4.4.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.delay import non_oscillating_gain
from gpuvision.servoing.observer import LatestPose, MotionEstimate, PoseMeasurement, Verdict
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]


class Controller(Protocol):
    """Rule that turns the error of a pose into a commanded velocity; see `PidController`."""

    def reset(self) -> None:
        """Forget the past."""

    def __call__(
        self, error: Float64, velocity: Float64, period: float, target_velocity: Float64 | None = None
    ) -> Float64:
        """Return the commanded velocity (3,) for an error, its derivative and the target's velocity, (3,) each."""

    def applied(self, velocity: Float64) -> None:
        """Take the velocity (3,) that was sent to the plant instead of the last command, after all guards."""


@dataclass(frozen=True, kw_only=True)
class PidGains:
    """Gains of a controller of a velocity.

    Parameters
    ----------
    proportional : float
        Velocity per error [1/s], above 0.
    integral : float
        Time constant of the integral part [s]; infinite (default) for none.
    derivative : float
        Time constant of the derivative part [s]; 0 (default) for none. Range: 0 or more.

    Raises
    ------
    ValueError
        A gain is out of range.
    """

    proportional: float
    integral: float = math.inf
    derivative: float = 0.0

    def __post_init__(self) -> None:
        finite(self.proportional, "proportional", above=0.0)
        finite(self.derivative, "derivative", minimum=0.0)
        if not self.integral > 0.0:
            raise ValueError(f"integral is {self.integral}, expected a number > 0, or infinity for no integral part")


def gains_without_oscillation(delay: float, period: float) -> PidGains:
    """Return the largest proportional gain that does not oscillate with a delay.

    Parameters
    ----------
    delay : float
        Delay from the middle of the exposure to the command [s]: `DelayBudget.latency`, or a measured delay.
    period : float
        Time between two frames [s]. Range: above 0.
    """
    period = finite(period, "period", above=0.0)
    return PidGains(proportional=non_oscillating_gain(delay / period) / period)


def simc_gains(delay: float, *, lag: float = 0.0, closed_loop: float | None = None, integral: bool = True) -> PidGains:
    """Return gains by Skogestad's rule for an integrator with a delay and a lag.

    Parameters
    ----------
    delay : float
        Total delay [s], with half a frame for the hold: `DelayBudget.total`. Above 0.
    lag : float
        Time constant of the velocity of the plant [s]; the derivative part cancels it. Default 0. Range: 0 or more.
    closed_loop : float, optional
        Wanted time constant of the closed loop [s]. Default: the delay, Skogestad's compromise of speed and margin.
        Range: above 0.
    integral : bool
        Whether the controller has an integral part, which removes constant disturbances. Default True.

    References
    ----------
    .. [1] S. Skogestad, *Simple analytic rules for model reduction and PID controller tuning*, Journal of Process
       Control 13, 2003, table 1.
    """
    delay = finite(delay, "delay", above=0.0)
    sum_of_times = delay + (delay if closed_loop is None else finite(closed_loop, "closed_loop", above=0.0))
    return PidGains(
        proportional=1.0 / sum_of_times,
        integral=4.0 * sum_of_times if integral else math.inf,
        derivative=finite(lag, "lag", minimum=0.0),
    )


class PidController:
    """P, PI, PD or PID controller of a velocity in series form, with saturation and anti-windup.

    Parameters
    ----------
    gains : PidGains
        Gains of all axes.
    limit : array_like
        (3,) largest commanded velocity [m/s], [m/s], [rad/s]. Default: none.
    feed_forward : float
        Part of the target's own velocity that is added, 0 to 1. Default 1.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.

    Notes
    -----
    The command is ``proportional (part + integral of part / integral) + feed_forward target'`` with ``part = error +
    derivative error'``: the form of `simc_gains`. The derivative of the error is the target's velocity less the
    observer's, and needs no filter. A command beyond the limit is cut, and the integral part of this axis stands still
    while ``part`` would drive the command further beyond the limit (conditional integration) [1]_. The same holds for a
    command that a guard cut: `ServoLoop` calls `applied` with the velocity that it sent.

    References
    ----------
    .. [1] K. J. Astrom and T. Hagglund, *Advanced PID Control*, ISA 2006, section 3.5.
    """

    def __init__(
        self, gains: PidGains, *, limit: npt.ArrayLike = (math.inf, math.inf, math.inf), feed_forward: float = 1.0
    ) -> None:
        self.gains = gains
        self.limit = np.array(limit, np.float64)
        if self.limit.shape != (3,) or not np.all(self.limit > 0.0):
            raise ValueError("limit must be 3 numbers above 0")
        self.feed_forward = finite(feed_forward, "feed_forward", minimum=0.0, maximum=1.0)
        self.reset()

    def reset(self) -> None:
        """Set the integral part to 0."""
        self._integral, self._before = np.zeros(3), np.zeros(3)
        self._part, self._command = np.zeros(3), np.zeros(3)

    def __call__(
        self, error: Float64, velocity: Float64, period: float, target_velocity: Float64 | None = None
    ) -> Float64:
        """Return the commanded velocity.

        Parameters
        ----------
        error : numpy.ndarray
            (3,): target less pose [m], [m], [rad].
        velocity : numpy.ndarray
            (3,): derivative of the error; used with a derivative part only.
        period : float
            Time since the last call [s].
        target_velocity : numpy.ndarray, optional
            (3,): velocity of the target. Default: it rests.
        """
        gains = self.gains
        part = error + gains.derivative * velocity if gains.derivative else error
        wanted = gains.proportional * part
        if target_velocity is not None:
            wanted = wanted + self.feed_forward * target_velocity
        if math.isinf(gains.integral):
            return np.clip(wanted, -self.limit, self.limit)
        self._part, self._before = np.array(part), self._integral
        self._integral = self._before + gains.proportional / gains.integral * period * part
        self._command = wanted + self._integral
        self.applied(np.clip(self._command, -self.limit, self.limit))
        return np.clip(wanted + self._integral, -self.limit, self.limit)

    def applied(self, velocity: Float64) -> None:
        """Take the velocity that was sent to the plant instead of the last command.

        The integral part of an axis returns to its value before the last command if the velocity differs from the
        command, and the error drives the command further away from the velocity.

        Parameters
        ----------
        velocity : numpy.ndarray
            (3,): velocity after all guards [m/s], [m/s], [rad/s].
        """
        is_driven_away = (self._command - velocity) * self._part > 0.0
        self._integral = np.where(is_driven_away, self._before, self._integral)


class SmithPredictor:
    """Observer that adds the motion commanded during a known delay to the latest pose.

    With the right delay, gain and lag of the plant the loop behaves as without delay. In contrast to `PoseObserver` it
    uses a configured delay and no time stamps; `predictor_polynomial` gives its sensitivity to a wrong model.

    Parameters
    ----------
    delay : float
        Delay of the measurements [s]. Range: 0 or more.
    lag : array_like
        (3,) time constants with which the velocities of the axes follow the command [s], 0 or more; 0 (default) follows
        at once.
    plant_gain : float
        Velocity of the plant per commanded velocity. Default 1. Range: above 0.
    history : int
        Number of commands that are kept. Default 256.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.

    Notes
    -----
    A model of the axes runs on the commands: ``lag v' = plant_gain u - v``, ``m' = v``, exact between two commands. The
    estimate is the latest pose plus ``m(t) - m(t - delay)``, and the velocity of the model [1]_. The controller then
    sees the axes without the delay: `closed_loop` with the delay 0 and the lag. Motion before the oldest kept command
    counts as 0.

    References
    ----------
    .. [1] K. J. Astrom and T. Hagglund, *Advanced PID Control*, ISA 2006, section 8.2.
    """

    def __init__(
        self, delay: float, *, lag: npt.ArrayLike = (0.0, 0.0, 0.0), plant_gain: float = 1.0, history: int = 256
    ) -> None:
        self.delay = finite(delay, "delay", minimum=0.0)
        self.lag = np.array([finite(each, "lag", minimum=0.0) for each in numbers(lag, (3,), "lag")])
        self.plant_gain = finite(plant_gain, "plant_gain", above=0.0)
        self._latest = LatestPose()
        # Time, velocity to which the axes tend, position and velocity of the model.
        self._commands: deque[tuple[float, Float64, Float64, Float64]] = deque(maxlen=history)

    def reset(self, time: float, pose: npt.ArrayLike, covariance: npt.ArrayLike) -> None:
        """Forget everything and start from a pose (3,) at rest with a covariance (3, 3)."""
        self._latest.reset(time, numbers(pose, (3,), "pose"), numbers(covariance, (3, 3), "covariance"))
        self._commands.clear()

    @property
    def exposed(self) -> float:
        """Time of the latest exposure [s]."""
        return self._latest.exposed

    def command(self, time: float, velocity: Float64) -> None:
        """Take the velocity (3,) that the head is commanded from a time on."""
        position, speed = self._model(time)
        wanted = self.plant_gain * np.array(velocity)
        self._commands.append((time, wanted, position, np.where(self.lag > 0.0, speed, wanted)))

    def add(self, measurement: PoseMeasurement) -> Verdict:
        """Take a measurement that was exposed after all earlier ones."""
        return self._latest.add(measurement)

    def estimate(self, time: float) -> MotionEstimate:
        """Return the latest pose, moved by the commands of the last delay."""
        latest = self._latest.estimate(time)
        position, velocity = self._model(time)
        moved = position - self._model(time - self.delay)[0]
        return MotionEstimate(time, latest.pose + moved, velocity, latest.covariance)

    def predicted_pose(self, time: float) -> Float64 | None:
        """Return the pose (3,) predicted for an exposure: the latest pose and the commanded motion since its exposure.

        None before the first accepted measurement.
        """
        latest = self._latest.predicted_pose(time)
        return None if latest is None else latest + self._model(time)[0] - self._model(self.exposed)[0]

    def _model(self, time: float) -> tuple[Float64, Float64]:
        """Return position and velocity (3,) of the model of the axes at a time."""
        for start, wanted, position, speed in reversed(self._commands):
            if start <= time:
                decay = np.exp((start - time) / np.maximum(self.lag, 1e-300))
                faded = (speed - wanted) * (1.0 - decay)  # loss of the velocity beyond the wanted one
                return position + wanted * (time - start) + self.lag * faded, speed - faded
        return (self._commands[0][2], np.zeros(3)) if self._commands else (np.zeros(3), np.zeros(3))
