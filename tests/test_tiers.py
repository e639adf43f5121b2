"""The fast tier has the tests that find the planted faults."""

from __future__ import annotations

import functools
import itertools
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device
from tiers import (
    Selection,
    best_devices,
    collected_items,
    device_of,
    function_of,
    is_refused,
    one_case_each,
    refusal_message,
    select_fast,
    select_full,
    split_refused,
    unexpected_refusal,
    without_other_variants,
)

ROOT = Path(__file__).resolve().parents[1]
PLANTED = tomllib.loads((ROOT / "tests" / "mutants" / "planted.toml").read_text())["fault"]
KILLING = sorted({name for fault in PLANTED for name in fault["tests"]})


@functools.cache
def _items_of_files(session: pytest.Session) -> dict[Path, list[pytest.Item]]:
    """Return the collected tests of each file."""
    files: dict[Path, list[pytest.Item]] = {}
    for item in collected_items(session):
        files.setdefault(item.path, []).append(item)
    return files


@pytest.mark.parametrize("name", KILLING)
def test_the_fast_tier_has_each_killing_test(request: pytest.FixtureRequest, name: str) -> None:
    path, _, function = name.partition("::")
    function = function.partition("[")[0]
    of_file = _items_of_files(request.session).get(ROOT / path, [])
    named = {item for item in of_file if function_of(item) == function or not function}
    best = best_devices()
    chosen = named.intersection(select_fast(of_file, best).chosen)
    # A run of other files collects none of them.
    assert not named or any(device_of(item) in (None, *best) for item in chosen)


def test_the_fast_tier_holds_each_value_of_each_parameter(request: pytest.FixtureRequest) -> None:
    best = best_devices()
    items = [item for item in collected_items(request.session) if device_of(item) in (None, *best)]
    fast = [item for item in items if not any(item.get_closest_marker(mark) for mark in ("slow", "nightly"))]
    expected = _values(list(without_other_variants(fast)))
    assert _values(select_fast(items, best).chosen) == expected


def _values(items: list[pytest.Item]) -> set[tuple[object, ...]]:
    return {
        (item.parent, function_of(item), name, repr(value))
        for item in items
        if hasattr(item, "callspec")
        for name, value in item.callspec.params.items()
    }


class Case(SimpleNamespace):
    """Stand-in of a test: equal only to itself, and hashable."""

    __eq__ = object.__eq__
    __hash__ = object.__hash__


LISTS: dict[str, list[Any]] = {"variant": ["vector", "work_item"], "kernel": [(a, b) for a in "xyz" for b in (1, 2)]}
LISTS["dtype"] = [np.uint8, np.float32, np.float64]
ENTRIES = ("variant", "first", "second", "dtype")


def _kernel_cases(
    function: str,
    device: Any,
    *,
    mark: str = "",
    lists: dict[str, list[Any]] = LISTS,
    stem: str = "test_psd",
    folder: str = "ranging",
) -> list[Any]:
    """Return the product of values as cases of a test of a kernel."""
    path = ROOT / "tests" / folder / f"{stem}.py"
    return [
        Case(
            path=path,
            parent=path,
            name="",
            originalname=function,
            callspec=SimpleNamespace(params={"device": device, **dict(zip(lists, values, strict=True))}),
            iter_markers=lambda name: [SimpleNamespace(args=[each]) for each in lists],
            get_closest_marker=lambda name: name if name == mark else None,
        )
        for values in itertools.product(*lists.values())
    ]


def _held(items: list[Any], strength: int) -> set[Any]:
    """Return the combinations of values in cases; entries of the parameter ``kernel`` are parameters."""
    held = set()
    for item in items:
        params = item.callspec.params
        values = (params["variant"], *params["kernel"], params["dtype"])
        held.update(itertools.combinations(zip(ENTRIES, values, strict=True), strength))
    return held


def test_the_full_tier_holds_each_pair_of_values() -> None:
    """On the best device in each kernel test; on another one in one test of the file, and each value in each test."""
    best, other = Case(label="best"), Case(label="other")
    cases = {(name, each.label): _kernel_cases(name, each) for name in ("a", "b") for each in (best, other)}
    chosen = select_full(list(itertools.chain(*cases.values())), [best]).chosen  # type: ignore[list-item]
    kept = {key: [item for item in items if item in chosen] for key, items in cases.items()}
    every = cases["a", "best"]
    for name in ("a", "b"):
        assert _held(kept[name, "best"], 2) == _held(every, 2)
        assert _held(kept[name, "other"], 1) == _held(every, 1)
        assert 9 <= len(kept[name, "best"]) <= 14
    assert _held(kept["a", "other"], 2) == _held(every, 2)
    assert len(kept["b", "other"]) == 3


def test_the_full_tier_holds_chosen_examples_and_other_tests() -> None:
    """On the best device all cases of one list, and of tests that are not about a kernel."""
    best = Case(label="best")
    listed = _kernel_cases("a", best, lists={"kernel": LISTS["kernel"]})
    items = [*listed, *_kernel_cases("b", best, stem="test_focus")]
    assert select_full(items, [best]).chosen == items  # type: ignore[list-item]


def test_the_full_tier_runs_the_profiler_on_the_best_device() -> None:
    best, other = Case(label="best"), Case(label="other")
    items = [*_kernel_cases("a", best, folder="profiling"), *_kernel_cases("a", other, folder="profiling")]
    assert {item.callspec.params["device"] for item in select_full(items, [best]).chosen} == {best}  # type: ignore[list-item]


def test_only_the_nightly_tier_has_nightly_tests() -> None:
    best = Case(label="best", prefers_vectors=True)
    items = _kernel_cases("a", best, mark="nightly")
    for select in (select_fast, select_full):
        selection = select(items, [best])  # type: ignore[list-item]
        assert (selection.chosen, selection.left) == ([], items)


@pytest.mark.parametrize(
    ("parameters", "mark", "expected"),
    [
        ({"dtype": np.float32, "variant": "work_item"}, "slow", "nothing"),
        ({"dtype": np.float64}, "", "doubles"),
        ({"dtype": np.dtype(np.float64)}, "", "doubles"),
        ({"precision": "double"}, "", "doubles"),
        ({"operation": SimpleNamespace(precision="double", variant="auto")}, "", "doubles"),
        ({"rows": 3}, "double", "doubles"),
        ({"rows": 3}, "vectors", "vectors"),
        ({"variant": "vector"}, "", "vectors"),
        ({"kernel": ("vector", np.float32)}, "", "vectors"),
        ({"kernel": (3, np.float64)}, "", "doubles"),
        ({"operation": SimpleNamespace(variant="vector")}, "", "vectors"),
    ],
    ids=repr,
)
def test_a_device_runs_no_case_that_it_refuses(parameters: dict[str, Any], mark: str, expected: str) -> None:
    for has_double in (False, True):
        for takes_vectors in (False, True):
            device = SimpleNamespace(has_double=has_double, takes_vectors=takes_vectors)
            item: Any = SimpleNamespace(
                callspec=SimpleNamespace(params={"device": device, **parameters}),
                get_closest_marker=lambda name: name == mark,
            )
            lacking = {"doubles": not has_double, "vectors": not takes_vectors}
            assert bool(is_refused(item)) == lacking.get(expected, False)


@pytest.mark.parametrize("kind", ["pocl", "intel", "rusticl"])
def test_no_test_vanishes_on_a_cpu_runtime_with_doubles(kind: str) -> None:
    """A fault of ``Device.has_double`` or ``Device.takes_vectors`` must not deselect all tests of a kernel."""
    for has_double, takes_vectors in ((True, True), (False, True), (True, False)):
        device = SimpleNamespace(kind=kind, label=f"{kind}:1", has_double=has_double, takes_vectors=takes_vectors)
        items: list[Any] = [
            SimpleNamespace(
                nodeid=f"test_a.py::test_b[{variant}]",
                callspec=SimpleNamespace(params={"device": device, "dtype": dtype, "variant": variant}),
                get_closest_marker=lambda name: None,
            )
            for dtype, variant in ((np.float32, "work_item"), (np.float64, "work_item"), (np.float32, "vector"))
        ]
        refused = [each for each, has in zip(items[1:], (has_double, takes_vectors), strict=True) if not has]
        assert split_refused(items) == ([each for each in items if each not in refused], refused)
        unexpected = refused[0] if refused and kind != "rusticl" else None
        assert unexpected_refusal(refused) is unexpected
        if unexpected is not None:
            expected = rf"device {kind}:1 refuses test_a\.py::test_b\[\w+\] \(has_double {has_double}, takes_vectors"
            assert re.match(expected, refusal_message(unexpected))


def test_the_requested_device_runs_the_whole_tier(monkeypatch: pytest.MonkeyPatch) -> None:
    for device in Device.all():
        monkeypatch.setenv("GPUVISION_DEVICE", device.label)
        assert best_devices() == (device,)
    monkeypatch.setenv("GPUVISION_DEVICE", "no such device")
    with pytest.raises(pytest.UsageError, match="no such device"):
        best_devices()
    monkeypatch.delenv("GPUVISION_DEVICE")
    assert best_devices() == Device.all()[:1]
    monkeypatch.setattr(Device, "all", staticmethod(lambda: ()))
    assert best_devices() == ()


CASES = """
import numpy as np
import pytest

@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_case(device, dtype):
    pass
"""
WITHOUT_DOUBLES = """
from gpuvision.host import Device

for device in Device.all():
    device.has_double = False
    device.kind = {kind}
"""


def run_cases(folder: Path, device: Device, kind: str = "", *, workers: int = 0) -> subprocess.CompletedProcess[str]:
    """Run two cases for each device in the fast tier, with a device as the best one; a kind has no doubles."""
    (folder / "conftest.py").write_text((ROOT / "tests" / "conftest.py").read_text())
    (folder / "test_cases.py").write_text(CASES)
    (folder / "without_doubles.py").write_text(WITHOUT_DOUBLES.format(kind=kind) if kind else "")
    options = [
        "-p",
        "no:cacheprovider",
        "-p",
        "without_doubles",
        "-o",
        f"pythonpath={ROOT / 'tests'}",
        "-n",
        str(workers),
    ]
    command = [sys.executable, "-m", "pytest", "-q", "--tier", "fast", *options, str(folder)]
    environment = os.environ | {"GPUVISION_DEVICE": device.label, "PYTHONPATH": f"{ROOT}:{folder}"}
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, env=environment)


@pytest.mark.slow
def test_the_fast_tier_runs_whole_on_the_requested_device(tmp_path: Path) -> None:
    *others, last = Device.all()
    run = run_cases(tmp_path, last)
    assert f"kernel tests passed: {last.label} 2\n" in run.stdout, run.stdout
    left = ", ".join(f"{each} 2" for each in sorted(each.label for each in others))
    assert f"left to the full tier (make test-full): {left}\n" in run.stdout or not left
    assert "left to no tier" not in run.stdout


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_summary_counts_refused_tests(tmp_path: Path, workers: int) -> None:
    device = Device.best()
    run = run_cases(tmp_path, device, "'other'", workers=workers)
    assert f"kernel tests passed: {device.label} 1\n" in run.stdout, run.stdout
    refused = ", ".join(f"{each} 1" for each in sorted(each.label for each in Device.all()))
    assert f"left to no tier, because the device refuses them: {refused}\n" in run.stdout


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_run_in_which_pocl_refuses_doubles_fails(tmp_path: Path, workers: int) -> None:
    run = run_cases(tmp_path, Device.best(), "'pocl'", workers=workers)
    assert run.returncode == pytest.ExitCode.TESTS_FAILED, run.stdout + run.stderr
    assert "refuses test_cases.py::test_case[" in run.stdout, run.stdout


def test_one_case_of_each_function_of_a_kernel(tmp_path: Path) -> None:
    """The option ``--one-case`` leaves first cases on the best device: of kernels, of shared code and of tests/host."""
    other = SimpleNamespace(label="other")
    best = SimpleNamespace(label="best")

    def item_of(path: str, function: str, device: Any) -> Any:
        place = tmp_path / path
        params = {"device": device} if device else {}
        return Case(name="", path=place, parent=place, originalname=function, callspec=SimpleNamespace(params=params))

    psd, whole = "ranging/test_psd.py", "workflows/test_psd.py"
    places = [(psd, "a", other), (psd, "a", best), (psd, "a", best), (psd, "b", best), (psd, "c", None)]
    places += [(whole, "a", best), ("ranging/test_focus.py", "a", best), ("host/test_ring.py", "a", best)]
    places += [(name, "a", best) for name in ("test_two_float.py", "test_lanes.py", "test_work_groups.py")]
    places += [("matching/test_problem_groups.py", "a", best), ("test_two_float.py", "a", best)]
    items = [item_of(*each) for each in places]
    chosen, left, without_inline = one_case_each(Selection(items, [], {items[1], items[2]}), [best])
    assert [items.index(each) for each in chosen] == [1, 3, 7, 8, 9, 10, 11]
    assert [items.index(each) for each in left] == [0, 2, 4, 5, 6, 12]
    assert without_inline == {items[1]}
