"""Estimation of alpha and f' for a known lens."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.views.known_lens import fit_tilt
from tilted_camera import scene


def _views(rng, tilt, direction, count, sigma=0.0, kappa=0.0):
    """Views through a tilted sensor, distorted in the sensor plane as in the model of the thesis."""
    made = scene(rng, "grid", tilt, corner_px=0.0, views=count, weakest=10.0, direction=direction)
    lens = Lens(k1=kappa, centre=(float(made.matrix[0, 2]), float(made.matrix[1, 2])))
    return made, lens, [(target, lens.distort(image)) for target, image in made.views(rng, sigma)]


@pytest.mark.parametrize("kappa", [0.0, 2e-8])
@pytest.mark.parametrize("tilt", [0.0, 5.0, 20.0, 45.0])
@pytest.mark.parametrize(
    ("count", "known"),
    [(1, {"direction": 0.7}), (1, {"focal_length": 1700.0}), (3, {}), (2, {"direction": 0.7 + math.pi})],
)
def test_exact_points_give_the_exact_sensor(rng, tilt, count, known, kappa):
    made, lens, views = _views(rng, tilt, 0.7, count, kappa=kappa)
    fit = fit_tilt(views, lens, **known)
    assert fit.sensor.focal_length == pytest.approx(1700.0, rel=1e-6)
    np.testing.assert_allclose(fit.sensor.axis, _axis(math.radians(tilt), 0.7), atol=1e-6)
    for pose, rotation, translation in zip(fit.poses, made.rotations, made.translations, strict=True):
        np.testing.assert_allclose(pose.rotation, rotation, atol=1e-6)
        np.testing.assert_allclose(pose.translation, translation, atol=1e-6)
    assert fit.rms_px < 1e-5


def _axis(alpha, direction):
    return [math.sin(alpha) * math.cos(direction), math.sin(alpha) * math.sin(direction), math.cos(alpha)]


@pytest.mark.slow
def test_deviations_cover_the_truth(rng):
    """60 draws: the mean squared normalised error is 1 within 4 of its standard deviations."""
    errors = []
    for _ in range(60):
        _, lens, views = _views(rng, 20.0, 0.7, 1, sigma=0.1)
        fit = fit_tilt(views, lens, direction=0.7)
        off = (fit.sensor.focal_length - 1700.0) / math.sqrt(fit.covariance[0, 0])
        errors.append([(fit.sensor.alpha - math.radians(20.0)) / fit.alpha_sigma, off])
    mean = np.mean(np.square(errors), axis=0)
    np.testing.assert_allclose(mean, 1.0, atol=4.0 * math.sqrt(2.0 / 60.0))


def test_what_the_views_lack(rng):
    _, lens, views = _views(rng, 20.0, 0.7, 1)
    with pytest.raises(ValueError, match="one view"):
        fit_tilt(views, lens)
    # A target perpendicular to the axis of an untilted sensor does not determine f'.
    row, column = np.indices((9, 12)).reshape(2, -1)
    with pytest.raises(ValueError, match="oblique"):
        fit_tilt([(np.stack([column, row], 1) * 0.01, np.stack([column, row], 1) * 50.0 + 300.0)], lens, direction=0.7)
