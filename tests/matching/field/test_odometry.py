"""Odometry and views together: against simulated robots, Kalman's equations, and with insufficient views."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.matching.field.odometry import PoseEstimate, correct, predict, squared_mahalanobis_distance

POSE = np.array([1.0, 2.0, 3.0])
COVARIANCE = np.array([[4e-3, 1e-3, 2e-4], [1e-3, 9e-3, -3e-4], [2e-4, -3e-4, 1e-4]])


def test_a_motion_is_in_the_robots_frame() -> None:
    start = PoseEstimate(np.array([1.0, 2.0, np.pi / 2]), np.zeros((3, 3)))
    moved = predict(start, (0.5, 0.2, np.pi), np.diag([1e-4, 4e-4, 1e-6]))
    np.testing.assert_allclose(moved.pose, [0.8, 2.5, -np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(moved.covariance, np.diag([4e-4, 1e-4, 1e-6]), atol=1e-15)


@pytest.mark.slow
def test_the_covariance_is_that_of_many_robots(rng: np.random.Generator) -> None:
    noise = np.diag([1e-4, 4e-4, 1e-4])
    robots = rng.multivariate_normal(POSE, COVARIANCE, 40_000)
    motions = rng.multivariate_normal([0.5, -0.2, 0.1], noise, 40_000)
    ends = np.array([predict(PoseEstimate(a, COVARIANCE), b, noise).pose for a, b in zip(robots, motions, strict=True)])
    ends[:, 2] = np.where(ends[:, 2] < 0, ends[:, 2] + 2 * np.pi, ends[:, 2])
    predicted = predict(PoseEstimate(POSE, COVARIANCE), (0.5, -0.2, 0.1), noise)
    # Second order in an angle of 0.01 is 1e-4 of it; 40 000 draws give a covariance to a percent of its diagonal.
    size = np.sqrt(np.outer(np.diag(predicted.covariance), np.diag(predicted.covariance)))
    np.testing.assert_allclose(np.cov(ends.T) / size, predicted.covariance / size, atol=0.03)


def test_correction_is_kalmans() -> None:
    estimate, view = PoseEstimate(POSE, COVARIANCE), np.add(POSE, [0.05, -0.03, 0.01])
    noise = np.array([[2e-3, 0.0, 1e-4], [0.0, 1e-3, 0.0], [1e-4, 0.0, 5e-5]])
    gain = COVARIANCE @ np.linalg.inv(COVARIANCE + noise)
    corrected = correct(estimate, view, np.linalg.inv(noise))
    expected = POSE + gain @ (view - POSE)
    np.testing.assert_allclose(corrected.pose, expected - [0, 0, 0 if expected[2] < np.pi else 2 * np.pi], rtol=1e-10)
    np.testing.assert_allclose(corrected.covariance, (np.eye(3) - gain) @ COVARIANCE, rtol=1e-9)
    far = (view - POSE) @ np.linalg.inv(COVARIANCE + noise) @ (view - POSE)
    assert squared_mahalanobis_distance(estimate, view, np.linalg.inv(noise)) == pytest.approx(far, rel=1e-10)


def test_one_line_corrects_what_it_says() -> None:
    """A line along x determines y and the heading; x does not change."""
    estimate = PoseEstimate(np.array([1.0, 2.0, 0.0]), np.diag([0.04, 0.04, 0.01]))
    corrected = correct(estimate, (50.0, 2.1, 0.05), np.diag([0.0, 1e8, 1e8]))
    np.testing.assert_allclose(corrected.pose, [1.0, 2.1, 0.05], atol=1e-6)
    np.testing.assert_allclose(np.diag(corrected.covariance), [0.04, 1e-8, 1e-8], rtol=1e-5)
    assert squared_mahalanobis_distance(estimate, (50.0, 2.0, 0.0), np.diag([0.0, 1e8, 1e8])) == pytest.approx(0.0)


def test_headings_are_compared_around_the_circle() -> None:
    estimate = PoseEstimate(np.array([0.0, 0.0, np.pi - 0.01]), np.eye(3) * 1e-4)
    corrected = correct(estimate, (0.0, 0.0, -np.pi + 0.01), np.eye(3) * 1e4)
    assert abs(abs(corrected.pose[2]) - np.pi) < 1e-9
    assert squared_mahalanobis_distance(estimate, (0.0, 0.0, -np.pi + 0.01), np.eye(3) * 1e4) == pytest.approx(2.0)


def test_the_twin_disagrees() -> None:
    estimate = PoseEstimate(np.array([3.0, 2.0, 0.5]), np.diag([0.01, 0.01, 0.01]))
    assert squared_mahalanobis_distance(estimate, (-3.0, -2.0, 0.5 - np.pi), np.eye(3) * 1e4) > 16.3


def test_wrong_sizes_are_refused() -> None:
    estimate = PoseEstimate(POSE, COVARIANCE)
    with pytest.raises(ValueError, match="motion"):
        predict(estimate, (1.0, 2.0), np.eye(3))
    with pytest.raises(ValueError, match="information"):
        correct(estimate, POSE, np.eye(2))
    with pytest.raises(ValueError, match="pose"):
        squared_mahalanobis_distance(estimate, (1.0, 2.0, np.nan), np.eye(3))
