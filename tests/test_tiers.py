"""The fast tier has the tests that find the planted faults."""

from __future__ import annotations

import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device
from tiers import collected_items, device_of, function_of, is_refused, select_fast, without_other_variants

ROOT = Path(__file__).resolve().parents[1]
PLANTED = tomllib.loads((ROOT / "tests" / "mutants" / "planted.toml").read_text())["fault"]
KILLING = sorted({name for fault in PLANTED for name in fault["tests"]})


@pytest.mark.parametrize("name", KILLING)
def test_the_fast_tier_has_each_killing_test(request: pytest.FixtureRequest, name: str) -> None:
    path, _, function = name.partition("::")
    function = function.partition("[")[0]
    of_file = [item for item in collected_items(request.session) if item.path == ROOT / path]
    named = {item for item in of_file if function_of(item) == function or not function}
    best = Device.all()[:1]
    chosen = named.intersection(select_fast(of_file, best).chosen)
    # A run of other files collects none of them.
    assert not named or any(device_of(item) in (None, *best) for item in chosen)


def test_the_fast_tier_holds_each_value_of_each_parameter(request: pytest.FixtureRequest) -> None:
    best = Device.all()[:1]
    items = [item for item in collected_items(request.session) if device_of(item) in best]
    fast = [item for item in items if item.get_closest_marker("slow") is None]
    expected = _values(list(without_other_variants(fast)))
    assert _values(select_fast(items, best).chosen) == expected


def _values(items: list[pytest.Item]) -> set[tuple[object, ...]]:
    return {
        (item.parent, function_of(item), name, repr(value))
        for item in items
        if hasattr(item, "callspec")
        for name, value in item.callspec.params.items()
    }


@pytest.mark.parametrize(
    ("parameters", "has_mark", "expected"),
    [
        ({"dtype": np.float32, "variant": "work_item"}, False, "nothing"),
        ({"dtype": np.float64}, False, "doubles"),
        ({"dtype": np.dtype(np.float64)}, False, "doubles"),
        ({"precision": "double"}, False, "doubles"),
        ({"operation": SimpleNamespace(precision="double", variant="auto")}, False, "doubles"),
        ({"rows": 3}, True, "doubles"),
        ({"variant": "vector"}, False, "vectors"),
        ({"kernel": ("vector", np.float32)}, False, "vectors"),
        ({"kernel": (3, np.float64)}, False, "doubles"),
        ({"operation": SimpleNamespace(variant="vector")}, False, "vectors"),
    ],
    ids=repr,
)
def test_a_device_runs_no_case_that_it_refuses(parameters: dict[str, Any], has_mark: bool, expected: str) -> None:
    for has_double in (False, True):
        for takes_vectors in (False, True):
            device = SimpleNamespace(has_double=has_double, takes_vectors=takes_vectors)
            item: Any = SimpleNamespace(
                callspec=SimpleNamespace(params={"device": device, **parameters}),
                get_closest_marker=lambda name: has_mark and name == "double",
            )
            lacking = {"doubles": not has_double, "vectors": not takes_vectors}
            assert bool(is_refused(item)) == lacking.get(expected, False)
