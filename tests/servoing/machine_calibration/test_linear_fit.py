"""Weighted linear least squares against NumPy, and the names of undetermined parameters."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.ranging.homography_fit import DegenerateError
from gpuvision.servoing.machine_calibration.linear_fit import fit_linear, undetermined, whiten

NAMES = ("a", "b", "c")
COVARIANCE = np.array([[4e-12, 1e-12], [1e-12, 9e-12]])


@pytest.mark.parametrize("each", [False, True])
def test_fit_is_that_of_the_normal_equations(each: bool, rng: np.random.Generator) -> None:
    design = rng.normal(size=(10, 2, 3)) * [1.0, 1e-3, 1e3]
    truth = np.array([1e-3, 2.0, -1e-6])
    covariance = COVARIANCE * rng.uniform(0.5, 2.0, (10, 1, 1)) if each else COVARIANCE
    weights = np.linalg.inv(np.broadcast_to(covariance, (10, 2, 2)))
    observed = design @ truth + rng.multivariate_normal([0.0, 0.0], COVARIANCE, 10)
    found = fit_linear(design, observed, covariance, NAMES, "")
    normal = np.einsum("nri,nrs,nsj->ij", design, weights, design)
    expected = np.linalg.inv(normal)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6)
    right = np.einsum("nri,nrs,ns->i", design, weights, observed)
    np.testing.assert_allclose((found.values - expected @ right) / scale, 0.0, atol=1e-5)
    rest = observed - design @ found.values
    chi_square = np.einsum("nr,nrs,ns->", rest, weights, rest)
    assert found.degrees_of_freedom == 17
    assert found.residual_scale == pytest.approx(math.sqrt(chi_square / 17), rel=1e-6)
    assert math.isnan(fit_linear(design[:2, :, :2], observed[:2], COVARIANCE, NAMES[:2], "").residual_scale) is False
    assert math.isnan(fit_linear(design[:1, :, :2], observed[:1], COVARIANCE, NAMES[:2], "").residual_scale)


def test_undetermined_parameters_are_named(rng: np.random.Generator) -> None:
    """A column of zeros, and two columns that are equal, up to a factor."""
    design = rng.normal(size=(8, 3))
    assert undetermined(design, NAMES) == ()
    assert undetermined(design * [1.0, 0.0, 1.0], NAMES) == ("b",)
    assert undetermined(np.column_stack([design[:, 0], 1e6 * design[:, 0], design[:, 1]]), NAMES) == ("a", "b")
    assert undetermined(design[:2], NAMES) != ()
    assert undetermined(np.zeros((4, 3)), NAMES) == NAMES
    with pytest.raises(DegenerateError, match=r"^a, b cannot be found: move more$"):
        fit_linear(np.stack([design[:, [0, 0, 1]]] * 2, axis=1), design[:, :2], np.eye(2), NAMES, "move more")


def test_wrong_covariances_are_refused(rng: np.random.Generator) -> None:
    rows = rng.normal(size=(5, 2, 3))
    factor = np.linalg.cholesky(COVARIANCE)
    np.testing.assert_allclose(factor @ whiten(rows, COVARIANCE), rows, rtol=1e-9)
    with pytest.raises(ValueError, match=r"covariance has shape \(3, 3\), expected \(2, 2\) or \(n, 2, 2\)"):
        whiten(rows, np.eye(3))
    with pytest.raises(ValueError, match=r"covariance has shape \(4, 2, 2\)"):
        whiten(rows, np.stack([np.eye(2)] * 4))
    with pytest.raises(ValueError, match="not positive definite"):
        whiten(rows, np.array([[1.0, 2.0], [2.0, 1.0]]))
