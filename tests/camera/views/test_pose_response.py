"""Poses and their dependence on the camera, against the joint covariance of OpenCV's derivatives."""

from __future__ import annotations

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.views.planar_calibration import fit_camera
from gpuvision.camera.views.pose_response import change_camera, pose_responses, ray_derivatives
from tilted_camera import scene


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
