"""Structure of the project: contents of the wheel, imports between packages, consistency of kernels and Python."""

from __future__ import annotations

import ast
import functools
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import gpuvision
from gpuvision.status import Status
from source_trees import tree_of

ROOT = Path(__file__).resolve().parents[1]
# Installed package of each folder of the tree.
ROOMS = {
    "gpuvision": "gpuvision",
    "host": "gpuvision/host",
    "kernels": "gpuvision/kernels",
    "profiling": "gpuvision/profiling",
    "tests/reference": "gpuvision/reference",
}
SHIPPED = {".py", ".pyi", ".cl", ".h", ".html", ".toml", ".typed"}


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


def _copy_of_the_sources(folder: Path) -> Path:
    for room in ROOMS:
        shutil.copytree(ROOT / room, folder / room, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(ROOT / name, folder)
    return folder


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[zipfile.ZipFile]:
    """Return the wheel, built from a copy, because files of earlier builds in the tree would get into it."""
    source, target = _copy_of_the_sources(tmp_path_factory.mktemp("source")), tmp_path_factory.mktemp("wheel")
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


@pytest.mark.slow
def test_installed_wheel_runs_outside_the_tree(wheel: zipfile.ZipFile, tmp_path: Path) -> None:
    """The installed package finds its kernels, presets and version; the tree is not on the path."""
    target = tmp_path / "site"
    wheel.extractall(target)  # equivalent to `pip install --target` for a pure Python wheel
    environment = os.environ | {"PYTHONPATH": os.fspath(target)}
    code = "import gpuvision, gpuvision.host; print(gpuvision.__file__, gpuvision.host.__file__)"
    code += "; from gpuvision import LineReadout; import numpy; LineReadout()(numpy.zeros((1, 16, 32), numpy.uint8))"
    code += "; from gpuvision.sensor.sensor import Sensor; Sensor.load('psd_line')"

    def output(*arguments: str) -> str:
        command = [sys.executable, *arguments]
        ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
        return ran.stdout

    assert all(Path(each).is_relative_to(target) for each in output("-c", code).split())
    assert output("-m", "gpuvision", "--version") == f"gpuvision {gpuvision.__version__}\n"
    assert '"healthy": true' in output("-m", "gpuvision", "devices", "--json", "-")
    (metadata,) = target.glob("*.dist-info/METADATA")
    assert f"\nVersion: {gpuvision.__version__}\n" in metadata.read_text()


@pytest.mark.slow
def test_source_distribution_holds_what_a_build_needs(tmp_path: Path) -> None:
    """Packages, kernels, presets, README and licence; tests and documentation stay in the repository."""
    source = _copy_of_the_sources(tmp_path / "source")
    (source / "tests" / "test_something.py").write_text("")  # setuptools would include it automatically
    build = f"from setuptools.build_meta import build_sdist; build_sdist({os.fspath(tmp_path)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=source, check=True, capture_output=True)
    (path,) = tmp_path.glob("gpuvision-*.tar.gz")
    with tarfile.open(path) as opened:
        names = {name.partition("/")[2] for name in opened.getnames()}
    expected = {path.relative_to(ROOT).as_posix() for room in ROOMS for path in _files(room) if path.suffix in SHIPPED}
    assert expected | {"pyproject.toml", "README.md", "LICENSE"} <= names
    others = {name for name in names if not name.startswith("tests/reference")}
    assert not any(name.startswith(("tests/", "docs", "examples")) for name in others - {"tests/"})


def test_wheel_installs_one_package(wheel: zipfile.ZipFile) -> None:
    names = wheel.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"gpuvision"}
    (metadata,) = [name for name in names if name.endswith(".dist-info/METADATA")]
    assert "License-Expression: MIT" in wheel.read(metadata).decode()
    assert any(name.endswith("licenses/LICENSE") for name in names)
    (entry,) = [name for name in names if name.endswith("entry_points.txt")]
    assert "gpuvision = gpuvision.cli.main:main" in wheel.read(entry).decode()


def test_status_is_the_same_in_kernels() -> None:
    header = (ROOT / "kernels" / "common" / "status.h").read_text()
    defined = {name: int(value) for name, value in re.findall(r"#define STATUS_(\w+) (\d+)$", header, re.MULTILINE)}
    assert defined == {name: int(flag) for name, flag in Status.__members__.items()}


def test_headers_that_kernels_include_exist() -> None:
    kernels = ROOT / "kernels"
    sources = [path for path in _files("kernels") if path.suffix in {".cl", ".h"}]
    included = {(path.name, name) for path in sources for name in re.findall(r'#include "([^"]+)"', path.read_text())}
    assert {(user, name) for user, name in included if not (kernels / name).exists()} == set()
    headers = {path.relative_to(kernels).as_posix() for path in sources if path.suffix == ".h"}
    assert headers - {name for _, name in included} == set()


def test_kernel_includes_are_not_circular() -> None:
    kernels = ROOT / "kernels"
    graph = {
        path.relative_to(kernels).as_posix(): set(re.findall(r'#include "([^"]+)"', path.read_text()))
        for path in _files("kernels")
        if path.suffix in {".cl", ".h"}
    }
    assert list(TopologicalSorter(graph).static_order())


def test_every_kernel_has_a_module_a_test_and_a_benchmark_of_its_name() -> None:
    """``kernels/line/line.cl`` belongs to ``line.py``, ``test_line.py`` and the benchmark ``profiling/line.py``."""
    kernels = [path for path in _files("kernels") if path.suffix == ".cl"]
    assert {path.parent.name for path in kernels} - {path.stem for path in kernels} == set()
    operations = {path.parent.name for path in kernels} - {"ceiling"}  # a benchmark
    assert len(operations) > 20
    assert operations - {path.stem for path in _files("gpuvision")} == set()
    assert {f"test_{name}" for name in operations} - {path.stem for path in _files("tests")} == set()
    assert operations - {path.stem for path in _files("profiling")} == set()


# Floors of the packages, bottom to top. A name with a dot is a sub-package, or a module on a higher floor than the
# sub-packages of its package. A module imports only from lower floors and from its package.
FLOORS = (
    ("kernels", "host", "reference"),
    ("status", "validation", "schema", "jackknife", "normal_distribution"),
    ("operation",),
    ("camera",),
    ("camera.patterns",),
    ("camera.lines", "camera.views"),
    ("camera.correction_uncertainty",),
    ("camera.calibration",),
    ("ranging", "matching"),
    ("matching.artwork",),
    ("matching.features",),
    ("matching.field",),
    ("matching.pose",),
    ("matching.features.feature_set",),
    ("matching.board",),
    ("inspection",),
    ("simulation.scene",),
    ("simulation.sensors",),
    ("simulation.board_image", "simulation.errors", "simulation.transport"),
    ("simulation.clustering",),
    ("simulation",),
    ("servoing",),
    ("accuracy",),
    ("formats", "plots"),
    ("sensor",),
    ("workflows",),
    ("profiling.offline",),
    ("profiling",),
    ("profiling.gpu_run",),
    ("cli",),
    ("__main__",),
)
FLOOR = {package: number for number, packages in enumerate(FLOORS) for package in packages}


@functools.cache
def _imported(path: Path) -> tuple[str, ...]:
    """Return the modules and names that a file imports."""
    names = []
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, "imports are absolute: the tree's folders are not the package's"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(names)


def _package(name: str) -> str:
    """Return the package with a floor that contains a module or a name in it: the longest match."""
    parts = name.split(".")[1:]
    fitting = [".".join(parts[:count]) for count in range(len(parts), 0, -1) if ".".join(parts[:count]) in FLOOR]
    return fitting[0] if fitting else ""


def _gpuvision_imports() -> Iterator[tuple[str, str]]:
    """Yield (module, imported name) for every import within gpuvision, including imports for type checkers."""
    for module, path in _modules():
        for name in _imported(path):
            if name.split(".")[0] == "gpuvision":
                yield module, name


def test_every_package_has_a_floor() -> None:
    modules = {module for module, _ in _modules()} - {"gpuvision"}
    assert {module for module in modules if not _package(module)} == set()
    packages = {module.removeprefix("gpuvision.") for module in modules}
    assert set(FLOOR) - packages == set()


def test_imports_run_down_the_floors() -> None:
    wrong = [
        f"{module} imports {name}"
        for module, name in _gpuvision_imports()
        if _package(module) != _package(name) and FLOOR[_package(module)] <= FLOOR.get(_package(name), len(FLOORS))
    ]
    assert wrong == []


def test_references_are_independent() -> None:
    """A reference that shared code, or a constant, with the operation would share its faults."""
    room = "gpuvision.reference"
    wrong = [
        f"{module} imports {name}"
        for module, name in _gpuvision_imports()
        if _package(module) == "reference" and not f"{name}.".startswith(f"{room}.")
    ]
    assert wrong == []
    users = [path for path in _files("tests") if path.suffix == ".py" and path.parent.name != "reference"]
    # The first word of each line that looks like an import, also in a docstring: parsing all tests takes seconds.
    names = {word for path in users for word in re.findall(r"^\s*(?:from|import) (\w+)", path.read_text(), re.M)}
    assert names > {"gpuvision", "numpy"}
    assert "reference" not in names, "tests import references from gpuvision.reference only"


def test_no_import_is_circular() -> None:
    modules = {module for module, _ in _modules()}
    graph: dict[str, set[str]] = {module: set() for module in modules}
    for module, name in _gpuvision_imports():
        target = name if name in modules else name.rpartition(".")[0]
        if target in modules and target != module:
            graph[module].add(target)
    assert list(TopologicalSorter(graph).static_order())


def test_functions_without_types_are_compiled_by_numba() -> None:
    """Mypy accepts functions without annotations in ``profiling``, because Numba infers the types of compiled ones."""
    bare = [
        (path.name, node.name, any(ast.unparse(each).startswith("numba.njit(") for each in node.decorator_list))
        for path in _files("profiling")
        if path.suffix == ".py"
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.FunctionDef) and node.returns is None
    ]
    assert len(bare) > 20
    assert [each for each in bare if not each[2]] == []


def test_no_module_imports_private_names_of_another() -> None:
    wrong = [
        f"{module} imports {name}"
        for module, name in _gpuvision_imports()
        if any(part.startswith("_") and not part.startswith("__") for part in name.split("."))
    ]
    assert wrong == []


# Objects with a state: a batch on its way through the stream, and the queue and kernel of a bound operation.
MUTABLE_DATACLASSES = {"Batch", "Site"}


def test_dataclasses_are_frozen() -> None:
    """Operations and results are keys of caches and are shared between threads: nobody may change their fields."""
    mutable = set()
    for _, path in _modules():
        # Most files need no parsing: each of their decorators has the flag in its line.
        is_suspect = re.search(r"^\s*@dataclass(?!.*frozen=True)", path.read_text(), re.M)
        for node in ast.walk(tree_of(path)) if is_suspect else ():
            for each in node.decorator_list if isinstance(node, ast.ClassDef) else ():
                if ast.unparse(each).startswith("dataclass") and "frozen=True" not in ast.unparse(each):
                    mutable.add(node.name)
    assert mutable == MUTABLE_DATACLASSES


@pytest.mark.parametrize("top", ["numba", "pytest", "hypothesis", "mpmath"])
def test_the_library_needs_no_extra(top: str) -> None:
    """Library and command do not import packages of the extras `test`, `profile` and `reference`."""
    with_extras = ("gpuvision.profiling", "gpuvision.reference")
    users = [
        module
        for module, path in _modules()
        if not module.startswith(with_extras) and any(name.split(".")[0] == top for name in _imported(path))
    ]
    assert users == []


def test_planted_faults_have_a_place_and_a_test() -> None:
    """The list of planted faults is that of the tree: each text is in its file once, each test is in its file."""
    faults = tomllib.loads((ROOT / "tests" / "mutants" / "planted.toml").read_text())["fault"]
    for fault in faults:
        assert (ROOT / fault["file"]).read_text().count(fault["find"]) == 1, fault
        assert fault["replace"] != fault["find"]
        for test in fault["tests"]:
            path, _, name = test.partition("::")
            assert f"def {name}(" in (ROOT / path).read_text(), fault
    assert len(faults) > 30


def test_no_file_knows_a_machine() -> None:
    """No file contains a path of a machine or the address of a package registry: pip and apt are configured outside."""
    known = re.compile(r"(?<![\w.~}])/(work|root|home|Users)/|\bpypi\.org\b|--(extra-)?index-url")
    kinds = SHIPPED | {".md", ".sh"}
    folders = (*ROOMS, "tests", "docs", "examples", ".ci")
    texts = [path for path in _files(*folders) if path.suffix in kinds or path.parent.name == ".ci"]
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
    code = "import gpuvision.host, gpuvision.kernels, gpuvision.profiling, gpuvision.reference"
    code += "; print(gpuvision.host.__file__, gpuvision.reference.__file__)"
    run = subprocess.run([sys.executable, "-S", "-c", code], cwd=ROOT, capture_output=True, text=True)
    hidden = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert "No module named 'gpuvision" not in run.stderr
    assert hidden.stdout.split() == [str(ROOT / room / "__init__.py") for room in ("host", "tests/reference")]
