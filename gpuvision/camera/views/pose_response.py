"""Poses of a calibrated camera's views: their noise for a known camera, and their dependence on the camera.

A bundle adjustment couples the poses of all views through the camera's parameters. To first order the pose of a view is

    pose = (noise of the view's own points) + derivative @ (error of the camera's parameters),

where ``derivative = -H_pp^-1 H_pc`` follows from the blocks of the normal equations, and ``sigma^2 H_pp^-1`` is the
covariance of the first part. The errors of the first part are independent between views. The second part is common to
all views, so quantities that combine several views (a laser plane, a transport direction) need both parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import COEFFICIENT_NAMES, Camera
from gpuvision.camera.tilted_projection import Floats, rotation_matrix
from gpuvision.camera.views.camera_fit import CameraFit, Pose

# Length of a residual [standard deviations of a coordinate] above which a point is an outlier, which a robust loss has
# not used. Derived: one of 1e5 points at normal noise.
_OUTLIER = 5.0
# Points that fix a pose and leave residuals; ratio of their second to their first extent below which they are collinear
# (chosen: places of points are not known to 1e-4 of their extent).
_MIN_POINTS, _COLLINEAR = 4, 1e-4
# Gauss-Newton steps from the algebraic solution, and movement of the projected points that ends them [px].
_MAX_STEPS, _CONVERGED_PX = 50, 1e-9
# Columns of OpenCV's Jacobian of projected points: rotation 3, translation 3, fx, fy, cx, cy, coefficients.
_TRANSLATION, _FX, _COEFFICIENTS = 3, 6, 10


class PoseResponse(NamedTuple):
    """Pose of a target for a known camera, and its dependence on the camera.

    A change of a pose is a rotation vector [rad], applied from the left in the camera's frame, and a translation [m].

    Attributes
    ----------
    pose : Pose
        Pose of the target in the camera's frame.
    covariance : numpy.ndarray
        (6, 6): covariance of the pose if the camera is known exactly.
    by_camera : numpy.ndarray
        (6, m): derivative of the pose by the m camera parameters `CameraFit.names`.
    """

    pose: Pose
    covariance: Floats
    by_camera: Floats


def pose_responses(fit: CameraFit, views: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]]) -> tuple[PoseResponse, ...]:
    """Return noise and camera dependence of the pose of every view of a calibration.

    Parameters
    ----------
    fit : CameraFit
        Result of `fit_camera`.
    views : sequence of View
        Views that `fit_camera` got, in the same order.

    Returns
    -------
    tuple of PoseResponse
        One per view.
    """
    responses = []
    for pose, (target, _), errors in zip(fit.poses, views, fit.residuals, strict=True):
        used = np.linalg.norm(errors, axis=1) < _OUTLIER * max(fit.sigma_px, np.finfo(float).tiny)
        points = np.zeros((np.count_nonzero(used), 3))
        points[:, :2] = np.asarray(target, dtype=np.float64)[used, :2]
        by_pose, by_camera = _projection_derivatives(fit.camera, fit.names, pose, points)
        inverse: Floats = np.linalg.inv(by_pose.T @ by_pose).astype(np.float64)
        responses.append(PoseResponse(pose, fit.sigma_px**2 * inverse, -inverse @ by_pose.T @ by_camera))
    return tuple(responses)


def fit_pose(
    camera: Camera, names: Sequence[str], points: npt.ArrayLike, pixels: npt.ArrayLike
) -> tuple[PoseResponse, Floats]:
    """Fit the pose of an object with known points to one view of a calibrated camera.

    Parameters
    ----------
    camera : Camera
        Calibrated camera.
    names : sequence of str
        Parameters of the camera for the derivative, as in `CameraFit.names`.
    points : array_like
        (n, 3): points of the object [m], four at least, not on one line; they may lie in one plane.
    pixels : array_like
        (n, 2): measured (column, row) [px].

    Returns
    -------
    PoseResponse
        Its covariance follows from the residuals.
    numpy.ndarray
        (n, 2): measured minus projected points [px].

    Raises
    ------
    ValueError
        The points do not determine a pose.
    """
    scene, measured = np.asarray(points, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    if len(scene) < _MIN_POINTS or _are_collinear(scene):
        raise ValueError(f"{len(scene)} points, expected {_MIN_POINTS} at least that do not lie on one line")
    rays = camera.rays(measured)
    ideal = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
    if not np.isfinite(ideal).all():
        raise ValueError("a measured point is unknown, or no ray through the lens leads to it")
    try:
        _, vector, translation = cv2.solvePnP(scene, ideal, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error as error:  # its equations have too small a rank
        raise ValueError(f"{len(scene)} points are too close to one line to determine a pose") from error
    pose = Pose(cv2.Rodrigues(vector)[0].astype(np.float64), np.asarray(translation, dtype=np.float64).ravel())
    for _ in range(_MAX_STEPS):
        errors = measured - camera.project(scene, *pose)
        if not np.isfinite(errors).all():
            raise ValueError("the points have no pose in front of the camera; check their order and the axes")
        by_pose, by_camera = _projection_derivatives(camera, names, pose, np.ascontiguousarray(scene))
        step = np.linalg.lstsq(by_pose, errors.ravel(), rcond=None)[0]
        if np.abs(by_pose @ step).max() < _CONVERGED_PX:
            break
        pose = Pose(rotation_matrix(step[:3]) @ pose.rotation, pose.translation + step[3:])
    inverse: Floats = np.linalg.inv(by_pose.T @ by_pose).astype(np.float64)
    variance = float(np.sum(errors**2)) / (errors.size - 6)
    return PoseResponse(pose, variance * inverse, -inverse @ by_pose.T @ by_camera), errors


def _are_collinear(points: Floats) -> bool:
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[1] <= _COLLINEAR * extents[0])


def _projection_derivatives(camera: Camera, names: Sequence[str], pose: Pose, points: Floats) -> tuple[Floats, Floats]:
    """Return the derivatives (2 n, 6) and (2 n, m) of projected points by the pose and by camera parameters."""
    rotated = points @ pose.rotation.T
    vector = cv2.Rodrigues(pose.rotation)[0]
    matrix, distortion = np.array(camera.matrix), np.array(camera.distortion)
    slopes = np.asarray(cv2.projectPoints(points, vector, pose.translation, matrix, distortion)[1], dtype=np.float64)
    by_place = slopes[:, _TRANSLATION : _TRANSLATION + 3].reshape(-1, 2, 3)
    # A rotation vector w from the left moves a point by w x (R X).
    by_rotation = np.cross(rotated[:, None, :], by_place)
    by_pose = np.concatenate([by_rotation, by_place], axis=2).reshape(-1, 6)
    return by_pose, np.stack([np.zeros(len(slopes)), *(_column(slopes, name) for name in names)], axis=1)[:, 1:]


def _column(slopes: Floats, name: str) -> Floats:
    if name == "f":
        return np.asarray(slopes[:, _FX] + slopes[:, _FX + 1])
    place = ("fx", "fy", "cx", "cy").index(name) + _FX if name[0] in "fc" else _COEFFICIENTS + _place(name)
    return np.asarray(slopes[:, place])


def _place(name: str) -> int:
    return COEFFICIENT_NAMES.index(name)


def change_camera(camera: Camera, name: str, change: float) -> Camera:
    """Return a camera with one parameter changed, by its name in `CameraFit.names`."""
    (fx, _, cx), (_, fy, cy), _ = camera.matrix
    numbers = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **dict(zip(COEFFICIENT_NAMES, camera.distortion, strict=True))}
    for each in ("fx", "fy") if name == "f" else (name,):
        numbers[each] += change
    return Camera(
        matrix=((numbers["fx"], 0.0, numbers["cx"]), (0.0, numbers["fy"], numbers["cy"]), (0.0, 0.0, 1.0)),
        distortion=tuple(numbers[each] for each in COEFFICIENT_NAMES),
    )


def ray_derivatives(camera: Camera, names: Sequence[str], points: npt.ArrayLike) -> Floats:
    """Return the derivatives (n, 3, m) of the unit viewing directions of measured points by camera parameters.

    Central differences. The step is 1e-3 px for lengths in pixels and 1e-6 for coefficients and angles; the rounding
    of the inverse lens (1e-15) leaves a relative error of 1e-8.

    Parameters
    ----------
    camera : Camera
        Camera.
    names : sequence of str
        Names of the parameters, as in `CameraFit.names`.
    points : array_like
        (n, 2): measured (column, row) [px].
    """
    measured = np.asarray(points, dtype=np.float64)
    columns = []
    for name in names:
        step = 1e-3 if name[0] in "fc" else 1e-6
        ends = [change_camera(camera, name, sign * step).rays(measured) for sign in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    return np.stack(columns, axis=-1) if columns else np.zeros((len(measured), 3, 0))
