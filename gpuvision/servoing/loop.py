"""Interfaces of the servo loop: a plant, a sensor of poses and a clock, each simulated or real."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.observer import PoseMeasurement

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
        """Move with a velocity (3,) [m/s], [m/s], [rad/s] from a time on, until the next command."""

    def read(self, time: float) -> PlantReading:
        """Return the reading of the encoders at a time, not before the last command."""


class PoseSensor(Protocol):
    """Source of measured poses: a camera with its image processing, or their simulation."""

    def __call__(self, time: float) -> Sequence[PoseMeasurement]:
        """Return the measurements that arrived since the last call, up to a time."""


class Clock(Protocol):
    """Clock of the loop: wall clock or simulated clock."""

    def now(self) -> float:
        """Return the time [s]."""

    def wait_until(self, time: float) -> float:
        """Wait until a time [s] and return the time; return at once if it is past."""
