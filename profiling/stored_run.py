"""Reader of the JSON files of ``gpuvision profile --json``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar

from gpuvision.host.errors import ReadError
from gpuvision.host.reading import reading
from gpuvision.profiling.run import Failure, Probe, Row, Run

T = TypeVar("T", Row, Failure, Probe)

# Values of each annotation in JSON. Whole numbers are written for floats, too; bool is an int in Python.
_TYPES: dict[str, tuple[type, ...]] = {
    "str": (str,),
    "int": (int,),
    "int | None": (int, type(None)),
    "float": (int, float),
    "float | None": (int, float, type(None)),
    "bool": (bool,),
}


def read_run(path: str | Path) -> Run:
    """Read a run that `Run.write` wrote, also one of an earlier version, which has fewer columns.

    Raises
    ------
    ReadError
        The file is not JSON, or not of a run.
    OSError
        The file cannot be read.
    """
    with reading(path, "JSON file", hint="gpuvision profile --json FILE writes one"):
        tree = json.loads(Path(path).read_text(encoding="utf-8"))
    if (
        not isinstance(tree, dict)
        or not isinstance(tree.get("machine"), dict)
        or not isinstance(tree.get("valid"), bool)
    ):
        raise ReadError(f"{path}: not a run of gpuvision profile; expected the keys machine, valid and rows")
    seconds = tree.get("seconds", 0.0)
    return Run(
        rows=[_object(Row, each, f"{path}: row {number}") for number, each in _numbered(tree, "rows", path)],
        valid=tree["valid"],
        machine=tree["machine"],
        failures=[_object(Failure, each, f"{path}: failure {n}") for n, each in _numbered(tree, "failures", path)],
        probes=[_object(Probe, each, f"{path}: probe {n}") for n, each in _numbered(tree, "probes", path)],
        seconds=float(seconds) if isinstance(seconds, int | float) else 0.0,
    )


def _numbered(tree: Mapping[str, Any], name: str, path: str | Path) -> list[tuple[int, Any]]:
    found = tree.get(name, [])
    if not isinstance(found, list):
        raise ReadError(f"{path}: {name} is {type(found).__name__}, expected a list")
    return list(enumerate(found, 1))


def _object(kind: type[T], tree: Any, place: str) -> T:
    """Return the dataclass of a JSON object; unknown keys of a row are its metadata."""
    if not isinstance(tree, dict):
        raise ReadError(f"{place} is {type(tree).__name__}, expected an object")
    values: dict[str, Any] = {}
    columns = [each for each in fields(kind) if each.name != "metadata"]
    for each in columns:
        if each.name not in tree:
            if each.default is MISSING:
                raise ReadError(f"{place}: {each.name} is missing")
            continue
        value = tree[each.name]
        expected = _TYPES[str(each.type)]
        if not isinstance(value, expected) or (isinstance(value, bool) and bool not in expected):
            raise ReadError(f"{place}: {each.name} is {value!r:.40}, expected {each.type}")
        values[each.name] = value
    if kind is Row:
        values["metadata"] = {name: value for name, value in tree.items() if name not in values}
    return kind(**values)
