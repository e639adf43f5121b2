"""Defaults that docstrings state are the defaults of the signature."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FILES = [path for folder in ("gpuvision", "host") for path in sorted((ROOT / folder).rglob("*.py"))]
# ``name : type`` or ``name`` and the indented lines below it, in a section of numpydoc.
_ENTRY = re.compile(r"^(?P<names>\w+(?:, \w+)*)(?: :[^\n]*)?\n(?P<text>(?:(?:[ ]{4}[^\n]*)?\n)+)", re.MULTILINE)
# A number, a word in code or a constant, followed by no unit: "default 0.", "Default False.", "default ``"pairs"``".
_DEFAULT = re.compile(
    r"\b[Dd]efault:?\s+(?:``(?P<code>[^`]+)``|(?P<plain>True|False|-?\d[\d.]*?(?:e[-+]?\d+)?))"
    r"(?=[.,;:)]*(?:\s*$|[.,;:)]\s|\n\n))"
)


def _functions(path: Path) -> Iterator[tuple[str, str, dict[str, ast.expr]]]:
    """Yield name, docstring and defaults of each function and class of a module."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            spec = node.args
            places = [*spec.posonlyargs, *spec.args]
            pairs = [*zip(places[len(places) - len(spec.defaults) :], spec.defaults, strict=True)]
            pairs += [(name, value) for name, value in zip(spec.kwonlyargs, spec.kw_defaults, strict=True) if value]
            yield node.name, ast.get_docstring(node) or "", {name.arg: value for name, value in pairs}
        elif isinstance(node, ast.ClassDef):
            fields = [each for each in node.body if isinstance(each, ast.AnnAssign) and each.value is not None]
            yield node.name, ast.get_docstring(node) or "", {ast.unparse(each.target): each.value for each in fields}


def _documented() -> Iterator[tuple[str, object, object]]:
    """Yield a name, the default in the source and the default of the docstring."""
    for path in FILES:
        for owner, text, defaults in _functions(path):
            for entry in _ENTRY.finditer(text + "\n"):
                stated = _DEFAULT.search(entry["text"])
                # An entry of two parameters states two defaults in words.
                name = entry["names"]
                if stated is not None and name in defaults:
                    values = [_literal(each) for each in (defaults[name], stated["code"] or stated["plain"])]
                    if None not in values:
                        yield f"{path.relative_to(ROOT)}: {owner}.{name}", *values


def _literal(source: ast.expr | str) -> object:
    """Return a literal value; None for an expression, and for None, whose meaning the docstring states."""
    try:
        return ast.literal_eval(source)
    except (ValueError, SyntaxError):
        return None


def test_a_stated_default_is_the_default_of_the_signature() -> None:
    cases = list(_documented())
    assert len(cases) > 100
    wrong = []
    for name, default, stated in cases:
        # "default 0" of a pair is the default of each member.
        members = default if isinstance(default, tuple) and not isinstance(stated, tuple) else (default,)
        if any(each != stated for each in members):
            wrong.append(f"{name}: the docstring states {stated}, the signature {default}")
    assert wrong == []
