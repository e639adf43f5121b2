"""Kalman filter of a robot's pose: predict with odometry, correct with the pose from an image.

Poses are (x, y, heading) in metres and radians, motions (forward, left, turn) in the frame of the robot before it
moves.

References
----------
.. [1] S. Thrun, W. Burgard and D. Fox, *Probabilistic Robotics*, MIT Press 2005, chapters 3 and 7 (extended Kalman
   filter).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.validation import numbers

Float64 = npt.NDArray[np.float64]


class PoseEstimate(NamedTuple):
    """Pose (3,) with its covariance (3, 3)."""

    pose: Float64
    covariance: Float64


def predict(estimate: PoseEstimate, motion: npt.ArrayLike, covariance: npt.ArrayLike) -> PoseEstimate:
    """Return the estimate after a motion.

    Parameters
    ----------
    estimate
        Estimate before the motion.
    motion
        (forward, left, turn) from odometry [m], [m], [rad].
    covariance
        (3, 3) covariance of the motion.

    Notes
    -----
    The covariances are propagated with the Jacobian of the motion: to first order in the uncertainty of the heading.
    """
    forward, left, rotation = numbers(motion, (3,), "motion")
    noise = np.array(numbers(covariance, (3, 3), "covariance"))
    x, y, heading = estimate.pose
    c, s = math.cos(heading), math.sin(heading)
    dx, dy = c * forward - s * left, s * forward + c * left
    by_pose = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    by_motion = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = by_pose @ estimate.covariance @ by_pose.T + by_motion @ noise @ by_motion.T
    return PoseEstimate(np.array([x + dx, y + dy, _wrapped(heading + rotation)]), moved)


def squared_mahalanobis_distance(estimate: PoseEstimate, pose: npt.ArrayLike, information: npt.ArrayLike) -> float:
    """Return the squared Mahalanobis distance of a measured pose from the estimate (NIS).

    NIS is the normalised innovation squared.

    Its mean is 3 for a consistent filter; it exceeds 16.3 with a probability of 0.001 (chi square with 3 degrees of
    freedom): then the measurement is another candidate or a symmetric twin, or the robot was carried. The number of
    degrees of freedom is the rank of ``information``.

    Parameters
    ----------
    estimate
        Expected pose.
    pose
        (3,) measured pose.
    information
        (3, 3) inverse of the covariance of the measured pose.
    """
    view, measured = np.array(numbers(pose, (3,), "pose")), np.array(numbers(information, (3, 3), "information"))
    difference = view - estimate.pose
    difference[2] = _wrapped(difference[2])
    # (P + I^-1)^-1 = (1 + I P)^-1 I, which needs no inverse of I.
    return float(difference @ np.linalg.solve(np.eye(3) + measured @ estimate.covariance, measured @ difference))


def correct(estimate: PoseEstimate, pose: npt.ArrayLike, information: npt.ArrayLike) -> PoseEstimate:
    """Return the estimate after a measured pose.

    Parameters
    ----------
    estimate
        Expected pose.
    pose
        (3,) measured pose, as in a `PoseCandidate`.
    information
        (3, 3) inverse of the covariance of the measured pose. With a lower rank (a single line or circle in view) the
        pose is corrected only in the directions that were measured.
    """
    view, measured = np.array(numbers(pose, (3,), "pose")), np.array(numbers(information, (3, 3), "information"))
    difference = view - estimate.pose
    difference[2] = _wrapped(difference[2])
    left = np.linalg.solve(np.eye(3) + estimate.covariance @ measured, estimate.covariance)
    known = 0.5 * (left + left.T)
    corrected = estimate.pose + known @ measured @ difference
    corrected[2] = _wrapped(corrected[2])
    return PoseEstimate(corrected, known)


def _wrapped(angle: float) -> float:
    return float(angle - 2.0 * math.pi * np.rint(angle / (2.0 * math.pi)))
