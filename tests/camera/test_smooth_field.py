"""Variances of the modes of a smooth field, and lower bounds of covariances, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.camera.smooth_field import mode_variances, not_below

COUNT = 100


def test_variance_of_a_seen_degree() -> None:
    """Three modes with the inner products 50 I: estimate and standard error of a sum of three squares."""
    product = np.array([30.0, -40.0, 120.0])
    found = mode_variances(np.array([1, 1, 1]), 50.0 * np.eye(3), product, 2.0, COUNT)
    estimate = np.mean(product**2 / 50.0**2) - 2.0 / 50.0
    # Each product has the variance (estimate + 2 / 50) 50^2; the mean of three squares has sqrt(2 / 3) of it.
    error = math.sqrt(2.0 / 3.0) * (estimate + 2.0 / 50.0)
    np.testing.assert_allclose(found, [0.0, estimate + error], rtol=1e-12)


def test_noise_alone_leaves_the_standard_error() -> None:
    """The estimate is not negative; the standard error of products of pure noise stays."""
    found = mode_variances(np.array([1, 1]), 50.0 * np.eye(2), np.array([1.0, -1.0]), 2.0, COUNT)
    np.testing.assert_allclose(found, [0.0, math.sqrt(2.0 / 2.0) * 2.0 / 50.0], rtol=1e-12)


@pytest.mark.parametrize(("share", "is_seen"), [(0.05, True), (0.0499, False)])
def test_an_unseen_degree_is_extrapolated(share: float, is_seen: bool) -> None:
    """Degree 4 bounds the degrees below it: its variance times (4 / degree)^4, where that is more than their own."""
    seen = np.diag([share * COUNT, 50.0])
    found = mode_variances(np.array([2, 4]), seen, np.array([1e3, 100.0]), 2.0, COUNT)
    least = found[4] * (4.0 / np.array([1.0, 2.0, 3.0])) ** 4
    assert found[4] > 1.0
    np.testing.assert_allclose(found[3], least[2], rtol=1e-12)
    if is_seen:
        assert found[2] > 1e4
        np.testing.assert_allclose(found[1], 16.0 * found[2], rtol=1e-12)
    else:
        np.testing.assert_allclose(found[1:3], least[:2], rtol=1e-12)


def test_a_raised_covariance_is_at_least_both(rng: np.random.Generator) -> None:
    np.testing.assert_allclose(not_below(np.diag([1.0, 9.0]), np.diag([4.0, 4.0])), np.diag([4.0, 9.0]), atol=1e-12)
    for _ in range(5):
        first, second = (each @ each.T + 0.1 * np.eye(3) for each in rng.normal(size=(2, 3, 3)))
        raised = not_below(first, second)
        for least in (first, second):
            assert np.linalg.eigvalsh(raised - least)[0] > -1e-12
        np.testing.assert_allclose(not_below(first + second, second), first + second, rtol=1e-9)
