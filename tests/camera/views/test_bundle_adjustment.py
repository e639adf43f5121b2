"""Robust losses of the bundle adjustment: weight and curvature are derivatives of the loss."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.views import camera_fit
from gpuvision.camera.views.bundle_adjustment import PackedViews, RobustLoss
from gpuvision.camera.views.camera_fit import residual_sigma, residual_variance_factor


@pytest.mark.parametrize("kind", ["squared", "huber", "tukey"])
@pytest.mark.parametrize("scale", [0.3, 2.0])
def test_weights_and_slopes_are_derivatives_of_the_loss(kind: str, scale: float) -> None:
    """For the loss L / 2 of a residual r in a plane: w r = L' / 2, and the mean curvature (L'' + L' / r) / 4."""
    loss, step = RobustLoss(kind, scale), 1e-4 * scale
    length = scale * np.linspace(0.06, 7.06, 141)  # no sample within a step of the ends of the losses
    below, here, above = (loss.cost(length + sign * step) for sign in (-1.0, 0.0, 1.0))
    first, second = (above - below) / (2.0 * step), (above - 2.0 * here + below) / step**2
    np.testing.assert_allclose(loss.weight(length) * length, 0.5 * first, atol=1e-6 * scale)
    np.testing.assert_allclose(loss.slope(length), 0.25 * (second + first / length), atol=1e-5)
    assert loss.weight(np.array([1e-9 * scale])) == pytest.approx(1.0)
    assert loss.cost(np.array([1e-3 * scale])) == pytest.approx(1e-6 * scale**2, rel=1e-4)


def test_variance_of_residuals(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """Of 3 views with 12, 10 and 7 points a camera takes 5 parameters and each pose 6; padding does not count."""
    weight = np.arange(12) < np.array([12, 10, 7])[:, None]
    errors = rng.normal(0.0, 0.3, (3, 2, 12))
    views = PackedViews(np.zeros((3, 3, 12)), np.zeros((3, 2, 12)), weight.astype(float))
    known = np.sum(errors**2, axis=1)[weight]
    state: Any = SimpleNamespace(cost=float(np.sum(known)))
    free: Any = SimpleNamespace(count=5)
    monkeypatch.setattr(camera_fit, "residuals", lambda *_: errors)
    squared = RobustLoss("squared", 1.0)
    expected = np.sum(known) / (58 - 5 - 18)
    assert residual_sigma(views, free, state, squared) == pytest.approx(math.sqrt(expected))
    assert residual_variance_factor(views, free, state, squared) == pytest.approx(expected)
    assert residual_variance_factor(views, free, state, squared, 0.7) == pytest.approx(0.49)
    # Losses whose edge lies far beyond all residuals are the squared loss.
    for kind in ("huber", "tukey"):
        assert residual_variance_factor(views, free, state, RobustLoss(kind, 1e6)) == pytest.approx(expected)
    # Huber's sandwich: the influences are clipped at 1.5 scales, the curvature is 1 within and half of it along a
    # clipped residual.
    length, edge = np.sqrt(known), 1.5 * 0.2
    inside = length < edge
    assert 5 < np.count_nonzero(inside) < 25
    influence = np.where(inside, length, edge)
    curvature = np.mean(np.where(inside, 1.0, 0.5 * edge / length))
    found = residual_variance_factor(views, free, state, RobustLoss("huber", 0.2))
    assert found == pytest.approx(np.sum(influence**2) / (58 - 5 - 18) / curvature)
    free.count = 58 - 18
    assert math.isnan(residual_sigma(views, free, state, squared))
