"""Uncertainty of the correction, against derivatives by complex steps and against Monte Carlo."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from gpuvision.camera.camera import COEFFICIENT_NAMES, Camera
from gpuvision.camera.correction_uncertainty import (
    correction_covariance,
    correction_map,
    correction_sigma,
    largest_sigma,
)
from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.lens_fit import LensFit
from gpuvision.camera.lines.line_families import grid_lines
from gpuvision.camera.lines.vanishing_points import fit_lens
from gpuvision.camera.views.planar_calibration import fit_camera
from straight_lines import plane_grid, radial_lens
from view_scenes import RADIAL, SIZE, bent, camera, exact_views

LENS = radial_lens(10.0)
FOCAL, CENTRE = (900.0, 950.0), (650.0, 470.0)
# No thin prism, which `fit_camera` does not fit.
RATIONAL = {"k1": -0.2, "k2": 0.08, "k3": 0.01, "k4": 0.02, "k5": -0.01, "k6": 0.005, "tauX": 0.1, "tauY": -0.05}
DECENTRED = {"k1": -0.2, "p1": 1e-3, "p2": -2e-3}


def correction_errors(found: Any, true: Any, points: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the difference of two corrections at points after the homography that fits the measured points best."""
    homography, _ = cv2.findHomography(found.undistort(measured), true.undistort(measured))
    moved = cv2.perspectiveTransform(found.undistort(points)[:, None], homography)[:, 0]
    return np.asarray(moved - true.undistort(points))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lines", "views"])
def test_it_is_the_scatter_of_corrections(rng: np.random.Generator, kind: str) -> None:
    """The errors of the fits have the predicted covariance, inside and outside the measured points."""
    squares = []
    for _ in range(16):
        if kind == "lines":
            ideal = LENS.distort(plane_grid(rng, 20.0))
            fit: Any = fit_lens(
                grid_lines(ideal + rng.normal(0.0, 0.05, ideal.shape)), model="k1,k2", lines="free", sigma=0.05
            )
            model, true, measured = fit.lens, LENS, ideal.reshape(-1, 2)
        else:
            views = exact_views(rng, camera(*RADIAL), views=5)
            fit = fit_camera(bent(rng, views, 0.0, 0.05), SIZE, model="k1,k2", sigma=0.05)
            model, true, measured = fit.camera, camera(*RADIAL), np.concatenate([image for _, image in views])
        low, high = measured.min(axis=0), measured.max(axis=0)
        points = np.array([(a, b) for a in (0.0, 0.3, 1.05) for b in (0.5, 1.05)]) * (high - low) + low
        covariance = correction_covariance(fit, points, measured)
        error = correction_errors(model, true, points, measured)
        squares.append(np.einsum("ni,nij,nj->n", error, np.linalg.pinv(covariance, hermitian=True), error))
    # Chi-squared of 2 degrees of freedom: the mean of 16 independent draws is 2 +- 0.5; points of one fit correlate.
    assert np.mean(squares) == pytest.approx(2.0, abs=1.2)
    assert np.mean(np.array(squares) < 9.0) >= 0.95


def distorted(x: Any, y: Any, c: dict[str, Any]) -> tuple[Any, Any]:
    """Return OpenCV's distorted coordinates; complex numbers give derivatives by complex steps."""
    r = x * x + y * y
    radial = (1.0 + c["k1"] * r + c["k2"] * r**2 + c["k3"] * r**3) / (
        1.0 + c["k4"] * r + c["k5"] * r**2 + c["k6"] * r**3
    )
    u = x * radial + 2.0 * c["p1"] * x * y + c["p2"] * (r + 2.0 * x * x)
    v = y * radial + c["p1"] * (r + 2.0 * y * y) + 2.0 * c["p2"] * x * y
    (cos_x, sin_x), (cos_y, sin_y) = ((np.cos(c[name]), np.sin(c[name])) for name in ("tauX", "tauY"))
    # Rotated point (a, b, w), projected along the optical axis: OpenCV's matTilt, with the rotation's last column.
    a = cos_y * u + sin_y * (sin_x * v - cos_x)
    b, w = cos_x * v + sin_x, sin_y * u + cos_y * (cos_x - sin_x * v)
    axis_x, axis_y, axis_w = -sin_y * cos_x, sin_x, cos_y * cos_x
    return (axis_w * a - axis_x * w) / w, (axis_w * b - axis_y * w) / w


def camera_derivatives(seen: Camera, names: tuple[str, ...], points: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, 2, m) of corrected points by the camera's parameters: of the implicit function."""
    (fx, fy), step = FOCAL, 1e-30
    known = dict(zip(COEFFICIENT_NAMES, seen.distortion, strict=True))
    measured = (points - CENTRE) / FOCAL
    x, y = ((seen.undistort(points) - CENTRE) / FOCAL).T
    by_x = np.stack(distorted(x + 1j * step, y, known), -1).imag / step
    by_y = np.stack(distorted(x, y + 1j * step, known), -1).imag / step
    inverse = np.linalg.inv(np.stack([by_x, by_y], -1))
    columns = []
    for name in names:
        if name in known:
            moved = np.stack(distorted(x, y, known | {name: known[name] + 1j * step}), -1).imag / step
            columns.append(-np.einsum("nij,nj->ni", inverse, moved) * FOCAL)
        elif name[0] == "c":
            axis = np.array([name == "cx", name == "cy"], dtype=float)
            columns.append(axis - inverse @ (axis / FOCAL) * FOCAL)
        else:  # with one focal length for both axes, both change in proportion
            rate = {"f": (1.0, fy / fx), "fx": (1.0, 0.0), "fy": (0.0, 1.0)}[name]
            ideal = np.stack([x, y], -1)
            columns.append(rate * ideal - np.einsum("nij,nj->ni", inverse, rate * measured / FOCAL) * FOCAL)
    return np.stack(columns, -1)


def lens_derivatives(lens: Lens, points: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, 2, 6) of corrected points by k1 to k4 and the centre."""
    offset = points - lens.centre
    r = np.sum(offset**2, axis=-1)[:, None]
    factor = 1.0 + lens.k1 * r + lens.k2 * r**2 + lens.k3 * r**3 + lens.k4 * r**4
    slope = 2.0 * (lens.k1 + 2.0 * lens.k2 * r + 3.0 * lens.k3 * r**2 + 4.0 * lens.k4 * r**3)
    jacobian = factor[:, :, None] * np.eye(2) + slope[:, :, None] * offset[:, :, None] * offset[:, None, :]
    return np.concatenate([np.stack([offset * r**order for order in (1, 2, 3, 4)], -1), np.eye(2) - jacobian], -1)


def without_homography(columns: np.ndarray, corrected: np.ndarray, count: int) -> np.ndarray:
    """Return displacements (n, 2, m) minus the displacement of a homography that fits the last points best."""
    places = np.column_stack([(corrected - corrected[-count:].mean(axis=0)) / 500.0, np.ones(len(corrected))])
    moves = []
    for entry in np.ndindex(3, 3):
        if entry != (2, 2):
            matrix = np.eye(3, dtype=complex)
            matrix[entry] += 1e-30j
            moved = places @ matrix.T
            moves.append((moved[:, :2] / moved[:, 2:]).imag * 1e30)
    design = np.stack(moves, -1)
    part = np.linalg.pinv(design[-count:].reshape(2 * count, 8)) @ columns[-count:].reshape(2 * count, -1)
    return np.asarray((columns - design @ part)[:-count])


def covariance_of(sizes: list[float]) -> np.ndarray:
    """Return a covariance of correlated parameters with these standard deviations."""
    count = len(sizes)
    mixed = np.eye(count) + 0.3 * np.sin(1.0 + np.arange(count * count)).reshape(count, count)
    return np.asarray((mixed @ mixed.T) * np.outer(sizes, sizes))


def fit_of(model: Any, names: tuple[str, ...], covariance: np.ndarray) -> Any:
    """Return the parts of a fit that the correction uses."""
    if isinstance(model, Camera):
        return SimpleNamespace(camera=model, names=names, covariance=covariance)
    fit = object.__new__(LensFit)
    for name, value in (("lens", model), ("names", names), ("covariance", covariance)):
        object.__setattr__(fit, name, value)
    return fit


PLACES = np.array([[[30.0, 40.0], [600.0, 500.0], [1250.0, 930.0]], [[640.0, 20.0], [900.0, 333.0], [5.0, 900.0]]])
MEASURED = np.stack(np.meshgrid(np.linspace(100.0, 1200.0, 9), np.linspace(60.0, 900.0, 7)), -1).reshape(-1, 2)


@pytest.mark.parametrize(
    ("names", "coefficients", "scale"),
    [
        (("fx", "fy", "cx", "cy", *RATIONAL), RATIONAL, 1.0),
        (tuple(RATIONAL), RATIONAL, 0.05),
        (("f", "p1", "p2"), DECENTRED, 1.0),
    ],
    ids=["rational", "near the centre", "decentred"],
)
def test_covariance_of_a_correction_by_a_camera(
    names: tuple[str, ...], coefficients: dict[str, float], scale: float
) -> None:
    """Also near the principal point, where a coefficient moves points by little."""
    seen = Camera(
        matrix=((FOCAL[0], 0.0, CENTRE[0]), (0.0, FOCAL[1], CENTRE[1]), (0.0, 0.0, 1.0)),
        distortion=tuple(coefficients.get(name, 0.0) for name in COEFFICIENT_NAMES),
    )
    places, measured = ((each - CENTRE) * scale + CENTRE for each in (PLACES, MEASURED))
    together = np.concatenate([places.reshape(-1, 2), measured])
    derivative = without_homography(camera_derivatives(seen, names, together), seen.undistort(together), len(measured))
    # About the same movement by each parameter; a coefficient multiplies this power of the radius.
    powers = {"k1": 2, "k2": 4, "k3": 6, "k4": 2, "k5": 4, "k6": 6, "p1": 1, "p2": 1}
    sizes = [{"f": 0.5, "c": 0.7}.get(name[0], 1e-3 * scale ** -powers.get(name, 0)) for name in names]
    covariance = covariance_of(sizes)
    expected = derivative @ covariance @ derivative.transpose(0, 2, 1)
    unknown = np.concatenate([measured, [[np.nan, 5.0], [7.0, np.nan]]])
    found = correction_covariance(fit_of(seen, names, covariance), places, unknown)
    assert found.shape == (2, 3, 2, 2)
    np.testing.assert_allclose(found.reshape(-1, 2, 2), expected, rtol=1e-6, atol=1e-6 * expected.max())
    sigma = correction_sigma(fit_of(seen, names, covariance), places, unknown)
    largest = np.sqrt(np.linalg.norm(expected, ord=2, axis=(-2, -1))).reshape(2, 3)
    np.testing.assert_allclose(sigma, largest, rtol=1e-6, atol=1e-6 * largest.max())


def test_covariance_of_a_correction_by_a_lens() -> None:
    lens = Lens(k1=-1e-7, k2=3e-14, k3=-2e-20, k4=1e-26, centre=(650.0, 470.0))
    together = np.concatenate([PLACES.reshape(-1, 2), MEASURED])
    names = ("k1", "k2", "k3", "k4", "C_c", "R_c", "v0_C", "v0_R")
    covariance = covariance_of([1e-8, 1e-14, 1e-20, 1e-26, 3.0, 2.0, 1.0, 1.0])
    derivative = without_homography(lens_derivatives(lens, together), lens.undistort(together), len(MEASURED))
    for left_out in (None, 1, 4):  # a parameter whose variance is 0 is known
        kept = [each for each in range(6) if each != left_out]
        changed = covariance.copy()
        if left_out is not None:
            changed[left_out] = changed[:, left_out] = 0.0
        part = derivative[..., kept]
        expected = part @ covariance[np.ix_(kept, kept)] @ part.transpose(0, 2, 1)
        found = correction_covariance(fit_of(lens, names, changed), PLACES, MEASURED).reshape(-1, 2, 2)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * expected.max())
    # An unknown coefficient leaves only the centre known.
    covariance[2, 2] = np.inf
    found = correction_covariance(fit_of(lens, names, covariance), [[*lens.centre], [900.0, 300.0]], MEASURED)
    assert np.isfinite(found[0]).all()
    assert np.isinf(found[1]).all()
    assert correction_sigma(fit_of(lens, names, covariance), [[900.0, 300.0]], MEASURED) == [np.inf]
    image = np.array([[[*lens.centre]] * 3, [[900.0, 300.0]] * 3])
    found = correction_covariance(fit_of(lens, names, covariance), image, MEASURED)
    np.testing.assert_array_equal(np.isinf(found).all(axis=(-1, -2)), [[False] * 3, [True] * 3])
    # No parameter with a finite variance above 0. A coefficient does not move the centre.
    for variance, expected in ((np.inf, [0.0, np.inf]), (0.0, [0.0, 0.0])):
        fit = fit_of(lens, ("k1",), np.array([[variance]]))
        found = correction_covariance(fit, [[*lens.centre], [900.0, 300.0]], MEASURED)
        np.testing.assert_array_equal(found, np.full((2, 2, 2), np.array(expected)[:, None, None]))


def test_the_homography_is_fitted_to_4000_points_at_most() -> None:
    """Of 4001 points every second one is used, of 4000 all; without a point nothing is removed."""
    fit = fit_of(Lens(k1=-1e-7, centre=CENTRE), ("k1",), np.array([[1e-16]]))
    points = np.stack([np.linspace(10.0, 1270.0, 4001), 400.0 + 300.0 * np.sin(np.arange(4001.0) ** 2)], -1)
    for count, step in ((4001, 2), (4000, 1)):
        chosen = correction_covariance(fit, PLACES, points[:count][::step])
        np.testing.assert_array_equal(correction_covariance(fit, PLACES, points[:count]), chosen)
        assert np.any(chosen != correction_covariance(fit, PLACES, points[1:count:2]))
    offset = PLACES - CENTRE
    moved = 1e-8 * offset * np.sum(offset**2, axis=-1, keepdims=True)
    found = correction_covariance(fit, PLACES, np.full((2, 2), np.nan))
    np.testing.assert_allclose(found, moved[..., :, None] * moved[..., None, :], rtol=1e-6)


def test_map_of_the_correction() -> None:
    """Past the fold there is no correction; a sigma at the limit is within it."""
    lens = Lens(k1=-8e-7, centre=(320.0, 240.0))  # folds at a radius of 645 px
    fit = fit_of(lens, ("k1", "C_c", "R_c"), covariance_of([1e-8, 3.0, 2.0]))
    measured = [np.array([[100.0, 100.0], [700.0, 100.0]]), np.array([[700.0, 400.0], [100.0, 400.0], [np.nan, 9.0]])]
    found = correction_map(fit, (1001, 601), measured, max_sigma_px=1.0, grid=(11, 7))
    assert found.points.shape == (7, 11, 2)
    np.testing.assert_allclose(found.points[2, 3], [300.0, 200.0])
    np.testing.assert_array_equal(found.inside, ((found.points > 90) & (found.points < [710, 410])).all(axis=-1))
    radius = np.hypot(*(found.points - lens.centre).transpose(2, 0, 1))
    np.testing.assert_array_equal(np.isnan(found.sigma_px), radius > lens.fold_radius)
    np.testing.assert_array_equal(found.sigma_px, correction_sigma(fit, found.points, np.concatenate(measured)))
    limit = found.sigma_px[2, 3]
    at_limit = correction_map(fit, (1001, 601), measured, max_sigma_px=float(limit), grid=(11, 7))
    np.testing.assert_array_equal(at_limit.extrapolated, ~(found.inside & (found.sigma_px <= limit)))
    assert not at_limit.extrapolated[2, 3]
    assert at_limit.extrapolated[found.inside].any()
    assert largest_sigma(found, inside=True) == found.sigma_px[found.inside].max()
    assert largest_sigma(found, inside=False) == np.nanmax(found.sigma_px)
    nothing = correction_map(fit, (1001, 601), [np.full((3, 2), np.nan)], max_sigma_px=1.0)
    assert nothing.points.shape == (31, 41, 2)
    assert nothing.points[-1, -1].tolist() == [1000.0, 600.0]
    assert not nothing.inside.any()
    assert np.isnan(largest_sigma(nothing, inside=True))


def test_extrapolated_areas_are_marked(rng: np.random.Generator) -> None:
    points = LENS.distort(plane_grid(rng, 0.0)) * 0.4 + 100.0
    fit = fit_lens(grid_lines(points + rng.normal(0.0, 0.02, points.shape)), model="k1")
    found = correction_map(fit, (1024, 1024), [points.reshape(-1, 2)], max_sigma_px=0.1)
    low, high = points.reshape(-1, 2).min(axis=0) - 20.0, points.reshape(-1, 2).max(axis=0) + 20.0
    outside = ((found.points < low) | (found.points > high)).any(axis=-1)
    assert found.extrapolated[outside].all()
    assert not found.inside[outside].any()
    assert not found.extrapolated[found.inside].any()
    assert largest_sigma(found, inside=True) < largest_sigma(found, inside=False)
    small = correction_map(fit, (1024, 1024), [points.reshape(-1, 2)], max_sigma_px=1e-6)
    assert small.extrapolated.all()


def test_without_a_lens_there_is_no_uncertainty(rng: np.random.Generator) -> None:
    points = plane_grid(rng, 0.0)
    fit = fit_lens(grid_lines(points + rng.normal(0.0, 0.1, points.shape)), model="none")
    assert np.all(correction_sigma(fit, points, points) == 0.0)


def test_parameters_without_an_error_have_no_part() -> None:
    """All parameters are exact: the covariance is zero, with and without measured points."""
    camera = Camera(matrix=((900.0, 0.0, 640.0), (0.0, 900.0, 480.0), (0.0, 0.0, 1.0)))
    fit: Any = SimpleNamespace(camera=camera, names=("f", "cx"), covariance=np.zeros((2, 2)))
    points = np.array([[[10.0, 20.0], [900.0, 700.0], [500.0, 30.0]]])
    for measured in (np.empty((0, 2)), np.random.default_rng(1).uniform(0.0, 900.0, (9, 2))):
        np.testing.assert_array_equal(correction_covariance(fit, points, measured), np.zeros((1, 3, 2, 2)))
