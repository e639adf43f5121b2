"""Covering designs hold every value or pair that occurs, in few cases."""

from __future__ import annotations

import doctest
import itertools
from typing import Any

import pytest

import designs
from designs import combinations, covering

PRODUCT = [dict(zip("abcd", case, strict=True)) for case in itertools.product(range(9), "xy", (1.5, None, ()), "pq")]


def held_by(cases: list[dict[str, Any]], strength: int) -> set[Any]:
    return {held for case in cases for held in itertools.combinations(sorted(case.items()), strength)}


@pytest.mark.parametrize("strength", [1, 2])
@pytest.mark.parametrize("cases", [PRODUCT, PRODUCT[5:], PRODUCT[::7], PRODUCT[:1]], ids=len)
def test_everything_that_occurs_is_held(cases: list[dict[str, Any]], strength: int) -> None:
    chosen = covering(cases, strength)
    assert chosen == sorted(set(chosen))
    assert held_by([cases[k] for k in chosen], strength) == held_by(cases, strength)


def test_few_cases() -> None:
    """No fewer cases than values or pairs of the longest lists of values, and not many more."""
    assert len(covering(PRODUCT, 1)) == 9
    assert 27 <= len(covering(PRODUCT, 2)) <= 30


def test_all_pairs_of_two_parameters_are_all_cases() -> None:
    cases = [{"a": a, "b": b} for a in range(4) for b in range(3)]
    assert covering(cases, 2) == list(range(12))


def test_each_value_of_two_parameters() -> None:
    cases = [{"a": a, "b": b} for a in range(4) for b in range(3)]
    assert len(covering(cases, 1)) == 4


@pytest.mark.parametrize("strength", [1, 2])
def test_combinations_of_other_cases_are_not_held_again(strength: int) -> None:
    """The cases that remain are few, and hold together with the other cases what all cases hold."""
    others = PRODUCT[:5]
    held = {each for case in others for each in combinations(case, strength)}
    chosen = covering(PRODUCT, strength, held=held)
    together = [*others, *(PRODUCT[k] for k in chosen)]
    assert held_by(together, strength) == held_by(PRODUCT, strength)
    assert len(chosen) < len(covering(PRODUCT, strength))
    assert covering(others, strength, held=held) == []


def test_docstring() -> None:
    assert doctest.testmod(designs) == (0, 4)
