"""Map from the lines of the source to the tests that run them, from one run of the fast tier."""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import sys
import xml.etree.ElementTree
from collections import defaultdict
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import coverage

from mutants.faults import ROOT, Fault

OUT = ROOT / "build" / "mutants"
_MAX_FILES = 7
_LEVELS = 3  # a module, its users, and their users
_DATA, _TIMES = OUT / "coverage", OUT / "times.xml"
# Tests that read the text of every source file: no record shows them.
_TESTS_OF_TEXTS = (
    "tests/test_source_rules.py",
    "tests/test_house.py::test_dataclasses_are_frozen",
    "tests/docs/test_documented_defaults.py",
    "tests/docs/test_checked_ranges.py",
    "tests/cli/test_option_defaults.py",
)


def record_lines(arguments: Iterable[str] = ()) -> None:
    """Run the fast tier with a record of the lines that each test runs."""
    OUT.mkdir(parents=True, exist_ok=True)
    settings = OUT / "coveragerc"
    settings.write_text(f"[run]\ndata_file = {_DATA}\nrelative_files = true\nomit = {ROOT}/tests/*\n")
    measured = ["--cov", str(ROOT), "--cov-config", str(settings), "--cov-context=test", "--cov-report="]
    words = ["-n", "logical", "--tier", "fast", "-q", *measured, "--junitxml", str(_TIMES), *arguments]
    subprocess.run([sys.executable, "-m", "pytest", *words], cwd=ROOT, env=environment(ROOT), check=True)


def is_recorded() -> bool:
    """Return whether the map is there."""
    return _DATA.exists() and _TIMES.exists()


def environment(tree: Path) -> dict[str, str]:
    """Return the environment of tests in a copy of the repository: its packages come before installed ones."""
    path = f"{tree}{os.pathsep}{tree / 'tests'}"
    return {**os.environ, "PYTHONPATH": path, "GPUVISION_DEBUG": "", "PYTHONDONTWRITEBYTECODE": ""}


def tests_of(fault: Fault, budget: float) -> list[str]:
    """Return tests for a fault, in the order to run them: recorded tests, the shortest first, then test files.

    Python files have tests that read the source, too. They take a few seconds and come before the test files.
    The recorded tests run the lines of the fault and take up to `budget` seconds together. Lines that run only at
    import have no recorded tests; for them, take all tests that run any line of the file. For a kernel, take the files
    that include it, which compile only its functions, before the recorded tests; then the test file of its name, and
    the tests of the operations that launch it; for a header of many kernels, at most `_MAX_FILES` files, the first file
    of each operation before the second ones.
    """
    path = ROOT / fault.file
    is_code = path.suffix == ".py"
    places = [(path, fault.lines(path.read_text()))] if is_code else list(_launches(fault.file))
    own = [] if is_code else [str(file.relative_to(ROOT)) for file in _tests() if file.name == f"test_{path.stem}.py"]
    # Tests that compile a program of their own with the kernel file.
    include = f'#include "{_in_folder(fault.file)}"'
    direct = [str(file.relative_to(ROOT)) for file, text in _tests().items() if include in text]
    by_operation = itertools.zip_longest(*dict.fromkeys(_test_files(file) for file, _ in places))
    others = [file for files in by_operation for file in files if file is not None]
    files = list(dict.fromkeys([*own, *direct, *others]))[:_MAX_FILES]
    chosen: list[str] = []
    if budget:
        names = {name for file, lines in places for name in _contexts(file, lines)}
        names = names or {name for file, _ in places for name in _contexts(file, None)}
        times, total = _seconds(), 0.0
        for name in sorted(names, key=lambda name: (times[_key(name)], name)):
            total += times[_key(name)]
            if total <= budget:
                chosen.append(name)
    return list(dict.fromkeys([*direct, *chosen, *(_TESTS_OF_TEXTS if is_code else ()), *files]))


@cache
def _test_files(path: Path) -> tuple[str, ...]:
    """Return the test files of a Python file, at most `_MAX_FILES`.

    They are the files of the same name and the files that import the module, those that mention most of its names
    first; then the same of the modules that import it, and of the modules that import these.
    """
    files: list[Path] = []
    level, known = [path], {path}
    for _ in range(_LEVELS):
        for each in level:
            names = re.compile(rf"\b(?:{'|'.join([each.stem, *_public_names(each.read_text())])})\b")
            own = [file for file in _tests() if file.name == f"test_{each.stem}.py"]
            others = (file for file in _tests() if _imports(_tests()[file], each))
            files += own
            files += sorted(others, key=lambda file: (-len(set(names.findall(_tests()[file]))), len(_tests()[file])))
        users = [file for file, text in _modules().items() if any(_imports(text, each) for each in level)]
        level = [each for each in users if each not in known]
        known |= set(level)
        if len(set(files)) >= _MAX_FILES:
            break
    return tuple(str(each.relative_to(ROOT)) for each in list(dict.fromkeys(files))[:_MAX_FILES])


def _imports(text: str, path: Path) -> bool:
    """Return whether the text of a Python file imports from a module."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    package, name = ".".join(("gpuvision",) * (parts[0] != "gpuvision") + parts[:-1]), parts[-1]
    return bool(re.search(rf"(?:from|import) {re.escape(package)}(?:\.{name}\b| import [^\n]*\b{name}\b)", text))


def _in_folder(kernel: str) -> str:
    """Return the path of a kernel file as other kernels include it."""
    return kernel.removeprefix("kernels/")


def _public_names(text: str) -> list[str]:
    """Return the public functions and classes of a module."""
    return re.findall(r"^(?:def|class) ([A-Za-z]\w+)", text, re.MULTILINE)


@cache
def _tests() -> dict[Path, str]:
    """Return the texts of the test files."""
    return {file: file.read_text() for file in sorted((ROOT / "tests").rglob("test_*.py"))}


@cache
def _modules() -> dict[Path, str]:
    """Return the texts of the modules."""
    folders = ("gpuvision", "host")
    return {file: file.read_text() for folder in folders for file in sorted((ROOT / folder).rglob("*.py"))}


def _contexts(path: Path, lines: range | None) -> set[str]:
    by_line = _contexts_of(path)
    found = (by_line.get(line, ()) for line in (by_line if lines is None else lines))
    return {name for contexts in found for name in contexts}


@cache
def _contexts_of(path: Path) -> dict[int, list[str]]:
    """Return the tests of each line of a Python file."""
    data = coverage.CoverageData(str(_DATA))
    data.read()
    return {
        line: [context.rpartition("|")[0] for context in contexts if context]
        for line, contexts in data.contexts_by_lineno(str(path.relative_to(ROOT))).items()
    }


@cache
def _launches(kernel: str) -> tuple[tuple[Path, range], ...]:
    """Return the places of operations that launch a kernel whose source includes a file of ``kernels/``."""
    sources = {f'"{name}"' for name in _sources(kernel)}
    found = []
    for path in sorted((ROOT / "gpuvision").rglob("*.py")):
        for number, line in enumerate(path.read_text().splitlines(), 1):
            if any(source in line for source in sources):
                # The call of the builder begins up to a few lines above the name of the source.
                found.append((path, range(number - 2, number + 2)))
    return tuple(found)


def _sources(kernel: str) -> set[str]:
    """Return the kernel files that include a file, directly or not."""
    folder = ROOT / "kernels"
    users = defaultdict(set)
    for path in folder.rglob("*"):
        if path.suffix in (".cl", ".h"):
            for name in re.findall(r'#include "([^"]+)"', path.read_text()):
                users[name].add(str(path.relative_to(folder)))
    found, new = set(), {_in_folder(kernel)}
    while new:
        found |= new
        new = {user for name in new for user in users[name]} - found
    return {name for name in found if name.endswith(".cl")}


@cache
def _seconds() -> defaultdict[str, float]:
    """Return the time of each test [s]."""
    times: defaultdict[str, float] = defaultdict(lambda: 1.0)
    for case in xml.etree.ElementTree.parse(_TIMES).iter("testcase"):
        times[f"{case.get('classname')}.{case.get('name')}"] = float(case.get("time", "1"))
    return times


def _key(name: str) -> str:
    """Return the name of a test as in the report of times."""
    file, _, test = name.partition("::")
    return f"{file.removesuffix('.py').replace('/', '.')}.{test.replace('::', '.')}"
