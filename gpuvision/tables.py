"""Checks of plain tables (what a TOML file holds) and of the numbers in them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any


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
