"""Poses that a camera measures, and the state estimate that an observer makes of them."""

from __future__ import annotations

import enum
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


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
    """Its status is not 0, its pose or covariance is not finite, or it was exposed after it arrived."""
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
