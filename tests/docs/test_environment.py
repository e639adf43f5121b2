"""The page on environment variables lists exactly the variables that the code reads and sets."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from gpuvision.host.reading import FileLimits

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "environment.md"
READING = {"get", "setdefault"}


def tables() -> tuple[set[str], set[str]]:
    """Return the variables in the first and in the second table of the page."""
    read, written = PAGE.read_text().split("## Variables that gpuvision sets")
    return tuple(set(re.findall(r"^\| `([A-Z_]+)`", text, re.MULTILINE)) for text in (read, written))


def uses(path: Path) -> Iterator[tuple[str, bool]]:
    """Yield (variable, whether it is set) for each use of the environment in a file."""
    tree = ast.parse(path.read_text())
    constants = {
        node.targets[0].id: node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and isinstance(node.value, ast.Constant)
    }

    def name(node: ast.expr) -> str:
        if isinstance(node, ast.Constant):
            return str(node.value)
        if isinstance(node, ast.Name):
            return str(constants[node.id])
        assert ast.unparse(node).startswith("_variable("), f"{path}: {ast.unparse(node)}"
        return "GPUVISION_MAX_"

    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith(("os.environ.", "os.getenv", "os.putenv")):
            assert ast.unparse(node.func).removeprefix("os.environ.") in READING, f"{path}: {ast.unparse(node)}"
            yield name(node.args[0]), ast.unparse(node.func).endswith("setdefault")
        elif isinstance(node, ast.Subscript) and ast.unparse(node.value) == "os.environ":
            yield name(node.slice), isinstance(node.ctx, ast.Store)
        elif isinstance(node, ast.Compare) and ast.unparse(node.comparators[0]) == "os.environ":
            yield name(node.left), False


def test_the_page_lists_the_variables_of_the_code() -> None:
    found = {
        use for room in ("gpuvision", "host", "profiling") for each in (ROOT / room).rglob("*.py") for use in uses(each)
    }
    assert ("GPUVISION_MAX_", False) in found
    limits = {f"GPUVISION_{each.name.upper()}" for each in fields(FileLimits)}
    read, written = tables()
    assert written == {name for name, is_set in found if is_set}
    assert read == limits | {name for name, is_set in found if not is_set and name != "GPUVISION_MAX_"}
