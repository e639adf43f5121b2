"""Order and regularity of the positions of an encoder."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.ranging.encoder import EncoderStatistics, not_advancing, unwrapped_counts


@pytest.mark.parametrize(
    ("counts", "bits", "unwrapped"),
    [
        ([250, 255, 3, 9, 252], 8, [250, 255, 259, 265, 252]),
        ([0, 127, 255, 128], 8, [0, 127, 255, 128]),
        ([-128, 127, -127, 100], 8, [-128, -129, -127, -156]),
        ([65530, 4, 65529], 16, [65530, 65540, 65529]),
        ([0, 7, 14, 5], 4, [0, 7, 14, 21]),
    ],
)
def test_a_counter_that_wraps_around_goes_on(counts: list[int], bits: int, unwrapped: list[int]) -> None:
    np.testing.assert_array_equal(unwrapped_counts(counts, bits), unwrapped)


@pytest.mark.parametrize(("counts", "place"), [([0, 255, 256], 2), ([-129, 5], 0), ([1, -128, 300, 400], 2)])
def test_a_count_beyond_its_bits_is_named(counts: list[int], place: int) -> None:
    message = f"^the encoder: count {counts[place]} of profile {place} does not fit 8 bits$"
    with pytest.raises(ValueError, match=message):
        unwrapped_counts(counts, 8)
    with pytest.raises(ValueError, match=f"belt: count {counts[place]} of"):
        unwrapped_counts(counts, 8, "belt")


def longest_monotone(values: list[float]) -> int:
    """Return the length of the longest strictly monotone subsequence, by trying all of them."""
    for count in range(len(values), 0, -1):
        for kept in combinations(values, count):
            steps = np.diff(kept)
            if np.all(steps > 0) or np.all(steps < 0):
                return count
    return 0


@given(st.lists(st.integers(-4, 4), min_size=1, max_size=9))
def test_the_smallest_set_is_marked(counts: list[int]) -> None:
    marked = not_advancing(counts)
    steps = np.diff(np.array(counts, dtype=float)[~marked])
    assert np.all(steps > 0) or np.all(steps < 0)
    assert np.count_nonzero(~marked) == longest_monotone([float(each) for each in counts])


@pytest.mark.parametrize(
    ("counts", "marked"),
    [
        ([0, 1, 2, 3], []),
        ([3, 2, 1, 0], []),
        ([0, 1, 90, 3, 4, 5], [2]),  # a wrong position marks no profile after it
        ([0, 1, 2, 2, 2, 3], [3, 4]),  # the belt stands: its first profile stays
        ([9, 8, 8, 7], [2]),
        ([5], []),
    ],
)
def test_profiles_that_do_not_advance(counts: Any, marked: list[int]) -> None:
    assert np.flatnonzero(not_advancing(counts)).tolist() == marked


def test_jitter_is_the_error_of_a_position() -> None:
    rng = np.random.default_rng(3)
    time = np.arange(20_000.0)
    smooth = 1e-3 * time + 2e-3 * np.sin(time / 500.0)  # the speed changes by 0.4 %
    found = EncoderStatistics.from_positions(smooth + rng.normal(0.0, 2e-5, time.size))
    assert found.jitter == pytest.approx(2e-5, rel=0.02)
    assert found.step_mean == pytest.approx(1e-3, rel=1e-2)
    assert found.not_advancing == 0
    assert EncoderStatistics.from_positions(smooth).jitter < 1e-8


def test_rounding_to_counts_is_jitter() -> None:
    profile = np.arange(20_000.0)
    # The speed grows from 10 to 22 counts per profile, so that the roundings of neighbours are uncorrelated on average.
    position = np.floor(10.0 * profile + 3e-4 * profile**2)
    assert EncoderStatistics.from_positions(position).jitter == pytest.approx(1.0 / np.sqrt(12.0), rel=0.03)


def test_few_positions_have_no_jitter() -> None:
    one, two = (EncoderStatistics.from_positions(np.arange(float(n))) for n in (1, 2))
    nothing = [one.step_mean, one.step_std, one.step_smallest, one.step_largest, one.jitter, two.jitter]
    assert np.isnan(nothing).all()
    assert (one.profiles, two.profiles, one.not_advancing) == (1, 2, 0)
    assert two.step_mean == two.step_smallest == two.step_largest == 1.0
    assert two.step_std == 0.0
    assert EncoderStatistics.from_positions(np.array([0.0, 1.0, 4.0])).jitter == pytest.approx(2.0 / np.sqrt(6.0))


def test_steps_of_few_positions() -> None:
    """Steps of 1, 3 and -1: their standard deviation is sqrt(8 / 3), the second differences are 2 and -4."""
    statistics = EncoderStatistics.from_positions([0.0, 1.0, 4.0, 3.0])
    assert (statistics.profiles, statistics.not_advancing) == (4, 1)
    assert (statistics.step_mean, statistics.step_smallest, statistics.step_largest) == (1.0, -1.0, 3.0)
    assert statistics.step_std == pytest.approx(np.sqrt(8.0 / 3.0))
    assert statistics.jitter == pytest.approx(np.sqrt(10.0 / 6.0))
