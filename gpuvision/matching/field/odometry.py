"""What wheels and views say together about a pose: predict with a motion, correct with a view.

Poses are (x, y, heading) in metres and radians, motions (forward, left, turn) in the robot's frame before it moves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.validation import numbers

Float64 = npt.NDArray[np.float64]


class PoseEstimate(NamedTuple):
    """A pose (3,) with its covariance (3, 3)."""

    pose: Float64
    covariance: Float64


def predict(estimate: PoseEstimate, motion: npt.ArrayLike, covariance: npt.ArrayLike) -> PoseEstimate:
    """Return where the robot is after a motion.

    Parameters
    ----------
    estimate
        Where it was.
    motion
        (forward, left, turn) as the wheels say.
    covariance
        (3, 3) of the motion.

    Notes
    -----
    Covariances go through the motion's Jacobian: to first order in the heading's uncertainty.
    """
    forward, left, turn = numbers(motion, (3,), "motion")
    noise = np.array(numbers(covariance, (3, 3), "covariance"))
    x, y, heading = estimate.pose
    c, s = math.cos(heading), math.sin(heading)
    dx, dy = c * forward - s * left, s * forward + c * left
    by_pose = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    by_motion = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = by_pose @ estimate.covariance @ by_pose.T + by_motion @ noise @ by_motion.T
    return PoseEstimate(np.array([x + dx, y + dy, _wrapped(heading + turn)]), moved)


def disagreement(estimate: PoseEstimate, pose: npt.ArrayLike, information: npt.ArrayLike) -> float:
    """Return how far a view's pose is from what was expected: squared, in standard deviations; 3 in the mean.

    Directions of which the view says nothing (``information`` of lower rank) say nothing here either; there the mean is
    as much lower. Beyond 16.3 it is one in a thousand: another candidate, its twin, or a robot that was carried.
    """
    view, measured = np.array(numbers(pose, (3,), "pose")), np.array(numbers(information, (3, 3), "information"))
    off = view - estimate.pose
    off[2] = _wrapped(off[2])
    # (P + I^-1)^-1 = (1 + I P)^-1 I, which needs no inverse of I.
    return float(off @ np.linalg.solve(np.eye(3) + measured @ estimate.covariance, measured @ off))


def correct(estimate: PoseEstimate, pose: npt.ArrayLike, information: npt.ArrayLike) -> PoseEstimate:
    """Return what is known once a view's pose is taken in.

    Parameters
    ----------
    estimate
        What was expected.
    pose
        (3,) as a `Candidate` has it.
    information
        (3, 3), inverse of the view's covariance. Of lower rank (one line seen, one circle): only that part of the
        pose is corrected which was seen.
    """
    view, measured = np.array(numbers(pose, (3,), "pose")), np.array(numbers(information, (3, 3), "information"))
    off = view - estimate.pose
    off[2] = _wrapped(off[2])
    left = np.linalg.solve(np.eye(3) + estimate.covariance @ measured, estimate.covariance)
    known = 0.5 * (left + left.T)
    corrected = estimate.pose + known @ measured @ off
    corrected[2] = _wrapped(corrected[2])
    return PoseEstimate(corrected, known)


def _wrapped(angle: float) -> float:
    return float(angle - 2.0 * math.pi * np.rint(angle / (2.0 * math.pi)))
