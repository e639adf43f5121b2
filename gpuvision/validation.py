"""Checks of parameters: finite numbers, integers, arrays of numbers, and the keys of tables (TOML, JSON)."""

from __future__ import annotations

import math
import operator
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np


def check_keys(
    table: Mapping[str, Any], allowed: Collection[str], required: Collection[str], what: str
) -> Mapping[str, Any]:
    """Return a table after a check that it has all required keys and no unknown key.

    Parameters
    ----------
    table : mapping
        Table with string keys.
    allowed, required : collection of str
        Keys that the table may have, and keys that it must have.
    what : str
        Name of the table for the message.

    Raises
    ------
    ValueError
        A key is unknown or missing. The message names the key, and lists the allowed keys.
    """
    for key in table:
        if key not in allowed:
            raise ValueError(f"{what}: unknown key '{key}', expected one of {', '.join(sorted(allowed))}")
    for key in required:
        if key not in table:
            raise ValueError(f"{what}: the key '{key}' is missing")
    return table


def finite(
    value: Any,
    what: str,
    *,
    minimum: float | None = None,
    above: float | None = None,
    maximum: float | None = None,
) -> float:
    """Return a finite number as a float; a bool or a text is not a number here.

    Parameters
    ----------
    value : number
        Value to check; NumPy numbers are accepted.
    what : str
        Name of the value for the message.
    minimum, maximum : float, optional
        Smallest and largest allowed value.
    above : float, optional
        Number that the value must exceed.

    Raises
    ------
    TypeError
        The value is not a number.
    ValueError
        The number is infinite or NaN, or out of its range.
    """
    if isinstance(value, bool | np.bool_ | str | bytes):
        raise TypeError(f"{what} must be a number, got {value!r}")
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise TypeError(f"{what} must be a number, got {value!r}") from None
    if not math.isfinite(number):
        raise ValueError(f"{what} must be finite, got {number}")
    limits = ((minimum, ">=", operator.ge), (above, ">", operator.gt), (maximum, "<=", operator.le))
    given = [(limit, sign, holds) for limit, sign, holds in limits if limit is not None]
    if not all(holds(number, limit) for limit, _, holds in given):
        expected = " and ".join(f"{sign} {limit:g}" for limit, sign, _ in given)
        raise ValueError(f"{what} is {value}, expected a number {expected}")
    return number


def integer(value: Any, what: str, *, minimum: int | None = None, maximum: int | None = None) -> int:
    """Return an integer as an int; a bool is not an integer here.

    Parameters
    ----------
    value : int
        Value to check; NumPy integers are accepted.
    what : str
        Name of the value for the message.
    minimum, maximum : int, optional
        Smallest and largest allowed value. A maximum needs a minimum.

    Raises
    ------
    TypeError
        The value is not an integer.
    ValueError
        The integer is below the minimum or above the maximum.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool):
        raise TypeError(f"{what} must be a whole number, got {value!r}")
    if (minimum is not None and number < minimum) or (maximum is not None and number > maximum):
        expected = f"{minimum} to {maximum}" if maximum is not None else f"at least {minimum}"
        raise ValueError(f"{what} is {number}, expected {expected}")
    return number


def numbers(values: Any, shape: tuple[int, ...], what: str) -> Any:
    """Return finite numbers of a given shape (one or two dimensions) as nested tuples of floats.

    Parameters
    ----------
    values : array_like
        Numbers of the shape.
    shape : tuple of int
        Expected shape: ``(n,)`` or ``(rows, columns)``.
    what : str
        Name of the values for the message.

    Raises
    ------
    TypeError
        A value is not a number.
    ValueError
        The shape differs, or a number is infinite or NaN.
    """
    try:
        given = np.asarray(values)
        # A bool, a text or a complex number is not a number here.
        array = given.astype(np.float64) if given.dtype.kind in "iufO" else None
    except (TypeError, ValueError):
        array = None
    if array is None:
        # Made here only: the text of an array takes about 30 us, and a servo loop checks arrays in each frame.
        raise TypeError(f"{what} must be numbers of shape {shape}, got {values!r}")
    if array.shape != shape:
        raise ValueError(f"{what} has shape {array.shape}, expected {shape}")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{what} has a number that is not finite")
    return tuple(map(tuple, array.tolist())) if array.ndim == 2 else tuple(array.tolist())
