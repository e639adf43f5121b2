"""Correlated residuals of views: found where they are, covered by the uncertainties, and described by further terms."""

from __future__ import annotations

import types
from typing import Any

import numpy as np
import pytest
import scipy.stats
from scipy.special import eval_legendre

from gpuvision.camera.smooth_field import LackOfFit
from gpuvision.camera.views.correlated_errors import (
    CorrelatedErrors,
    _bounding_box,
    _degrees,
    _field,
    _jackknife,
    _lack_of_fit,
    _view_p_value,
)
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


def test_lack_of_fit_is_the_f_test_of_the_modes(rng: np.random.Generator) -> None:
    """Against least squares by NumPy and the F distribution of SciPy; a mode that the fit absorbs is left out."""
    design = rng.normal(size=(50, 4))
    design[:, 3] *= 1e-4  # its sum of squares is below 1e-3 of the number of residuals
    values = design[:, :3] @ [0.5, -0.3, 0.4] + rng.normal(size=50)
    values -= design[:, 3] * (design[:, 3] @ values) / (design[:, 3] @ design[:, 3])
    orthogonal = design[:, :3] - np.outer(design[:, 3], design[:, 3] @ design[:, :3]) / (design[:, 3] @ design[:, 3])
    design[:, :3] = orthogonal
    fitted = orthogonal @ np.linalg.lstsq(orthogonal, values, rcond=None)[0]
    gain, rest = np.sum(fitted**2), np.sum((values - fitted) ** 2)
    for free, left in ((20, 17), (4, 1), (3, 0), (2, -1)):
        lack, variance = _lack_of_fit(design.T @ design, design.T @ values, float(values @ values), 50, free)
        noise = rest / max(left, 1)
        assert lack.modes == 3
        assert variance == pytest.approx(noise, rel=1e-9)
        assert lack.noise_px == pytest.approx(np.sqrt(noise), rel=1e-9)
        assert lack.rms_px == pytest.approx(np.sqrt(max(gain - 3.0 * noise, 0.0) / 50.0), rel=1e-9)
        expected = scipy.stats.f.sf(gain / 3.0 / noise, 3, left) if left > 0 else 1.0
        assert lack.p_value == pytest.approx(expected, rel=1e-9)
    # Residuals at the level of rounding, 1e-6 px, say nothing; without modes there is no test.
    assert _lack_of_fit(np.eye(2), np.array([1e-7, 0.0]), 1e-14, 2, 9)[0].p_value > 0.9
    lack, variance = _lack_of_fit(np.empty((0, 0)), np.empty(0), 8.0, 2, 4)
    assert (lack, variance) == (LackOfFit(p_value=1.0, rms_px=0.0, noise_px=np.sqrt(2.0), modes=0), 2.0)


def test_views_are_compared_by_an_f_test(rng: np.random.Generator) -> None:
    """One camera for all of three views against one for each, which adds two times two parameters."""
    design, values = rng.normal(size=(3, 8, 2)), rng.normal(size=(3, 8))
    values = values - design @ np.linalg.lstsq(design.reshape(-1, 2), values.ravel(), rcond=None)[0]
    own = np.stack([each @ np.linalg.lstsq(each, of, rcond=None)[0] for each, of in zip(design, values, strict=True)])
    gain, cost = np.sum(own**2), np.sum(values**2)
    normal, side = np.swapaxes(design, 1, 2) @ design, np.einsum("vij,vi->vj", design, values)
    for free, left in ((22, 18), (5, 1), (4, 0)):
        expected = scipy.stats.f.sf(gain / 4.0 / ((cost - gain) / left), 4, left) if left else 1.0
        assert _view_p_value(normal, side, cost, free) == pytest.approx(expected, rel=1e-9)
    assert _view_p_value(normal[:1], side[:1], cost, 22) == 1.0
    assert _view_p_value(normal, side * 1e-9, cost * 1e-18, 22) > 0.99  # at the level of rounding
    # A view that determines one combination only adds one parameter less.
    weak = normal.copy()
    weak[2] = np.outer([0.6, 0.8], [0.6, 0.8])
    side[2] = 0.3 * np.array([0.6, 0.8])
    gain = sum(each @ np.linalg.solve(of, each) for each, of in zip(side[:2], weak[:2], strict=True)) + 0.09
    expected = scipy.stats.f.sf(gain / 3.0 / ((cost - gain) / 19.0), 3, 19)
    assert _view_p_value(weak, side, cost, 22) == pytest.approx(expected, rel=1e-9)


def test_modes_are_legendre_polynomials(rng: np.random.Generator) -> None:
    """Two directions of each product, with a mean square of 1 over the bounding box, times the root of the weight."""
    image, root = rng.uniform((100.0, 50.0), (900.0, 450.0), (30, 2)).T, rng.uniform(0.5, 1.0, 30)
    low, high = np.array([[100.0], [50.0]]), np.array([[900.0], [450.0]])
    x, y = (image[0] - 500.0) / 400.0, (image[1] - 250.0) / 200.0
    found = _field(image, low, high, np.array([1, 2]), root)
    expected = []
    for i, k in ((0, 1), (1, 0), (0, 2), (1, 1), (2, 0)):
        shape = eval_legendre(i, x) * eval_legendre(k, y) * np.sqrt((2 * i + 1) * (2 * k + 1)) * root
        expected += [[*shape, *0.0 * shape], [*0.0 * shape, *shape]]
    np.testing.assert_allclose(found, expected, atol=1e-13)
    assert _field(image, low, high, np.empty(0, dtype=np.intp), root).shape == (0, 60)


def test_box_and_degrees_of_the_modes() -> None:
    """The box of the points with a weight, at least 1 px wide; all degrees whose modes are at most the given number."""
    image = np.array([[[1.0, 5.0, -9.0], [2.0, 2.5, 99.0]], [[3.0, 0.0, 4.0], [2.0, 2.0, 2.0]]])
    packed: Any = types.SimpleNamespace(image=image, weight=np.array([[1.0, 0.5, 0.0], [1.0, 1.0, 1.0]]))
    low, high = _bounding_box(packed)
    assert (low.tolist(), high.tolist()) == ([[0.0], [2.0]], [[5.0], [3.0]])
    first = int(_degrees(10**6)[0])
    counts = np.cumsum([2 * (n + 1) for n in _degrees(10**6)])
    for length, count in enumerate(counts.tolist(), 1):
        assert _degrees(count).tolist() == list(range(first, first + length))
        assert len(_degrees(count - 1)) == length - 1


def test_parts_of_the_covariance_add_up() -> None:
    """Errors by view replace independent ones where they are larger; the field adds to both."""
    white, field = np.diag([4.0, 9.0]), np.array([[1.0, 0.5], [0.5, 2.0]])
    lack = LackOfFit(p_value=0.3, rms_px=0.0, noise_px=1.0, modes=3)
    found = CorrelatedErrors(lack_of_fit=lack, view_p_value=0.2, field=field, by_view=np.diag([16.0, 1.0]))
    np.testing.assert_allclose(found.covariance_by_view(white), np.diag([16.0, 9.0]))
    np.testing.assert_allclose(found.covariance(white), np.diag([16.0, 9.0]) + field)
    few = CorrelatedErrors(lack_of_fit=lack, view_p_value=0.4, field=field, by_view=None)
    np.testing.assert_array_equal(few.covariance(white), white + field)
    assert (found.is_correlated(0.2), found.is_correlated(0.21), few.is_correlated(0.3)) == (False, True, False)
    assert few.is_correlated(0.31)


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
