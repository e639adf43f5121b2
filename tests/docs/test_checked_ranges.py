"""Ranges of numbers that functions and classes check are the ranges that their docstrings state."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from source_trees import tree_of

ROOT = Path(__file__).resolve().parents[2]
FILES = [path for folder in ("gpuvision", "host") for path in sorted((ROOT / folder).rglob("*.py"))]
_ENTRY = re.compile(r"^(?P<names>\w+(?:, \w+)*)(?: :[^\n]*)?\n(?P<text>(?:(?:[ ]{4}[^\n]*)?\n)+)", re.MULTILINE)
_NUMBER = r"(-?\d+(?:\.\d+)?(?:e-?\d+)?)"
# Phrases of docstrings, and the bounds that they state.
_PHRASES = (
    (rf"\b[Aa]bove {_NUMBER}(?:,? at most| to| and below) {_NUMBER}", ("above", "maximum")),
    (rf"\b[Aa]bove {_NUMBER}", ("above",)),
    (rf"\b{_NUMBER} to {_NUMBER}", ("minimum", "maximum")),
    (rf"\b{_NUMBER} or more", ("minimum",)),
    (rf"\bat least {_NUMBER}", ("minimum",)),
    (rf">= {_NUMBER}", ("minimum",)),
    (r"\bpositive()\b", ("above",)),
)
OTHERS = {
    "gpuvision/servoing/low_latency.py: low_latency.priority",  # 1 to 99, or 0 for none
    "gpuvision/matching/pose/pose.py: SolvePose.max_trials",  # a multiple of 16
}


# Names and docstring entries of the classes and functions around a place of the source, from the outside.
Owners = tuple[tuple[str, dict[str, str]], ...]
# Variable of the innermost loop over names of members, and these names.
Loop = tuple[str, tuple[str, ...]]


class Check(NamedTuple):
    """Checked parameter: bounds of the call, and text of the docstring."""

    name: str
    bounds: dict[str, float]
    text: str


def _entries(node: ast.AST) -> dict[str, str]:
    """Return the text of each parameter of a docstring."""
    text = ast.get_docstring(node) or "" if isinstance(node, ast.ClassDef | ast.FunctionDef) else ""
    found: dict[str, str] = {}
    for entry in _ENTRY.finditer(text + "\n"):
        found |= dict.fromkeys(entry["names"].split(", "), " ".join(entry["text"].split()))
    return found


def _checks(node: ast.AST, owners: Owners = (), loop: Loop = ("", ())) -> Iterator[Check]:
    """Yield the checks `finite` and `integer` with constant bounds, one for each documented name that they check."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef | ast.FunctionDef):
            yield from _checks(child, (*owners, (child.name, _entries(child))))
            continue
        if isinstance(child, ast.Call) and ast.unparse(child.func) in ("finite", "integer"):
            bounds = {str(each.arg): each.value for each in child.keywords}
            constant = {key: value.value for key, value in bounds.items() if isinstance(value, ast.Constant)}
            if constant and len(constant) == len(bounds):
                numbers = {key: float(value) for key, value in constant.items() if isinstance(value, int | float)}
                for owner, name, text in _documented(child, owners, loop):
                    yield Check(f"{owner}.{name}", numbers, text)
        yield from _checks(child, owners, _loop_over_names(child) or loop)


def _loop_over_names(node: ast.AST) -> Loop | None:
    """Return the variable and the strings of ``for name in ("a", "b")``; None for another node."""
    if not (isinstance(node, ast.For) and isinstance(node.target, ast.Name) and isinstance(node.iter, ast.Tuple)):
        return None
    return node.target.id, tuple(str(each.value) for each in node.iter.elts if isinstance(each, ast.Constant))


def _documented(call: ast.Call, owners: Owners, loop: Loop) -> list[tuple[str, str, str]]:
    """Return owner, name and text of the docstring entries of a checked number.

    Parameters are in the docstring of the function, or of the class for `__init__`; members in that of the class. In
    these methods the message names a number without a name of its own (``for each in self.gains``).
    """
    given, message = ast.unparse(call.args[0]), call.args[1]
    names = loop[1] if given == f"getattr(self, {loop[0]})" else (given.removeprefix("self."),)
    builds = owners[-1][0] in ("__init__", "__post_init__")
    near = owners[-2:] if builds or given.startswith("self.") else owners[-1:]
    found = [(owner, name, text[name]) for name in names for owner, text in reversed(near) if name in text]
    if not found and builds and isinstance(message, ast.Constant):
        label = str(message.value).partition(" [")[0].rpartition(".")[2]
        found = [(owner, label, text[label]) for owner, text in near if label in text]
    return found


def _stated(text: str) -> dict[str, float]:
    """Return the bounds of the first phrase in the text of a docstring."""
    found = [(match, names) for phrase, names in _PHRASES for match in re.finditer(phrase, text)]
    if not found:
        return {}
    match, names = min(found, key=lambda pair: pair[0].start())  # of equal places the first, longest phrase
    return {name: float(value or 0) for name, value in zip(names, match.groups(), strict=True)}


def test_a_checked_range_is_the_stated_one() -> None:
    checks = [
        each._replace(name=f"{path.relative_to(ROOT)}: {each.name}")
        for path in FILES
        for each in _checks(tree_of(path))
    ]
    assert len(checks) > 100
    wrong = [each for each in checks if _stated(each.text) != each.bounds and each.name not in OTHERS]
    assert [
        f"{name}: the check has {bounds}, the docstring states {_stated(text)}" for name, bounds, text in wrong
    ] == []
