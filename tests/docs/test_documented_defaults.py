"""Docstrings state each number that is a default, and these are the defaults of the signature."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from source_trees import tree_of

ROOT = Path(__file__).resolve().parents[2]
FILES = [path for folder in ("gpuvision", "host") for path in sorted((ROOT / folder).rglob("*.py"))]
# ``name : type`` or ``name`` and the indented lines below it, in a section of numpydoc.
_ENTRY = re.compile(r"^(?P<names>\w+(?:, \w+)*)(?: :[^\n]*)?\n(?P<text>(?:(?:[ ]{4}[^\n]*)?\n)+)", re.MULTILINE)
# A number, a pair, a word in code or a constant, with a unit or alone: "default 0.", "Default 50 um.", "0 (default)",
# "default ``"pairs"``", "default 10 (chosen)".
_NUMBER = r"-?\d[\d.]*?(?:e[-+]?\d+)?"
_VALUE = rf"(?:``(?P<code>[^`]+)``|(?P<plain>True|False|0[xo][\da-f]+|{_NUMBER}|\({_NUMBER}(?:, {_NUMBER})+\)))"
UNITS = {"mm": 1e-3, "ms": 1e-3, "mrad": 1e-3, "um": 1e-6, "nm": 1e-9, "m": 1.0, "s": 1.0, "rad": 1.0}
_DEFAULT = re.compile(
    rf"\b[Dd]efault:?\s+{_VALUE}(?:\s(?P<unit>{'|'.join(UNITS)}))?(?=[.,;:)]*(?:\s*$|[.,;:)]\s|\s\(|\n\n))"
)
_MARKED = re.compile(rf"(?<!\w){_VALUE}(?: \(default\)|, the default\b)")
# Defaults of all parameters of an entry: "Defaults 0.3 and 0.15."
_SHARED = re.compile(r"\bDefaults\s(?P<values>[^ ]+(?:,\s[^ ]+)*\sand\s[^ ]+)\.$", re.MULTILINE)


def _functions(path: Path) -> Iterator[tuple[str, str, dict[str, ast.expr]]]:
    """Yield name, docstring and defaults of each function and class of a module."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.FunctionDef):
            spec = node.args
            places = [*spec.posonlyargs, *spec.args]
            pairs = [*zip(places[len(places) - len(spec.defaults) :], spec.defaults, strict=True)]
            pairs += [(name, value) for name, value in zip(spec.kwonlyargs, spec.kw_defaults, strict=True) if value]
            yield node.name, ast.get_docstring(node) or "", {name.arg: value for name, value in pairs}
        elif isinstance(node, ast.ClassDef):
            fields = [each for each in node.body if isinstance(each, ast.AnnAssign) and each.value is not None]
            yield node.name, ast.get_docstring(node) or "", {ast.unparse(each.target): each.value for each in fields}


class Default(NamedTuple):
    """Default of a parameter in the source, and in the docstring; None if the docstring states none."""

    name: str
    value: object
    stated: object


@cache
def _documented() -> list[Default]:
    """Return the defaults of the parameters and members that a docstring describes."""
    found = []
    for path in FILES:
        for owner, text, defaults in _functions(path):
            for entry in _ENTRY.finditer(text + "\n"):
                names = [name for name in entry["names"].split(", ") if name in defaults]
                # An entry of several parameters may state its defaults in words: zip ends with the shorter sequence.
                for name, stated in zip(names, _stated(entry["text"], ", " in entry["names"]), strict=False):
                    value = _literal(defaults[name])
                    if value is not None:
                        found.append(Default(f"{path.relative_to(ROOT)}: {owner}.{name}", value, stated))
    return found


def _stated(text: str, is_shared: bool) -> list[object]:
    """Return the defaults that the text of an entry of one or several parameters states; none if it is in words."""
    if is_shared:
        shared = _SHARED.search(text.rstrip())
        return [_literal(each.strip("`")) for each in re.split(r",\s|\sand\s", shared["values"])] if shared else []
    for found in (*_DEFAULT.finditer(text), *_MARKED.finditer(text)):
        value, unit = _literal(found["code"] or found["plain"]), found.groupdict().get("unit")
        if value is not None:
            return [value * UNITS[unit] if unit and isinstance(value, int | float) else value]
    return [] if re.search("[Dd]efault", text) else [None]


def _literal(source: ast.expr | str) -> object:
    """Return a literal value; None for an expression, and for None, whose meaning the docstring states."""
    try:
        return ast.literal_eval(source)
    except (ValueError, SyntaxError):
        return None


def _is_number(value: object) -> bool:
    """Return whether a default is a number or has numbers as members."""
    return isinstance(value, int | float) or (isinstance(value, tuple) and value != () and all(map(_is_number, value)))


def _agree(value: object, stated: object) -> bool:
    if isinstance(value, tuple) and not isinstance(stated, tuple):
        return all(_agree(each, stated) for each in value)  # "default 0" of a pair is the default of each member
    if isinstance(value, float) and isinstance(stated, float):
        return math.isclose(value, stated, rel_tol=1e-12)  # a number of millimetres is rounded in metres
    return value == stated


def test_a_stated_default_is_the_default_of_the_signature() -> None:
    cases = [each for each in _documented() if each.stated is not None]
    assert len(cases) > 600
    wrong = [each for each in cases if not _agree(each.value, each.stated)]
    assert [f"{name}: the docstring states {stated}, the signature {value}" for name, value, stated in wrong] == []


def test_every_number_that_is_a_default_is_stated() -> None:
    """Thresholds that a user may change are in the documentation, and no change of a threshold goes unseen."""
    numbers = [each for each in _documented() if _is_number(each.value)]
    assert len(numbers) > 500
    missing = [each for each in numbers if each.stated is None]
    assert [f"{name}: state the default {value}" for name, value, _ in missing] == []
