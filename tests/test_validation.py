"""Checks of parameters: ends of ranges, types, shapes of numbers, and keys of tables, each with its whole message."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from gpuvision.validation import check_keys, finite, integer, numbers

TINY = 5e-324


def refused(kind: type[Exception], make: Callable[[], Any], message: str) -> None:
    with pytest.raises(kind) as caught:
        make()
    assert str(caught.value) == message


def test_keys_of_a_table() -> None:
    table = {"b": 1, "a": 2}
    assert check_keys(table, ("a", "b", "c"), ("a",), "camera") is table
    assert check_keys({}, (), (), "camera") == {}
    refused(
        ValueError,
        lambda: check_keys(table, ("c", "a"), (), "camera"),
        "camera: unknown key 'b', expected one of a, c",
    )
    refused(
        ValueError, lambda: check_keys(table, ("a", "b", "c"), ("a", "c"), "camera"), "camera: the key 'c' is missing"
    )


def test_ends_of_the_range_of_a_number() -> None:
    assert finite(2.0, "x", minimum=2.0) == finite(2.0, "x", maximum=2.0) == finite(2.0, "x", above=2.0 - 1e-15) == 2.0
    assert finite(-TINY, "x") == -TINY
    for limits, value, words in (
        ({"minimum": 0.0}, -TINY, ">= 0"),
        ({"above": 0.0}, 0.0, "> 0"),
        ({"maximum": 1.0}, math.nextafter(1.0, 2.0), "<= 1"),
        ({"minimum": 0.0, "maximum": 1.0}, 2.0, ">= 0 and <= 1"),
        ({"minimum": 0.0, "maximum": 1.0}, -2.0, ">= 0 and <= 1"),
        ({"above": 0.5, "maximum": 1.0}, 0.5, "> 0.5 and <= 1"),
    ):
        refused(
            ValueError,
            lambda v=value, given=limits: finite(v, "x", **given),
            f"x is {value}, expected a number {words}",
        )
    for value in (math.nan, math.inf, -math.inf):
        refused(ValueError, lambda v=value: finite(v, "x", minimum=0.0), f"x must be finite, got {value}")


@pytest.mark.parametrize("value", [True, np.False_, "1", b"1", None, [1.0], 1j, np.zeros(2)])
def test_what_is_no_number(value: Any) -> None:
    refused(TypeError, lambda: finite(value, "x"), f"x must be a number, got {value!r}")
    refused(TypeError, lambda: integer(value, "x"), f"x must be a whole number, got {value!r}")


def test_kinds_of_numbers() -> None:
    for value in (3, np.int8(3), np.float32(3.0), Fraction(3)):
        found = finite(value, "x")
        assert (found, type(found)) == (3.0, float)
    for value in (3, np.int8(3), np.uint64(3)):
        found = integer(value, "x")
        assert (found, type(found)) == (3, int)
    for value in (3.0, np.float64(3.0), Fraction(3)):
        refused(TypeError, lambda v=value: integer(v, "x"), f"x must be a whole number, got {value!r}")


def test_ends_of_the_range_of_an_integer() -> None:
    assert integer(-5, "x") == -5
    assert [integer(each, "x", minimum=2, maximum=4) for each in (2, 3, 4)] == [2, 3, 4]
    assert integer(2, "x", minimum=2) == 2
    for value in (1, 5):
        refused(ValueError, lambda v=value: integer(v, "x", minimum=2, maximum=4), f"x is {value}, expected 2 to 4")
    refused(ValueError, lambda: integer(1, "x", minimum=2), "x is 1, expected at least 2")
    refused(ValueError, lambda: integer(-1, "x", minimum=0), "x is -1, expected at least 0")


def test_shapes_of_numbers() -> None:
    assert numbers((1, 2.5), (2,), "x") == (1.0, 2.5)
    assert numbers(np.array([[1, 2, 3]], np.uint8), (1, 3), "x") == ((1.0, 2.0, 3.0),)
    assert numbers([Fraction(1, 2), 10**400 // 10**400], (2,), "x") == (0.5, 1.0)
    assert numbers([], (0,), "x") == ()
    assert [type(each) for each in numbers(np.float32([1, 2]), (2,), "x")] == [float, float]
    for values, shape in (([1.0], (1,)), ([[1.0, 2.0]], (1, 2)), (1.0, ()), ([[1.0], [2.0]], (2, 1))):
        refused(ValueError, lambda v=values: numbers(v, (2,), "x"), f"x has shape {shape}, expected (2,)")
    for value in (math.nan, math.inf, -math.inf):
        refused(ValueError, lambda v=value: numbers([1.0, v], (2,), "x"), "x has a number that is not finite")
    for values in (["1", "2"], [True, False], [1j, 2], [[1.0], 2.0]):
        refused(TypeError, lambda v=values: numbers(v, (2,), "x"), f"x must be numbers of shape (2,), got {values!r}")
