"""Helpers of the pattern finders: grey images, noise of a grid, agreement of a point with its neighbours."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtri

from gpuvision.camera.patterns.grid_polynomial import GridPolynomial, agrees_with_grid
from gpuvision.camera.patterns.pattern import estimate_localisation_noise, finder_image, nan_median, trim_empty_border
from target_images import view


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_grey_of_a_colour_is_opencvs(dtype: type, rng: np.random.Generator) -> None:
    image = rng.integers(0, 200, (5, 7, 3)).astype(dtype)
    assert np.array_equal(finder_image(image), cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32))
    assert np.array_equal(finder_image(image[..., 0]), image[..., 0].astype(np.float32))


@pytest.mark.parametrize(
    "image", [np.zeros((4, 4), bool), np.zeros((4, 4), np.int32), np.zeros((4, 4)), [[1, 2]], None]
)
def test_other_types_are_refused(image: object) -> None:
    with pytest.raises(TypeError, match="expected an array of uint8, uint16 or float32"):
        finder_image(image)


@pytest.mark.parametrize("shape", [(4,), (4, 4, 4), (4, 4, 1), (0, 4), (4, 0, 3), ()])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="expected \\(height, width\\)"):
        finder_image(np.zeros(shape, np.uint8))


def test_pixels_that_are_no_numbers_are_refused() -> None:
    image = np.ones((4, 4), np.float32)
    image[1, 2:] = np.nan, np.inf
    with pytest.raises(ValueError, match="2 pixels that are no finite numbers"):
        finder_image(image)


@pytest.mark.parametrize(("rows", "columns", "within"), [(60, 60, 0.05), (6, 9, 0.35)])
@pytest.mark.parametrize("barrel", [0.0, 40.0])
def test_noise_is_found_whatever_the_lens(
    rows: int, columns: int, within: float, barrel: float, rng: np.random.Generator
) -> None:
    """A fine grid gives the noise to some percent, 54 points to a third (median of about 54 differences)."""
    points = view((1000, 1000), rows, columns, 800 / columns, barrel=barrel, tilt=20).nodes(rows, columns)
    points += rng.normal(0.0, 0.1, points.shape)
    points[rng.random((rows, columns)) < 0.05] = np.nan
    assert estimate_localisation_noise(points) == pytest.approx(0.1, rel=within)


def test_noise_is_the_least_of_the_differences_of_the_third_to_the_sixth_order(rng: np.random.Generator) -> None:
    """Sums with binomial coefficients along rows and columns, by loops; an order needs twelve of them."""
    points = rng.normal(0.0, 0.1, (4, 6, 2)) + np.stack(np.meshgrid(np.arange(6.0), np.arange(4.0)), axis=-1) ** 3.5
    points[1, 2, 0] = np.nan
    estimates = []
    for order in range(3, 7):
        terms = [(-1) ** k * math.comb(order, k) for k in range(order + 1)]
        sums = [
            sum(term * line[start + k] for k, term in enumerate(terms))
            for axis in (0, 1)
            for line in np.moveaxis(points, axis, 0).reshape(points.shape[axis], -1).T
            for start in range(len(line) - order)
        ]
        known = np.abs([each for each in sums if np.isfinite(each)])
        if len(known) >= 12:
            estimates.append(np.median(known) / ndtri(0.75) / math.sqrt(math.comb(2 * order, order)))
    assert len(estimates) == 2
    assert estimate_localisation_noise(points) == pytest.approx(min(estimates), rel=1e-9)
    line = rng.normal(size=(1, 9, 2))
    assert math.isfinite(estimate_localisation_noise(line))
    assert math.isnan(estimate_localisation_noise(line[:, :8]))


def test_noise_of_too_few_points_is_not_a_number() -> None:
    assert math.isnan(estimate_localisation_noise(np.zeros((1, 4, 2))))
    assert math.isnan(estimate_localisation_noise(np.full((9, 9, 2), np.nan)))


@given(st.lists(st.floats(-10, 10) | st.just(math.nan), min_size=1, max_size=8))
def test_nan_median_is_numpys(values: list[float]) -> None:
    found = nan_median(np.array(values)[:, None])[0]
    known = [each for each in values if not math.isnan(each)]
    assert found == np.median(known) if known else math.isnan(found)


def test_trimmed_cuts_the_border_only() -> None:
    points = np.full((5, 6, 2), np.nan)
    points[1, 2] = points[3, 4] = 0.0
    assert trim_empty_border(points).shape == (3, 3, 2)
    for rows in (0, 1, 3):
        assert trim_empty_border(np.full((rows, 4, 2), np.nan)).shape == (0, 0, 2)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_derivatives_of_a_polynomial_are_exact(seed: int) -> None:
    """The fit reproduces any polynomial of degree 3 up to rounding of its largest term."""
    a = np.random.default_rng(seed).normal(size=(2, 4, 4))
    v, u = np.indices((9, 11)) / 10.0
    points = np.stack([np.polynomial.polynomial.polyval2d(u, v, each) for each in a], axis=-1)
    bent = GridPolynomial(points)
    assert bent.derivative(0, 0) == pytest.approx(points, abs=1e-10)
    by_u = [np.polynomial.polynomial.polyder(each, axis=0) for each in a]
    slope = np.stack([np.polynomial.polynomial.polyval2d(u, v, each) for each in by_u], axis=-1)
    assert bent.derivative(1, 0) * 10.0 == pytest.approx(slope, abs=1e-8)


def test_points_off_the_grid_are_told_also_at_its_border(rng: np.random.Generator) -> None:
    points = view((1000, 1000), 20, 20, 40.0, barrel=60.0, tilt=30).nodes(20, 20)
    points += rng.normal(0.0, 0.02, points.shape)
    off = [(0, 0), (0, 7), (9, 9), (19, 3), (12, 19)]
    for node in off:
        points[node] += 0.8, -0.6
    points[4, 4] = np.nan
    rejected = {(int(i), int(j)) for i, j in np.argwhere(~agrees_with_grid(points, 7.0, 0.003))}
    # In a corner an outlier cannot be distinguished from its neighbour.
    assert rejected >= set(off)
    assert len(rejected) <= len(off) + 3
    assert not agrees_with_grid(np.full((3, 3, 2), np.nan), 7.0, 0.003).any()
