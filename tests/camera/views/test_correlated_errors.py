"""Correlated residuals of views: found where they are, covered by the uncertainties, and described by further terms."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.camera.views.correlated_errors import _jackknife
from gpuvision.camera.views.planar_calibration import fit_camera
from view_scenes import RADIAL, SIZE, bent, camera, exact_views


def test_noise_alone_is_not_correlated(rng: np.random.Generator) -> None:
    views = exact_views(rng, camera(*RADIAL))
    fits = [fit_camera(bent(rng, views, 0.0, 0.1), SIZE, model="k1,k2") for _ in range(12)]
    assert all(fit.error_model == "independent" for fit in fits)
    # The two p-values are uniform: the mean of 12 lies within 0.5 +- 3 * 0.083.
    assert 0.25 < np.mean([fit.lack_of_fit.p_value for fit in fits]) < 0.75
    assert 0.25 < np.mean([fit.view_p_value for fit in fits]) < 0.75
    assert np.mean([fit.lack_of_fit.noise_px for fit in fits]) == pytest.approx(0.1, rel=0.03)


def test_jackknife_is_that_of_fits_without_a_view(rng: np.random.Generator) -> None:
    """Of a linear model the first order is exact: least squares by NumPy without each of six views in turn."""
    design, values = rng.normal(size=(6, 8, 3)), rng.normal(size=(6, 8))
    found = np.linalg.lstsq(design.reshape(-1, 3), values.ravel(), rcond=None)[0]
    shifts = []
    for view in range(6):
        others = np.arange(6) != view
        shifts.append(np.linalg.lstsq(design[others].reshape(-1, 3), values[others].ravel(), rcond=None)[0] - found)
    rows = np.concatenate([design, (values - design @ found)[..., None]], axis=2)
    products = np.swapaxes(rows, 1, 2) @ rows
    np.testing.assert_allclose(_jackknife(products, 3), 5.0 / 6.0 * np.transpose(shifts) @ shifts, rtol=1e-9)


@pytest.mark.slow
def test_uncertainties_cover_views_that_differ(rng: np.random.Generator) -> None:
    """Independent errors would claim two to three times too little."""
    true = np.array([900.0, 650.0, 470.0, *RADIAL])
    found, independent = [], []
    for _ in range(12):
        ideal = exact_views(rng, camera(*RADIAL))
        fit = fit_camera(bent(rng, ideal, 0.3, 0.05), SIZE, model="k1,k2")
        assert fit.error_model == "correlated"
        errors = np.array([fit.camera.matrix[0][0], fit.camera.matrix[0][2], fit.camera.matrix[1][2]])
        errors = np.array([*errors, *fit.camera.distortion[:2]]) - true
        white = fit_camera(ideal, SIZE, model="k1,k2", sigma=fit.sigma_px)
        found.append(errors / np.sqrt(np.diag(fit.covariance)))
        independent.append(errors / np.sqrt(np.diag(white.covariance)))
    assert np.mean(np.abs(found) < 3.0) >= 0.95
    assert np.mean(np.abs(independent) < 3.0) < 0.9


def test_a_wide_lens_gets_further_terms(rng: np.random.Generator) -> None:
    """A rational lens leaves a smooth pattern with k1, k2, and the test goes on to the terms that describe it."""
    views = bent(rng, exact_views(rng, camera(0.3, 0.2, 0.0, 0.0, 0.05, 0.7, 0.3, 0.1), views=12), 0.0, 0.02)
    small = fit_camera(views, SIZE, model="k1")
    assert any("smooth pattern" in each and "model k1," in each for each in small.warnings)
    assert small.lack_of_fit.noise_px < 0.5 * small.sigma_px
    fit = fit_camera(views, SIZE)
    assert "k3" in fit.names
    assert fit.sigma_px == pytest.approx(0.02, rel=0.05)
    assert not any("smooth pattern" in each for each in fit.warnings)
    with pytest.raises(ValueError, match="k4, k5, k6"):
        fit_camera(views, SIZE, model="k7")


def test_few_views_that_differ_are_said(rng: np.random.Generator) -> None:
    fit = fit_camera(bent(rng, exact_views(rng, camera(*RADIAL), views=4), 0.5, 0.02), SIZE, model="k1,k2")
    assert any("4 views are too few" in each for each in fit.warnings)
