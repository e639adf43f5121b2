"""Stored light: files of blocks, what is computed again, progress, and the work of a Dask cluster."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.host.errors import RecordingError
from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.sensors.readings import GroundTruth
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.workflows import light_cache
from gpuvision.workflows.light_cache import (
    LightBlock,
    LightStore,
    SimulationTask,
    compute_block,
    compute_missing_blocks,
    make_light_paths,
)


def task_of(count: int, sensor: Any = None) -> Any:
    """Return a task of some profiles, 16 in a block, whose fingerprint is "abc"."""
    task = SimulationTask(
        part="part",  # type: ignore[arg-type]
        materials=("material",),  # type: ignore[arg-type]
        sensor=sensor,
        transports=0.5 * np.arange(count),
        paths=("direct", "glow"),
        tolerance=1e-6,
        patch_size=2e-3,
    )
    task.__dict__["fingerprint"] = "abc"
    return task


def block_of(rng: np.random.Generator, profiles: int = 3) -> LightBlock:
    fields = len(GroundTruth._fields)
    truth = GroundTruth(*rng.normal(size=(fields, profiles, 5)))
    exposures = {name: Exposure(*rng.uniform(size=(2, profiles, 5, 7))) for name in ("direct", "glow")}
    return LightBlock(exposures, truth, {"pairs": rng.integers(0, 9, profiles), "bound": rng.uniform(size=profiles)})


@pytest.mark.parametrize(("count", "sizes"), [(1, [1]), (16, [16]), (17, [16, 1]), (40, [16, 16, 8])])
def test_profiles_of_blocks(count: int, sizes: list[int]) -> None:
    blocks = task_of(count).blocks()
    assert [len(each) for each in blocks] == sizes
    assert [number for each in blocks for number in each] == list(range(count))


def test_a_block_is_kept_in_single_precision(tmp_path: Path, rng: np.random.Generator) -> None:
    """Powers and moments are rounded to single, positions and statistics are kept exactly."""
    block = block_of(rng)
    (tmp_path / "block.npz").write_bytes(block.to_bytes())
    found = LightBlock.from_file(tmp_path / "block.npz")
    assert list(found.exposures) == ["direct", "glow"]
    for name, exposure in block.exposures.items():
        for kept, given in zip(found.exposures[name], exposure, strict=True):
            assert kept.dtype == np.float64
            np.testing.assert_array_equal(kept, given.astype(np.float32))
    for kept, given in zip(found.truth, block.truth, strict=True):
        np.testing.assert_array_equal(kept, given)
    assert list(found.statistics) == ["pairs", "bound"]
    for name, values in block.statistics.items():
        np.testing.assert_array_equal(found.statistics[name], values)
    np.savez(tmp_path / "other.npz", frames=np.zeros(3))
    with pytest.raises(RecordingError, match=r"other\.npz: holds no simulated light; delete it, and it is computed"):
        LightBlock.from_file(tmp_path / "other.npz")


def test_only_missing_and_damaged_blocks_are_computed(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 40 profiles the first 16 are stored, the file of the next 16 is cut, the last 8 are missing."""
    store = LightStore(tmp_path, task_of(40))
    assert store.path(7) == tmp_path / "light" / "abc" / "block_00007.npz"
    contents = [block_of(rng, 16).to_bytes(), block_of(rng, 16).to_bytes(), block_of(rng, 8).to_bytes()]
    store.write(0, contents[0])
    store.write(1, contents[1][:-100])
    assert store.missing() == [1, 2]
    asked: list[Any] = []
    monkeypatch.setattr(
        light_cache,
        "compute_block",
        lambda task, number, device: asked.append((task, number, device)) or contents[number],
    )
    steps: list[Any] = []
    device: Any = "cpu"
    assert compute_missing_blocks(store, device=device, progress=lambda *given: steps.append(given)) == 2
    assert asked == [(store.task, 1, "cpu"), (store.task, 2, "cpu")]
    assert steps == [(16, 40), (32, 40), (40, 40)]
    assert [len(block.truth[0]) for block in store] == [16, 16, 8]
    assert store.missing() == []
    assert compute_missing_blocks(store) == 0


@pytest.mark.parametrize("place", ["light", "light/abc"])
def test_a_file_in_the_place_of_the_light_is_refused_before_the_work(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / place).write_text("a user's")
    monkeypatch.setattr(light_cache, "compute_block", lambda *_: pytest.fail("computed"))
    with pytest.raises(
        NotADirectoryError, match=rf"cannot write into .*: {tmp_path / place} is a file, expected a fol"
    ):
        compute_missing_blocks(LightStore(tmp_path, task_of(4)))
    assert (tmp_path / place).read_text() == "a user's"


def test_a_block_stacks_its_profiles(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator, tmp_path: Path) -> None:
    """The second block of 18 profiles has the transports 8.0 and 8.5."""
    asked: list[np.ndarray] = []
    lights = [
        SimpleNamespace(
            exposures={"direct": Exposure(*rng.uniform(size=(2, 5, 7)).astype(np.float32))},
            truth=GroundTruth(*rng.normal(size=(len(GroundTruth._fields), 5))),
            statistics={"pairs": 3.0 + number},
        )
        for number in range(2)
    ]
    paths = SimpleNamespace(profiles=lambda transports: asked.append(transports) or lights)
    monkeypatch.setattr(light_cache, "_cached_light_paths", lambda task, device: paths)
    (tmp_path / "block.npz").write_bytes(compute_block(task_of(18), 1))
    found = LightBlock.from_file(tmp_path / "block.npz")
    assert [each.tolist() for each in asked] == [[8.0, 8.5]]
    for number, light in enumerate(lights):
        for kept, given in zip(found.exposures["direct"], light.exposures["direct"], strict=True):
            np.testing.assert_array_equal(kept[number], given)
        for kept, given in zip(found.truth, light.truth, strict=True):
            np.testing.assert_array_equal(kept[number], given)
    assert found.statistics["pairs"].tolist() == [3.0, 4.0]


@pytest.mark.parametrize(("preset", "end_bins"), [("psd_line", 24), ("camera_line", 0)])
def test_light_paths_of_a_task(preset: str, end_bins: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the 96 bins of a PSD lies beyond each end; its rays are spread."""
    made: list[dict[str, Any]] = []
    monkeypatch.setattr(light_cache, "LightPaths", lambda **options: made.append(options) or "paths")
    for name, function in (("view", "make_sensor_view"), ("sheet", "make_light_sheet")):
        monkeypatch.setattr(light_cache, function, lambda sensor, name=name: (name, sensor))
    sensor = Sensor.load(preset)
    device: Any = "cpu"
    task = dataclasses.replace(task_of(3, sensor), bounce_nodes=(1, 2))
    assert make_light_paths(task, device) == "paths"
    (options,) = made
    light = sensor.light
    assert light is not None
    assert options == {
        "view": ("view", sensor),
        "sheet": ("sheet", sensor),
        "scene": "part",
        "materials": ("material",),
        "paths": ("direct", "glow"),
        "sub_sheets": light.sub_sheets,
        "blur": light.blur,
        "nodes": light.nodes,
        "bounce_nodes": (1, 2),
        "spreads_rays": preset == "psd_line",
        "end_bins": end_bins,
        "patch_size": 2e-3,
        "tolerance": 1e-6,
        "min_power": light_cache.minimum_sample_power(sensor),
        "device": "cpu",
    }


def test_light_paths_are_kept_for_one_task_and_device(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(light_cache, "_CACHE", {})
    monkeypatch.setattr(
        light_cache, "make_light_paths", lambda task, device: made.append((task.fingerprint, device.label)) or len(made)
    )
    one, other = task_of(1), task_of(1)
    other.__dict__["fingerprint"] = "def"
    cpu: Any = SimpleNamespace(label="cpu")
    gpu: Any = SimpleNamespace(label="gpu")
    found = [light_cache._cached_light_paths(*each) for each in ((one, cpu), (one, cpu), (one, gpu), (other, gpu))]
    assert found == [1, 1, 2, 3]
    assert made == [("abc", "cpu"), ("abc", "gpu"), ("def", "gpu")]
    assert light_cache._cached_light_paths(one, cpu) == 4  # the cache holds one task


def test_blocks_of_a_cluster_come_in_any_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """The task is sent once; each block has a key of its own."""
    contents = [block_of(rng, 16).to_bytes(), block_of(rng, 16).to_bytes(), block_of(rng, 8).to_bytes()]
    calls: list[Any] = []

    class Client:
        def __init__(self, address: str, **options: Any) -> None:
            calls.append((address, options))

        def __enter__(self) -> Client:
            return self

        def __exit__(self, *_: object) -> None:
            calls.append("closed")

        def as_current(self) -> Any:
            return contextlib.nullcontext()

        def scatter(self, task: Any, broadcast: bool) -> Any:
            calls.append(("scattered", task, broadcast))
            return "everywhere"

        def submit(self, function: Any, *given: Any, key: str) -> str:
            assert function is light_cache._compute_on_worker
            calls.append(given)
            return key

    def as_completed(futures: dict[str, int], with_results: bool) -> Iterator[tuple[str, bytes]]:
        assert with_results
        for key in reversed(list(futures)):
            yield key, contents[int(key.rpartition("-")[2])]

    dask: Any = ModuleType("distributed")
    dask.Client, dask.as_completed = Client, as_completed
    monkeypatch.setitem(sys.modules, "distributed", dask)
    monkeypatch.setattr(light_cache, "source_digest", lambda: "digest")
    store = LightStore(tmp_path, task_of(40))
    steps: list[Any] = []
    assert compute_missing_blocks(store, scheduler="tcp://a:1", progress=lambda *given: steps.append(given)) == 3
    assert steps == [(0, 40), (8, 40), (24, 40), (40, 40)]
    assert calls == [
        ("tcp://a:1", {"timeout": "10s", "set_as_default": False}),
        ("scattered", store.task, True),
        *[("everywhere", number, "digest") for number in range(3)],
        "closed",
    ]
    assert [store.path(number).read_bytes() for number in range(3)] == contents
    monkeypatch.setitem(sys.modules, "distributed", None)
    store.path(0).unlink()
    with pytest.raises(ImportError, match=r"a scheduler needs Dask: pip install 'gpuvision\[cluster\]'"):
        compute_missing_blocks(store, scheduler="tcp://a:1")
