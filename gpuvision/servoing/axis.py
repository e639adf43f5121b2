"""Model of one axis of a machine: drive, friction, resonance, long stroke with a fine stage, limits; stepped exactly.

The state is (p, v, s, w, q, q', u, 1): position and velocity of the axis, displacement and velocity of the fine stage
on it, position and velocity of the payload, commanded velocity, and 1. Between two events (the axis stops or breaks
away, the drive saturates, a stop is met) the motion is linear,

    p' = v
    v' = demand - viscous v - coulomb sign(v),       demand = (u + recentring s - v) / lag, within +-acceleration
    s' = w,    w' = (u - v - w) / fine lag
    q'' = resonance^2 (p + s - q) + 2 damping resonance (p' + s' - q')

and one matrix exponential steps it. The payload is light: it does not act back on the axis.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]

P, V, S, W, Q, R, U, ONE = range(8)
"""Indices of the state."""

TICK = 1e-12
"""Resolution of time [s]: the time of an event is found to one tick."""

# Matrix exponentials that are kept for steps that occur again.
_MAX_STEPS = 4096
# The demand of the drive may exceed its limit by this factor before the mode changes: more than rounding.
_SLACK = 1.0 + 1e-9


@dataclass(frozen=True, kw_only=True)
class FineStage:
    """Fine stage on a long-stroke axis: it moves by the difference between the command and the position of the axis.

    Parameters
    ----------
    lag : float
        Time constant of its velocity [s], above 0.
    stroke : float
        Largest displacement from the middle, in each direction [m] or [rad], above 0.
    recentring : float
        Velocity of the long stroke per displacement of the fine stage [1/s], 0 or more. Default 20.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.
    """

    lag: float
    stroke: float
    recentring: float = 20.0

    def __post_init__(self) -> None:
        finite(self.lag, "lag", above=0.0)
        finite(self.stroke, "stroke", above=0.0)
        finite(self.recentring, "recentring", minimum=0.0)


@dataclass(frozen=True, kw_only=True)
class Axis:
    """Axis with a velocity drive; lengths are [m], or [rad] for an axis of rotation.

    Parameters
    ----------
    lag : float
        Time constant with which the velocity follows the command [s], 0 or more; 0 (default) follows at once, and then
        the axis has no friction, no limit of the acceleration and no fine stage.
    viscous : float
        Viscous friction over mass [1/s], 0 or more. Default 0.
    coulomb : float
        Coulomb friction over mass [m/s^2], also the force at which the resting axis breaks away. Range: 0 or more.
        Default 0.
    acceleration : float
        Largest acceleration of the drive [m/s^2]. Default: no limit.
    speed : float
        Largest commanded velocity [m/s]; larger commands are cut. Default: no limit.
    lower, upper : float
        Stops of the axis [m]. Default: none.
    resonance : float
        Natural angular frequency of the payload [rad/s], 0 or more; 0 (default) is a rigid payload.
    damping : float
        Damping ratio of the payload, 0 to 1. Default 0.05.
    fine : FineStage, optional
        Fine stage between the axis and the payload.
    encoder : float
        Step of the encoder [m], 0 or more; 0 (default) reads exactly.

    Raises
    ------
    ValueError
        A number is out of range, or an axis without lag has friction, a limited acceleration or a fine stage.
    """

    lag: float = 0.0
    viscous: float = 0.0
    coulomb: float = 0.0
    acceleration: float = math.inf
    speed: float = math.inf
    lower: float = -math.inf
    upper: float = math.inf
    resonance: float = 0.0
    damping: float = 0.05
    fine: FineStage | None = None
    encoder: float = 0.0

    def __post_init__(self) -> None:
        for name in ("lag", "viscous", "coulomb", "resonance", "encoder"):
            finite(getattr(self, name), name, minimum=0.0)
        finite(self.damping, "damping", minimum=0.0, maximum=1.0)
        if not (self.acceleration > 0.0 and self.speed > 0.0 and self.lower < self.upper):
            raise ValueError("acceleration and speed must be above 0, and lower below upper")
        if self.lag == 0.0 and (
            self.viscous or self.coulomb or math.isfinite(self.acceleration) or self.fine is not None
        ):
            raise ValueError("an axis with friction, a limited acceleration or a fine stage needs a lag above 0")

    @property
    def is_linear(self) -> bool:
        """Whether the axis has no events: no Coulomb friction, limited acceleration, stop or fine stage."""
        limits = (self.acceleration, self.upper, -self.lower)
        return self.coulomb == 0.0 and self.fine is None and all(each == math.inf for each in limits)

    @property
    def longest_step(self) -> float:
        """Longest step without a search for events [s]: half of the shortest time constant."""
        times = [math.inf, *([self.lag] if self.lag else [])]
        if self.fine is not None:
            times += [self.fine.lag, *([1.0 / self.fine.recentring] if self.fine.recentring else [])]
        return 0.5 * min(times)

    def start(self, position: float) -> Float64:
        """Return the state (8,) of the axis at rest at a position."""
        state = np.zeros(8)
        state[[P, Q, ONE]] = position, position, 1.0
        return state


# Signs of the friction (0 sticks, 2 without friction), of a saturated drive, of the stops of axis and fine stage.
_Mode = tuple[int, int, int, int]


class AxisStepper:
    """Exact motion of an axis between two commands.

    It has no state of a motion. `of` returns the same stepper for equal axes, with the matrix exponentials that earlier
    plants needed: they are most of the time of a short placement.
    """

    @staticmethod
    @functools.lru_cache(maxsize=16)
    def of(axis: Axis) -> AxisStepper:
        """Return the stepper of an axis."""
        return AxisStepper(axis)

    def __init__(self, axis: Axis) -> None:
        self.axis = axis
        self._recentring = 0.0 if axis.fine is None else axis.fine.recentring
        self._matrices: dict[_Mode, Float64] = {}
        self._steps: dict[tuple[_Mode, int], Float64] = {}
        self._longest = max(int(min(axis.longest_step / TICK, 2.0**50)), 1)

    def command(self, state: Float64, velocity: float) -> Float64:
        """Return the state (8,) with another commanded velocity, cut to the largest speed."""
        new = state.copy()
        new[U] = min(max(velocity, -self.axis.speed), self.axis.speed)
        if self.axis.lag == 0.0:
            new[V] = new[U]
        return new

    def advance(self, state: Float64, ticks: int) -> Float64:
        """Return the state (8,) after a time in ticks."""
        if self.axis.is_linear:
            return self._exponential((2, 0, 0, 0), ticks) @ state if ticks else state
        while ticks > 0:
            mode = self._mode(state)
            step = min(ticks, self._longest)
            moved = self._exponential(mode, step) @ state
            if not self._holds(mode, moved):
                moved, step = self._up_to_the_event(mode, state, step)
            state, ticks = moved, ticks - step
        return state

    def at_stop(self, state: Float64) -> int:
        """Return -1 or 1 if the axis is at its lower or upper stop, otherwise 0."""
        return int(state[P] >= self.axis.upper) - int(state[P] <= self.axis.lower)

    def _demand(self, state: Float64) -> float:
        return float(state[U] + self._recentring * state[S] - state[V]) / self.axis.lag if self.axis.lag else 0.0

    def _mode(self, state: Float64) -> _Mode:
        axis, demand = self.axis, self._demand(state)
        drive = int(demand > axis.acceleration) - int(demand < -axis.acceleration)
        stop = self.at_stop(state)
        if stop and not self._pushes(state, stop):
            stop = 0
        sign = 2
        if axis.coulomb:
            cut = min(max(demand, -axis.acceleration), axis.acceleration)
            sign = int(np.sign(state[V])) or (int(np.sign(cut)) if abs(cut) > axis.coulomb else 0)
        fine = 0
        if axis.fine is not None and abs(state[S]) >= axis.fine.stroke:
            side = int(np.sign(state[S]))
            fine = side if side * (state[U] - state[V]) >= 0.0 else 0
        return sign, drive, stop, fine

    def _pushes(self, state: Float64, stop: int) -> bool:
        return stop * float(state[U] + self._recentring * state[S]) >= 0.0

    def _holds(self, mode: _Mode, state: Float64) -> bool:
        """Return whether a state still belongs to the mode in which it was reached."""
        axis, (sign, drive, stop, fine) = self.axis, mode
        demand = self._demand(state)
        if sign in (-1, 1) and sign * state[V] < 0.0 and not stop:
            return False
        if sign == 0 and min(abs(demand), axis.acceleration) > axis.coulomb * _SLACK:
            return False
        if (drive * demand * _SLACK < axis.acceleration) if drive else (abs(demand) > axis.acceleration * _SLACK):
            return False
        if not (self._pushes(state, stop) if stop else axis.lower <= state[P] <= axis.upper):
            return False
        if axis.fine is None:
            return True
        return bool(fine * (state[U] - state[V]) >= 0.0 if fine else abs(state[S]) <= axis.fine.stroke)

    def _up_to_the_event(self, mode: _Mode, state: Float64, ticks: int) -> tuple[Float64, int]:
        """Return the state just after the mode ends, with the values at which it ends, and the time in ticks.

        Binary search with the matrices of 2^k ticks: the time is the largest sum of them for which the mode holds, and
        one tick more.
        """
        done = 0
        for power in range(ticks.bit_length() - 1, -1, -1):
            if done + (1 << power) < ticks:
                moved = self._exponential(mode, 1 << power) @ state
                if self._holds(mode, moved):
                    state, done = moved, done + (1 << power)
        state = self._exponential(mode, 1) @ state
        axis = self.axis
        if mode[0] in (-1, 1) and mode[0] * state[V] < 0.0:
            state[V] = 0.0
        if not mode[2] and not axis.lower <= state[P] <= axis.upper:
            state[P], state[V] = min(max(state[P], axis.lower), axis.upper), 0.0
        if axis.fine is not None and not mode[3] and abs(state[S]) > axis.fine.stroke:
            state[S], state[W] = math.copysign(axis.fine.stroke, state[S]), 0.0
        return state, done + 1

    def _exponential(self, mode: _Mode, ticks: int) -> Float64:
        found = self._steps.get((mode, ticks))
        if found is None:
            if len(self._steps) >= _MAX_STEPS:
                self._steps.clear()
            if mode not in self._matrices:
                self._matrices[mode] = self._matrix(mode)
            found = self._steps[mode, ticks] = expm(self._matrices[mode] * (TICK * ticks))
        return found

    def _matrix(self, mode: _Mode) -> Float64:
        """Return the matrix (8, 8) of the differential equation in a mode."""
        axis, (sign, drive, stop, fine) = self.axis, mode
        matrix = np.zeros((8, 8))
        if axis.lag == 0.0 and not stop:
            matrix[P, U] = 1.0
        elif sign != 0 and not stop:
            matrix[P, V] = 1.0
            if drive:
                matrix[V, ONE] = drive * axis.acceleration
            else:
                matrix[V, [U, S, V]] = np.array([1.0, self._recentring, -1.0]) / axis.lag
            matrix[V, V] -= axis.viscous
            matrix[V, ONE] -= axis.coulomb * (sign if sign in (-1, 1) else 0)
        if axis.fine is not None and not fine:
            matrix[S, W] = 1.0
            matrix[W, [U, V, W]] = np.array([1.0, -1.0, -1.0]) / axis.fine.lag
        if axis.resonance:
            square, rate = axis.resonance**2, 2.0 * axis.damping * axis.resonance
            matrix[Q, R] = 1.0
            matrix[R] = rate * (matrix[P] + matrix[S])  # the velocity of what carries the payload
            matrix[R, [P, S]] += square
            matrix[R, Q] -= square
            matrix[R, R] -= rate
        return matrix
