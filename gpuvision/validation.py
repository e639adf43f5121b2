"""Plain tables, as TOML and JSON files hold them: checks of their keys and numbers, and what JSON has no word for."""

from __future__ import annotations

import math
import operator
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np


def checked_keys(
    table: Mapping[str, Any], allowed: Collection[str], required: Collection[str], what: str
) -> Mapping[str, Any]:
    """Return the table if it has all required keys and none that is not allowed.

    Raises
    ------
    ValueError
        Names the key, and those that are known.
    """
    for key in table:
        if key not in allowed:
            raise ValueError(f"{what}: unknown key '{key}', expected one of {', '.join(sorted(allowed))}")
    for key in required:
        if key not in table:
            raise ValueError(f"{what}: the key '{key}' is missing")
    return table


def finite(value: Any, what: str) -> float:
    """Return a number as a float.

    Raises
    ------
    TypeError
        It is no number.
    ValueError
        It is infinite or NaN.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise TypeError(f"{what} must be a number, got {value!r}") from None
    if not math.isfinite(number):
        raise ValueError(f"{what} must be finite, got {number}")
    return number


def whole(value: Any, what: str, *, least: int | None = None, most: int | None = None) -> int:
    """Return a count as an int; a bool is none.

    Raises
    ------
    TypeError
        It is no whole number.
    ValueError
        It is less than the least, or more than the most.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool):
        raise TypeError(f"{what} must be a whole number, got {value!r}")
    if (least is not None and number < least) or (most is not None and number > most):
        expected = f"{least} to {most}" if most is not None else f"at least {least}"
        raise ValueError(f"{what} is {number}, expected {expected}")
    return number


def numbers(values: Any, shape: tuple[int, ...], what: str) -> Any:
    """Return an array of numbers, of one or two dimensions, as nested tuples of floats.

    Raises
    ------
    TypeError
        They are no numbers.
    ValueError
        The shape is another one, or a number is infinite or NaN.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"{what} must be numbers of shape {shape}, got {values!r}") from None
    if array.shape != shape:
        raise ValueError(f"{what} has shape {array.shape}, expected {shape}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{what} has a number that is not finite")
    return tuple(map(tuple, array.tolist())) if array.ndim == 2 else tuple(array.tolist())
