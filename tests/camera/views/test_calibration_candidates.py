"""Comparison of camera models: F test, Wald's test with errors by view, and the summary of an alternative."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.stats

from gpuvision.camera.views import calibration_candidates
from gpuvision.camera.views.calibration_candidates import alternative_of, p_value_against, parse_model
from gpuvision.camera.views.diagnosis import CalibrationLimits
from gpuvision.camera.views.parameters import FreeParameters

VALUES = np.array([900.0, 1.0, 650.0, 470.0, 640.0, 480.0, -0.2, 0.08, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0])


def task(views: int = 6, coordinates: int = 200, focal_length: float | None = None) -> Any:
    return SimpleNamespace(
        masks=(None,) * views,
        views=SimpleNamespace(coordinates=coordinates),
        limits=CalibrationLimits(),
        focal_length=focal_length,
        sigma=None,
    )


def candidate(
    model: str, cost: float = 0.0, *, p_value: float = 1.0, focal_length: float | None = None, values: Any = VALUES
) -> Any:
    tilt, coefficients = parse_model(model)
    return SimpleNamespace(
        model=model,
        free_parameters=FreeParameters(coefficients=coefficients, tilt=tilt, focal_length=focal_length),
        state=SimpleNamespace(values=values, cost=cost),
        loss=None,
        correlated=SimpleNamespace(is_correlated=lambda significance: p_value < significance),
    )


@pytest.mark.parametrize(("model", "tilt", "coefficients"), [
    ("none", False, ()),
    ("tilt", True, ("k1", "k2")),
    ("tilt,k1", True, ("k1",)),
    ("k3, k1,p1", False, ("k1", "p1", "k3")),
])  # fmt: skip
def test_terms_of_a_model(model: str, tilt: bool, coefficients: tuple[str, ...]) -> None:
    assert parse_model(model) == (tilt, coefficients)
    for term in ("p1", "p2"):
        with pytest.raises(ValueError, match="cannot be separated"):
            parse_model(f"tilt,{term}")


@pytest.mark.parametrize(("small", "large", "more"), [("k1", "k1,k2,p1", 2), ("none", "k1", 1), ("k1,k2", "tilt", 2)])
def test_independent_errors_are_compared_by_the_f_test(
    small: str, large: str, more: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The variance of a residual is that of the larger model; 6 parameters for each view."""
    monkeypatch.setattr(calibration_candidates, "residual_variance_factor", lambda *_: 1.3)
    larger = candidate(large)
    free = 200 - larger.free_parameters.count - 36
    for rise in (0.0, 4.0, 25.0):
        found = p_value_against(task(), candidate(small, 50.0 + rise), candidate(large, 50.0))
        assert found == pytest.approx(scipy.stats.f.sf(rise / more / 1.3, more, free), rel=1e-9)
    assert p_value_against(task(), candidate(small, 49.0), candidate(large, 50.0)) == 1.0
    assert p_value_against(task(), larger, larger) == 1.0
    enough = larger.free_parameters.count + 36
    for coordinates, is_known in ((enough + 1, True), (enough, False), (enough - 1, False)):
        found = p_value_against(task(coordinates=coordinates), candidate(small, 1e3), candidate(large, 50.0))
        assert (found < 1.0) == is_known
    # Residuals at rounding level, 1e-6 px, are equal.
    monkeypatch.setattr(calibration_candidates, "residual_variance_factor", lambda *_: 1e-20)
    found = p_value_against(task(), candidate(small, 4e-12), candidate(large, 0.0))
    assert found == pytest.approx(scipy.stats.f.sf(4.0 / more, more, free), rel=1e-9)


def mixed(count: int) -> np.ndarray:
    """Return a covariance of correlated parameters."""
    root = np.eye(count) + 0.3 * np.sin(1.0 + np.arange(count * count)).reshape(count, count)
    return np.asarray(root @ root.T)


@pytest.mark.parametrize("views", [5, 9])
def test_correlated_errors_are_compared_by_walds_test(views: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The further coefficients with their covariance; F distribution with the number of views less 1."""
    covariance = mixed(6) * 1e-6
    monkeypatch.setattr(calibration_candidates, "free_covariance", lambda *_: covariance)
    monkeypatch.setattr(calibration_candidates, "residual_variance_factor", lambda *_: 1.3)
    # f, c_column, c_row, k1, k2, p1
    further = np.array([0.08, 1e-3])
    statistic = further @ np.linalg.solve(covariance[4:, 4:], further) / 2.0
    large = candidate("k1,k2,p1", 50.0, p_value=9e-4)
    found = p_value_against(task(views), candidate("k1", 60.0), large)
    assert found == pytest.approx(scipy.stats.f.sf(statistic, 2, views - 1), rel=1e-9)
    # Without correlation, against a model without a lens, and with too few views: the F test.
    f_test = scipy.stats.f.sf(10.0 / 2 / 1.3, 2, 200 - 6 - 6 * views)
    assert p_value_against(task(views), candidate("k1", 60.0), candidate("k1,k2,p1", 50.0, p_value=1e-3)) == (
        pytest.approx(f_test, rel=1e-9)
    )
    f_test = scipy.stats.f.sf(10.0 / 3 / 1.3, 3, 200 - 6 - 6 * views)
    assert p_value_against(task(views), candidate("none", 60.0), large) == pytest.approx(f_test, rel=1e-9)
    f_test = scipy.stats.f.sf(10.0 / 2 / 1.3, 2, 200 - 6 - 24)
    assert p_value_against(task(4), candidate("k1", 60.0), large) == pytest.approx(f_test, rel=1e-9)


@pytest.mark.parametrize("focal_length", [None, 910.0])
def test_walds_test_of_a_tilt(focal_length: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tilt moves v away from the centre c: the difference with its covariance, whether f' is known or not."""
    count = 6 if focal_length else 7  # v_column, v_row, c_column, c_row, k1, k2, after f
    covariance = mixed(count)
    monkeypatch.setattr(calibration_candidates, "free_covariance", lambda *_: covariance)
    large = candidate("tilt", p_value=0.0, focal_length=focal_length)
    found = p_value_against(task(8, focal_length=focal_length), candidate("k1,k2", focal_length=focal_length), large)
    away = np.zeros((2, count))
    first = count - 6
    for axis in (0, 1):
        away[axis, [first + axis, first + 2 + axis]] = 1.0, -1.0
    difference = np.array([650.0 - 640.0, 470.0 - 480.0])
    statistic = difference @ np.linalg.solve(away @ covariance @ away.T, difference) / 2.0
    assert found == pytest.approx(scipy.stats.f.sf(statistic, 2, 7), rel=1e-6)


def test_summary_of_an_alternative(monkeypatch: pytest.MonkeyPatch) -> None:
    """Residuals of 3 and 4 px in 100 points; parameters are those of the camera and 6 for each view."""
    errors = np.array([[[3.0] * 50, [4.0] * 50]] * 2)
    monkeypatch.setattr(calibration_candidates, "residuals", lambda *_: errors)
    chosen = SimpleNamespace(values=VALUES + np.array([0, 0, 0, 0, 30.0, -40.0, *[0.0] * 8]))
    found = alternative_of(task(), candidate("k1,k2", 80.0), 0.25, chosen)
    assert (found.model, found.parameters, found.p_value) == ("k1,k2", 5, 0.25)
    assert (found.centre, found.centre_distance_px) == ((640.0, 480.0), pytest.approx(50.0))
    assert found.rms_px == pytest.approx(5.0)
    assert found.aic == pytest.approx(200.0 * math.log(80.0 / 200.0) + 2.0 * (5 + 36))
    exact = alternative_of(task(), candidate("k1,k2", 0.0), 0.25, chosen)
    assert exact.aic == pytest.approx(200.0 * math.log(1e-12) + 82.0)
