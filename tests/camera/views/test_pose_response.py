"""Poses and their dependence on the camera, against the joint covariance of OpenCV's derivatives."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gpuvision.camera.camera import COEFFICIENT_NAMES, Camera
from gpuvision.camera.views.camera_fit import Pose
from gpuvision.camera.views.planar_calibration import fit_camera
from gpuvision.camera.views.pose_response import change_camera, fit_pose, pose_responses, ray_derivatives
from tilted_camera import scene

CAMERA = Camera(
    matrix=((900.0, 0.0, 330.0), (0.0, 950.0, 235.0), (0.0, 0.0, 1.0)),
    distortion=(-0.2, 0.1, 0.0, 0.0, 0.02, *(0.0,) * 9),
)
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "tauX", "tauY")
POSE = Pose(Rotation.from_rotvec([0.3, -0.4, 0.2]).as_matrix(), np.array([0.02, -0.03, 0.6]))
X, Y = np.meshgrid(np.linspace(-0.1, 0.12, 4), np.linspace(-0.08, 0.07, 3))
BODY = np.stack([X, Y, 0.3 * X * Y + 0.02 * np.cos(30.0 * X)], axis=-1).reshape(-1, 3)
NOISE = 0.2 * np.sin(1.0 + np.arange(2.0 * len(BODY)) ** 2).reshape(-1, 2)


def pose_slopes(points: np.ndarray) -> np.ndarray:
    """Return the derivatives (2 n, 6) of projected points by rotation and translation, by central differences."""
    columns = []
    for change in 1e-6 * np.eye(6):
        ends = [
            CAMERA.project(
                points,
                Rotation.from_rotvec(sign * change[:3]).as_matrix() @ POSE.rotation,
                POSE.translation + sign * change[3:],
            )
            for sign in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]).ravel() / 2e-6)
    return np.stack(columns, axis=-1)


def camera_slopes(points: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Return the derivatives (2 n, m) of projected points by the camera's parameters, by central differences."""
    columns = []
    for name in names:
        ends = []
        for step in (1e-5, -1e-5):
            matrix, distortion = np.array(CAMERA.matrix), list(CAMERA.distortion)
            if name in COEFFICIENT_NAMES:
                distortion[COEFFICIENT_NAMES.index(name)] += step
            else:
                for place in {"f": [(0, 0), (1, 1)], "fx": [(0, 0)], "fy": [(1, 1)], "cx": [(0, 2)], "cy": [(1, 2)]}[
                    name
                ]:
                    matrix[place] += step
            ends.append(Camera(matrix=matrix.tolist(), distortion=tuple(distortion)).project(points, *POSE))
        columns.append((ends[0] - ends[1]).ravel() / 2e-5)
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("names", [NAMES, ("f", "cy"), ()])
def test_pose_of_known_points(names: tuple[str, ...]) -> None:
    """Exact points have the exact pose; of inexact ones the residuals are orthogonal to the derivatives by the pose."""
    exact = CAMERA.project(BODY, *POSE)
    found, errors = fit_pose(CAMERA, names, BODY, exact)
    np.testing.assert_allclose(found.pose.rotation, POSE.rotation, atol=1e-10)
    np.testing.assert_allclose(found.pose.translation, POSE.translation, atol=1e-10)
    np.testing.assert_allclose(errors, 0.0, atol=1e-8)
    slopes = pose_slopes(BODY)
    inverse = np.linalg.inv(slopes.T @ slopes)
    expected = np.zeros((6, 0)) if not names else -inverse @ slopes.T @ camera_slopes(BODY, names)
    np.testing.assert_allclose(found.by_camera, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max(initial=0.0))
    # Residuals that no change of the pose reduces: the points have the same pose to first order.
    noise = NOISE.ravel() - slopes @ (inverse @ slopes.T @ NOISE.ravel())
    noisy, errors = fit_pose(CAMERA, names, BODY, exact + noise.reshape(-1, 2))
    np.testing.assert_allclose(errors.ravel(), noise, atol=2e-3)
    expected = np.sum(noise**2) / (2 * len(BODY) - 6) * inverse
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(noisy.covariance / np.outer(size, size), expected / np.outer(size, size), atol=5e-3)


@pytest.mark.parametrize("kept", [[0, 3, 8, 11], [0, 1, 5, 6, 10]])
def test_four_points_have_a_pose(kept: list[int]) -> None:
    found, _ = fit_pose(CAMERA, (), BODY[kept], CAMERA.project(BODY[kept], *POSE))
    np.testing.assert_allclose(found.pose.translation, POSE.translation, atol=1e-9)
    assert np.isfinite(found.covariance).all()


def test_points_without_a_pose() -> None:
    pixels = CAMERA.project(BODY, *POSE)
    with pytest.raises(ValueError, match="3 points, expected 4 at least that do not lie on one line"):
        fit_pose(CAMERA, (), BODY[[0, 3, 8]], pixels[[0, 3, 8]])
    line = np.linspace(0.0, 1.0, 6)[:, None] * [0.1, 0.05, 0.0] + [0.01, 0.02, 0.0]
    # The solver refuses some points with a second extent between 1e-4 and 1e-3 of the first.
    for bend, words in (
        (0.9e-4, "6 points, expected 4 at least that do not lie on one line"),
        (1.2e-4, "too close to"),
        (0.01, None),
    ):
        # A displacement across the line that is orthogonal to it: its norm is the second singular value.
        across = np.array([1.0, -1.0, 0.0, 0.0, -1.0, 1.0])
        length = np.linalg.norm(line - line.mean(axis=0))
        points = line + np.outer(across / 2.0, [-0.05, 0.1, 0.0]) / np.hypot(0.05, 0.1) * bend * length
        seen = CAMERA.project(points, *POSE)
        if words is None:
            np.testing.assert_allclose(
                fit_pose(CAMERA, (), points, seen)[0].pose.translation, POSE.translation, atol=1e-7
            )
        else:
            with pytest.raises(ValueError, match=words):
                fit_pose(CAMERA, (), points, seen)
    pixels[3, 1] = np.nan
    with pytest.raises(ValueError, match="a measured point is unknown, or no ray"):
        fit_pose(CAMERA, (), BODY, pixels)


def test_a_response_leaves_out_outliers() -> None:
    """Points with residuals of 5 standard deviations or more are not used."""
    names = ("f", "cy", "k1")
    residuals = np.zeros((len(BODY), 2))
    residuals[2], residuals[7], residuals[9] = (0.3, 0.4), (0.0, 0.49), (-3.0, 0.0)
    target = BODY * [1.0, 1.0, 0.0]
    fit: Any = SimpleNamespace(camera=CAMERA, names=names, poses=(POSE,), residuals=(residuals,), sigma_px=0.1)
    used = np.delete(target, [2, 9], axis=0)
    slopes = pose_slopes(used)
    inverse = np.linalg.inv(slopes.T @ slopes)
    for given in (target, target[:, :2]):
        (found,) = pose_responses(fit, [(given, CAMERA.project(target, *POSE))])
        assert found.pose is POSE
        np.testing.assert_allclose(found.covariance, 0.01 * inverse, rtol=1e-5, atol=1e-7 * 0.01 * inverse.max())
        expected = -inverse @ slopes.T @ camera_slopes(used, names)
        np.testing.assert_allclose(found.by_camera, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_pose_covariance_is_noise_plus_camera() -> None:
    """The two parts add up to the covariance of the poses that the bundle adjustment computes in other coordinates."""
    rng = np.random.default_rng(11)
    made = scene(rng, "grid", 20.0, views=6)
    views = made.views(rng, 0.05)
    fit = fit_camera(views, made.size, model="tilt")
    for each, total in zip(pose_responses(fit, views), fit.pose_covariance, strict=True):
        together = each.covariance + each.by_camera @ fit.covariance @ each.by_camera.T
        size = np.sqrt(np.diag(total))
        np.testing.assert_allclose(together / np.outer(size, size), total / np.outer(size, size), atol=2e-3)


def test_ray_derivatives_predict_the_rays_of_a_changed_camera() -> None:
    camera = Camera(
        matrix=((900.0, 0.0, 330.0), (0.0, 900.0, 235.0), (0.0, 0.0, 1.0)),
        distortion=(-0.2, 0.1, *(0.0,) * 10, 0.25, -0.1),
    )
    points = np.stack(np.meshgrid(np.linspace(0.0, 640.0, 5), np.linspace(0.0, 480.0, 5)), axis=-1).reshape(-1, 2)
    names, changes = ("f", "cx", "cy", "k1", "k2", "tauX", "tauY"), (0.3, -0.2, 0.4, 1e-4, -2e-4, 2e-4, 1e-4)
    slopes = ray_derivatives(camera, names, points)
    changed = camera
    for name, change in zip(names, changes, strict=True):
        changed = change_camera(changed, name, change)
    moved = changed.rays(points) - camera.rays(points)
    np.testing.assert_allclose(slopes @ changes, moved, atol=2e-6)
    assert np.abs(moved).max() > 2e-4


def test_ray_derivatives_of_no_parameter() -> None:
    assert ray_derivatives(CAMERA, (), np.zeros((5, 2))).shape == (5, 3, 0)


def test_a_changed_camera_differs_in_one_parameter() -> None:
    focal = {"f": [1.0, 1.0, 0.0, 0.0], "fx": [1.0, 0.0, 0.0, 0.0], "fy": [0.0, 1.0, 0.0, 0.0]}
    focal |= {"cx": [0.0, 0.0, 1.0, 0.0], "cy": [0.0, 0.0, 0.0, 1.0]}
    for name in (*focal, *COEFFICIENT_NAMES):
        changed = change_camera(CAMERA, name, 0.25)
        (fx, skew, cx), (below, fy, cy), last = changed.matrix
        expected = np.array([900.0, 950.0, 330.0, 235.0]) + 0.25 * np.array(focal.get(name, [0.0] * 4))
        assert (fx, fy, cx, cy) == tuple(expected)
        assert (skew, below, last) == (0.0, 0.0, (0.0, 0.0, 1.0))
        moved = np.array([0.25 * (each == name) for each in COEFFICIENT_NAMES])
        assert changed.distortion == tuple(CAMERA.distortion + moved)
