"""Focal length, aspect and principal point from homographies, against a pinhole camera."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from scipy.spatial.transform import Rotation

from gpuvision.camera.views.initialization import fit_homographies, tilt_closed_form, zhang_closed_form
from gpuvision.camera.views.target_views import pack


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


CENTRE, RADIUS = np.array([300.0, 220.0]), 400.0
RADIAL = (-0.15, 0.07)
PLANES = np.array(
    [
        [[0.9, 0.05, -0.2], [-0.1, 0.8, 0.15], [0.2, -0.1, 1.0]],
        [[0.7, -0.2, 0.1], [0.25, 0.75, -0.1], [-0.15, 0.2, 1.0]],
        [[0.8, 0.1, 0.05], [0.0, 0.95, -0.05], [0.1, 0.25, 1.0]],
    ]
)


def distorted(homography: np.ndarray, radial: tuple[float, float], target: np.ndarray) -> np.ndarray:
    """Return the pixels (n, 2) of target points: x (1 + a r^2 + b r^4), in units of RADIUS about CENTRE."""
    mapped = np.column_stack([target, np.ones(len(target))]) @ homography.T
    x = mapped[:, :2] / mapped[:, 2:]
    r2 = np.sum(x**2, axis=1, keepdims=True)
    return CENTRE + RADIUS * x * (1.0 + radial[0] * r2 + radial[1] * r2**2)


def views_of(
    rng: np.random.Generator, radial: tuple[float, float], noise: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return views of 30, 24 and 20 points of a grid, with normal noise [px]."""
    rows, columns = np.indices((5, 6)).reshape(2, -1)
    grid = np.stack([0.25 * columns - 0.5, 0.22 * rows - 0.4], axis=1)
    views = [(grid[:n], distorted(plane, radial, grid[:n])) for plane, n in zip(PLANES, (30, 24, 20), strict=True)]
    return [(target, image + rng.normal(0.0, noise, image.shape)) for target, image in views]


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("undistorted", [False, True])
def test_exact_points_give_homographies_and_radial_terms(
    robust: bool, undistorted: bool, rng: np.random.Generator
) -> None:
    radial = (0.0, 0.0) if undistorted else RADIAL
    packed, _ = pack(views_of(rng, radial, 0.0))
    found = fit_homographies(packed, CENTRE, RADIUS, robust=robust, undistorted=undistorted)
    np.testing.assert_allclose(found.radial, radial, atol=1e-7)
    scaled = found.homographies / found.homographies[:, 2:, 2:]
    np.testing.assert_allclose(scaled, PLANES, atol=1e-7)
    assert found.noise < 1e-4


@pytest.mark.parametrize("counts", [(30, 24, 20), (6, 7)])
def test_the_noise_counts_the_spare_coordinates(counts: tuple[int, ...], rng: np.random.Generator) -> None:
    """Of 2 n coordinates a homography fixes 8, the radial terms fix 2; the sum of squares is SciPy's."""
    grid = views_of(rng, RADIAL, 0.0)[0][0]
    targets = [grid[rng.permutation(30)[:count]] for count in counts]
    pairs = [
        (target, distorted(plane, RADIAL, target) + rng.normal(0.0, 0.3, target.shape))
        for target, plane in zip(targets, PLANES, strict=False)
    ]
    found = fit_homographies(pack(pairs)[0], CENTRE, RADIUS)

    def residuals(values: np.ndarray) -> np.ndarray:
        planes = np.column_stack([values[2:].reshape(-1, 8), np.ones(len(pairs))]).reshape(-1, 3, 3)
        model = [
            distorted(plane, (values[0], values[1]), target) for (target, _), plane in zip(pairs, planes, strict=True)
        ]
        return np.concatenate([image - each for (_, image), each in zip(pairs, model, strict=True)]).ravel()

    start = np.concatenate([RADIAL, *(plane.ravel()[:8] for plane in PLANES[: len(pairs)])])
    best = scipy.optimize.least_squares(residuals, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    spare = 2 * sum(counts) - 8 * len(counts) - 2
    assert found.noise == pytest.approx(math.sqrt(2.0 * best.cost / spare), rel=1e-3)
    np.testing.assert_allclose(found.radial, best.x[:2], atol=1e-3)


def test_reweighting_rejects_outliers(rng: np.random.Generator) -> None:
    """A tenth of the points lies far away; the noise is that of the others, from the median of the lengths."""
    views = views_of(rng, RADIAL, 0.2)
    for _, image in views:
        image[::10] += (40.0, -25.0)
    found = fit_homographies(pack(views)[0], CENTRE, RADIUS, robust=True)
    lengths = []
    for (target, image), plane in zip(views, found.homographies, strict=True):
        lengths.append(np.linalg.norm(image - distorted(plane, tuple(found.radial), target), axis=1))
    assert found.noise == pytest.approx(np.median(np.concatenate(lengths)) / math.sqrt(2.0 * math.log(2.0)), rel=1e-4)
    assert 0.1 < found.noise < 0.3
    np.testing.assert_allclose(found.radial, RADIAL, atol=0.01)
    assert all(np.all(each[::10] > 40.0) for each in lengths)
