"""Read a TOML description key by key, with messages that name the key, the unit and the allowed range.

What a reader asks for is the schema: every key that nobody asked for is an error, and what it could have meant is
found among those that were asked for.
"""

from __future__ import annotations

import difflib
import math
import operator
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, overload

Choice = TypeVar("Choice", bound=str)
_REQUIRED: Any = object()
# Larger numbers are slips, and would leave single precision somewhere on their way to a point.
_LARGEST = {"m": 1e6, "m per profile": 1e3, "pixel": 1e6}
_LARGEST_OF_ALL = 1e20
_LARGEST_WHOLE = (1 << 31) - 1


class DescriptionError(ValueError):
    """A description says something that it cannot say; one line with file, key, value and what was expected."""


class Section:
    """A table of a description; ask it for its keys, then `finish` it.

    Parameters
    ----------
    table
        What TOML gave.
    source
        The file's name, for messages.
    name
        Dotted name of this table; empty for the whole file.
    """

    def __init__(self, table: Mapping[str, Any], source: str, name: str = "") -> None:
        self._table, self._source, self._name = table, source, name
        self._known: list[str] = []

    def __contains__(self, key: str) -> bool:
        return key in self._table

    @property
    def name(self) -> str:
        """Dotted name of this table."""
        return self._name

    def dotted(self, key: str) -> str:
        """Return the key's full name."""
        return f"{self._name}.{key}" if self._name else key

    def error(self, message: str) -> DescriptionError:
        """Return an error about this file."""
        return DescriptionError(f"{self._source}: {message}")

    def section(self, key: str) -> Section:
        """Return a table within this one.

        Raises
        ------
        DescriptionError
            It is missing, or no table.
        """
        value = self._value(key, "a table", _REQUIRED)
        if not isinstance(value, dict):
            raise self._wrong(key, value, "", f"a table [{self.dotted(key)}]")
        return Section(value, self._source, self.dotted(key))

    def optional_section(self, key: str) -> Section | None:
        """Return a table within this one, or None where there is none."""
        self._known.append(key)
        return self.section(key) if key in self else None

    def sections(self, key: str) -> tuple[Section, ...]:
        """Return the tables of an array of tables ``[[key]]``, named with their numbers; none where it is missing.

        Raises
        ------
        DescriptionError
            It is no array of tables.
        """
        tables = self._value(key, "tables", [])
        if not isinstance(tables, list) or not all(isinstance(each, dict) for each in tables):
            raise self._wrong(key, tables, "", f"tables [[{self.dotted(key)}]]")
        return tuple(Section(each, self._source, f"{self.dotted(key)}[{n}]") for n, each in enumerate(tables))

    @overload
    def number(self, key: str, unit: str, default: float = ..., **limits: float) -> float: ...
    @overload
    def number(self, key: str, unit: str, default: None, **limits: float) -> float | None: ...
    def number(self, key: str, unit: str, default: Any = _REQUIRED, **limits: float) -> float | None:
        """Return a number.

        Parameters
        ----------
        key, unit
            Its name, and its unit for the messages (empty for a pure number).
        default
            What a missing key means; without one it is an error.
        **limits
            ``above``, ``at_least``, ``below``, ``at_most``.

        Raises
        ------
        DescriptionError
            It is missing, no number, or out of its range.
        """
        value = self._value(key, _expected(unit, limits), default)
        return value if value is default else self._checked(key, value, unit, limits)

    @overload
    def integer(self, key: str, default: int = ..., **limits: float) -> int: ...
    @overload
    def integer(self, key: str, default: None, **limits: float) -> int | None: ...
    def integer(self, key: str, default: Any = _REQUIRED, **limits: float) -> int | None:
        """Return a whole number; as `number`."""
        expected = _expected("", limits).replace("number", "whole number", 1)
        value = self._value(key, expected, default)
        if value is default:
            return value if value is None else int(value)
        if isinstance(value, bool) or not isinstance(value, int) or not _within(value, limits):
            raise self._wrong(key, value, "", expected)
        if abs(value) > _LARGEST_WHOLE:
            raise self._wrong(key, value, "", f"a whole number of at most {_LARGEST_WHOLE}")
        return value

    @overload
    def numbers(
        self, key: str, unit: str, counts: Sequence[int], default: tuple[float, ...] = ...
    ) -> tuple[float, ...]: ...
    @overload
    def numbers(self, key: str, unit: str, counts: Sequence[int], default: None) -> tuple[float, ...] | None: ...
    def numbers(self, key: str, unit: str, counts: Sequence[int], default: Any = _REQUIRED) -> Any:
        """Return a list of finite numbers, of one of the lengths; as `number`."""
        expected = f"a list of {' or '.join(map(str, counts))} numbers{_in(unit)}"
        value = self._value(key, expected, default)
        if value is default:
            return value
        if not isinstance(value, list) or len(value) not in counts:
            raise self._wrong(key, value, "", expected)
        return tuple(self._checked(key, each, unit, {}) for each in value)

    def rows(self, key: str, unit: str, width: int | None = None, default: Any = _REQUIRED) -> Any:
        """Return a list of rows of finite numbers, one row at least, of one width if it is given; as `number`."""
        expected = f"a list of rows of {'' if width is None else f'{width} '}numbers{_in(unit)}"
        value = self._value(key, expected, default)
        if value is default:
            return value
        rows: list[Any] = value if isinstance(value, list) else [None]
        if not rows or not all(isinstance(row, list) and row and len(row) == (width or len(row)) for row in rows):
            raise self._wrong(key, value, "", expected)
        return tuple(tuple(self._checked(key, each, unit, {}) for each in row) for row in rows)

    @overload
    def choice(self, key: str, choices: Sequence[Choice], default: Choice = ...) -> Choice: ...
    @overload
    def choice(self, key: str, choices: Sequence[Choice], default: None) -> Choice | None: ...
    def choice(self, key: str, choices: Sequence[Choice], default: Any = _REQUIRED) -> Choice | None:
        """Return one of some words; as `number`."""
        expected = "one of " + ", ".join(f'"{each}"' for each in choices)
        value: Choice | None = self._value(key, expected, default)
        if value is not default and value not in choices:
            close = difflib.get_close_matches(str(value), choices, 1)
            raise self._wrong(key, value, "", expected + (f' (did you mean "{close[0]}"?)' if close else ""))
        return value

    @overload
    def text(self, key: str, default: str = ...) -> str: ...
    @overload
    def text(self, key: str, default: None) -> str | None: ...
    def text(self, key: str, default: Any = _REQUIRED) -> str | None:
        """Return a string; as `number`."""
        value = self._value(key, "text", default)
        if value is not default and not isinstance(value, str):
            raise self._wrong(key, value, "", "text")
        found: str | None = value
        return found

    def finish(self) -> None:
        """Check that every key was asked for.

        Raises
        ------
        DescriptionError
            A key is unknown; says which known one it could mean.
        """
        for key in self._table:
            if key not in self._known:
                close = difflib.get_close_matches(key, self._known, 1)
                hint = f"did you mean '{self.dotted(close[0])}'?" if close else f"known: {', '.join(self._known)}"
                raise self.error(f"unknown key '{self.dotted(key)}'; {hint}")

    def _value(self, key: str, expected: str, default: Any) -> Any:
        self._known.append(key)
        if key in self._table:
            return self._table[key]
        if default is _REQUIRED:
            unknown = [each for each in self._table if each not in self._known]
            close = difflib.get_close_matches(key, unknown, 1)
            hint = f" (is it '{self.dotted(close[0])}'?)" if close else ""
            raise self.error(f"the key '{self.dotted(key)}' is missing, expected {expected}{hint}")
        return default

    def _checked(self, key: str, value: Any, unit: str, limits: Mapping[str, float]) -> float:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        # A whole number of TOML may be too large for a float: look at its size first.
        is_finite = is_number and (isinstance(value, int) or math.isfinite(value))
        if not is_finite or not _within(value, limits):
            raise self._wrong(key, value, unit if is_number else "", _expected(unit, limits))
        largest = _LARGEST.get(unit, _LARGEST_OF_ALL)
        if abs(value) > largest:
            raise self._wrong(key, value, unit, f"a size of at most {largest:g}")
        return float(value)

    def _wrong(self, key: str, value: Any, unit: str, expected: str) -> DescriptionError:
        shown = f"{value!r} {unit}".rstrip()
        if len(shown) > 60:
            shown = f"{shown[:56]} ..."
        return self.error(f"{self.dotted(key)} is {shown}, expected {expected}")


def read_toml(path: Path) -> Section:
    """Read a TOML file.

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        It is no TOML; the message has line and column.
    """
    try:
        return Section(tomllib.loads(path.read_text(encoding="utf-8")), path.name)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DescriptionError(f"{path.name}: not valid TOML: {error}") from None


_TESTS: dict[str, tuple[str, Callable[[float, float], bool]]] = {
    "above": ("above", operator.gt),
    "at_least": ("of at least", operator.ge),
    "below": ("below", operator.lt),
    "at_most": ("of at most", operator.le),
}


def _within(value: float, limits: Mapping[str, float]) -> bool:
    return all(_TESTS[name][1](value, limit) for name, limit in limits.items())


def _in(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _expected(unit: str, limits: Mapping[str, float]) -> str:
    bounds = " and ".join(f"{_TESTS[name][0]} {limit:g}" for name, limit in limits.items())
    return f"a number{_in(unit)}{' ' if bounds else ''}{bounds}"
