"""Selection of the fast tier: tests of the best device, a smoke set of the others, covering designs of products."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import pytest

from designs import covering
from gpuvision.host import Device

# Folders whose tests run whole tasks with the kernels of other files.
_COMPOSED = frozenset({"cli", "profiling", "workflows"})
# Tests of this run that the fast tier leaves to the full tier, for `pytest.Session`.
LEFT = pytest.StashKey[list[pytest.Item]]()


class Selection(NamedTuple):
    """Tests of the fast tier, in their order.

    Attributes
    ----------
    chosen : list of pytest.Item
        Tests of the fast tier.
    left : list of pytest.Item
        Slow tests, cases beyond a covering design and, on all devices but the best, tests beyond the smoke set.
    without_inline : set of pytest.Item
        Chosen tests that run without PoCL's inline device, for which PoCL compiles each kernel once more: all tests
        outside ``tests/host`` that are not in the smoke set.
    """

    chosen: list[pytest.Item]
    left: list[pytest.Item]
    without_inline: set[pytest.Item]


def select_fast(items: Sequence[pytest.Item], best: Collection[Device]) -> Selection:
    """Return the fast tier of some tests; `best` has the best device."""
    fast = [item for item in items if item.get_closest_marker("slow") is None]
    designed = set(_designed(fast))
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
        if is_more and not _is_of_host(item):
            selection.without_inline.add(item)
    return selection


def collected_items(session: pytest.Session) -> list[pytest.Item]:
    """Return the tests that were collected before the tier's selection."""
    return [*session.items, *session.config.stash.get(LEFT, [])]


def _designed(items: Sequence[pytest.Item]) -> Iterator[pytest.Item]:
    """Yield a covering design of each kernel test, and all cases of other tests.

    Most of a kernel test's time is compilation, once for each kernel variant, dtype and option. Of a test with two
    parameters the design holds each value, of a test with more each pair of values; the device is not a parameter.
    In ``tests/host``, which compiles little, it holds each pair in both cases.
    """
    functions: dict[Any, list[pytest.Item]] = {}
    for item in items:
        functions.setdefault((item.parent, function_of(item), device_of(item)), []).append(item)
    for (_, _, device), cases in functions.items():
        parameters = [
            {name: value for name, value in _parameters_of(item).items() if name != "device"} for item in cases
        ]
        strength = 1 if len(parameters[0]) == 2 and not _is_of_host(cases[0]) else 2
        is_product = device is not None and len(parameters[0]) > 1
        yield from (cases[k] for k in (covering(parameters, strength) if is_product else range(len(cases))))


def _smoke_case(item: pytest.Item) -> tuple[Any, ...] | None:
    """Return a key: file and device; the smoke set has the first test of each key.

    Runtimes differ most in queues and memory: in ``tests/host`` the key also has the test function. ``None``: the smoke
    set has no test of the file, because it runs whole tasks with the kernels of other files.
    """
    if item.path.parent.name in _COMPOSED:
        return None
    function = function_of(item) if _is_of_host(item) else ""
    return (item.path, function, str(device_of(item)))


def _is_of_host(item: pytest.Item) -> bool:
    return item.path.parent.name == "host"


def function_of(item: pytest.Item) -> str:
    """Return the name of the test function, without the parameters."""
    name: str = getattr(item, "originalname", item.name)
    return name


def device_of(item: pytest.Item) -> Device | None:
    """Return the device of a kernel test; None for another test."""
    return _parameters_of(item).get("device")


def _parameters_of(item: pytest.Item) -> Mapping[str, Any]:
    return item.callspec.params if hasattr(item, "callspec") else {}
