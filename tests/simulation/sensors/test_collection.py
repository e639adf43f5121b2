"""Collection of light by a sensor: known values and limits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.simulation.sensors.collection import cos4, image_irradiance, lens_solid_angle, responsivity


def test_solid_angle() -> None:
    """A hemisphere at distance 0, area over squared distance far away, and no cancellation in between."""
    assert lens_solid_angle(1.0, 0.0) == pytest.approx(math.tau, rel=1e-15)
    assert lens_solid_angle(1.0, 1.0) == pytest.approx(math.tau * (1.0 - math.sqrt(0.5)), rel=1e-14)
    assert lens_solid_angle(1e-9, 1.0) == pytest.approx(math.pi * 1e-18, rel=1e-14)


def test_image_irradiance() -> None:
    assert image_irradiance(1.0, 1.0) == pytest.approx(math.pi / 4.0, rel=1e-15)
    assert image_irradiance(3.0, 2.0, 1.0) == pytest.approx(3.0 * math.pi / 64.0, rel=1e-15)
    # Radiance times pi / 4 and cos^4 over the square of N (1 + m), of different numbers.
    expected = 2.0 * math.pi / 4.0 * math.cos(0.6) ** 4 / (5.0 * 1.25) ** 2
    assert image_irradiance(2.0, 5.0, 0.25, 0.6) == pytest.approx(expected, rel=1e-14)
    with pytest.raises(ValueError, match="f_number > 0"):
        image_irradiance(1.0, 0.0)


def test_fall_towards_the_edge() -> None:
    np.testing.assert_allclose(cos4([0.0, math.pi / 4.0, math.pi / 2.0, 2.0]), [1.0, 0.25, 0.0, 0.0], atol=1e-60)


def test_responsivity() -> None:
    """One electron per photon at 1239.84198 nm is an ampere per watt."""
    assert responsivity(1.239841984e-6, 1.0) == pytest.approx(1.0, rel=1e-9)
    assert responsivity(1.239841984e-6 / 4.0, 0.5) == pytest.approx(0.125, rel=1e-9)
    assert responsivity(1.239841984e-6 / 2.0, 0.5) == pytest.approx(0.25, rel=1e-9)
