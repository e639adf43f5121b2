"""Robust losses of the bundle adjustment: weight and curvature are derivatives of the loss."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.camera.views.bundle_adjustment import RobustLoss


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
