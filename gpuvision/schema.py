"""Read a TOML description key by key, with messages that name the key, the unit and the allowed range.

The keys that a reader queries are the schema. `Section.finish` refuses every other key of the table and suggests the
closest queried key.
"""

from __future__ import annotations

import contextlib
import copy
import difflib
import math
import operator
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar, overload

from gpuvision.host.errors import GpuVisionError
from gpuvision.host.reading import FileLimit, one_line, reading, reason_of

Choice = TypeVar("Choice", bound=str)
_REQUIRED: Any = object()
# Largest magnitudes by unit. Larger numbers are typing errors, and would overflow float32 in later computations.
MAX_DESCRIPTION_BYTES = FileLimit("GPUVISION_MAX_DESCRIPTION_BYTES", 1 << 20)
"""Bytes of a TOML file. Chosen: 1 MiB, four times the largest file of features."""
MAX_NESTING = FileLimit("GPUVISION_MAX_NESTING", 32)
"""Depth of tables and arrays in a TOML file, and parts of a dotted key. Chosen: 32; gpuvision writes 4."""
_LARGEST = {"m": 1e6, "m per profile": 1e3, "pixel": 1e6}
_LARGEST_NUMBER = 1e20  # for all other units
_LARGEST_INTEGER = (1 << 31) - 1  # of a 32-bit integer


# Tokens of TOML that matter for the depth of its tables. Possessive quantifiers of characters keep the scan linear in
# the size. A possessive group with a negative lookahead matches too much before Python 3.11.5 (CPython issue 100061).
_TOKEN = re.compile(
    r"""(?P<part>\"{3}[^"\\]*+(?:(?:\\.|"(?!""))[^"\\]*+)*\"{3}|'{3}.*?'{3}"""
    r"""|"[^"\\\n]*+(?:\\.[^"\\\n]*+)*"|'[^'\n]*+'|[\w+-]++)"""
    r"|(?P<dot>\.)|(?P<open>[\[{])|(?P<close>[\]}])|#[^\n]*+|[=,\n]",
    re.DOTALL,
)
_LONGEST_SHOWN = 60  # characters of a key or a value in a message


class DescriptionError(GpuVisionError, ValueError):
    """Error in a TOML description; the message is one line with file, key, value and expected range."""


class Section:
    """Table of a description. Query its keys, then call `finish`.

    Parameters
    ----------
    table : mapping
        Parsed table.
    source : str
        File for messages: its path as the user gave it.
    name : str
        Dotted name of this table; empty for the whole file.
    folder : Path, optional
        Folder that relative file names in the table refer to; default: the current folder.
    """

    def __init__(self, table: Mapping[str, Any], source: str, name: str = "", *, folder: Path | None = None) -> None:
        self._table, self._source, self._name, self._folder = table, source, name, folder or Path()
        self._queried: list[str] = []
        self._files: list[Path] = []  # shared with the sub-tables

    def __contains__(self, key: str) -> bool:
        return key in self._table

    def to_dict(self) -> dict[str, Any]:
        """Return a copy of the table as in the file."""
        return copy.deepcopy(dict(self._table))

    @property
    def name(self) -> str:
        """Dotted name of this table."""
        return self._name

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that this table, or another table of the same description, names: all results of `file` so far."""
        return tuple(self._files)

    def dotted(self, key: str) -> str:
        """Return the full, dotted name of a key."""
        return f"{self._name}.{key}" if self._name else key

    def error(self, message: str) -> DescriptionError:
        """Return an error whose message starts with the file name."""
        return DescriptionError(f"{self._source}: {message}")

    @contextlib.contextmanager
    def checking(self) -> Iterator[None]:
        """Turn the errors of a class that checks values of this table into errors that name the file and the table."""
        try:
            yield
        except DescriptionError:
            raise
        except (ArithmeticError, TypeError, ValueError) as error:
            raise self.error(f"{self._name}: {error}" if self._name else str(error)) from error

    def section(self, key: str) -> Section:
        """Return a sub-table.

        Raises
        ------
        DescriptionError
            The key is missing, or its value is not a table.
        """
        value = self._value(key, "a table", _REQUIRED)
        if not isinstance(value, dict):
            raise self._value_error(key, value, "", f"a table [{self.dotted(key)}]")
        return self._below(value, self.dotted(key))

    def optional_section(self, key: str) -> Section | None:
        """Return a sub-table, or None if the key is missing."""
        self._queried.append(key)
        return self.section(key) if key in self else None

    def sections(self, key: str) -> tuple[Section, ...]:
        """Return the tables of an array of tables ``[[key]]``; an empty tuple if the key is missing.

        The name of each table ends with its number: ``key[0]``.

        Raises
        ------
        DescriptionError
            The value is not an array of tables.
        """
        tables = self._value(key, "tables", [])
        if not isinstance(tables, list) or not all(isinstance(each, dict) for each in tables):
            raise self._value_error(key, tables, "", f"tables [[{self.dotted(key)}]]")
        return tuple(self._below(each, f"{self.dotted(key)}[{n}]") for n, each in enumerate(tables))

    @overload
    def number(self, key: str, unit: str, default: float = ..., **limits: float) -> float: ...
    @overload
    def number(self, key: str, unit: str, default: None, **limits: float) -> float | None: ...
    def number(self, key: str, unit: str, default: Any = _REQUIRED, **limits: float) -> float | None:
        """Return a number.

        Parameters
        ----------
        key : str
            Name of the key.
        unit : str
            Unit for the messages; empty for a number without a unit.
        default : float or None, optional
            Value for a missing key. Without a default a missing key is an error.
        **limits : float
            Range: any of ``above``, ``at_least``, ``below``, ``at_most``.

        Raises
        ------
        DescriptionError
            The key is missing, or its value is not a number or out of range.
        """
        value = self._value(key, _expected(unit, limits), default)
        return value if value is default else self._check_number(key, value, unit, limits)

    @overload
    def integer(self, key: str, default: int = ..., **limits: float) -> int: ...
    @overload
    def integer(self, key: str, default: None, **limits: float) -> int | None: ...
    def integer(self, key: str, default: Any = _REQUIRED, **limits: float) -> int | None:
        """Return a whole number; parameters and errors as for `number`."""
        expected = _expected("", limits).replace("number", "whole number", 1)
        value = self._value(key, expected, default)
        if value is default:
            return value if value is None else int(value)
        if isinstance(value, bool) or not isinstance(value, int) or not _within(value, limits):
            raise self._value_error(key, value, "", expected)
        if abs(value) > _LARGEST_INTEGER:
            raise self._value_error(key, value, "", f"a whole number of at most {_LARGEST_INTEGER}")
        return value

    @overload
    def numbers(
        self, key: str, unit: str, counts: Sequence[int], default: tuple[float, ...] = ...
    ) -> tuple[float, ...]: ...
    @overload
    def numbers(self, key: str, unit: str, counts: Sequence[int], default: None) -> tuple[float, ...] | None: ...
    def numbers(self, key: str, unit: str, counts: Sequence[int], default: Any = _REQUIRED) -> Any:
        """Return a list of finite numbers whose length is one of ``counts``; other parameters as for `number`."""
        expected = f"a list of {' or '.join(map(str, counts))} numbers{_unit_suffix(unit)}"
        value = self._value(key, expected, default)
        if value is default:
            return value
        if not isinstance(value, list) or len(value) not in counts:
            raise self._value_error(key, value, "", expected)
        return tuple(self._check_number(key, each, unit, {}) for each in value)

    def rows(self, key: str, unit: str, width: int | None = None, default: Any = _REQUIRED) -> Any:
        """Return at least one row of finite numbers; all have the length ``width`` if given; otherwise as `number`."""
        expected = f"a list of rows of {'' if width is None else f'{width} '}numbers{_unit_suffix(unit)}"
        value = self._value(key, expected, default)
        if value is default:
            return value
        rows: list[Any] = value if isinstance(value, list) else [None]
        if not rows or not all(isinstance(row, list) and row and len(row) == (width or len(row)) for row in rows):
            raise self._value_error(key, value, "", expected)
        return tuple(tuple(self._check_number(key, each, unit, {}) for each in row) for row in rows)

    @overload
    def choice(self, key: str, choices: Sequence[Choice], default: Choice = ...) -> Choice: ...
    @overload
    def choice(self, key: str, choices: Sequence[Choice], default: None) -> Choice | None: ...
    def choice(self, key: str, choices: Sequence[Choice], default: Any = _REQUIRED) -> Choice | None:
        """Return a string that must be one of ``choices``; errors as for `number`."""
        expected = "one of " + ", ".join(f'"{each}"' for each in choices)
        value: Choice | None = self._value(key, expected, default)
        if value is not default and value not in choices:
            close = difflib.get_close_matches(value[:_LONGEST_SHOWN], choices, 1) if isinstance(value, str) else []
            raise self._value_error(key, value, "", expected + (f' (did you mean "{close[0]}"?)' if close else ""))
        return value

    @overload
    def text(self, key: str, default: str = ...) -> str: ...
    @overload
    def text(self, key: str, default: None) -> str | None: ...
    def text(self, key: str, default: Any = _REQUIRED) -> str | None:
        """Return a string; errors as for `number`."""
        value = self._value(key, "text", default)
        if value is not default and not isinstance(value, str):
            raise self._value_error(key, value, "", "text")
        found: str | None = value
        return found

    def word(self, key: str, words: Sequence[Choice]) -> Choice | None:
        """Return the value if it is one of ``words``; None for another value, or where the key is missing.

        For a key that takes a word or another kind of value: call the method for that kind where this one returns None.
        """
        self._queried.append(key)
        value = self._table.get(key)
        return next((each for each in words if each == value), None)

    def file(self, key: str) -> Path:
        """Return a file name; a relative name refers to the folder of the description. Errors as for `number`."""
        name = self.text(key)
        if not name or "\0" in name:
            raise self._value_error(key, name, "", "the name of a file")
        self._files.append(self._folder / name)
        return self._files[-1]

    def finish(self) -> None:
        """Check that every key of the table was queried.

        Raises
        ------
        DescriptionError
            A key is unknown; the message names the closest known key.
        """
        for key in self._table:
            if key not in self._queried:
                close = difflib.get_close_matches(key, self._queried, 1)
                known = ", ".join(dict.fromkeys(self._queried)) or "none"
                hint = f"did you mean '{self.dotted(close[0])}'?" if close else f"known: {known}"
                raise self.error(f"unknown key '{_shown(self.dotted(key))}'; {hint}")

    def _below(self, table: Mapping[str, Any], name: str) -> Section:
        """Return a sub-table; it shares the list of named files with this table."""
        below = Section(table, self._source, name, folder=self._folder)
        below._files = self._files
        return below

    def _value(self, key: str, expected: str, default: Any) -> Any:
        self._queried.append(key)
        if key in self._table:
            return self._table[key]
        if default is _REQUIRED:
            unknown = [each for each in self._table if each not in self._queried]
            close = difflib.get_close_matches(key, unknown, 1)
            hint = f" (is it '{_shown(self.dotted(close[0]))}'?)" if close else ""
            raise self.error(f"the key '{self.dotted(key)}' is missing, expected {expected}{hint}")
        return default

    def _check_number(self, key: str, value: Any, unit: str, limits: Mapping[str, float]) -> float:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        # math.isfinite raises OverflowError for an integer that exceeds the range of a float: all integers are finite.
        is_finite = is_number and (isinstance(value, int) or math.isfinite(value))
        if not is_finite or not _within(value, limits):
            raise self._value_error(key, value, unit if is_number else "", _expected(unit, limits))
        largest = _LARGEST.get(unit, _LARGEST_NUMBER)
        if abs(value) > largest:
            raise self._value_error(key, value, unit, f"a size of at most {largest:g}")
        return float(value)

    def _value_error(self, key: str, value: Any, unit: str, expected: str) -> DescriptionError:
        shown = _shown(f"{_represented(value)} {unit}".rstrip())
        return self.error(f"{self.dotted(key)} is {shown}, expected {expected}")


def preset_names(folder: str) -> tuple[str, ...]:
    """Return the names of the presets in a folder of ``gpuvision/presets``, in order."""
    return tuple(sorted(Path(each.name).stem for each in _presets(folder).iterdir()))


def _presets(folder: str) -> Traversable:
    return resources.files("gpuvision").joinpath("presets", folder)


def read_preset(path: str | Path, folder: str, kind: str) -> Section:
    """Read a TOML file, or a preset of the package by its name.

    Parameters
    ----------
    path : str or Path
        Path of a file, or one of `preset_names`.
    folder : str
        Folder of ``gpuvision/presets``.
    kind : str
        Content of the file, for error messages.

    Returns
    -------
    Section
        Table of the whole file.

    Raises
    ------
    FileNotFoundError
        There is no such file and no such preset; the message names the presets.
    OSError, DescriptionError
        As `read_toml`.
    """
    names = preset_names(folder)
    if str(path) in names:
        with resources.as_file(_presets(folder) / f"{path}.toml") as file:
            return _read_toml(file, f"preset {path}")
    path = Path(path)
    if not path.exists():
        close = difflib.get_close_matches(path.stem, names, 1)
        hint = f"did you mean '{close[0]}'?" if close else f"give a file or one of {', '.join(names)}"
        raise FileNotFoundError(f"there is no {kind} file {one_line(str(path))}; {hint}")
    return read_toml(path)


def read_toml(path: Path) -> Section:
    """Read a TOML file.

    Parameters
    ----------
    path : Path
        The messages show it as it is given, relative or absolute.

    Returns
    -------
    Section
        Table of the whole file.

    Raises
    ------
    OSError
        The file cannot be read, or it is a folder.
    DescriptionError
        The file is not valid TOML; the message has line and column.
    """
    return _read_toml(path, one_line(str(path)))


def _read_toml(path: Path, source: str) -> Section:
    """Read a TOML file; the messages call it `source`."""
    if path.is_dir():
        raise IsADirectoryError(f"{source}: a folder, expected a TOML file")
    with reading(source, "TOML file", DescriptionError):
        try:
            with path.open("rb") as file:
                content = file.read(int(MAX_DESCRIPTION_BYTES.value) + 1)
            MAX_DESCRIPTION_BYTES.check(len(content), f"{source}: {len(content)} bytes", DescriptionError)
            text = content.decode("utf-8")
            _check_nesting(text, source)
            return Section(tomllib.loads(text), source, folder=path.parent)
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise DescriptionError(f"{source}: not valid TOML: {reason_of(error)}") from None


def _check_nesting(text: str, source: str) -> None:
    """Check the depth of a TOML file before it is parsed: the parser's time and memory grow with its square.

    Raises
    ------
    DescriptionError
        Arrays and tables are nested, or a key has parts, beyond `MAX_NESTING`.
    """
    depth = deepest = parts = longest = 0
    before = None
    for token in _TOKEN.finditer(text):
        kind = token.lastgroup
        if kind == "open":
            depth += 1
            deepest = max(deepest, depth)
        elif kind == "close":
            depth -= 1
        if kind == "part":
            parts = parts + 1 if before == "dot" else 1
            longest = max(longest, parts)
        before = kind
    MAX_NESTING.check(deepest, f"{source}: nested {deepest} deep", DescriptionError)
    MAX_NESTING.check(longest, f"{source}: a key of {longest} parts", DescriptionError)


def _shown(text: str) -> str:
    """Return a key or a value for a message: printable, and cut where it is long."""
    short = text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN - 4]} ..."
    return one_line(short)


def _represented(value: Any) -> str:
    """Return the representation of a value; of an integer beyond Python's limit of digits its number of bits."""
    try:
        return repr(value)
    except ValueError:
        return f"a number of {value.bit_length()} bits" if isinstance(value, int) else "a list of very large numbers"


_TESTS: dict[str, tuple[str, Callable[[float, float], bool]]] = {
    "above": ("above", operator.gt),
    "at_least": ("of at least", operator.ge),
    "below": ("below", operator.lt),
    "at_most": ("of at most", operator.le),
}


def _within(value: float, limits: Mapping[str, float]) -> bool:
    return all(_TESTS[name][1](value, limit) for name, limit in limits.items())


def _unit_suffix(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _expected(unit: str, limits: Mapping[str, float]) -> str:
    bounds = " and ".join(f"{_TESTS[name][0]} {limit:g}" for name, limit in limits.items())
    return f"a number{_unit_suffix(unit)}{' ' if bounds else ''}{bounds}"
