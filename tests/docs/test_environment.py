"""The page on environment variables lists exactly the variables that the code reads and sets."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "environment.md"
READING = {"get", "setdefault"}


def tables() -> tuple[set[str], set[str]]:
    """Return the variables in the first and in the second table of the page."""
    read, written = PAGE.read_text().split("## Variables that gpuvision sets")
    return tuple(set(re.findall(r"^\| `([A-Z_]+)`", text, re.MULTILINE)) for text in (read, written))


def uses(path: Path) -> Iterator[tuple[str, bool]]:
    """Yield (variable, whether it is set) for each use of the environment in a file."""
    text = path.read_text()
    if not re.search(r"\bos\.(environ|getenv|putenv)", text):
        return  # most files: without parsing
    tree = ast.parse(text)
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
        assert ast.unparse(node) == "self.variable", f"{path}: {ast.unparse(node)}"
        return "GPUVISION_MAX_"

    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith(("os.environ.", "os.getenv", "os.putenv")):
            assert ast.unparse(node.func).removeprefix("os.environ.") in READING, f"{path}: {ast.unparse(node)}"
            yield name(node.args[0]), ast.unparse(node.func).endswith("setdefault")
        elif isinstance(node, ast.Subscript) and ast.unparse(node.value) == "os.environ":
            yield name(node.slice), isinstance(node.ctx, ast.Store)
        elif isinstance(node, ast.Compare) and ast.unparse(node.comparators[0]) == "os.environ":
            yield name(node.left), False


def files() -> Iterator[Path]:
    """Yield the files of the package."""
    for room in ("gpuvision", "host", "profiling"):
        yield from (ROOT / room).rglob("*.py")


def limits() -> dict[str, float]:
    """Return variable and default of each `FileLimit` of the package."""
    made = re.compile(r"^[A-Z_]+ = FileLimit\((.*)\)$", re.MULTILINE)
    texts = [found for each in files() for found in made.findall(each.read_text())]
    return {eval(variable): float(eval(default)) for variable, default in (text.split(",") for text in texts)}


def test_the_page_lists_the_variables_of_the_code() -> None:
    found = {use for each in files() for use in uses(each)}
    assert ("GPUVISION_MAX_", False) in found
    read, written = tables()
    assert written == {name for name, is_set in found if is_set}
    assert read == set(limits()) | {name for name, is_set in found if not is_set and name != "GPUVISION_MAX_"}


def test_the_page_on_file_limits_lists_the_defaults_of_the_code() -> None:
    page = (ROOT / "docs" / "reference" / "file_limits.md").read_text()
    listed = re.findall(r"^\|[^|]+\| `(\w+)` \| ([0-9. ]+) \|", page, re.MULTILINE)
    assert {variable: float(default.replace(" ", "")) for variable, default in listed} == limits()
    made = sum(each.read_text().count("= FileLimit(") for each in files())
    assert made == len(listed) == 14
