"""Subsets of points that robust fits start from."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gpuvision.matching.robust import sample_subsets


@pytest.mark.parametrize("max_trials", [45, 46, 1000])
def test_all_pairs_where_they_are_few(max_trials: int) -> None:
    assert sorted(map(tuple, sample_subsets(10, 2, max_trials).tolist())) == list(itertools.combinations(range(10), 2))


@pytest.mark.parametrize(("count", "size", "max_trials"), [(10, 2, 44), (100, 2, 50), (10, 3, 1000), (3, 3, 5)])
def test_random_subsets_have_the_given_number(count: int, size: int, max_trials: int) -> None:
    subsets = sample_subsets(count, size, max_trials)
    assert subsets.shape == (max_trials, size)
    assert all(len(set(each)) == size and min(each) >= 0 and max(each) < count for each in subsets.tolist())
    np.testing.assert_array_equal(sample_subsets(count, size, max_trials), subsets)
