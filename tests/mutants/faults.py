"""Faults that the mutation tests plant: the planted faults, and faults drawn at random from code and kernels."""

from __future__ import annotations

import ast
import random
import re
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosmic_ray.ast import Visitor, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).resolve().parents[2]
PLANTED, EQUIVALENT = (Path(__file__).with_name(f"{name}.toml") for name in ("planted", "equivalent"))
# Operators of Cosmic Ray that leave a plausible program: no shifts or bit operations of floats, no identity of numbers.
_PLAUSIBLE = re.compile(
    r"ReplaceBinaryOperator_(Add|Sub|Mul|Div|FloorDiv|Mod|Pow)_(Add|Sub|Mul|Div)$"
    r"|ReplaceBinaryOperator_Bit(Or|And)_Bit(Or|And)$"
    r"|ReplaceComparisonOperator_(Eq|NotEq|Lt|LtE|Gt|GtE)_(Eq|NotEq|Lt|LtE|Gt|GtE)$"
    r"|ReplaceComparisonOperator_Is(Not)?_Is(Not)?$"
    r"|ReplaceUnaryOperator_Delete_|AddNot$|Replace(True|False|And|Or|Break|Continue)With|NumberReplacer$|ZeroIteration"
)
# Changes of a kernel: pattern, and replacement.
_KERNEL_CHANGES: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r" <= ", " < "),
    (r" < ", " <= "),
    (r" >= ", " > "),
    (r" > ", " >= "),
    (r" == ", " != "),
    (r" && ", " || "),
    (r" \|\| ", " && "),
    (r" \+ ", " - "),
    (r" - ", " + "),
    (r" \* ", " / "),
    (r" \+= ", " -= "),
    (r"\bfmax\(", "fmin("),
    (r"\bfmin\(", "fmax("),
    (r"(?<![\w.])\d+\.\d+", lambda number: str(1.1 * float(number[0]) or 0.1)),
    (r"(?<![\w.])[1-9](?=[;,)\]])", lambda number: str(int(number[0]) - 1)),
)
# Keyword arguments of figures that set only the sizes of panes, text, lines and markers, or their transparency: no
# statement about data. They are not changed in `gpuvision/plots`; every other number of a figure is.
_APPEARANCE = re.compile(
    "figsize|height_ratios|width_ratios|fontsize|labelsize|labelpad|linewidths?|markersize|markeredgewidth|alpha"
)
# Lines of kernels that only choose which memory is loaded into the caches early: no result depends on them, and no
# address is invalid ("Data prefetch does not generate faults if addr is invalid": GCC, `__builtin_prefetch`).
_PREFETCH = re.compile(r"\bprefetch_\w+\(|__builtin_prefetch\(")
_NO_CODE = re.compile(r"//[^\n]*|/\*.*?\*/|^[ \t]*#(?:[^\n]*\\\n)*[^\n]*", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Fault:
    """Change of one place of a source file.

    Attributes
    ----------
    file : str
        Path from the root of the repository.
    start, end : int
        Characters of the file that are replaced.
    replacement : str
        Text in their place.
    tests : tuple of str
        Tests that find it, where they are known.
    """

    file: str
    start: int
    end: int
    replacement: str
    tests: tuple[str, ...] = ()

    def planted(self, text: str) -> str:
        """Return the text of the file with the fault."""
        return text[: self.start] + self.replacement + text[self.end :]

    def lines(self, text: str) -> range:
        """Return the numbers of the lines with the place."""
        return range(text.count("\n", 0, self.start) + 1, text.count("\n", 0, self.end) + 2)

    def row(self, text: str) -> dict[str, str | int]:
        """Return the line before and after, as in the report."""
        line = self.lines(text)[0]
        before, after = (content.splitlines()[line - 1].strip() for content in (text, self.planted(text)))
        return {"file": self.file, "line": line, "before": before, "after": after}


def planted_faults() -> list[Fault]:
    """Return the faults of the list."""
    faults = []
    for entry in tomllib.loads(PLANTED.read_text())["fault"]:
        start = (ROOT / entry["file"]).read_text().index(entry["find"])
        end = start + len(entry["find"])
        faults.append(Fault(entry["file"], start, end, entry["replace"], tuple(entry["tests"])))
    return faults


def draw_faults(
    rng: random.Random, count: int, *, kernel_share: float, only: tuple[str, ...] = ("",)
) -> Iterator[Fault]:
    """Yield faults in Python files and in kernels; a file is drawn by its size, a place within it at random.

    Faults in the list of equivalent faults are omitted.

    Parameters
    ----------
    rng : random.Random
        Random numbers.
    count : int
        Number of faults.
    kernel_share : float
        Share of the faults that are in kernels, if there are files of both kinds.
    only : tuple of str
        Starts of paths: faults are drawn in these files only.
    """
    python = _chosen(only, [path for folder in ("gpuvision", "host") for path in (ROOT / folder).rglob("*.py")])
    opencl = _chosen(only, [path for path in (ROOT / "kernels").rglob("*") if path.suffix in (".cl", ".h")])
    kernels = (round(kernel_share * count) if python else count) if opencl else 0
    drawn = set()
    equivalent = tomllib.loads(EQUIVALENT.read_text())["fault"]
    for files, draw, share in ((python, _code_fault, count - kernels), (opencl, _kernel_fault, kernels)):
        sizes = [path.stat().st_size for path in files]
        enough = len(drawn) + share
        while len(drawn) < enough:
            fault = draw(rng.choices(files, sizes)[0], rng)
            if fault is None or fault in drawn:
                continue
            row = fault.row((ROOT / fault.file).read_text())
            if any(all(row[key] == each[key] for key in ("file", "before", "after")) for each in equivalent):
                continue
            drawn.add(fault)
            yield fault


def _chosen(only: tuple[str, ...], paths: list[Path]) -> list[Path]:
    """Return the paths that begin with one of the starts, sorted."""
    return sorted(path for path in paths if str(path.relative_to(ROOT)).startswith(only))


def _code_fault(path: Path, rng: random.Random) -> Fault | None:
    """Return a change of a Python file by an operator of Cosmic Ray; None if it does not change the behaviour."""
    text = path.read_text()
    places = _Places(text).found
    if not places:
        return None
    name, occurrence = rng.choice(places[rng.choice(sorted(places))])
    changed = mutate_code(text, get_operator(name)(), occurrence)
    if changed is None or _behaviour(changed) in (None, _behaviour(text)):
        return None
    start = next(k for k, (old, new) in enumerate(zip(text, changed, strict=False)) if old != new)
    rest = min(len(text), len(changed)) - start
    same = next((k for k in range(rest) if text[-1 - k] != changed[-1 - k]), rest)
    if path.parent == ROOT / "gpuvision" / "plots" and _is_appearance(text, start):
        return None
    return Fault(str(path.relative_to(ROOT)), start, len(text) - same, changed[start : len(changed) - same])


def _is_appearance(text: str, place: int) -> bool:
    """Return whether a character of a Python file belongs to a keyword argument that `_APPEARANCE` matches."""
    lines = text[:place].split("\n")
    at = (len(lines), len(lines[-1].encode()))  # columns of the syntax tree are bytes
    return any(
        _APPEARANCE.fullmatch(each.arg or "")
        and (each.lineno, each.col_offset) <= at < (each.end_lineno or 0, each.end_col_offset or 0)
        for each in ast.walk(ast.parse(text))
        if isinstance(each, ast.keyword)
    )


class _Places(Visitor):
    """Places of a Python file that operators change: for each position, names of operators and their occurrences."""

    def __init__(self, text: str) -> None:
        self.found: dict[tuple[int, int], list[tuple[str, int]]] = {}
        self._operators = {name: get_operator(name)() for name in operator_names() if _PLAUSIBLE.search(name)}
        self._counts = dict.fromkeys(self._operators, 0)
        self.walk(get_ast(text))

    def visit(self, node: Any) -> Any:
        for name, operator in self._operators.items():
            for start, _ in operator.mutation_positions(node):
                self.found.setdefault(start, []).append((name, self._counts[name]))
                self._counts[name] += 1
        return node


def _behaviour(text: str) -> str | None:
    """Return the syntax tree without annotations and documentation; None if the text is no Python."""
    try:
        tree = ast.parse(text)
    except SyntaxError:
        return None
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign):
            node.annotation = ast.Constant(0)
        elif isinstance(node, ast.FunctionDef):
            node.returns = None
    return ast.dump(tree)


def _kernel_fault(path: Path, rng: random.Random) -> Fault | None:
    """Return a change of the code of a kernel file; comments, directives of the preprocessor and prefetches stay."""
    text = path.read_text()
    code = _NO_CODE.sub(lambda found: " " * len(found[0]), text)
    code = "\n".join(" " * len(line) if _PREFETCH.search(line) else line for line in code.split("\n"))
    places = [(found, change) for pattern, change in _KERNEL_CHANGES for found in re.finditer(pattern, code)]
    if not places:
        return None
    found, change = rng.choice(places)
    replacement = change if isinstance(change, str) else change(found)
    return Fault(str(path.relative_to(ROOT)), found.start(), found.end(), replacement)
