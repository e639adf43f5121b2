"""Depth from focus with parallel pinholes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gpuvision.ranging.focus import DepthFromFocus, conjugate_distance
from gpuvision.status import Status

FOCAL, FIRST, SPACING = 0.05, 0.06, 1e-3


def behind(count: int, peak: np.ndarray | float, width: float = 1.5e-3, level: float = 1000.0) -> np.ndarray:
    """Return intensities of a Gaussian with its peak at an image distance, behind ``count`` pinholes."""
    place = FIRST + SPACING * np.arange(count)
    return level * np.exp(-0.5 * ((place - np.asarray(peak)[..., None]) / width) ** 2)


def system(**more: float) -> DepthFromFocus:
    return DepthFromFocus(first=FIRST, spacing=SPACING, focal_length=FOCAL, **more)


@pytest.mark.parametrize("count", [3, 4, 5, 8, 15])
def test_gaussian_is_met_exactly(count: int) -> None:
    # Not on the outermost pinholes themselves: there a rounding decides whether the peak is outside.
    peaks = FIRST + SPACING * np.linspace(0.001, count - 1.001, 57)
    reading = system()(behind(count, peaks))
    assert not reading.status.any()
    np.testing.assert_allclose(reading.image_distance, peaks, rtol=0, atol=1e-14)
    np.testing.assert_allclose(reading.width, 1.5e-3, rtol=1e-11)
    np.testing.assert_allclose(reading.object_distance, FOCAL * peaks / (peaks - FOCAL), rtol=1e-11)


def test_three_pinholes_follow_the_closed_form(rng: np.random.Generator) -> None:
    light = rng.uniform(1.0, 1000.0, (500, 3))
    low, middle, high = np.log(light).T
    expected = 0.5 * SPACING * (low - high) / (low - 2.0 * middle + high)
    reading = system()(light)
    good = reading.status == 0
    assert good.any()
    assert not good.all()
    np.testing.assert_allclose(reading.image_distance[good] - (FIRST + SPACING), expected[good], rtol=1e-9, atol=1e-15)
    peaked = (low - 2.0 * middle + high < 0.0) & (np.abs(expected) <= SPACING)
    np.testing.assert_array_equal(good, peaked)


def test_weights_are_those_of_a_weighted_polynomial_fit(rng: np.random.Generator) -> None:
    light = behind(7, FIRST + 3.3 * SPACING) * rng.uniform(0.9, 1.1, 7)
    place = np.arange(7.0)
    # polyfit multiplies the residuals, so that weights I there are weights I^2 on their squares.
    square, linear, _ = np.polyfit(place, np.log(light), 2, w=light)
    assert system()(light).image_distance == pytest.approx(FIRST - SPACING * 0.5 * linear / square, rel=1e-12)


@pytest.mark.parametrize("count", [3, 5, 9])
def test_predicted_sigma_is_the_spread_of_noisy_readings(count: int, rng: np.random.Generator) -> None:
    peak, sigma, trials = FIRST + SPACING * (0.5 * count - 0.8), 2.0, 20_000
    light = behind(count, peak) + rng.normal(0.0, sigma, (trials, count))
    reading = system(sigma_intensity=sigma)(light)
    assert reading.sigma_image is not None
    assert reading.sigma_object is not None
    # Weighted by I^2: the noise affects the weights only in second order. 20000 trials determine a deviation to 0.5 %.
    assert np.std(reading.image_distance) == pytest.approx(np.mean(reading.sigma_image), rel=0.03)
    assert np.std(reading.object_distance) == pytest.approx(np.mean(reading.sigma_object), rel=0.03)


def test_weights_pay_on_dim_pinholes(rng: np.random.Generator) -> None:
    light = behind(9, np.full(4000, FIRST + 2.0 * SPACING)) + rng.normal(0.0, 2.0, (4000, 9))
    reading = system(minimum=1e-9)(light)
    lit = np.where(light > 1e-9, light, 1.0)
    unweighted = np.array([np.polyfit(np.arange(9.0), np.log(each), 2) for each in lit[:500]])
    spread = np.std(-0.5 * SPACING * unweighted[:, 1] / unweighted[:, 0])
    assert np.std(reading.image_distance[:500]) < 0.2 * spread


@pytest.mark.parametrize("level", [1.0, 3.7, 1e-300, 1e300])
@pytest.mark.parametrize("count", [3, 6])
def test_equal_intensities_have_no_peak(count: int, level: float) -> None:
    reading = system()(np.full((2, count), level))
    np.testing.assert_array_equal(reading.status, Status.AMBIGUOUS)
    assert np.all(np.isnan(reading.image_distance))


def test_valley_has_no_peak() -> None:
    assert system()(np.array([5.0, 1.0, 5.0])).status == Status.AMBIGUOUS


def test_dark_pinhole() -> None:
    light = np.array([[0.0, 5.0, 3.0], [3.0, 5.0, -1.0], [0.0, 0.0, 0.0], [3.0, 5.0, 3.0]])
    np.testing.assert_array_equal(system()(light).status, [Status.LOW_SIGNAL, Status.LOW_SIGNAL, Status.LOW_SIGNAL, 0])
    np.testing.assert_array_equal(system(minimum=3.5)(light[3]).status, Status.LOW_SIGNAL)


def test_dark_pinhole_among_many_is_left_out() -> None:
    peak = FIRST + 2.2 * SPACING
    light = behind(6, peak)
    light[5] = 0.0
    reading = system()(light)
    assert reading.status == 0
    assert reading.image_distance == pytest.approx(peak, abs=1e-14)
    light[:3] = 0.0
    assert system()(light).status == Status.LOW_SIGNAL


def test_peak_outside_the_pinholes() -> None:
    outside = FIRST + SPACING * np.array([-0.01, 2.01, -1.0, 3.0])
    reading = system()(behind(3, outside))
    np.testing.assert_array_equal(reading.status, Status.OUT_OF_RANGE)
    assert np.all(np.isnan(reading.object_distance))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_not_finite(bad: float) -> None:
    assert system()(np.array([1.0, bad, 1.0])).status == Status.NOT_FINITE
    assert system()(np.array([1.0, 4.0, bad, 1.0])).status == Status.NOT_FINITE


@example(peak=0.01, width=0.8125, level=5.0, count=10)  # two pinholes have nearly all of the weight
@given(peak=st.floats(0.01, 3.99), width=st.floats(0.8, 20.0), level=st.floats(-6.0, 6.0), count=st.integers(5, 12))
def test_level_and_width_do_not_move_the_peak(peak: float, width: float, level: float, count: int) -> None:
    light = behind(count, FIRST + SPACING * peak, SPACING * width, 10.0**level)
    reading = system()(light)
    assert reading.status == 0
    # Logarithms of up to 14 + (11 / width)^2 / 2 carry roundings, which move the peak the more the flatter the
    # parabola is, by width^2 spacings per unit.
    roundings = 16.0 * np.finfo(float).eps * (14.0 + 60.0 / width**2)
    assert reading.image_distance == pytest.approx(FIRST + SPACING * peak, abs=SPACING * roundings * (1.0 + width**2))


def test_thin_lens_both_ways() -> None:
    image = np.array([0.0501, 0.06, 0.1, 1.0])
    far = conjugate_distance(image, FOCAL)
    np.testing.assert_allclose(1.0 / image + 1.0 / far, 1.0 / FOCAL, rtol=1e-12)
    np.testing.assert_allclose(conjugate_distance(far, FOCAL), image, rtol=1e-12)
    assert conjugate_distance(0.1, FOCAL) == pytest.approx(0.1)
    assert np.all(np.isnan(conjugate_distance([FOCAL, 0.01, -1.0, np.nan], FOCAL)))


def test_shapes() -> None:
    reading = system(sigma_intensity=1.0)(behind(5, np.full((2, 3), FIRST + 2e-3)))
    assert all(each.shape == (2, 3) for each in reading)
    assert system()(np.empty((0, 3))).status.shape == (0,)
    assert system()(behind(3, FIRST + 1e-3)).sigma_image is None
    for shape in ((), (2,), (5, 2)):
        with pytest.raises(ValueError, match="at least 3"):
            system()(np.ones(shape))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"spacing": 0.0}, "spacing"),
        ({"first": 0.04}, "beyond the focal length"),
        ({"minimum": -1.0}, "minimum"),
        ({"sigma_intensity": 0.0}, "sigma_intensity"),
        ({"focal_length": math.inf}, "finite"),
    ],
)
def test_bad_systems(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DepthFromFocus(**{"first": FIRST, "spacing": SPACING, "focal_length": FOCAL, **change})
