"""Confidence intervals of medians, compared with scipy and with simulated samples."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from gpuvision.profiling.rounds import BETWEEN_RUNS, median_interval, stated_interval


@pytest.mark.parametrize(("count", "rank"), [(6, 1), (8, 1), (9, 2), (15, 4), (25, 8), (50, 18), (101, 41)])
def test_the_ranks_are_those_of_the_sign_test(count: int, rank: int) -> None:
    """The rank is the largest one that keeps 95 %, with the binomial distribution of scipy."""
    interval = median_interval(np.random.default_rng(0).permutation(count))
    assert (interval.low, interval.high) == (rank - 1, count - rank)
    assert interval.confidence == pytest.approx(1.0 - 2.0 * stats.binom.cdf(rank - 1, count, 0.5))
    assert interval.confidence >= 0.95 > 1.0 - 2.0 * stats.binom.cdf(rank, count, 0.5)


@pytest.mark.parametrize(("count", "confidence"), [(1, 0.0), (2, 0.5), (3, 0.75), (5, 0.9375)])
def test_few_values_give_their_range_and_its_confidence(count: int, confidence: float) -> None:
    interval = median_interval(np.arange(count))
    assert (interval.low, interval.high, interval.confidence) == (0.0, count - 1.0, confidence)


def test_the_interval_contains_the_median_as_often_as_it_states() -> None:
    """Durations with a long tail; 4 standard deviations of the binomial share."""
    samples = np.random.default_rng(1).lognormal(sigma=1.0, size=(4000, 21))
    intervals = [median_interval(each) for each in samples]
    confidence = intervals[0].confidence
    inside = np.mean([each.low <= 1.0 <= each.high for each in intervals])
    assert abs(inside - confidence) < 4.0 * math.sqrt(confidence * (1.0 - confidence) / len(samples))


def test_the_stated_interval_of_many_runs_contains_the_ratio_as_often_as_it_states() -> None:
    """Ratios of runs, each with its own offset, and rounds around it.

    21 rounds give an interval of 97.3 %, so that the share is above 95 %.
    """
    rng, inside, runs = np.random.default_rng(2), 0, 2000
    for offset in rng.normal(scale=BETWEEN_RUNS / 1.96, size=runs):
        rounds = 2.0 * np.exp(offset + rng.normal(scale=0.2, size=21))
        found = median_interval(rounds)
        row = {
            "ratio": np.median(rounds),
            "ratio_low": found.low,
            "ratio_high": found.high,
            "confidence": found.confidence,
        }
        low, high = stated_interval(row) or (math.nan, math.nan)
        inside += low <= 2.0 <= high
    assert 0.95 <= inside / runs <= 0.99


@pytest.mark.parametrize("changes", [{"confidence": 0.9}, {"confidence": None}, {"ratio_low": None}])
def test_a_row_without_an_interval_of_its_rounds_states_none(changes: dict[str, float | None]) -> None:
    row = {"ratio": 2.0, "ratio_low": 1.9, "ratio_high": 2.1, "confidence": 0.95}
    assert stated_interval(row) is not None
    assert stated_interval(row | changes) is None
