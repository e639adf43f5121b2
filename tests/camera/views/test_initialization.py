"""Focal length and principal point from homographies, against a pinhole camera."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gpuvision.camera.views.initialization import tilt_closed_form


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
