"""Guards of a servo loop: bound of the travel since the last trusted pose, and fault counters that end the loop."""

from __future__ import annotations

import enum
import math
from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.frames import pose_difference
from gpuvision.servoing.observer import PoseMeasurement, Verdict
from gpuvision.validation import finite, integer, numbers

Float64 = npt.NDArray[np.float64]


class Outcome(enum.Enum):
    """Reason why a servo loop ended."""

    ARRIVED = "arrived"
    """The settling rule was satisfied."""
    TIME_OVER = "time over"
    """The duration is over."""
    LOST = "no trusted pose for too long"
    """No measurement was accepted for `LoopLimits.abort_after`."""
    INCONSISTENT = "measured poses contradict the model of the motion"
    """The gate refused `LoopLimits.gated` measurements in a row: wrong delay, wrong model, or a wrong match."""
    AT_LIMIT = "an axis is at its limit and the target is beyond it"
    """The state lasted for `LoopLimits.readings` readings."""
    ENCODER = "the encoders contradict the commands"
    """The difference lasted for `LoopLimits.readings` readings: an axis is blocked, or an encoder is broken."""
    TOO_SLOW = "the loop does not keep its frame time"
    """`LoopLimits.missed` frames in a row began late by a frame or more."""


@dataclass(frozen=True, kw_only=True)
class LoopLimits:
    """Decision thresholds of the guards.

    Parameters
    ----------
    hold_after : float
        Age of the newest accepted exposure from which on the head stands still [s]. Default 10 ms (chosen). Range:
        above 0.
    abort_after : float
        Age from which on the loop gives up [s]. Default 0.1 s (chosen).
    gated : int
        Number of measurements in a row beyond the gate after which the loop gives up, 1 or more. Default 10 (chosen):
        a valid measurement is beyond the gate once in 1000.
    margin_sigmas : float
        Largest travel beyond the error of a measured pose [standard deviations of this pose].
        Default 3. Range: 0 or more.
    overshoot : tuple of float
        Travel beyond the error of a measured pose by the overshoot of the step response [m], [m], [rad], which is
        allowed only in frames with a new trusted pose. Default 0: a controller with an integral part is slower then,
        because the guard cuts the overshoot that empties this part.
    lag : tuple of float
        Time constants with which the axes follow the commanded velocity [s]. The travel includes the motion that
        remains from the velocity at the exposure. Default 0.
    watchdog : float
        Time without a command after which the plant stops by itself [s]; see `Plant`. Default: never, and the last
        command lasts until a late frame.
    encoder_error : tuple of float
        Largest difference of encoder and integrated command [m], [m], [rad]; give more than the lag times the speed of
        the axes. The zero of the encoders is the first reading that the next reading confirms. Default: not checked.
    readings : int
        Number of readings in a row after which a wrong encoder or an axis at its limit ends the loop. Shorter faults
        are ignored. Range: 1 or more. Default 5 (chosen).
    missed : int
        Number of late frames in a row after which the loop gives up, 1 or more. Default 10 (chosen).

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.
    """

    hold_after: float = 0.01
    abort_after: float = 0.1
    gated: int = 10
    margin_sigmas: float = 3.0
    overshoot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lag: tuple[float, float, float] = (0.0, 0.0, 0.0)
    watchdog: float = math.inf
    encoder_error: tuple[float, float, float] = (math.inf, math.inf, math.inf)
    readings: int = 5
    missed: int = 10

    def __post_init__(self) -> None:
        finite(self.hold_after, "hold_after", above=0.0)
        finite(self.abort_after, "abort_after", minimum=self.hold_after)
        finite(self.margin_sigmas, "margin_sigmas", minimum=0.0)
        if not self.watchdog > 0.0:
            raise ValueError(f"watchdog is {self.watchdog}, expected a time > 0, or infinity for none")
        for name in ("overshoot", "lag"):
            for each in numbers(getattr(self, name), (3,), name):
                finite(each, name, minimum=0.0)
        for name in ("gated", "readings", "missed"):
            integer(getattr(self, name), name, minimum=1)
        if len(self.encoder_error) != 3 or not all(each > 0.0 for each in self.encoder_error):
            raise ValueError("encoder_error must be 3 numbers above 0")


class TravelGuard:
    """Guard that bounds the commanded motion since the last trusted exposure by the error of the pose.

    Parameters
    ----------
    margin_sigmas : float
        Largest motion beyond the error of the measured pose [standard deviations of this pose].
    lag : array_like
        (3,) time constants with which the axes follow the commanded velocity [s]. Default 0.
    overshoot : array_like
        (3,) motion beyond the error of the measured pose by the overshoot of the step response. Default 0.

    Notes
    -----
    In a frame without a new trusted pose, no axis gets a command that moves it, since the last trusted exposure, by
    more than the distance of this pose from the target plus the margin. An axis that moved further stands still. It can
    only have moved further by commands that a new trusted pose answered in their frame: by the overshoot at most. The
    guard bounds the integral of the commands since the exposure plus lag times the
    velocity at the exposure: the position at which an axis with this lag comes to rest. The swing of a resonance is not
    included.

    The bound holds for frames that begin in time. Before a late frame the last command lasts longer: n periods move an
    axis by up to n times the bound, unless a watchdog of one period stops the plant (`LoopLimits.watchdog`).
    """

    def __init__(
        self,
        margin_sigmas: float,
        lag: npt.ArrayLike = (0.0, 0.0, 0.0),
        overshoot: npt.ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        self._sigmas, self._lag = margin_sigmas, np.array(lag, np.float64)
        self._overshoot = np.array(overshoot, np.float64)
        # Time, commanded velocity, and velocity of the axes at this time.
        self._commands: deque[tuple[float, Float64, Float64]] = deque()
        self._exposed: float = -math.inf
        self._pose = np.zeros(3)
        self._margin = np.zeros(3)
        self._has_new = False  # a pose was trusted since the last command

    @property
    def exposed(self) -> float:
        """Time of the last trusted exposure [s]; minus infinity before the first one."""
        return self._exposed

    def trust(self, measurement: PoseMeasurement) -> None:
        """Take an accepted measurement; one that was exposed before the last one has no effect."""
        if measurement.exposed <= self._exposed:
            return
        self._exposed, self._pose, self._has_new = measurement.exposed, measurement.pose.copy(), True
        self._margin = self._sigmas * np.sqrt(np.diagonal(measurement.covariance))
        while len(self._commands) > 1 and self._commands[1][0] <= self._exposed:
            self._commands.popleft()

    def limit(self, time: float, velocity: Float64, target: Float64, period: float) -> Float64:
        """Return a velocity (3,), cut so that the motion until the next frame stays within the bound.

        Call it once in each frame: the first call after `trust` allows the overshoot.

        Parameters
        ----------
        time : float
            Time of the command [s].
        velocity : numpy.ndarray
            (3,): wanted velocity.
        target : numpy.ndarray
            (3,): target pose at the next command.
        period : float
            Time until the next command [s].

        Returns
        -------
        numpy.ndarray
            (3,): velocity to command; 0 before the first trusted pose.
        """
        if math.isinf(self._exposed):
            return np.zeros(3)
        bound = np.abs(pose_difference(target, self._pose)) + self._margin + self._has_new * self._overshoot
        self._has_new = False
        travelled = self._travelled(time)
        low, high = (-bound - travelled) / period, (bound - travelled) / period
        cut = np.clip(velocity, np.minimum(low, 0.0), np.maximum(high, 0.0))
        start, commanded, speed = self._commands[-1] if self._commands else (time, np.zeros(3), np.zeros(3))
        self._commands.append((time, cut, self._speed(commanded, speed, time - start)))
        return cut

    def stop(self, time: float) -> None:
        """Take note that the plant stopped by itself at a time [s]."""
        if self._commands:
            start, commanded, speed = self._commands[-1]
            self._commands.append((time, np.zeros(3), self._speed(commanded, speed, time - start)))

    def _speed(self, commanded: Float64, speed: Float64, step: float) -> Float64:
        """Return the velocity (3,) of the axes some time after a command."""
        decay = np.exp(-step / np.maximum(self._lag, 1e-300))
        return commanded + (speed - commanded) * np.where(self._lag > 0.0, decay, 0.0)

    def _travelled(self, time: float) -> Float64:
        """Return the travel (3,) since the last trusted exposure, by the commands up to a time."""
        total, end = np.zeros(3), time
        for start, velocity, speed in reversed(self._commands):
            total += velocity * (end - max(start, self._exposed))
            end = start
            if start <= self._exposed:
                return total + self._lag * self._speed(velocity, speed, self._exposed - start)
        return total


class FaultCounter:
    """Counters of consecutive faults, and the outcome when a counter reaches its limit."""

    def __init__(self, limits: LoopLimits) -> None:
        self._limits = limits
        self._gated = self._stopped = self._differing = self._missed = 0
        self._offset: Float64 | None = None
        self._last_difference: Float64 | None = None
        self.glitches = 0
        """Number of readings whose encoders contradicted the commands."""

    def verdict(self, verdict: Verdict) -> None:
        """Count a measurement."""
        if verdict is Verdict.GATED:
            self._gated += 1
        elif verdict is Verdict.ACCEPTED:
            self._gated = 0

    def reading(self, position: Float64, at_limit: npt.NDArray[np.int8], commanded: Float64, error: Float64) -> None:
        """Compare a reading with the integrated command (3,) and with the error (3,) that is to be corrected."""
        difference = position - commanded
        zero = self._last_difference if self._offset is None else self._offset
        self._last_difference = difference
        if zero is not None:
            outside = bool(np.any(np.abs(difference - zero) > np.array(self._limits.encoder_error)))
            self._differing = self._differing + 1 if outside else 0
            self.glitches += int(outside)
            if not outside:
                self._offset = zero
        self._stopped = self._stopped + 1 if np.any(at_limit * error > 0.0) else 0

    def tick(self, late: bool) -> None:
        """Count the begin of a frame, in time or late."""
        self._missed = self._missed + 1 if late else 0

    def outcome(self, age: float) -> Outcome | None:
        """Return the reason to give up, or None.

        Parameters
        ----------
        age : float
            Time since the last trusted exposure, or since the start [s].
        """
        limits = self._limits
        reasons = {
            Outcome.INCONSISTENT: self._gated >= limits.gated,
            Outcome.LOST: age > limits.abort_after,
            Outcome.ENCODER: self._differing >= limits.readings,
            Outcome.AT_LIMIT: self._stopped >= limits.readings,
            Outcome.TOO_SLOW: self._missed >= limits.missed,
        }
        return next((reason for reason, holds in reasons.items() if holds), None)
