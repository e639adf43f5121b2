"""All-pairs designs hold every pair that occurs, in few cases."""

from __future__ import annotations

import doctest
import itertools
from typing import Any

import pytest

import designs
from designs import all_pairs

PRODUCT = [dict(zip("abcd", case, strict=True)) for case in itertools.product(range(9), "xy", (1.5, None, ()), "pq")]


def pairs_of(cases: list[dict[str, Any]]) -> set[Any]:
    return {pair for case in cases for pair in itertools.combinations(sorted(case.items()), 2)}


@pytest.mark.parametrize("cases", [PRODUCT, PRODUCT[5:], PRODUCT[::7], PRODUCT[:1]], ids=len)
def test_every_pair_that_occurs_is_held(cases: list[dict[str, Any]]) -> None:
    chosen = all_pairs(cases)
    assert chosen == sorted(set(chosen))
    assert pairs_of([cases[k] for k in chosen]) == pairs_of(cases)


def test_few_cases() -> None:
    """No fewer cases than pairs of the two longest lists of values, and not many more."""
    assert 27 <= len(all_pairs(PRODUCT)) <= 30


def test_all_cases_of_two_parameters() -> None:
    cases = [{"a": a, "b": b} for a in range(4) for b in range(3)]
    assert all_pairs(cases) == list(range(12))


def test_docstring() -> None:
    assert doctest.testmod(designs) == (0, 2)
