"""Focal length, aspect and principal point from homographies, against a pinhole camera."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation

from gpuvision.camera.views.initialization import tilt_closed_form, zhang_closed_form


def homographies_of(f: float, v: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Return the homographies of three tilted planes, each of arbitrary scale: K (r1, r2, t)."""
    camera = np.array([[f, 0.0, v[0]], [0.0, f, v[1]], [0.0, 0.0, 1.0]])
    turns = Rotation.from_euler("xyz", [[0.4, -0.3, 0.2], [-0.5, 0.2, 1.0], [0.3, 0.5, -0.7]]).as_matrix()
    shifts = np.array([0.0, 0.0, 1.0]) + rng.uniform(-0.1, 0.1, (3, 3))
    planes = np.concatenate([turns[:, :, :2], shifts[:, :, None]], axis=2)
    return camera @ planes * rng.uniform(0.5, 2.0, (3, 1, 1))


@pytest.mark.parametrize("unit", [1e-3, 0.5, 1.0, 800.0])
@pytest.mark.parametrize("known", ["nothing", "direction", "focal length", "both"])
def test_exact_homographies_give_the_camera(unit: float, known: str, rng: np.random.Generator) -> None:
    """In any unit of length; with v = 0.2 f."""
    v = (0.16 * unit, -0.12 * unit)
    direction = math.atan2(v[1], v[0]) if known in ("direction", "both") else None
    focal = math.hypot(unit, *v) if known in ("focal length", "both") else None
    found = tilt_closed_form(homographies_of(unit, v, rng), direction, focal)
    assert found is not None
    assert found[0] == pytest.approx(unit, rel=1e-9)
    np.testing.assert_allclose(found[1], v, rtol=1e-8)


def test_a_direction_may_be_opposite(rng: np.random.Generator) -> None:
    views = homographies_of(0.9, (-0.2, 0.1), rng)
    found = tilt_closed_form(views, math.atan2(-0.1, 0.2), None)
    assert found is not None
    np.testing.assert_allclose(found[1], (-0.2, 0.1), rtol=1e-8)


def test_a_focal_length_shorter_than_the_tilt_has_no_solution(rng: np.random.Generator) -> None:
    assert tilt_closed_form(homographies_of(1.0, (0.9, 0.0), rng), None, 0.1) is None


@pytest.mark.parametrize("aspect", [1.0, 1.25])
def test_zhang_closed_form_gives_the_camera(aspect: float, rng: np.random.Generator) -> None:
    """The factor fy / fx scales the rows of homographies with the aspect 1."""
    views = np.diag([1.0, aspect, 1.0]) @ homographies_of(0.9, (-0.2, 0.1), rng)
    found = zhang_closed_form(views, aspect=True)
    assert found is not None
    assert found[:2] == pytest.approx((0.9, aspect), rel=1e-9)
    np.testing.assert_allclose(found[2], (-0.2, 0.1 * aspect), rtol=1e-8)
    if aspect == 1.0:
        without = zhang_closed_form(views, aspect=False)
        assert without is not None
        assert without[:2] == (pytest.approx(0.9, rel=1e-9), 1.0)
        np.testing.assert_allclose(without[2], (-0.2, 0.1), rtol=1e-8)


@pytest.mark.parametrize("signs", [(1.0, -1.0, 1.0), (1.0, 1.0, -1.0)])
def test_an_indefinite_conic_is_no_camera(signs: tuple[float, float, float], rng: np.random.Generator) -> None:
    """The columns of H are orthogonal and equally long in the metric diag(signs): fy^2 or f^2 would be negative."""
    omega = np.diag(signs)
    minus = signs.index(-1.0)
    views = []
    for _ in range(4):
        # exp(omega A) with A skew-symmetric keeps the metric.
        skew = rng.uniform(-0.5, 0.5, (3, 3))
        turn = scipy.linalg.expm(omega @ (skew - skew.T))
        views.append(np.delete(turn, minus, axis=1) @ np.array([[1.0, 0.0, 0.2], [0.0, 1.0, 0.3]]))
        views[-1][:, 2] += turn[:, minus]
        assert views[-1][:, 0] @ omega @ views[-1][:, 1] == pytest.approx(0.0, abs=1e-12)
    assert zhang_closed_form(np.array(views), aspect=True) is None
