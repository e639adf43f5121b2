"""Confidence intervals of medians, compared with scipy and with simulated samples."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from gpuvision.profiling.rounds import median_interval


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
