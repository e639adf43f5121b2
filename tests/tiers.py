"""Selection of the fast and of the full tier: what the best device runs, and what the other devices run of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from designs import Combination, combinations, covering
from gpuvision.host import Device
from gpuvision.host.errors import GpuVisionError
from gpuvision.host.launch import Variant

_ROOT = Path(__file__).resolve().parents[1]
# Names of the test files that are about one kernel; other files run whole tasks with kernels of these files.
_OF_KERNELS = {f"test_{path.parent.name}" for path in (_ROOT / "kernels").glob("*/*.cl")}
# Folders whose test files are not about a kernel, also where they have the name of one.
_COMPOSED = frozenset({"cli", "formats", "profiling", "workflows"})
# Test files about code that several kernels share: headers of kernels/common, and how launches divide work.
_OF_SHARED_CODE = frozenset({"test_lanes", "test_problem_groups", "test_two_float", "test_work_groups"})
# Test functions of a file that the fast tier runs in both kernel variants: the variants differ in few functions of a
# kernel, and each variant takes another compilation.
_IN_BOTH_VARIANTS = 2
# Kinds of runtimes whose devices have doubles and vectors of 16: a refused case is a fault of `gpuvision.host`.
_REFUSING_NOTHING = ("pocl", "intel")
# Tests of this run that the tier leaves out, for `pytest.Session`.
LEFT = pytest.StashKey[list[pytest.Item]]()


class Selection(NamedTuple):
    """Tests of a tier, in their order.

    Attributes
    ----------
    chosen : list of pytest.Item
        Tests of the tier.
    left : list of pytest.Item
        The other tests.
    without_inline : set of pytest.Item
        Chosen tests that run without PoCL's inline device, for which PoCL compiles each kernel once more: all tests
        outside ``tests/host``. Subprocesses that tests start have the inline device.
    """

    chosen: list[pytest.Item]
    left: list[pytest.Item]
    without_inline: set[pytest.Item]


def best_devices() -> tuple[Device, ...]:
    """Return the device that runs the whole tier: the default device; none without a healthy device.

    Raises
    ------
    pytest.UsageError
        ``GPUVISION_DEVICE`` names no healthy device.
    """
    if not Device.all():
        return ()
    try:
        return (Device.best(),)
    except GpuVisionError as error:
        raise pytest.UsageError(str(error)) from error


def select_full(items: Sequence[pytest.Item], best: Collection[Device]) -> Selection:
    """Return the full tier of some tests; `best` has the best device.

    The best device runs all tests; of kernel tests with several ``parametrize`` marks it runs a design that holds each
    pair of values. Every other device runs no slow tests: these measure accuracy, which the comparison of the devices
    with the references covers. It runs each value of each kernel test, and each pair of values in one kernel test of
    the file; of tests that use the kernels of other files it runs designs as the fast tier does. It runs no tests of
    the profiler, which measures all devices in the same way.
    """
    others = [item for item in items if device_of(item) not in (None, *best)]
    short = [item for item in others if item.get_closest_marker("slow") is None and not _is_of_profiler(item)]
    kernels = [item for item in items if device_of(item) in best and _is_of_kernel(item) and _has_product(item)]
    kept = {*_pairs(kernels), *_pairs_of_files([item for item in short if _is_of_kernel(item)])}
    kept.update(_designed([item for item in short if not _is_of_kernel(item)]))
    designed = {*others, *kernels}
    left = [item for item in items if (item in designed and item not in kept) or _is_nightly(item)]
    omitted = set(left)
    return Selection([item for item in items if item not in omitted], left, set())


def select_fast(items: Sequence[pytest.Item], best: Collection[Device]) -> Selection:
    """Return the fast tier of some tests; `best` has the best device.

    It leaves out slow tests, cases of the kernel variant that the device does not use by default beyond the first
    functions of a file, cases beyond a covering design and, on all devices but the best, tests beyond the smoke set.
    """
    fast = [item for item in items if item.get_closest_marker("slow") is None and not _is_nightly(item)]
    designed = set(_designed(list(without_other_variants(fast))))
    selection = Selection([], [], set())
    seen = set()
    for item in items:
        device = device_of(item)
        case = _smoke_case(item)
        is_more = device is not None and (case is None or case in seen)
        if item not in designed or (is_more and device not in best):
            selection.left.append(item)
            continue
        seen.add(case)
        selection.chosen.append(item)
        if not _is_of_host(item):
            selection.without_inline.add(item)
    return selection


def one_case_each(selection: Selection, best: Collection[Device]) -> Selection:
    """Return the first case of each test function that `has_one_case` accepts, on the best device.

    For a runtime that compiles slowly: most functions have one set of build options in their first case.
    """
    first: dict[Any, pytest.Item] = {}
    for item in selection.chosen:
        if device_of(item) in best and has_one_case(item.path):
            first.setdefault((item.path, item.parent, function_of(item)), item)
    chosen = list(first.values())
    kept = set(chosen)
    left = [*selection.left, *(item for item in selection.chosen if item not in kept)]
    return Selection(chosen, left, selection.without_inline & kept)


def has_one_case(path: Path) -> bool:
    """Return whether `one_case_each` chooses tests of a file: about a kernel or shared code, or in ``tests/host``."""
    is_of_kernel = path.stem in _OF_KERNELS and path.parent.name not in _COMPOSED
    return is_of_kernel or path.parent.name == "host" or path.stem in _OF_SHARED_CODE


def is_refused(item: pytest.Item) -> bool:
    """Return whether the device of a test lacks a property that the test needs.

    Cases of float64 and double precision, and tests with the mark ``double``, need a device with doubles. Cases of the
    vector variant, and tests with the mark ``vectors``, need a runtime with vectors of 16: others may abort the
    process.
    """
    device = device_of(item)
    if device is None:
        return False
    given = [value for name, value in _parameters_of(item).items() if name != "device"]
    values = [value for each in given for value in (each if isinstance(each, tuple) else (each,))]
    if not device.has_double and (item.get_closest_marker("double") or any(map(_is_double, values))):
        return True
    needs_vectors = item.get_closest_marker("vectors") or any(_variant_of(value) == "vector" for value in values)
    return bool(needs_vectors) and not device.takes_vectors


def variants_of(device: Device) -> tuple[Variant, ...]:
    """Return the kernel variants that a device takes, for tests that choose the variant themselves."""
    return ("vector", "work_item") if device.takes_vectors else ("work_item",)


def split_refused(items: Sequence[pytest.Item]) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """Return the tests that devices run, and the tests that they refuse."""
    run: list[pytest.Item] = []
    refused: list[pytest.Item] = []
    for item in items:
        (refused if is_refused(item) else run).append(item)
    return run, refused


def unexpected_refusal(refused: Sequence[pytest.Item]) -> pytest.Item | None:
    """Return the first test that PoCL or Intel's CPU runtime refuses, or None.

    These have doubles and vectors: without this check all such tests would vanish.
    """
    return next((item for item in refused if getattr(device_of(item), "kind", None) in _REFUSING_NOTHING), None)


def refusal_message(item: pytest.Item) -> str:
    """Return what a device refuses, for a test that it refuses."""
    device = device_of(item)
    assert device is not None
    return (
        f"device {device.label} refuses {item.nodeid} (has_double {device.has_double}, "
        f"takes_vectors {device.takes_vectors}); every {device.kind} device runs such tests"
    )


def _is_double(value: Any) -> bool:
    if isinstance(value, str):
        return value in ("double", "float64")
    if isinstance(value, (type, np.dtype)):
        return value in (np.float64, np.dtype(np.float64))
    return getattr(value, "precision", None) == "double"


def _variant_of(value: Any) -> Any:
    return value if isinstance(value, str) else getattr(value, "variant", None)


def collected_items(session: pytest.Session) -> list[pytest.Item]:
    """Return the tests that were collected before the tier's selection."""
    return [*session.items, *session.config.stash.get(LEFT, [])]


def without_other_variants(items: Sequence[pytest.Item]) -> Iterator[pytest.Item]:
    """Yield the tests; beyond the first functions of each file, only tests of the device's default kernel variant.

    A function without cases of the device's default variant keeps its cases.
    """
    by_function: dict[Any, list[pytest.Item]] = {}
    for item in items:
        by_function.setdefault((item.path, device_of(item), item.parent, function_of(item)), []).append(item)
    functions: Counter[Any] = Counter()
    for (path, device, *_), cases in by_function.items():
        usual = [item for item in cases if _has_usual_variant(item)]
        if len(usual) < len(cases) and not _is_of_host(cases[0]):
            functions[path, device] += 1
        yield from usual if usual and functions[path, device] > _IN_BOTH_VARIANTS else cases


def _has_usual_variant(item: pytest.Item) -> bool:
    """Return whether a kernel test has the variant that its device uses by default; True for other tests."""
    device, variant = device_of(item), _parameters_of(item).get("variant")
    return device is None or variant != ("work_item" if device.prefers_vectors else "vector")


def _designed(items: Sequence[pytest.Item]) -> Iterator[pytest.Item]:
    """Yield a covering design of the cases of each test.

    Most of a kernel test's time is compilation, once for each kernel variant, dtype and option. Of a test with two
    parameters the design holds each value, of a test with more each pair of values; the device is not a parameter.
    Parameters that one mark lists together count as one: always in tests without a device, whose lists are chosen
    examples, and in kernel tests if the design is smaller then. In ``tests/host``, which compiles little, it holds each
    pair of values in all cases.
    """
    for (_, _, device), cases in _by_function(items):
        single = [{name: value for name, value in _parameters_of(item).items() if name != "device"} for item in cases]
        joined = _joined(cases) if single[0] else single
        parameters = joined if device is None else single
        if _varying(parameters) < 2:
            yield from cases
            continue
        design = covering(parameters, 2)
        if not _is_of_host(cases[0]):
            others = (joined,) if device is None else (single, joined)
            design = min((design, *(covering(each, 1) for each in others if _varying(each) == 2)), key=len)
        yield from (cases[k] for k in design)


def _pairs(items: Sequence[pytest.Item]) -> Iterator[pytest.Item]:
    """Yield a design for each test function and device that holds each pair of values; see `_entries`."""
    for _, cases in _by_function(items):
        entries = _entries(cases)
        design = covering(entries, 2) if len(entries[0]) > 1 else range(len(cases))
        yield from (cases[k] for k in design)


def _pairs_of_files(items: Sequence[pytest.Item]) -> Iterator[pytest.Item]:
    """Yield designs that hold each value in each test function, and each pair of values in one function of the file.

    Test functions of a file use the same names of parameters, and the same build options.
    """
    held: dict[Any, set[Combination]] = {}
    for (parent, _, device), cases in _by_function(items):
        entries = _entries(cases)
        if len(entries[0]) < 2:
            yield from cases
            continue
        of_file = held.setdefault((parent, device), set())
        design = set(covering(entries, 1))
        of_file.update(*(combinations(entries[k], 2) for k in design))
        design.update(covering(entries, 2, held=of_file))
        of_file.update(*(combinations(entries[k], 2) for k in design))
        yield from (cases[k] for k in sorted(design))


def _by_function(items: Sequence[pytest.Item]) -> Iterable[tuple[tuple[Any, str, Device | None], list[pytest.Item]]]:
    """Return the cases of each test function on each device."""
    functions: dict[tuple[Any, str, Device | None], list[pytest.Item]] = {}
    for item in items:
        functions.setdefault((item.parent, function_of(item), device_of(item)), []).append(item)
    return functions.items()


def _entries(cases: Sequence[pytest.Item]) -> list[dict[str, Any]]:
    """Return the varying parameters of each case; entries of tuples of one length are parameters."""
    columns: dict[str, list[Any]] = {}
    for name in _parameters_of(cases[0]):
        values = [_parameters_of(item)[name] for item in cases]
        if all(isinstance(value, tuple) and len(value) == len(values[0]) for value in values):
            columns.update({f"{name}.{k}": list(entries) for k, entries in enumerate(zip(*values, strict=True))})
        else:
            columns[name] = values
    varying = {name: values for name, values in columns.items() if len(set(map(repr, values))) > 1}
    return [{name: values[k] for name, values in varying.items()} for k in range(len(cases))]


def _is_nightly(item: pytest.Item) -> bool:
    return item.get_closest_marker("nightly") is not None


def _has_product(item: pytest.Item) -> bool:
    """Return whether several ``parametrize`` marks, besides the device, multiply the cases of a test."""
    return len(list(item.iter_markers("parametrize"))) > 1


def _varying(cases: Sequence[Mapping[str, Any]]) -> int:
    """Return the number of parameters that do not have the same value in all cases."""
    return sum(len({repr(each[name]) for each in cases}) > 1 for name in cases[0])


def _joined(items: Sequence[pytest.Item]) -> list[dict[str, Any]]:
    """Return the parameters of each case, where the parameters of one ``parametrize`` mark are one."""
    listed = [mark.args[0] for mark in items[0].iter_markers("parametrize")]
    groups = [[name.strip() for name in (each.split(",") if isinstance(each, str) else each)] for each in listed]
    group_of = {name: "-".join(group) for group in groups for name in group}
    joined = []
    for item in items:
        case: dict[str, Any] = {}
        for name, value in _parameters_of(item).items():
            if name != "device":
                key = group_of.get(name, name)
                case[key] = (*case.get(key, ()), value)
        joined.append(case)
    return joined


def _smoke_case(item: pytest.Item) -> tuple[Any, ...] | None:
    """Return a key: file and device; the smoke set has the first test of each key.

    Runtimes differ most in queues and memory: in ``tests/host`` the key also has the test function. ``None``: the smoke
    set has no test of the file, because it runs the kernels of other files.
    """
    if _is_of_host(item):
        return (item.path, function_of(item), str(device_of(item)))
    return (item.path, "", str(device_of(item))) if _is_of_kernel(item) else None


def _is_of_kernel(item: pytest.Item) -> bool:
    return item.path.stem in _OF_KERNELS and item.path.parent.name not in _COMPOSED


def _is_of_host(item: pytest.Item) -> bool:
    return item.path.parent.name == "host"


def _is_of_profiler(item: pytest.Item) -> bool:
    return item.path.parent.name == "profiling"


def function_of(item: pytest.Item) -> str:
    """Return the name of the test function, without the parameters."""
    name: str = getattr(item, "originalname", item.name)
    return name


def device_of(item: pytest.Item) -> Device | None:
    """Return the device of a kernel test; None for another test."""
    return _parameters_of(item).get("device")


def _parameters_of(item: pytest.Item) -> Mapping[str, Any]:
    return item.callspec.params if hasattr(item, "callspec") else {}
