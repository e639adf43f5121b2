"""Discovery of devices: labels, health verdicts and their cache, on fake platforms."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyopencl as cl
import pytest

from fakes import FakeDevice, FakePlatform
from gpuvision.host import Device, discovery

Probe = Callable[[int, int], str]


def _forget() -> None:
    discovery.listed_devices.cache_clear()
    discovery._probed_devices.cache_clear()


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return an empty cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "gpuvision"


@pytest.fixture
def see(monkeypatch: pytest.MonkeyPatch, cache: Path) -> Iterator[Callable[..., list[tuple[int, int]]]]:
    """Make the loader list the given platforms; return the log of the probes."""

    def install(*platforms: FakePlatform, probe: Probe = lambda p, d: "") -> list[tuple[int, int]]:
        probed: list[tuple[int, int]] = []

        def ask(p: int, d: int) -> str:
            probed.append((p, d))
            return probe(p, d)

        monkeypatch.setattr(discovery, "platforms", lambda: platforms)
        monkeypatch.setattr(discovery, "_ask_probe", ask)
        _forget()
        return probed

    yield install
    _forget()


def _program(folder: Path, text: str) -> str:
    path = folder / "python"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


def test_platforms_of_one_name_are_told_apart(see: Any) -> None:
    see(
        FakePlatform(version="3.1+debian", devices=[FakeDevice(driver_version="3.1+debian")]),
        FakePlatform(version="3.0", devices=[FakeDevice(driver_version="3.0")]),
        probe=lambda p, d: "cannot compile" if p == 1 else "",
    )
    good, bad = discovery.probed_devices()
    assert (good.label, good.healthy, good.platform_index) == ("pocl:0", True, 0)
    assert (bad.label, bad.healthy, bad.reason) == ("pocl:1", False, "cannot compile")


def test_twins_are_each_asked(see: Any) -> None:
    """Two devices with equal strings (two cards, two installations) may differ in health."""
    twins = FakePlatform("NVIDIA CUDA", vendor="NVIDIA", devices=[FakeDevice(), FakeDevice()])
    probed = see(twins, probe=lambda p, d: "broken" if d == 1 else "")
    assert [each.healthy for each in discovery.probed_devices()] == [True, False]
    assert probed == [(0, 0), (0, 1)]


@pytest.mark.parametrize(
    ("platform", "vendor", "gpu", "kind"),
    [
        ("Portable Computing Language", "The pocl project", False, "pocl"),
        ("Portable Computing Language", "The pocl project", True, "pocl-gpu"),
        ("Intel(R) OpenCL", "Intel(R) Corporation", False, "intel"),
        ("Intel(R) OpenCL Graphics", "Intel(R) Corporation", True, "intel-gpu"),
        ("NVIDIA CUDA", "NVIDIA Corporation", True, "nvidia"),
        ("AMD Accelerated Parallel Processing", "Advanced Micro Devices, Inc.", True, "amd"),
        ("Rusticl Mesa", "Mesa", True, "rusticl"),
        ("", "", False, "unknown"),
    ],
)
def test_kinds(platform: str, vendor: str, gpu: bool, kind: str) -> None:
    device = FakeDevice(vendor=vendor, type=cl.device_type.GPU if gpu else cl.device_type.CPU)
    FakePlatform(platform, vendor=vendor, devices=[device])
    assert discovery.kind_of(device) == kind


def test_order_of_preference(see: Any) -> None:
    names = ["Oclgrind", "Intel(R) OpenCL", "Other", "Portable Computing Language"]
    gpu = FakePlatform("NVIDIA CUDA", devices=[FakeDevice(type=cl.device_type.GPU)])
    see(*(FakePlatform(name, vendor="") for name in names), gpu)
    ranked = sorted(discovery.probed_devices(), key=lambda each: each.rank)
    assert [each.kind for each in ranked] == ["nvidia", "pocl", "intel", "other", "oclgrind"]


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ({"max_compute_units": 80}, {"max_compute_units": 16}),
        ({"global_mem_size": 16 << 30}, {"global_mem_size": 4 << 30}),
        ({"host_unified_memory": False, "max_compute_units": 40}, {"max_compute_units": 96}),
    ],
)
def test_larger_gpu_comes_first_whatever_its_label(see: Any, better: dict[str, Any], worse: dict[str, Any]) -> None:
    def gpu(**properties: Any) -> FakeDevice:
        return FakeDevice(type=cl.device_type.GPU, **properties)

    see(FakePlatform("AMD", devices=[gpu(**worse)]), FakePlatform("NVIDIA CUDA", devices=[gpu(**better)]))
    assert min(discovery.probed_devices(), key=lambda each: each.rank).kind == "nvidia"
    see(FakePlatform("AMD", devices=[gpu(**better)]), FakePlatform("NVIDIA CUDA", devices=[gpu(**worse)]))
    assert min(discovery.probed_devices(), key=lambda each: each.rank).kind == "amd"


def test_gpus_alike_rank_as_listed(see: Any) -> None:
    """Labels sort nvidia:10 before nvidia:2."""
    see(FakePlatform("NVIDIA CUDA", devices=[FakeDevice(type=cl.device_type.GPU) for _ in range(11)]))
    ranked = sorted(discovery.probed_devices(), key=lambda each: each.rank)
    assert [each.device_index for each in ranked] == [*range(11)]


def test_driver_of_the_maker_precedes_pocl_on_a_gpu(see: Any) -> None:
    gpu = cl.device_type.GPU
    see(
        FakePlatform(devices=[FakeDevice("NVIDIA A2", type=gpu, max_compute_units=99)]),
        FakePlatform("NVIDIA CUDA", vendor="NVIDIA", devices=[FakeDevice("NVIDIA A2", type=gpu)]),
        FakePlatform(devices=[FakeDevice()]),
    )
    ranked = sorted(discovery.probed_devices(), key=lambda each: each.rank)
    assert [each.label for each in ranked] == ["nvidia", "pocl-gpu", "pocl"]


@pytest.mark.parametrize(
    "reason",
    [
        "clCreateContext failed: OUT_OF_RESOURCES",
        "clEnqueueNDRangeKernel failed: MEM_OBJECT_ALLOCATION_FAILURE",
        "clBuildProgram failed: OUT_OF_HOST_MEMORY",
        "clCreateContext failed: DEVICE_NOT_AVAILABLE",
        "the runtime ended the probe's process (exit -9: no message)",
    ],
)
def test_verdict_of_a_busy_device_is_not_kept(see: Any, reason: str) -> None:
    see(FakePlatform(), probe=lambda p, d: reason)
    (busy,) = discovery.probed_devices()
    assert (busy.healthy, busy.reason) == (False, reason)
    assert "start again when it is idle" in busy.advice
    probed = see(FakePlatform())
    assert discovery.probed_devices()[0].healthy
    assert probed == [(0, 0)]


@pytest.mark.parametrize(
    "reason",
    [
        "the runtime ended the probe's process (exit 1: LLVM ERROR: No space left on device)",
        "the runtime ended the probe's process (exit 1: sqlite3.OperationalError: database or disk is full)",
        "clBuildProgram failed: IO failure on output stream: Disk quota exceeded",
        "the runtime ended the probe's process (exit 1: LLVM ERROR: File too large)",
    ],
)
def test_verdict_on_a_full_disk_is_not_kept(see: Any, reason: str) -> None:
    """Messages of PoCL 3.1 and pyopencl in a full cache folder; the device works as soon as there is space."""
    see(FakePlatform(), probe=lambda p, d: reason)
    (full,) = discovery.probed_devices()
    assert (full.healthy, full.reason) == (False, reason)
    assert f"free some space in {discovery.cache_folder()}" in full.advice
    probed = see(FakePlatform())
    assert discovery.probed_devices()[0].healthy
    assert probed == [(0, 0)]


def test_verdict_of_a_driver_without_answer_is_kept_for_an_hour(see: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1_000_000.0
    monkeypatch.setattr(discovery.time, "time", lambda: now)
    reason = "the probe kernel did not finish within 120 s"
    see(FakePlatform(), probe=lambda p, d: reason)
    assert discovery.probed_devices()[0].reason == reason
    now += 3500
    probed = see(FakePlatform())
    (hanging,) = discovery.probed_devices()
    assert (hanging.reason, probed) == (reason, []), "no process waits for it again"
    assert "kept for an hour: `gpuvision devices --probe` asks again" in hanging.advice
    now += 200
    probed = see(FakePlatform())
    assert discovery.probed_devices()[0].healthy
    assert probed == [(0, 0)]


def test_verdict_of_a_driver_without_answer_ends_with_a_new_probe(see: Any) -> None:
    two = FakePlatform(devices=[FakeDevice("good"), FakeDevice("hanging")])
    see(two, probe=lambda p, d: "the probe kernel did not finish within 120 s" if d else "")
    discovery.probed_devices()
    probed = see(two)
    assert all(each.healthy for each in discovery.probed_devices(probe_again=True))
    assert probed == [(0, 1)]
    probed = see(two)
    assert all(each.healthy for each in discovery.probed_devices())
    assert probed == []


@pytest.mark.parametrize("until", [0, 1 << 60, "soon", None, [1]])
def test_damaged_end_of_a_verdict_is_asked_anew(see: Any, cache: Path, until: Any) -> None:
    see(FakePlatform())
    discovery.probed_devices()
    file = cache / "devices.json"
    file.write_text(json.dumps({key: ["broken", until] for key in json.loads(file.read_text())}))
    file.chmod(0o600)
    probed = see(FakePlatform())
    assert discovery.probed_devices()[0].healthy
    assert probed == [(0, 0)]


def test_inline_device_is_listed_with_the_device_it_belongs_to(see: Any) -> None:
    basic, workers = FakeDevice("basic-cpu"), FakeDevice("pthread-cpu")
    see(FakePlatform(devices=[basic, workers]))
    (only,) = discovery.probed_devices()
    assert (only.label, only.handle, only.inline_device, only.device_index) == ("pocl", workers, basic, 1)
    see(FakePlatform(devices=[basic]))
    (only,) = discovery.probed_devices()
    assert (only.handle, only.inline_device) == (basic, None), "asked for alone, it is the device"


def test_platform_without_devices(see: Any) -> None:
    see(FakePlatform(devices=[]), FakePlatform())
    (only,) = discovery.probed_devices()
    assert (only.label, only.platform_index) == ("pocl", 1)


def test_verdicts_are_kept_by_driver(see: Any) -> None:
    probed = see(FakePlatform())
    discovery.probed_devices()
    assert probed == [(0, 0)]
    probed = see(FakePlatform())
    discovery.probed_devices()
    assert probed == [], "the verdict is in the cache"
    probed = see(FakePlatform(devices=[FakeDevice(driver_version="1.1")]))
    discovery.probed_devices()
    assert probed == [(0, 0)], "another driver is another question"


def test_probing_again_asks_only_the_unhealthy(see: Any) -> None:
    two = FakePlatform(devices=[FakeDevice("good"), FakeDevice("bad")])
    see(two, probe=lambda p, d: "broken" if d == 1 else "")
    discovery.probed_devices()
    probed = see(two)
    assert [each.healthy for each in discovery.probed_devices()] == [True, False]
    assert probed == []
    assert [each.healthy for each in discovery.probed_devices(probe_again=True)] == [True, True]
    assert probed == [(0, 1)]
    assert [each.healthy for each in discovery.probed_devices()] == [True, True], "the better verdict stays"


@pytest.mark.parametrize("content", ["", "{", "[1]", '{"a": 1}', '"text"', "\x00"])
def test_corrupt_cache_is_asked_anew(see: Any, cache: Path, content: str) -> None:
    cache.mkdir()
    (cache / "devices.json").write_text(content)
    probed = see(FakePlatform())
    assert discovery.probed_devices()[0].healthy
    assert probed == [(0, 0)]
    assert list(json.loads((cache / "devices.json").read_text()).values()) == [""]


def test_unwritable_cache_costs_only_the_question(see: Any, cache: Path) -> None:
    cache.write_text("a file where the folder should be")
    probed = see(FakePlatform())
    assert discovery.probed_devices()[0].healthy
    _forget()
    assert discovery.probed_devices()[0].healthy
    assert probed == [(0, 0), (0, 0)]


def test_no_platform(see: Any) -> None:
    see()
    assert discovery.probed_devices() == ()


def test_loader_without_platforms(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> None:
        raise cl.LogicError("clGetPlatformIDs", -1001, "PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(cl, "get_platforms", none)
    assert discovery.platforms.__wrapped__() == ()


@pytest.mark.parametrize(
    ("driver", "platform", "advice"),
    [
        ("3.0", "Portable Computing Language", "apt-get install pocl-opencl-icd"),
        ("3.1+debian", "Portable Computing Language", "update or remove this driver"),
        ("1", "Other", "gpuvision[cpu]"),
    ],
)
def test_advice_for_the_unhealthy(see: Any, driver: str, platform: str, advice: str) -> None:
    device = FakeDevice(driver_version=driver)
    see(FakePlatform(platform, vendor="", devices=[device]), probe=lambda p, d: "unknown target CPU 'generic'")
    (broken,) = discovery.probed_devices()
    assert advice in broken.advice
    see(FakePlatform(platform, vendor="", version="good"))
    assert discovery.probed_devices()[0].advice == ""


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("echo 'LLVM ERROR: no such CPU' >&2; kill -ABRT $$", r"exit -6: LLVM ERROR: no such CPU"),
        ("kill -SEGV $$", r"exit -11: no message"),
        ("exit 0", r"exit 0: no message"),
        ("echo '[]'", r"ended the probe's process"),
        ("echo 'noise'; echo '{\"reason\": \"wrong numbers\"}'", r"^wrong numbers$"),
        ("exec sleep 60", r"did not finish within 0.2 s"),
    ],
)
def test_crash_and_hang_are_verdicts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, script: str, reason: str) -> None:
    monkeypatch.setattr(sys, "executable", _program(tmp_path, script))
    if "sleep" in script:
        monkeypatch.setattr(discovery, "_PROBE_SECONDS", 0.2)
    verdict = discovery._ask_probe(0, 0)
    assert re.search(reason, verdict), verdict


def test_probe_in_its_own_process(device: Device, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The probe also works in a folder that contains a folder named like the package."""
    (tmp_path / "gpuvision").mkdir()
    (tmp_path / "gpuvision" / "__init__.py").write_text("raise SystemExit('not the package')")
    monkeypatch.chdir(tmp_path)
    (listed,) = [each for each in discovery.listed_devices() if each.label == device.label]
    assert discovery._ask_probe(listed.platform_index, listed.device_index) == ""


@pytest.mark.parametrize(
    ("until", "is_kept"), [(1001, True), (1000, False), (999, False), (4601, True), (4602, False), (1000 + 3600, True)]
)
def test_a_verdict_of_an_hour_ends_between_now_and_then(
    until: int, is_kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 1000 s; a later end comes from a clock that was set back."""
    monkeypatch.setattr(discovery.time, "time", lambda: 1000.0)
    assert discovery._parsed(["hangs", until]) == (("hangs", until) if is_kept else None)
    assert discovery._parsed("broken") == ("broken", None)
    for damaged in (["hangs"], ["hangs", until, 1], [until, "hangs"], 7, None, {"a": 1}):
        assert discovery._parsed(damaged) is None


def listed(kind: str, **properties: Any) -> Any:
    """Return a device with the properties that its rank depends on."""
    usual = {"type": cl.device_type.GPU, "host_unified_memory": 0, "max_compute_units": 8, "global_mem_size": 1 << 30}
    handle = SimpleNamespace(**(usual | properties))
    return discovery.ProbedDevice("label", kind, 3, 5, handle, "key", None, reason="")


def test_rank_of_a_device() -> None:
    cpu = {"type": cl.device_type.CPU}
    memory = -(1 << 30)
    assert listed("nvidia").rank == (False, False, 2, False, -8, memory, 3, 5)
    assert listed("pocl-gpu").rank == (False, True, 2, False, -8, memory, 3, 5)
    assert listed("rusticl", host_unified_memory=1).rank == (False, True, 2, True, -8, memory, 3, 5)
    assert listed("pocl", **cpu, host_unified_memory=1).rank == (True, False, 0, False, -8, memory, 3, 5)
    assert listed("intel", **cpu).rank == (True, False, 1, False, -8, memory, 3, 5)
    assert listed("rusticl", **cpu, max_compute_units=4).rank == (True, False, 2, False, -4, memory, 3, 5)
    assert listed("oclgrind", **cpu).rank == (True, False, 4, False, -8, memory, 3, 5)


def test_reasons_have_at_most_500_characters_in_a_line() -> None:
    assert discovery._one_line("a\tb\n c") == "a b c"
    assert discovery._one_line("x" * 501) == "x" * 500


@pytest.mark.parametrize(
    ("names", "inline"),
    [
        (["pthread-epyc", "basic-epyc"], 1),
        (["basic-epyc", "pthread-epyc", "basic-2"], 0),
        (["basic-epyc"], None),
        (["cpu-pthread-x", "basic-epyc"], None),
        (["pthread-epyc", "other-basic-epyc"], None),
        ([], None),
    ],
)
def test_the_inline_device_stands_beside_one_with_workers(names: list[str], inline: int | None) -> None:
    devices = [FakeDevice(name) for name in names]
    assert discovery._inline_device(devices) is (None if inline is None else devices[inline])
