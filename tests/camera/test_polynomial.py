"""The measurement-plane polynomial: equations, predicted uncertainties of the fit, and refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gpuvision.camera.camera import Camera
from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.reference import plane_polynomial as reference

REGION = ((0.0, 1279.0), (0.0, 1023.0))
# 0.1 mm per pixel, turned by a degree, a little perspective and barrel distortion, mirrored or not.
P = (-0.064, 1.02e-4, -1.7e-6, 4e-9, 3e-9, -1e-9, 4e-12, 4e-12)
Q = (-0.051, 1.01e-4, 1.8e-6, -2e-9, 5e-9, 1e-9, 4e-12, 4e-12)
POLYNOMIAL = PlanePolynomial(p=P, q=Q, region=REGION)
MIRRORED = PlanePolynomial(p=tuple(-each for each in P), q=Q, region=REGION)
# Roundings of 0.1 m in about twenty operations.
TOLERANCE = 1e-15


def grid(columns: int = 17, rows: int = 13) -> np.ndarray:
    axes = np.linspace(*REGION[0], columns), np.linspace(*REGION[1], rows)
    return np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)


@pytest.mark.parametrize("polynomial", [POLYNOMIAL, MIRRORED], ids=["upright", "mirrored"])
def test_against_the_equations(polynomial: PlanePolynomial) -> None:
    expected = reference.to_plane(grid(), polynomial.p, polynomial.q).astype(np.float64)
    np.testing.assert_allclose(polynomial.to_plane(grid()), expected, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(polynomial.to_sensor(expected), grid(), rtol=0, atol=1e-9)


def test_round_trip_inside() -> None:
    points = grid()[np.all((grid() > 0.0) & (grid() < [1279.0, 1023.0]), axis=1)]
    np.testing.assert_allclose(POLYNOMIAL.to_sensor(POLYNOMIAL.to_plane(points)), points, rtol=0, atol=1e-9)


@settings(deadline=None)
@given(
    higher=st.tuples(*(st.floats(-0.03, 0.03),) * 10),
    linear=st.tuples(st.floats(0.5, 2.0), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.5, 2.0)),
    x=st.floats(-1.0, 1.0),
    y=st.floats(-1.0, 1.0),
)
def test_any_polynomial_inverts(higher, linear, x, y) -> None:
    polynomial = PlanePolynomial(
        p=(0.3, linear[0], linear[1], *higher[:5]),
        q=(0.2, linear[3], linear[2], *higher[5:]),
        region=((-1.0, 1.0), (-1.0, 1.0)),
    )
    plane = polynomial.to_plane([x, y])
    np.testing.assert_allclose(polynomial.to_sensor(plane), [x, y], rtol=0, atol=1e-13)


def test_fit_finds_what_is_exact() -> None:
    plane = reference.to_plane(grid(), P, Q).astype(np.float64)
    plane[3] = math.nan
    sensor = grid()
    sensor[40, 0] = math.nan
    fitted = PlanePolynomial.fit(sensor, plane, region=REGION)
    # Relative to each term's contribution at the far corner.
    reach = np.array([1.0, 1279.0, 1023.0, 1279.0**2, 1279.0 * 1023.0, 1023.0**2, 1023.0**2 * 1279.0, 1279.0**3])
    swapped = np.array([1.0, 1023.0, 1279.0, 1023.0**2, 1279.0 * 1023.0, 1279.0**2, 1279.0**2 * 1023.0, 1023.0**3])
    np.testing.assert_allclose(np.array(fitted.p) * reach, np.array(P) * reach, rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.array(fitted.q) * swapped, np.array(Q) * swapped, rtol=0, atol=1e-14)
    assert np.sqrt(np.array(fitted.covariance).max()) < 1e-15


def test_fit_to_eight_points() -> None:
    sensor = grid(4, 4)[[0, 3, 5, 6, 9, 11, 12, 14]]
    plane = reference.to_plane(sensor, P, Q).astype(np.float64)
    fitted = PlanePolynomial.fit(sensor, plane, region=REGION)
    assert fitted.covariance is None
    np.testing.assert_allclose(fitted.to_plane(sensor), plane, rtol=0, atol=1e-13)
    with pytest.raises(ValueError, match="covariance is not known"):
        fitted.covariance_at(sensor)


def test_covariance_is_that_of_a_numerical_jacobian() -> None:
    """The fit is linear in the plane coordinates: one fit for each changed coordinate gives the Jacobian."""
    sensor, places, sigma = grid(4, 4), np.array([[640.0, 500.0], [30.0, 1000.0], [1279.0, 0.0]]), 20e-6
    noise = sigma * np.sin(37.0 * np.arange(2.0 * len(sensor)) ** 2).reshape(-1, 2)
    plane = POLYNOMIAL.to_plane(sensor) + noise
    known, estimated = (PlanePolynomial.fit(sensor, plane, sigma=each, region=REGION) for each in (sigma, None))
    expected = np.zeros((3, 2, 2))
    for index in np.ndindex(plane.shape):
        changed = plane.copy()
        changed[index] += 1e-3
        fitted = PlanePolynomial.fit(sensor, changed, sigma=sigma, region=REGION)
        slope = (fitted.to_plane(places) - known.to_plane(places)) / 1e-3
        expected += sigma**2 * slope[:, :, None] * slope[:, None, :]
    np.testing.assert_allclose(known.covariance_at(places), expected, rtol=1e-8, atol=1e-8 * expected.max())
    residuals = plane - known.to_plane(sensor)
    ratio = np.sum(residuals**2, axis=0) / (len(sensor) - 8) / sigma**2  # eight coefficients of each coordinate
    np.testing.assert_allclose(
        estimated.covariance_at(places), expected * np.diag(ratio), rtol=1e-8, atol=1e-8 * expected.max()
    )


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [None, 20e-6])
def test_covariance_covers_the_truth(sigma: float | None, rng: np.random.Generator) -> None:
    plane = reference.to_plane(grid(), P, Q).astype(np.float64)
    places = np.array([[640.0, 500.0], [30.0, 1000.0], [1279.0, 0.0]])
    truth = POLYNOMIAL.to_plane(places)
    inside = 0
    for _ in range(400):
        noisy = plane + rng.normal(0.0, 20e-6, plane.shape)
        fitted = PlanePolynomial.fit(grid(), noisy, sigma=sigma)
        spread = np.sqrt(np.diagonal(fitted.covariance_at(places), axis1=-2, axis2=-1))
        inside = inside + (np.abs(fitted.to_plane(places) - truth) <= 1.96 * spread)
    # 95 % of 400, minus three standard deviations of the count.
    assert np.all(np.abs(np.asarray(inside) / 400.0 - 0.95) < 0.033)


@pytest.mark.parametrize(
    ("k1", "tilt", "pixels"),
    [(-0.05, (0, 0), 0.04), (-0.2, (0, 0), 0.6), (0.0, (0, 10), 0.05), (0.0, (0, 20), 0.4), (0.0, (10, 10), 3.0)],
)
def test_what_it_cannot_do(k1: float, tilt: tuple[int, int], pixels: float) -> None:
    """Invalid use raises the documented errors."""
    matrix = ((1700.0, 0.0, 640.0), (0.0, 1700.0, 512.0), (0.0, 0.0, 1.0))
    plane = (grid() - [640.0, 512.0]) * 1e-4
    sensor = Camera(matrix=matrix, distortion=(k1, *(0.0,) * 11, *np.radians(tilt))).distort(grid())
    error = np.abs(PlanePolynomial.fit(sensor, plane).to_plane(sensor) - plane).max() / 1e-4
    assert 0.8 * pixels < error < 1.2 * pixels


def test_beyond_the_region_there_is_nothing() -> None:
    points = np.array([[0.0, 0.0], [1279.0, 1023.0], [-0.01, 5.0], [5.0, 1023.01], [math.nan, 0.0], [math.inf, 0.0]])
    plane = POLYNOMIAL.to_plane(points)
    np.testing.assert_array_equal(np.isnan(plane), [[False] * 2] * 2 + [[True] * 2] * 4)
    outside = reference.to_plane(points[2:4], P, Q).astype(np.float64)
    far = [[5.0, 0.0], [-1e3, 1e3], [math.nan, 0.0]]
    assert np.isnan(POLYNOMIAL.to_sensor(np.concatenate([outside, far]))).all()


def test_shapes() -> None:
    for shape in ((0, 2), (2,), (3, 4, 2)):
        assert POLYNOMIAL.to_plane(np.full(shape, 100.0)).shape == shape
        assert POLYNOMIAL.to_sensor(np.full(shape, 0.01)).shape == shape
    assert PlanePolynomial.fit(grid().reshape(13, 17, 2), POLYNOMIAL.to_plane(grid()).reshape(13, 17, 2)).covariance


def test_table_round_trip() -> None:
    noisy = POLYNOMIAL.to_plane(grid()) + 1e-6 * np.sin(np.arange(2.0 * len(grid()))).reshape(-1, 2)
    for each in (POLYNOMIAL, PlanePolynomial.fit(grid(), noisy)):
        assert PlanePolynomial.from_dict(each.to_dict()) == each


def on_a_line(count: int = 30) -> np.ndarray:
    return np.stack([np.linspace(0.0, 1000.0, count), np.linspace(0.0, 800.0, count)], -1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PlanePolynomial(p=P[:7], q=Q, region=REGION), r"PlanePolynomial.p has shape \(7,\), expected \(8,\)"),
        (lambda: PlanePolynomial(p=P, q=Q, region=((5.0, 5.0), (0.0, 1.0))), r"expected \(\(c_min, c_max\)"),
        (lambda: PlanePolynomial(p=(0.0,) * 8, q=Q, region=REGION), "linear terms are not one-to-one"),
        (lambda: replace(POLYNOMIAL, covariance=(np.eye(8),)), "has 1 parts"),
        (lambda: replace(POLYNOMIAL, region=((0.0, 9e4), (0.0, 9e4)), p=(*P[:7], -4e-12)), "folds within its region"),
        (lambda: PlanePolynomial.fit(grid(), grid()[:-1]), r"\(221, 2\) and plane points \(220, 2\)"),
        (lambda: PlanePolynomial.fit(grid()[:7], grid()[:7]), "7 pairs of points are known, expected eight"),
        (lambda: PlanePolynomial.fit(np.full((9, 2), math.nan), grid()[:9]), "0 pairs of points are known"),
        (lambda: PlanePolynomial.fit(on_a_line(), on_a_line()), "do not fix eight terms"),
        (lambda: PlanePolynomial.fit(grid()[:17], grid()[:17]), "lie on one line"),
        (lambda: PlanePolynomial.fit(grid(17, 3)[:34], grid(17, 3)[:34]), "four columns and four rows"),
        (lambda: PlanePolynomial.fit(grid(), grid()[:, ::-1]), "exchange the plane's axes"),
        (lambda: PlanePolynomial.from_dict({"p": P, "q": Q}), "'region' is missing"),
    ],
)
def test_what_is_wrong_is_told(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
