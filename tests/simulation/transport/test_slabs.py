"""Slabs across a Gaussian sheet, and their light in the bins of a sensor, against SciPy's normal distribution."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm, truncnorm

from gpuvision.simulation.transport.slabs import SlabImage, Slabs, concatenated_slabs, read_sub_sheets
from lights import psd_view


def assert_slabs(found: Slabs, cuts: list[float]) -> None:
    """Check the slabs between cuts against the truncated normal distribution."""
    low, high = np.array([-math.inf, *cuts]), np.array([*cuts, math.inf])
    np.testing.assert_array_equal(found.low, low)
    np.testing.assert_array_equal(found.high, high)
    np.testing.assert_allclose(
        found.share, np.where(low > 0, norm.sf(low) - norm.sf(high), norm.cdf(high) - norm.cdf(low))
    )
    for number, (a, b) in enumerate(zip(low, high, strict=True)):
        assert found.middle[number] == pytest.approx(truncnorm.mean(a, b), rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("cuts", [[], [0.0], [-1.5, 0.25, 0.5, 2.0], [-7.0, -6.5, 6.0, 6.25]])
def test_slabs_between_divisions(cuts: list[float]) -> None:
    assert_slabs(Slabs.from_cuts(cuts), cuts)
    assert_slabs(read_sub_sheets(cuts), cuts)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 9])
def test_a_number_of_slabs_has_equal_widths_over_its_range(count: int) -> None:
    """All but the outer two have one width; the outer divisions are at sqrt(2 ln n), those of two slabs at 0."""
    reach = math.sqrt(2.0 * math.log(count)) if count > 2 else 0.0
    inner = [-reach + k * 2.0 * reach / max(count - 2, 1) for k in range(count - 1)]
    found = read_sub_sheets(count)
    np.testing.assert_allclose(found.high[:-1], inner, rtol=0, atol=1e-15)
    assert_slabs(found, found.high[:-1].tolist())


def test_outer_slabs_keep_the_means_of_the_others() -> None:
    slabs = Slabs.from_cuts([-1.0, 0.5, 2.0])
    found = slabs.with_outer(3.0)
    np.testing.assert_array_equal(found.low, [-math.inf, -3.0, -1.0, 0.5, 2.0, 3.0])
    np.testing.assert_array_equal(found.high, [-3.0, -1.0, 0.5, 2.0, 3.0, math.inf])
    np.testing.assert_array_equal(found.middle[1:-1], slabs.middle)
    np.testing.assert_allclose(found.middle[[0, -1]], [truncnorm.mean(-np.inf, -3.0), truncnorm.mean(3.0, np.inf)])
    np.testing.assert_allclose(found.share, np.diff([0.0, *norm.cdf([-3.0, -1.0, 0.5, 2.0, 3.0]), 1.0]))
    # Divisions beyond the place, or close to it, keep an outer slab of 0.05 sigmas at their side.
    wide = Slabs.from_cuts([-3.25, 2.96]).with_outer(3.0)
    np.testing.assert_allclose(wide.high[:-1], [-3.3, -3.25, 2.96, 3.01], rtol=1e-15)


def test_slabs_of_profiles_follow_each_other() -> None:
    one, two = Slabs.from_cuts([0.5]), Slabs.from_cuts([-1.0, 2.0])
    slabs, profile = concatenated_slabs([one, two])
    np.testing.assert_array_equal(profile, [0, 0, 1, 1, 1])
    for found, first, second in zip(slabs, one, two, strict=True):
        np.testing.assert_array_equal(found, [*first, *second])
    nothing, none = concatenated_slabs([])
    assert [len(each) for each in (*nothing, none)] == [0] * 5


@pytest.mark.parametrize("given", [0, -1])
def test_a_number_of_slabs_is_one_or_more(given: int) -> None:
    with pytest.raises(ValueError, match=f"sub_sheets is {given}, expected 1 or more"):
        read_sub_sheets(given)


@pytest.mark.parametrize("given", [[1.0, 1.0], [0.5, -0.5], [0.0, math.nan], [-math.inf, 0.0], [[0.0, 1.0]]])
def test_divisions_ascend_and_are_finite(given: list[float]) -> None:
    with pytest.raises(ValueError, match="ascending places in sigmas"):
        read_sub_sheets(given)


def expected_light(
    edges: np.ndarray, u: float, spread: float, mean: float, limits: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return power and first moment about the middle of each bin, of light at ``u + spread (t - mean)``."""
    power, moment = np.zeros(len(edges) - 1), np.zeros(len(edges) - 1)
    for k, (a, b) in enumerate(itertools.pairwise(edges)):
        t = np.clip(np.sort(mean + (np.array([a, b]) - u) / spread), *limits)
        if t[0] < t[1]:
            power[k] = norm.cdf(t[1]) - norm.cdf(t[0])
            middle = 0.5 * (a + b)
            moment[k] = quad(lambda t, m=middle: (u + spread * (t - mean) - m) * norm.pdf(t), *t, epsabs=1e-18)[0]
    return power, moment


@pytest.mark.parametrize("with_limits", [False, True])
def test_the_light_of_a_slab_is_a_part_of_a_gaussian_along_u(with_limits: bool) -> None:
    """Points with spreads of both signs, of several slabs and profiles; some beside the sensor, some at its ends."""
    view, slabs = psd_view(bins=12), Slabs.from_cuts([-0.75, 0.5])
    bin_width = 5e-4
    u = np.array([0.4e-3, -1.1e-3, 2.9e-3, -2.8e-3, 0.0, 0.1e-3])
    v = np.array([-2.1e-4, 0.3e-4, 0.9e-4, 2.2e-4, 2.6e-4, -2.6e-4])  # the last two are beside the strips
    spread = np.array([1.2e-3, -0.7e-3, 0.9e-3, -1.5e-3, 1e-3, 1e-3])
    slab = np.array([0, 2, 1, 0, 1, 2])
    profile = np.array([1, 0, 1])
    image = SlabImage(view, slabs, profile, 2, tail_sigmas=7.0)
    low = np.maximum(slabs.low[slab], np.array([-1.5, 0.6, -0.5, -2.0, -1.0, 0.0]))
    high = np.minimum(slabs.high[slab], np.array([-1.0, 1.5, 0.25, -0.9, 0.3, 1.0]))
    limits = (low, high) if with_limits else None
    lights = {"one": np.array([1.0, 2.0, 0.5, 3.0, 9.0, 9.0]), "two": np.arange(6.0)}
    found = image.deposit(np.stack([u, v], axis=1), spread, slab, lights, limits)
    assert list(found) == ["one", "two"]
    for name, powers in lights.items():
        power, moment = np.zeros((2, 5, 12)), np.zeros((2, 5, 12))
        for n, strip in enumerate([0, 2, 3, 4]):
            ends = (low[n], high[n]) if with_limits else (slabs.low[slab[n]], slabs.high[slab[n]])
            share, first = expected_light(view.u_edges, u[n], spread[n], slabs.middle[slab[n]], ends)
            power[profile[slab[n]], strip] += powers[n] * share / slabs.share[slab[n]]
            moment[profile[slab[n]], strip] += powers[n] * first / slabs.share[slab[n]]
        np.testing.assert_allclose(found[name].power, power, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found[name].moment, moment, rtol=1e-7, atol=1e-12 * bin_width)


def test_a_slab_without_width_is_in_one_bin() -> None:
    """A displacement of 0 along u: all the light is at the image of the mean."""
    view, slabs = psd_view(bins=12), Slabs.from_cuts([0.25])
    uv = np.array([[0.7e-3, 0.5e-4], [-2.9e-3, -1.8e-4]])
    image = SlabImage(view, slabs, np.zeros(2, np.int64), 1, tail_sigmas=5.0)
    found = image.deposit(uv, np.array([0.0, -1e-18]), np.array([1, 0]), {"all": np.array([2.0, 3.0])})["all"]
    power, moment = np.zeros((1, 5, 12)), np.zeros((1, 5, 12))
    power[0, 3, 7], power[0, 0, 0] = 2.0, 3.0
    moment[0, 3, 7], moment[0, 0, 0] = 2.0 * (0.7e-3 - 0.75e-3), 3.0 * (-2.9e-3 + 2.75e-3)
    np.testing.assert_allclose(found.power, power, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.moment, moment, rtol=1e-4, atol=1e-10)


def test_bins_beyond_the_tails_get_no_light() -> None:
    """The bins from -1 to 1 sigma about the middle, whole ones, have the light of the sheet; the others have none."""
    view, slabs = psd_view(bins=12), Slabs.from_cuts([])
    image = SlabImage(view, slabs, np.zeros(1, np.int64), 1, tail_sigmas=1.0)
    found = image.deposit(np.array([[0.1e-3, 0.0]]), np.array([-0.8e-3]), np.array([0]), {"all": np.ones(1)})["all"]
    # From -0.7 mm to 0.9 mm: bins 4 to 7 of 0.5 mm each.
    power, _ = expected_light(view.u_edges, 0.1e-3, -0.8e-3, 0.0, (-math.inf, math.inf))
    power[[*range(4), *range(8, 12)]] = 0.0
    np.testing.assert_allclose(found.power[0, 2], power, rtol=1e-12)
    assert found.power.sum() == found.power[0, 2].sum()
