"""Estimation of alpha and f' for a known lens."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.views import known_lens
from gpuvision.camera.views.bundle_adjustment import FitState
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


@pytest.mark.parametrize(
    ("focus", "noise", "is_known"),
    [
        (0.299, 0.01, True),
        (0.301, 0.01, False),
        (0.149, 0.005, True),
        (0.151, 0.005, False),
        (0.299, 5.0, True),
        (math.nan, 1.0, False),
    ],
)
def test_a_focal_length_that_the_views_do_not_determine(focus, noise, is_known, monkeypatch):
    """The relative error is at most 0.3 for noise of 0.01 px or more; less noise counts as 0.01 px."""
    monkeypatch.setattr(known_lens, "covariances", lambda *_: (np.diag([4.0, 9e-6, 1e-6]), None, focus))
    monkeypatch.setattr(known_lens, "residual_sigma", lambda *_: noise)
    values = np.zeros(14)
    values[:6] = 900.0, 1.0, 640.0, 480.0, 640.0, 480.0
    state = FitState(values, np.eye(3)[None], np.array([[0.0, 0.0, 0.5]]), cost=72.0)
    free = SimpleNamespace(names=("f", "tauX", "tauY"))
    views = SimpleNamespace(coordinates=16)
    if not is_known:
        with pytest.raises(ValueError, match="the views do not determine f'"):
            known_lens._result(views, free, state, Lens(k1=1e-8))
        return
    fit = known_lens._result(views, free, state, Lens(k1=1e-8))
    assert (fit.sensor.focal_length, fit.sensor.alpha, fit.names) == (900.0, 0.0, ("f", "tauX", "tauY"))
    assert fit.rms_px == pytest.approx(3.0)
    assert fit.alpha_sigma == pytest.approx(3e-3)  # of the less certain angle, where alpha is 0
    np.testing.assert_array_equal(fit.covariance, np.diag([4.0, 9e-6, 1e-6]))


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
