"""Calibration of a straight transport: direction and step per profile from poses of a target that the stage moves.

The stage carries the target without turning it: the target's middle moves by ``step`` per profile, a vector in the
camera's frame. `fit_transport` fits a common rotation, the first place and the step to the poses of all views by
generalised least squares, with the covariance of each pose. The error of the camera is common to all views; the result
keeps the derivative by its parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from gpuvision.camera.views.pose_response import PoseResponse

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class TransportFit:
    """Straight transport in the camera's frame.

    Attributes
    ----------
    step : numpy.ndarray
        (3,): movement of the scene from a profile to the next one [m].
    normal : numpy.ndarray
        (3,): Z axis of the moved target in the camera's frame.
    middle : numpy.ndarray
        (3,): middle of the target at the first view [m].
    noise_covariance : numpy.ndarray
        (3, 3): covariance of the step for a known camera [m^2].
    by_camera : numpy.ndarray
        (3, m): derivative of the step by the camera's parameters.
    residuals : numpy.ndarray
        (views, 3): places of the target's middle less the straight uniform motion [m].
    rotations : numpy.ndarray
        (views, 3): rotation vectors of the target about its common rotation [rad].
    view_ratio : float
        Reduced chi-square of the poses; `noise_covariance` includes it if it is above 1.
    """

    step: Float64
    normal: Float64
    middle: Float64
    noise_covariance: Float64
    by_camera: Float64
    residuals: Float64
    rotations: Float64
    view_ratio: float

    @property
    def length(self) -> float:
        """Length of the step [m]."""
        return float(np.linalg.norm(self.step))

    @property
    def direction(self) -> Float64:
        """Unit vector of the movement."""
        return np.asarray(self.step / self.length)

    def covariance(self, camera: npt.ArrayLike) -> Float64:
        """Return the covariance (3, 3) of the step for a camera with a covariance (m, m) [m^2]."""
        total: Float64 = self.noise_covariance + self.by_camera @ np.asarray(camera) @ self.by_camera.T
        return total


def fit_transport(
    targets: Sequence[PoseResponse], profiles: npt.ArrayLike, middle: npt.ArrayLike = (0.0, 0.0, 0.0)
) -> TransportFit:
    """Fit direction and step of a straight transport to the poses of a target that the stage moves.

    Parameters
    ----------
    targets : sequence of PoseResponse
        Pose of the target in each view. The same point of the target must be the origin of all of them.
    profiles : array_like
        (views,): number of the profile at each view; two numbers at least differ.
    middle : array_like
        (3,): middle of the target in its coordinates [m]. Its place has the smallest error. Default ``(0.0, 0.0,
        0.0)``.

    Returns
    -------
    TransportFit

    Raises
    ------
    ValueError
        There are fewer than two views, all are at one profile, or the target did not move.
    """
    numbers = np.asarray(profiles, dtype=np.float64)
    if len(targets) < 2 or numbers.shape != (len(targets),) or np.ptp(numbers) == 0.0:
        raise ValueError(
            f"{len(targets)} transport views at the profiles {numbers.tolist()}, expected two views at least, at "
            "different profiles"
        )
    point = np.asarray(middle, dtype=np.float64)
    reference = targets[len(targets) // 2].pose.rotation
    observed = np.stack([_observation(each, reference, point) for each in targets])
    normal, side, by_camera = np.zeros((9, 9)), np.zeros(9), np.zeros((9, targets[0].by_camera.shape[1]))
    weights, designs = [], []
    for each, values, number in zip(targets, observed, numbers, strict=True):
        to_middle = _pose_of_middle(each, point)
        weight = np.linalg.inv(to_middle @ each.covariance @ to_middle.T)
        design = np.zeros((6, 9))
        design[:, :6] = np.eye(6)
        design[3:, 6:] = number * np.eye(3)
        normal += design.T @ weight @ design
        side += design.T @ weight @ values
        by_camera += design.T @ weight @ to_middle @ each.by_camera
        weights.append(weight)
        designs.append(design)
    inverse: Float64 = np.linalg.inv(normal).astype(np.float64)
    solution = inverse @ side
    rest = observed - np.stack(designs) @ solution
    freedom = 6 * len(targets) - 9
    ratio = sum(float(row @ weight @ row) for row, weight in zip(rest, weights, strict=True)) / freedom
    step = solution[6:]
    if np.linalg.norm(step) == 0.0:
        raise ValueError("the target has the same place in all transport views; move the stage between them")
    return TransportFit(
        step=step,
        normal=Rotation.from_rotvec(solution[:3]).as_matrix() @ reference[:, 2],
        middle=solution[3:6] + numbers[0] * step,
        noise_covariance=max(ratio, 1.0) * inverse[6:, 6:],
        by_camera=(inverse @ by_camera)[6:],
        residuals=rest[:, 3:],
        rotations=rest[:, :3],
        view_ratio=ratio,
    )


def _observation(target: PoseResponse, reference: Float64, point: Float64) -> Float64:
    """Return the rotation vector against the reference rotation and the place of the middle, (6,)."""
    rotation, translation = target.pose
    turn = Rotation.from_matrix(rotation @ reference.T).as_rotvec()
    return np.concatenate([turn, rotation @ point + translation])


def _pose_of_middle(target: PoseResponse, point: Float64) -> Float64:
    """Return the derivative (6, 6) of rotation and place of the middle by rotation and translation of the pose."""
    x, y, z = target.pose.rotation @ point
    derivative = np.eye(6)
    # A rotation vector w moves the middle by w x (R X).
    derivative[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return derivative
