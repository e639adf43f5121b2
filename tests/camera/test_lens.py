"""The radial lens: direct polynomial, its inverse, its fold."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.camera.lens import Lens
from gpuvision.reference import triangulation as reference

CENTRE = (650.0, 500.0)
LENSES = [
    Lens(k1=-2e-7, centre=CENTRE),
    Lens(k1=3e-7, centre=CENTRE),
    Lens(k1=-2e-7, k2=5e-14, centre=CENTRE),
    Lens(k1=2e-7, k2=-2e-13, centre=CENTRE),
    Lens(k1=0.0, k2=1e-13, centre=CENTRE),
    Lens(k1=-4e-7, k2=8e-14, centre=CENTRE),
    Lens(k1=-3e-7, k2=1e-13, k3=-3e-20, centre=CENTRE),
    Lens(k1=3e-7, k2=-2e-13, k3=1e-19, centre=CENTRE),
    Lens(k1=-5e-7, k2=4e-13, k3=-2.5e-19, k4=9e-26, centre=CENTRE),
    Lens(k1=0.0, k4=-1e-25, centre=CENTRE),
]


def polynomial(lens: Lens, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """1 + k1 r^2 + ... and the slope of r (1 + k1 r^2 + ...), in extended precision, term by term."""
    s = np.asarray(square, dtype=np.longdouble)
    terms = [k * s**power for power, k in enumerate((lens.k1, lens.k2, lens.k3, lens.k4), 1)]
    return 1.0 + sum(terms), 1.0 + sum((2 * power + 1) * term for power, term in enumerate(terms, 1))


def field(lens: Lens, reach: float = 0.999) -> np.ndarray:
    """Points in a 1280 x 1024 image, within a fraction of the fold radius."""
    columns, rows = np.meshgrid(np.linspace(0.0, 1279.0, 41), np.linspace(0.0, 1023.0, 33))
    points = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    radius = np.hypot(*(points - lens.centre).T)
    return points[radius < reach * lens.fold_radius]


def test_a_lens_has_no_distortion_about_the_first_pixel_by_default() -> None:
    assert Lens(k1=2e-7) == Lens(k1=2e-7, k2=0.0, k3=0.0, k4=0.0, centre=(0.0, 0.0))


@pytest.mark.parametrize("lens", LENSES)
def test_polynomial(lens: Lens) -> None:
    points = field(lens)
    offset = points - lens.centre
    expected = np.array(lens.centre) + offset * polynomial(lens, np.sum(offset**2, axis=1))[0][:, None]
    # Two forms of a polynomial of 1e3 pixels agree to a few roundings of 1e-13.
    np.testing.assert_allclose(lens.undistort(points), expected.astype(float), rtol=0, atol=1e-12)
    if len(lens.coefficients) < 3:
        cubic = reference.undistort(points[:, 0], points[:, 1], lens.k1, lens.k2, lens.centre)
        np.testing.assert_allclose(lens.undistort(points), np.stack(cubic, -1), rtol=0, atol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_round_trip_is_exact_to_rounding(lens: Lens) -> None:
    points = field(lens)
    assert len(points) > 300
    np.testing.assert_allclose(lens.distort(lens.undistort(points)), points, rtol=0, atol=1e-9)


def test_round_trip_close_to_the_fold() -> None:
    lens = Lens(k1=-4e-7)
    radius = lens.fold_radius * (1.0 - np.array([1e-2, 1e-4, 1e-6]))
    points = np.stack([radius, np.zeros(3)], -1)
    # Towards the fold the slope of the polynomial vanishes with the distance, and the inverse loses the same number of
    # digits.
    slope = 6.0 * -lens.k1 * lens.fold_radius * (lens.fold_radius - radius)
    error = np.abs(lens.distort(lens.undistort(points))[:, 0] - radius)
    assert np.all(error < 4.0 * np.spacing(lens.fold_radius) / slope)


@pytest.mark.parametrize("lens", LENSES)
def test_jacobian_against_differences(lens: Lens) -> None:
    points, step = field(lens), 1e-3
    for axis, offset in enumerate(step * np.eye(2)):
        difference = (lens.undistort(points + offset) - lens.undistort(points - offset)) / (2.0 * step)
        # Third derivative times step^2, and 1e-13 pixels of rounding over the step.
        good = np.isfinite(difference).all(axis=1)
        np.testing.assert_allclose(lens.jacobian(points)[good, :, axis], difference[good], rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_fold_is_where_the_slope_vanishes(lens: Lens) -> None:
    fold = lens.fold_radius
    if math.isinf(fold):
        square = np.linspace(0.0, 1e4, 100_001) ** 2
    else:
        assert abs(polynomial(lens, np.array(fold**2))[1]) < 1e-12
        square = np.linspace(0.0, fold, 1000, endpoint=False) ** 2
    assert np.all(polynomial(lens, square)[1] > 0.0)


def test_beyond_the_fold_there_is_nothing() -> None:
    lens = Lens(k1=-4e-7, centre=(10.0, 20.0))
    outside = np.array([[10.0 + 1.001 * lens.fold_radius, 20.0], [np.nan, 0.0], [np.inf, 0.0]])
    assert np.all(np.isnan(lens.undistort(outside)))
    furthest = lens.undistort([[10.0 + (1.0 - 1e-9) * lens.fold_radius, 20.0]])[0, 0]
    beyond = np.array([[furthest + 1.0, 20.0], [np.nan, 0.0], [np.inf, 0.0]])
    assert np.all(np.isnan(lens.distort(beyond)).any(axis=1))


def test_centre_stays() -> None:
    lens = Lens(k1=-2e-7, k2=5e-14, centre=CENTRE)
    np.testing.assert_array_equal(lens.undistort(CENTRE), CENTRE)
    np.testing.assert_array_equal(lens.distort(CENTRE), CENTRE)


@given(k1=st.floats(-1e-6, 1e-6), k2=st.floats(-1e-12, 1e-12), part=st.floats(0.01, 0.9), turn=st.floats(0.0, 6.28))
def test_any_lens_inverts_inside_its_fold(k1: float, k2: float, part: float, turn: float) -> None:
    lens = Lens(k1=k1, k2=k2, centre=(3.0, -2.0))
    radius = part * min(lens.fold_radius, 2000.0)
    point = np.array([3.0 + radius * math.cos(turn), -2.0 + radius * math.sin(turn)])
    np.testing.assert_allclose(lens.distort(lens.undistort(point)), point, rtol=0, atol=1e-9)


@given(
    k=st.tuples(*(st.floats(-(scale**power), scale**power) for power, scale in enumerate([1e-6] * 4, 1))),
    part=st.floats(0.01, 0.9),
)
def test_any_lens_of_four_coefficients_inverts_inside_its_fold(k: tuple[float, ...], part: float) -> None:
    lens = Lens(k1=k[0], k2=k[1], k3=k[2], k4=k[3])
    radius = part * min(lens.fold_radius, 2000.0)
    squares = np.linspace(0.0, radius, 1001) ** 2
    assert np.all(polynomial(lens, squares)[1] > 0.0)
    point = np.array([0.6 * radius, -0.8 * radius])
    np.testing.assert_allclose(lens.distort(lens.undistort(point)), point, rtol=0, atol=1e-9)


def test_swapped_is_the_same_lens_in_the_other_order() -> None:
    lens = Lens(k1=-2e-7, k2=5e-14, centre=CENTRE)
    points = field(lens)
    np.testing.assert_array_equal(lens.swapped().undistort(points[:, ::-1]), lens.undistort(points)[:, ::-1])


def test_code_is_compiled_only_where_needed() -> None:
    assert Lens(k1=-1e-7).defines == {"LENS": None}
    assert Lens(k1=-1e-7, k2=1e-14).defines == {"LENS": None, "LENS_K2": None}
    assert Lens(k1=-1e-7, k3=1e-21).defines == {"LENS": None, "LENS_K3": None}
    assert Lens(k1=-1e-7, k4=1e-28).defines == {"LENS": None, "LENS_K4": None}


def test_table_round_trip() -> None:
    lens = Lens(k1=-2e-7, k2=5e-14, centre=CENTRE)
    assert Lens.from_dict(lens.to_dict()) == lens
    assert Lens.from_dict({"k1": 1e-7}) == Lens(k1=1e-7)
    wide = Lens(k1=-2e-7, k2=5e-14, k3=1e-20, k4=-2e-27, centre=CENTRE)
    assert Lens.from_dict(wide.to_dict()) == wide


def test_a_fold_too_far_out_for_a_float_is_none() -> None:
    assert Lens(k1=0.0, k3=-5e-324, k4=-5e-324).fold_radius > 1e30
    lens = Lens(k1=-5e-324)
    assert lens.fold_radius == math.inf
    np.testing.assert_array_equal(lens.distort([3.0, 4.0]), [3.0, 4.0])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"k1": 0.0, "k5": 1.0}, "unknown key 'k5'"),
        ({"k2": 0.0}, "'k1' is missing"),
        ({"k1": "x"}, "k1 must be a number"),
        ({"k1": math.nan}, "k1 must be finite"),
        ({"k1": 0.0, "centre": [1.0]}, r"centre \(column, row\) has shape \(1,\), expected \(2,\)"),
        ({"k1": 0.0, "centre": 5}, r"centre \(column, row\) has shape \(\), expected \(2,\)"),
        ({"k1": 0.0, "centre": [1e300, 0.0]}, r"centre is \(1e\+300, 0.0\), expected coordinates of at most 1e\+09"),
        ({"k1": 1e308}, r"k1 is 1e\+308, expected a size of at most 1e\+10"),
        ({"k1": 0.0, "k2": -1e308}, r"k2 is -1e\+308, expected a size of at most 1e\+20"),
    ],
)
def test_bad_tables_say_what_is_wrong(table: dict[str, object], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        Lens.from_dict(table)
