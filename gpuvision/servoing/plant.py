"""Simulated machine of three axes that move a head in x, y and theta."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.axis import TICK, Axis, AxisStepper, P, Q, S
from gpuvision.servoing.loop import PlantReading
from gpuvision.validation import integer, numbers

Float64 = npt.NDArray[np.float64]


class SimulatedPlant:
    """Machine with three axes, simulated exactly between the commands.

    Parameters
    ----------
    axes : sequence of Axis
        Axes of x, y and theta. Default: three axes that follow the commanded velocity at once.
    start : array_like
        (3,): x [m], y [m], theta [rad] at time 0, at rest. Default: zeros.
    history : int
        Number of past commands for which `pose` still answers, 2 or more. Default 4096.
    watchdog : float
        Time after a command at which the axes are commanded to stand still [s]. Default: never.
    swing : array_like
        (3,): displacement of the payload against its axis at time 0 [m], [m], [rad]: the residual vibration of a move
        before. An axis with a resonance swings with this amplitude; it must be 0 for the others. Default: zeros.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.

    Notes
    -----
    Implements `Plant`. `pose` gives the true pose of the payload: hand it to a simulated camera. A step of three axes
    costs about 10 us, an event (an axis stops, breaks away or meets a stop) about 0.1 ms.
    """

    def __init__(
        self,
        axes: Sequence[Axis] = (Axis(), Axis(), Axis()),
        *,
        start: npt.ArrayLike = (0, 0, 0),
        history: int = 4096,
        watchdog: float = math.inf,
        swing: npt.ArrayLike = (0, 0, 0),
    ) -> None:
        if len(axes) != 3:
            raise ValueError(f"a plant has 3 axes (x, y, theta), got {len(axes)}")
        if not watchdog > 0.0:
            raise ValueError(f"watchdog is {watchdog}, expected a time > 0, or infinity for none")
        self.axes, self._watchdog = tuple(axes), math.inf if math.isinf(watchdog) else _ticks(watchdog)
        self._steppers = [AxisStepper.of(each) for each in axes]
        position = numbers(start, (3,), "start")
        states = [each.start(where) for each, where in zip(axes, position, strict=True)]
        for axis, state, away in zip(axes, states, numbers(swing, (3,), "swing"), strict=True):
            if away and not axis.resonance:
                raise ValueError("swing needs an axis with a resonance")
            state[Q] += away
        self._segments: deque[tuple[int, list[Float64]]] = deque(
            [(0, states)], maxlen=integer(history, "history", minimum=2)
        )

    def command(self, time: float, velocity: Float64) -> None:
        """Move with a velocity (3,) [m/s], [m/s], [rad/s] from a time on.

        Raises
        ------
        ValueError
            The time is before the last command, or a velocity is not finite.
        """
        velocity = numbers(velocity, (3,), "velocity")
        states = self._states(time)
        moved = [each.command(state, float(v)) for each, state, v in zip(self._steppers, states, velocity, strict=True)]
        self._segments.append((_ticks(time), moved))

    def read(self, time: float) -> PlantReading:
        """Return the reading of the encoders at a time, not before the last command."""
        states = self._states(time)
        position = np.array([state[P] + state[S] for state in states])
        steps = np.array([each.encoder for each in self.axes])
        rounded = np.where(steps > 0.0, np.rint(position / np.where(steps > 0.0, steps, 1.0)) * steps, position)
        stops = [each.at_stop(state) for each, state in zip(self._steppers, states, strict=True)]
        return PlantReading(time, rounded, np.array(stops, np.int8))

    def pose(self, time: npt.ArrayLike) -> Float64:
        """Return the true pose of the payload.

        Parameters
        ----------
        time : array_like
            (...,) times [s]. Before time 0 the plant rests at its start.

        Returns
        -------
        numpy.ndarray
            (..., 3): x [m], y [m], theta [rad].

        Raises
        ------
        ValueError
            A time is before the first command of the history.
        """
        times = np.asarray(time, np.float64)
        found = [self._pose(float(each)) for each in times.ravel()]
        return np.array(found).reshape(*times.shape, 3)

    def _pose(self, time: float) -> list[float]:
        ticks = max(_ticks(time), 0)
        found = bisect_right(self._segments, ticks, key=lambda each: each[0]) - 1
        if found < 0:
            raise ValueError(f"the time {time:.6f} s is before the history of the plant; enlarge history")
        start, states = self._segments[found]
        moved = self._advance(states, ticks - start)
        return [
            float(state[Q] if axis.resonance else state[P] + state[S])
            for axis, state in zip(self.axes, moved, strict=True)
        ]

    def _states(self, time: float) -> list[Float64]:
        start, states = self._segments[-1]
        ticks = _ticks(time) - start
        if ticks < 0:
            raise ValueError(f"the time {time:.6f} s is before the last command at {start * TICK:.6f} s")
        return self._advance(states, ticks)

    def _advance(self, states: list[Float64], ticks: int) -> list[Float64]:
        """Return the states some ticks after a command."""
        steppers = self._steppers
        if ticks > self._watchdog:
            before = int(self._watchdog)
            moved = [each.advance(state, before) for each, state in zip(steppers, states, strict=True)]
            states = [each.command(state, 0.0) for each, state in zip(steppers, moved, strict=True)]
            ticks -= before
        return [each.advance(state, ticks) for each, state in zip(steppers, states, strict=True)]


def _ticks(time: float) -> int:
    return round(time / TICK)
