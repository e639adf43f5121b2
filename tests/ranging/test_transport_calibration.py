"""Direction and step of a transport from poses of a moved target."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gpuvision.camera.views.camera_fit import Pose
from gpuvision.camera.views.pose_response import PoseResponse
from gpuvision.ranging.transport_calibration import fit_transport

STEP = np.array([0.2e-4, -0.3e-3, 0.1e-3])
MIDDLE = np.array([0.05, 0.035, 0.0])


def moved(rng: np.random.Generator, profiles: np.ndarray, scale: float = 1.0) -> list[PoseResponse]:
    """Return noisy poses of a target: correlated noise of rotation and translation, times `scale`."""
    root = np.diag([2e-4] * 3 + [1e-5] * 3) + 2e-6 * np.tri(6, k=-1)
    rotation = Rotation.from_euler("xyz", [0.4, -0.2, 0.1]).as_matrix()
    made = []
    for number in profiles:
        noise = scale * root @ rng.normal(size=6)
        pose = Pose(
            Rotation.from_rotvec(noise[:3]).as_matrix() @ rotation, [0.01, 0.02, 0.3] + number * STEP + noise[3:]
        )
        made.append(PoseResponse(pose, root @ root.T, np.zeros((6, 0))))
    return made


def test_step_has_its_predicted_covariance(rng: np.random.Generator) -> None:
    profiles = np.array([0.0, 20.0, 40.0, 60.0, 100.0])
    chi_squares = []
    for _ in range(60):
        found = fit_transport(moved(rng, profiles), profiles, MIDDLE)
        error = found.step - STEP
        chi_squares.append(error @ np.linalg.solve(found.covariance(np.zeros((0, 0))), error))
    # Mean 3 of 60 chi-squares with 3 degrees of freedom, less for views that agree badly by chance: within 4 sigma.
    assert 2.0 < np.mean(chi_squares) < 3.0 + 4.0 * np.sqrt(6.0 / 60)
    assert found.length == pytest.approx(np.linalg.norm(STEP), rel=1e-2)
    np.testing.assert_allclose(found.direction, STEP / np.linalg.norm(STEP), atol=1e-2)


def test_uneven_stage_widens_the_uncertainty(rng: np.random.Generator) -> None:
    profiles = np.arange(8) * 25.0
    even, uneven = (fit_transport(moved(rng, profiles, scale), profiles, MIDDLE) for scale in (1.0, 10.0))
    assert uneven.view_ratio > 20.0 * even.view_ratio
    none = np.zeros((0, 0))
    assert np.trace(uneven.covariance(none)) > 20.0 * np.trace(even.covariance(none))
    assert even.residuals.shape == even.rotations.shape == (8, 3)


def test_two_views_suffice_and_one_does_not(rng: np.random.Generator) -> None:
    views = moved(rng, np.array([10.0, 40.0]))
    found = fit_transport(views, [10.0, 40.0], MIDDLE)
    np.testing.assert_allclose(found.step, STEP, atol=1e-5)
    np.testing.assert_allclose(found.middle, views[0].pose.rotation @ MIDDLE + views[0].pose.translation, atol=1e-4)
    with pytest.raises(ValueError, match="expected two views at least"):
        fit_transport(views[:1], [0.0])
    with pytest.raises(ValueError, match="at different profiles"):
        fit_transport(views, [5.0, 5.0])
    with pytest.raises(ValueError, match="2 transport views at the profiles"):
        fit_transport(views, [5.0, 6.0, 7.0])


def test_step_is_the_one_of_weighted_least_squares(rng: np.random.Generator) -> None:
    """Against a search over rotation, middle and step for the least sum of squares of the poses themselves."""
    profiles = np.array([10.0, 20.0, 50.0, 100.0])
    views = moved(rng, profiles, 0.1)
    # Views differ in their uncertainty, or all weights would agree.
    views = [replace_covariance(each, (1.0 + number) ** 2) for number, each in enumerate(views)]
    roots = [np.linalg.cholesky(np.linalg.inv(each.covariance)).T for each in views]
    start = views[2].pose.rotation

    def residuals(values: np.ndarray) -> np.ndarray:
        turned = Rotation.from_rotvec(values[:3]).as_matrix() @ start
        found = []
        for view, root, number in zip(views, roots, profiles, strict=True):
            turn = Rotation.from_matrix(view.pose.rotation @ turned.T).as_rotvec()
            # The middle moves with the stage: rotation @ MIDDLE + translation = middle + number step.
            shift = view.pose.rotation @ MIDDLE + view.pose.translation - values[3:6] - number * values[6:]
            found.append(root @ np.concatenate([turn, shift - np.cross(turn, view.pose.rotation @ MIDDLE)]))
        return np.concatenate(found)

    first = np.concatenate([np.zeros(3), views[0].pose.rotation @ MIDDLE + views[0].pose.translation, STEP])
    best = least_squares(residuals, first, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    found = fit_transport(views, profiles, MIDDLE)
    sigma = np.sqrt(np.diag(found.covariance(np.zeros((0, 0)))))
    np.testing.assert_array_less(np.abs(found.step - best.x[6:]), 1e-2 * sigma)
    predicted = np.linalg.inv(best.jac.T @ best.jac)[6:, 6:] * max(found.view_ratio, 1.0)
    np.testing.assert_allclose(found.noise_covariance, predicted, rtol=1e-3, atol=1e-3 * predicted.max())
    assert found.view_ratio == pytest.approx(2.0 * best.cost / (6 * 4 - 9), rel=1e-3)
    turned = Rotation.from_rotvec(best.x[:3]).as_matrix() @ start
    np.testing.assert_allclose(found.normal, turned[:, 2], atol=1e-6)
    np.testing.assert_allclose(found.middle, best.x[3:6] + profiles[0] * best.x[6:], atol=1e-7)
    for view, number, rotation, shift in zip(views, profiles, found.rotations, found.residuals, strict=True):
        expected = Rotation.from_matrix(view.pose.rotation @ turned.T).as_rotvec()
        np.testing.assert_allclose(rotation, expected, atol=1e-6)
        middle = view.pose.rotation @ MIDDLE + view.pose.translation
        np.testing.assert_allclose(shift, middle - best.x[3:6] - number * best.x[6:], atol=1e-6)


def test_step_moves_with_the_camera_as_predicted(rng: np.random.Generator) -> None:
    """Poses that move by their derivatives move the step by its derivative: the camera's share of the covariance."""
    profiles = np.array([10.0, 20.0, 50.0, 100.0])
    views = [
        PoseResponse(each.pose, (1.0 + number) * each.covariance, rng.normal(size=(6, 2)) * 1e-3)
        for number, each in enumerate(moved(rng, profiles, 1e-4))
    ]
    found = fit_transport(views, profiles, MIDDLE)
    assert found.by_camera.shape == (3, 2)
    for number, change in enumerate(1e-3 * np.eye(2)):
        both = []
        for sign in (1.0, -1.0):
            shifted = []
            for view in views:
                turn, shift = np.split(sign * view.by_camera @ change, 2)
                pose = Pose(Rotation.from_rotvec(turn).as_matrix() @ view.pose.rotation, view.pose.translation + shift)
                shifted.append(PoseResponse(pose, view.covariance, view.by_camera))
            both.append(fit_transport(shifted, profiles, MIDDLE).step)
        scale = np.abs(found.by_camera).max()
        np.testing.assert_allclose((both[0] - both[1]) / 2e-3, found.by_camera[:, number], atol=1e-3 * scale)
    camera = np.array([[4.0, 1.0], [1.0, 2.0]])
    expected = found.noise_covariance + found.by_camera @ camera @ found.by_camera.T
    np.testing.assert_allclose(found.covariance(camera), expected, rtol=1e-12)


def replace_covariance(view: PoseResponse, factor: float) -> PoseResponse:
    return PoseResponse(view.pose, factor * view.covariance, view.by_camera)
