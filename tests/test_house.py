"""The house is in order: what the wheel holds, who imports whom, what kernels and Python must agree on."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from gpuvision.status import Status

ROOT = Path(__file__).resolve().parents[1]
# Where a room of the tree is installed.
ROOMS = {
    "gpuvision": "gpuvision",
    "host": "gpuvision/host",
    "kernels": "gpuvision/kernels",
    "profiling": "gpuvision/profiling",
}
SHIPPED = {".py", ".cl", ".h", ".toml", ".typed"}


def _files(*places: str) -> Iterator[Path]:
    for place in places:
        for path in (ROOT / place).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                yield path


def _modules() -> Iterator[tuple[str, Path]]:
    """Yield the installed name and the path of every module."""
    for room, installed in ROOMS.items():
        for path in _files(room):
            if path.suffix == ".py":
                parts = Path(installed, path.relative_to(ROOT / room)).with_suffix("").parts
                yield ".".join(part for part in parts if part != "__init__"), path


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[zipfile.ZipFile]:
    """The wheel, built from a copy: what an earlier build left in the tree would get into it."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for room in ROOMS:
        shutil.copytree(ROOT / room, source / room, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = f"from setuptools.build_meta import build_wheel; build_wheel({os.fspath(target)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=source, check=True, capture_output=True)
    (path,) = target.glob("*.whl")
    with zipfile.ZipFile(path) as opened:
        yield opened


def test_wheel_holds_everything(wheel: zipfile.ZipFile) -> None:
    """A package that pyproject.toml does not list, or a kernel that no pattern matches, would be missing."""
    expected = {
        Path(installed, path.relative_to(ROOT / room)).as_posix()
        for room, installed in ROOMS.items()
        for path in _files(room)
        if path.suffix in SHIPPED
    }
    assert expected - set(wheel.namelist()) == set()
    assert "gpuvision/py.typed" in expected
    assert any(name.endswith(".cl") for name in expected)


def test_wheel_installs_one_package(wheel: zipfile.ZipFile) -> None:
    names = wheel.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"gpuvision"}
    (metadata,) = [name for name in names if name.endswith(".dist-info/METADATA")]
    assert "License-Expression: MIT" in wheel.read(metadata).decode()
    assert any(name.endswith("licenses/LICENSE") for name in names)
    (entry,) = [name for name in names if name.endswith("entry_points.txt")]
    assert "gpuvision = gpuvision.cli:main" in wheel.read(entry).decode()


def test_status_is_the_same_in_kernels() -> None:
    header = (ROOT / "kernels" / "status.h").read_text()
    defined = {name: int(value) for name, value in re.findall(r"#define STATUS_(\w+) (\d+)$", header, re.MULTILINE)}
    assert defined == {name: int(flag) for name, flag in Status.__members__.items()}


def test_headers_that_kernels_include_exist() -> None:
    kernels = ROOT / "kernels"
    included = {
        (path.name, name)
        for path in (*kernels.glob("*.cl"), *kernels.glob("*.h"))
        for name in re.findall(r'#include "([^"]+)"', path.read_text())
    }
    assert {(user, name) for user, name in included if not (kernels / name).exists()} == set()
    unused = {path.name for path in kernels.glob("*.h")} - {name for _, name in included}
    assert unused == set()


# A room imports from rooms of a lower number, and from itself; whatever is not named here stands on top.
LAYERS = {
    "kernels": 0,
    "host": 1,
    "status": 2,
    "tables": 2,
    "operation": 2,
    "camera": 3,
    "matching": 4,
    "ranging": 4,
    "servoing": 5,
    "simulation": 5,
    "accuracy": 6,
}
TOP = 7


def _imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, "imports are absolute: the tree's folders are not the package's"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _room(module: str) -> str:
    return ([*module.split("."), ""])[1]


def test_imports_run_one_way() -> None:
    wrong = []
    for module, path in _modules():
        layer = LAYERS.get(_room(module), TOP)
        for name in _imported(ast.parse(path.read_text())):
            if not name.startswith("gpuvision.") or _room(name) == _room(module):
                continue
            if LAYERS.get(_room(name), TOP) >= layer and layer < TOP:
                wrong.append(f"{module} imports {name}")
    assert wrong == []


@pytest.mark.parametrize("top", ["numba", "pytest", "hypothesis"])
def test_the_library_needs_no_extra(top: str) -> None:
    """What comes with the extras `test` and `profile` is imported by neither the library nor the command."""
    users = [
        module
        for module, path in _modules()
        if not module.startswith("gpuvision.profiling")
        and any(name.split(".")[0] == top for name in _imported(ast.parse(path.read_text())))
    ]
    assert users == []


def test_no_file_knows_a_machine() -> None:
    """Neither a path of somebody's machine nor a package registry: pip and apt are configured outside."""
    known = re.compile(r"(?<![\w.~}])/(work|root|home|Users)/|\bpypi\.org\b|--(extra-)?index-url")
    kinds = SHIPPED | {".md", ".sh"}
    texts = [path for path in _files(*ROOMS, "tests", ".ci") if path.suffix in kinds or path.parent.name == ".ci"]
    texts += [path for path in ROOT.iterdir() if path.suffix in kinds or path.name == "Makefile"]
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in texts
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if known.search(line) and path != Path(__file__).resolve()
    ]
    assert len(texts) > 20
    assert found == []


def test_package_works_from_the_repository_root() -> None:
    """Python started in the root finds the bare folder ``gpuvision/`` before the installed package."""
    code = "import gpuvision.host, gpuvision.kernels, gpuvision.profiling; print(gpuvision.host.__file__)"
    run = subprocess.run([sys.executable, "-S", "-c", code], cwd=ROOT, capture_output=True, text=True)
    hidden = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert "No module named 'gpuvision" not in run.stderr
    assert Path(hidden.stdout.strip()) == ROOT / "host" / "__init__.py"
