"""Every public operation has a benchmark, a curve, a stability map, a place in the roofline and a contract."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import pytest

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

import gpuvision as gv
from gpuvision.host import Operation
from gpuvision.profiling import harness
from gpuvision.profiling.contract import agreement
from gpuvision.profiling.curves import curve
from gpuvision.profiling.maps import stability

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


def built_by(folder: str, stems: tuple[str, ...]) -> set[str]:
    """Return the public operations that modules of a folder construct."""
    names = set().union(*(constructed(FOLDER / folder / f"{stem}.py") for stem in stems))
    return {each for each in public_operations() if {each, BOUND_BY.get(each, each)} & names}


def in_the_roofline() -> set[str]:
    """Return the public operations of benchmark modules whose cases state numbers of operations and of bytes."""
    found = set()
    for path in FOLDER.glob("*.py"):
        calls = [each for each in ast.walk(ast.parse(path.read_text())) if isinstance(each, ast.Call)]
        cases = [each for each in calls if isinstance(each.func, ast.Name) and each.func.id == "Case"]
        if any(keyword.arg == "flops" for case in cases for keyword in case.keywords):
            found |= {each for each in public_operations() if BOUND_BY.get(each, each) in constructed(path)}
    return found


def has() -> dict[str, set[str]]:
    """Return the public operations that have each part of the profile."""
    return {
        "curve": built_by("curves", curve.OPERATIONS),
        "map": built_by("maps", stability.OPERATIONS),
        "roofline": in_the_roofline(),
        "contract": set(agreement.stated_limits()),
    }


def test_every_public_operation_has_curve_map_roofline_and_contract() -> None:
    lacking = [f"{each} has no {part}" for part, names in has().items() for each in public_operations() - names]
    assert sorted(lacking) == []
