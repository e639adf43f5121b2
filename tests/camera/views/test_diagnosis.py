"""Warnings of a camera calibration: each condition on both sides of its limit, and the numbers of its message."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.camera import Camera
from gpuvision.camera.views.correlated_errors import MIN_VIEWS
from gpuvision.camera.views.diagnosis import CalibrationLimits, determines_focal_length, diagnose

SIZE = (641, 481)
CAMERA = Camera(matrix=((800.0, 0.0, 320.0), (0.0, 800.0, 240.0), (0.0, 0.0, 1.0)), distortion=(-0.1, *(0.0,) * 13))
LACK = SimpleNamespace(p_value=0.5, rms_px=0.0, noise_px=0.1)
FIT = SimpleNamespace(
    camera=CAMERA,
    names=("f", "cx", "cy", "k1"),
    covariance=np.diag([1.0, 0.04, 0.01, 1e-6]),
    sigma_px=0.1,
    alternatives=(),
    lack_of_fit=LACK,
    view_p_value=0.5,
    poses=(None,) * 4,
    model="k1",
    alpha_sigma=0.01,
)
GOOD: dict[str, Any] = {"focus": 1e-3, "converged": True, "noise": 0.1, "outliers": 0, "mirrored": False}


def _fit(**changes: Any) -> Any:
    return SimpleNamespace(**(vars(FIT) | changes))


def _warnings(fit: Any = FIT, **changes: Any) -> tuple[str, ...]:
    return diagnose(fit, SIZE, **(GOOD | changes))


def _only(words: str, fit: Any = FIT, **changes: Any) -> None:
    (warning,) = _warnings(fit, **changes)
    assert words in warning


def test_nothing_to_warn_of() -> None:
    assert _warnings() == ()
    assert _warnings(_fit(names=("f", "k1"), covariance=np.eye(2))) == ()


def test_focal_length() -> None:
    assert _warnings(focus=0.0199) == ()
    _only("determine the focal length to 2.0 % only", focus=0.02)
    # Residuals of 0.001 px count as 0.01 px.
    _only("to 3.0 % only", _fit(sigma_px=1e-3, covariance=np.zeros((4, 4))), focus=3e-3, noise=1e-3)
    for converged, limit in ((True, 0.3), (False, 0.02)):
        assert determines_focal_length(FIT, 0.999 * limit, converged=converged)
        assert not determines_focal_length(FIT, limit, converged=converged)


def test_centre() -> None:
    """The least determined direction is diagonal: 2 px^2 each and a correlation of 1 make 2 px."""
    covariance = np.zeros((4, 4))
    for variance, words in ((4.4, ""), (4.6, "the centre is known to 3 px only"), (4e6, "to no pixel only")):
        covariance[1:3, 1:3] = variance
        fit = _fit(covariance=covariance)
        if words:
            _only(words, fit)
        else:
            assert _warnings(fit) == ()
    names = ("f", "cx", "cy", "k1", "tauX", "tauY")
    covariance = np.diag([1.0, 16.0, 9.0, 1e-6, 1e-8, 1e-8])
    tilted = replace(CAMERA, distortion=(-0.1, *(0.0,) * 11, 0.03, 0.04))
    _only(
        "the centre is known to 4 px, the tilt to 0.57 degrees", _fit(names=names, covariance=covariance, camera=tilted)
    )


def test_a_centre_far_from_the_middle() -> None:
    """The limit is a tenth of the diagonal, 80.1 px, and three standard deviations of 0.2 px."""
    for shift, words in ((80.0, ""), (81.0, "lies 81 px from the image's middle: a sensor tilted by 5.8 degrees")):
        matrix = ((800.0, 0.0, 320.0 - shift), (0.0, 800.0, 240.0), (0.0, 0.0, 1.0))
        fit = _fit(camera=replace(CAMERA, matrix=matrix))
        assert [words in each for each in _warnings(fit)] == ([True] if words else [])
        matrix = ((800.0, 0.0, 320.0), (0.0, 800.0, 240.0 + shift), (0.0, 0.0, 1.0))
        fit = _fit(camera=replace(CAMERA, matrix=matrix))
        assert [words in each for each in _warnings(fit)] == ([True] if words else [])


def test_alternatives() -> None:
    other = SimpleNamespace(model="k1 k2", p_value=0.001, centre_distance_px=3.0, rms_px=0.12)
    _only(
        "model 'k1 k2' fits as well (rms 0.1200 px, p = 0.001) with its centre 3.0 px away", _fit(alternatives=(other,))
    )
    for change in ({"p_value": 0.00099}, {"centre_distance_px": 2.99}):
        assert _warnings(_fit(alternatives=(SimpleNamespace(**(vars(other) | change)),))) == ()


@pytest.mark.parametrize(
    ("tau", "words"),
    [
        ((0.012, 0.016), None),  # 1.15 degrees, 10 standard deviations
        ((0.009, 0.012), "a tilt of 0.86 degrees is no proof"),
        ((0.0035, 0.0049), "a tilt of 0.35 degrees is no proof"),  # 3.01 standard deviations
        ((0.0035, 0.0048), "the tilt found, 0.34 degrees, is within its own uncertainty"),  # 2.97
    ],
)
def test_small_tilts(tau: tuple[float, float], words: str | None) -> None:
    camera = replace(CAMERA, distortion=(-0.1, *(0.0,) * 11, *tau))
    covariance = np.diag([1.0, 0.04, 0.01, 1e-6, 4e-6, 4e-6])
    fit = _fit(camera=camera, names=(*FIT.names, "tauX", "tauY"), covariance=covariance)
    assert len(_warnings(fit)) == (words is not None)
    assert words is None or words in _warnings(fit)[0]


def test_smooth_residuals() -> None:
    """Reported for p < 0.001 and more than half the noise."""
    for p_value, rms, is_reported in ((9e-4, 0.06, True), (0.001, 0.06, False), (9e-4, 0.05, False)):
        lack = SimpleNamespace(p_value=p_value, rms_px=rms, noise_px=0.1)
        found = _warnings(_fit(lack_of_fit=lack))
        assert len(found) == is_reported
        assert not found or "a smooth pattern of 0.06 pixels rms over the image, beside 0.1 pixels of noise" in found[0]


def test_views_that_differ() -> None:
    for p_value, views, is_reported in (
        (9e-4, MIN_VIEWS - 1, True),
        (0.001, MIN_VIEWS - 1, False),
        (9e-4, MIN_VIEWS, False),
    ):
        found = _warnings(_fit(view_p_value=p_value, poses=(None,) * views))
        assert len(found) == is_reported
        assert not found or f"(p = 0.0009), and {views} views are too few" in found[0]


def test_other_warnings() -> None:
    _only("the fit stopped before it converged", converged=False)
    assert _warnings(noise=0.12) == ()
    _only("the residual is 1.3 times the given noise", noise=0.13)
    _only("1 points are outliers", outliers=1)
    _only("from behind", mirrored=True)
    # r (1 - 0.6 r^2) grows up to r = 0.745; the corner of the image lies at 0.5.
    for k1, is_folded in ((-0.6, True), (-0.3, False)):
        camera = replace(CAMERA, distortion=(k1, *(0.0,) * 13))
        folds = [each for each in _warnings(_fit(camera=camera)) if "folds within the image" in each]
        fold = math.sqrt(-1.0 / (3.0 * k1))
        assert (fold * (1.0 + k1 * fold**2) < math.hypot(320.0, 240.0) / 800.0) == is_folded
        assert len(folds) == is_folded


def test_folds_are_sought_along_the_border() -> None:
    """At points of all four sides, a distance of 1/16 of the side apart, from corner to corner."""
    asked: list[tuple[float, float]] = []

    def undistort(points: np.ndarray) -> np.ndarray:
        asked.extend((x, y) for x, y in points.tolist())
        return points

    fit = _fit(camera=SimpleNamespace(matrix=CAMERA.matrix, undistort=undistort))
    assert not [each for each in _warnings(fit) if "folds" in each]
    across, down = ([last * k / 16 for k in range(17)] for last in (640.0, 480.0))
    assert set(asked) == {(x, y) for x in across for y in down if x in (0.0, 640.0) or y in (0.0, 480.0)}


def test_every_warning_in_its_order() -> None:
    found = _warnings(converged=False, focus=1.0, noise=1.0, outliers=3, mirrored=True)
    words = ("focal length", "converged", "times the given noise", "outliers", "from behind")
    assert [word in each for word, each in zip(words, found, strict=True)] == [True] * 5
    assert _warnings(noise=1.0, limits=CalibrationLimits(max_noise_ratio=11.0)) == ()
