"""Every public operation has a benchmark."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import pytest

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

import gpuvision as gv
from gpuvision.host import Operation
from gpuvision.profiling import harness

FOLDER = Path(harness.__file__).parent


# Operations that a benchmark binds through another public function.
BOUND_BY = {"EstimateFeaturePose": "FeatureSet"}


def constructed(path: Path) -> set[str]:
    """Return the names of all functions and classes that a module calls, and of classes whose methods it calls."""
    called = [each.func for each in ast.walk(ast.parse(path.read_text())) if isinstance(each, ast.Call)]
    names = {each.id for each in called if isinstance(each, ast.Name)}
    for each in called:
        if isinstance(each, ast.Attribute):
            names |= {each.attr} | ({each.value.id} if isinstance(each.value, ast.Name) else set())
    return names


def modules_of(benchmark: str) -> set[Path]:
    """Return the module of a benchmark and the modules of this package that it imports."""
    path = FOLDER / f"{harness.OPERATIONS[benchmark]}.py"
    found = {path.stem}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "gpuvision.profiling":
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gpuvision.profiling."):
            found.add(str(node.module).split(".")[2])
    return {FOLDER / f"{name}.py" for name in found if (FOLDER / f"{name}.py").exists()}


def public_operations() -> set[str]:
    return {name for name in dir(gv) if inspect.isclass(each := getattr(gv, name)) and issubclass(each, Operation)}


def test_every_public_operation_has_a_benchmark() -> None:
    assert sorted(public_operations() ^ harness.MEASURED.keys()) == []


@pytest.mark.parametrize("operation", sorted(harness.MEASURED))
def test_the_benchmark_runs_the_operation(operation: str) -> None:
    names = set().union(*(constructed(path) for path in modules_of(harness.MEASURED[operation])))
    assert BOUND_BY.get(operation, operation) in names
