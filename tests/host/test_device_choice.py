"""Choice between a GPU and a CPU device by measured times, with a device that pretends to be a slow or fast GPU."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from gpuvision.host import (
    ArraySource,
    BuildError,
    Device,
    DeviceLostError,
    DeviceMemoryError,
    PlanLimits,
    StepDevices,
    StreamError,
    device_choice,
    fastest_device,
    kept_numbers,
    plan_stream,
    planning,
)
from gpuvision.host.cache import write_private
from gpuvision.host.kept_numbers import kept_number
from gpuvision.host.planning import Cost
from gpuvision.host.program import sources_digest
from gpuvision.ranging.psd import PsdReadout
from streams import READOUT, currents_of


class Clock:
    """Clock of `device_choice` that only `run` advances: measured times do not depend on the load of the machine."""

    def __init__(self) -> None:
        self.now = 0.0

    def run(self, seconds: float) -> None:
        """Pretend to compute for some seconds."""
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Measure with a clock that only the test advances."""
    clock = Clock()
    monkeypatch.setattr(device_choice, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    return clock


class TimedCalls(PsdReadout):
    """Operation whose calls take the seconds of the device, by its label."""

    clock: ClassVar[Clock]
    seconds: ClassVar[dict[str, float]]

    def __call__(self, *inputs: Any, device: Any = None, out: Any = None) -> Any:
        self.clock.run(self.seconds[device.label])
        return super().__call__(*inputs, device=device, out=out)


@pytest.fixture
def gpu(device: Device, monkeypatch: pytest.MonkeyPatch) -> Device:
    """List a GPU before the CPU device."""
    gpu = copy.copy(device)
    gpu.label, gpu.is_cpu = "gpu", False
    monkeypatch.delenv("GPUVISION_DEVICE", raising=False)
    monkeypatch.setattr(Device, "all", staticmethod(lambda: (gpu, gpu, device, device)))
    monkeypatch.setattr(Device, "best", staticmethod(lambda: gpu))
    return gpu


def test_small_work_runs_on_the_cpu_beside_a_gpu(
    gpu: Device, device: Device, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TimedCalls, "clock", clock, raising=False)
    monkeypatch.setattr(TimedCalls, "seconds", {"gpu": 3e-2, device.label: 1e-3}, raising=False)
    found = fastest_device(TimedCalls(strip_length=6e-3), currents_of(3))
    assert found.device is device
    assert found.seconds == pytest.approx({"gpu": 3e-2, device.label: 1e-3}, rel=1e-9)
    assert str(found) == f"TimedCalls on {device.label}, 1e+03 us (gpu 3e+04 us)"


def test_calls_of_a_measurement(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three calls bind the operation and fill the caches, 15 are timed; with one device, too."""
    calls: list[Any] = []
    monkeypatch.setattr(TimedCalls, "__call__", lambda self, *inputs, device: calls.append((inputs, device)))
    found = fastest_device(TimedCalls(strip_length=6e-3), "frames", devices=[device])  # type: ignore[arg-type]
    assert calls == [(("frames",), device)] * 18
    assert (found.operation, found.device, set(found.seconds)) == ("TimedCalls", device, {device.label})


def test_named_device_is_the_only_one(gpu: Device, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    assert device_choice.candidate_devices() == (gpu, device)
    monkeypatch.setenv("GPUVISION_DEVICE", "gpu")
    assert device_choice.candidate_devices() == (gpu,)
    assert fastest_device(READOUT, currents_of(3), devices=[device]).device is device


def test_without_a_gpu_one_device_is_measured(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GPUVISION_DEVICE", raising=False)
    monkeypatch.setattr(Device, "all", staticmethod(lambda: (device, copy.copy(device))))
    monkeypatch.setattr(Device, "best", staticmethod(lambda: device))
    assert device_choice.candidate_devices() == (device,)


class Refused(PsdReadout):
    """Operation that fails on the devices of these labels."""

    failures: ClassVar[dict[str, Exception]] = {}

    def __call__(self, *inputs: Any, device: Any = None, out: Any = None) -> Any:
        if device.label in self.failures:
            raise self.failures[device.label]
        return super().__call__(*inputs, device=device, out=out)


ERRORS = [BuildError("no\nlog"), DeviceMemoryError("no\nlog"), DeviceLostError("no\nlog"), ValueError("no\nlog")]


@pytest.mark.parametrize("error", ERRORS, ids=lambda each: type(each).__name__)
def test_a_device_that_cannot_run_the_operation_is_not_chosen(
    gpu: Device, device: Device, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Refused, "failures", {"gpu": error})
    found = fastest_device(Refused(strip_length=6e-3), currents_of(3))
    assert (found.device, set(found.seconds)) == (device, {device.label})
    assert found.unusable == {"gpu": "no"}
    assert str(found).endswith(" us (gpu is not usable: no)")
    monkeypatch.setattr(Refused, "failures", {"gpu": error, device.label: StreamError("second")})
    with pytest.raises(type(error), match="no"):
        fastest_device(Refused(strip_length=6e-3), currents_of(3))


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> dict[str, Cost]:
    """Costs of a batch by the label of the device, instead of measurements."""
    costs: dict[str, Cost] = {}

    def measurement(source: Any, steps: Any, device: Device, zero_copy: bool, limits: PlanLimits) -> Any:
        return lambda batch, inline: costs[device.label]

    monkeypatch.setattr(planning, "_Measurement", measurement)
    return costs


@pytest.mark.parametrize("error", ERRORS, ids=lambda each: type(each).__name__)
def test_plan_leaves_out_a_device_that_cannot_run_the_operation(
    gpu: Device, device: Device, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing = {"gpu"}

    def measurement(source: Any, steps: Any, device: Device, zero_copy: bool, limits: PlanLimits) -> Any:
        if device.label in failing:
            raise error
        return lambda batch, inline: Cost(1e4, 1e-4, 1e-5)

    monkeypatch.setattr(planning, "_Measurement", measurement)
    chosen = plan()
    assert (chosen.device, chosen.other_devices, chosen.unusable) == (device, {}, {"gpu": "no"})
    assert "(gpu is not usable: no)" in str(chosen)
    assert json.loads(json.dumps(chosen.to_dict()))["unusable"] == {"gpu": "no"}
    failing.add(device.label)
    with pytest.raises(type(error), match="no"):
        plan()


def plan() -> Any:
    source = ArraySource(np.zeros((300, 4, 2), np.float32))
    return plan_stream(source, READOUT, rate=100.0, inline=False, limits=PlanLimits(max_bytes=1 << 40), batches=(1,))


@pytest.mark.parametrize(("seconds", "label"), [(2e-4, "gpu"), (5e-5, "cpu")])
def test_plan_takes_the_device_of_lower_latency(
    gpu: Device, device: Device, measured: dict[str, Cost], seconds: float, label: str
) -> None:
    measured |= {"gpu": Cost(1e4, 1e-4, 1e-5), device.label: Cost(1e4, seconds, 1e-5)}
    chosen = plan()
    expected, other = (gpu, device) if label == "gpu" else (device, gpu)
    assert chosen.device is expected
    assert chosen.settings["device"] is expected
    assert chosen.other_devices == {other.label: measured[other.label].seconds}
    latency = f"on {expected.label} with a latency of {1e3 * chosen.latency:.3g} ms ({other.label} "
    assert str(chosen).startswith(latency)
    assert json.loads(json.dumps(chosen.to_dict()))["device"] == expected.label


def test_plan_takes_the_device_that_keeps_up(gpu: Device, device: Device, measured: dict[str, Cost]) -> None:
    measured |= {"gpu": Cost(1e4, 1e-2, 1e-5), device.label: Cost(50.0, 1e-5, 1e-5)}
    chosen = plan()
    assert (chosen.device, chosen.other_devices) == (gpu, {device.label: None})
    assert f"({device.label} does not keep up)" in str(chosen)
    measured["gpu"] = Cost(60.0, 1e-2, 1e-5)
    with pytest.raises(StreamError, match="the fastest, 1 frames, does 60 frames/s"):
        plan()


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """File of the kept times of steps; without failures that other tests left in the process."""
    monkeypatch.setattr(device_choice, "_failures", {})
    monkeypatch.setattr(kept_numbers, "cache_folder", lambda: tmp_path)
    return tmp_path / "step_seconds.json"


@pytest.mark.parametrize(
    ("calls", "limit", "made", "median"),
    [
        (7, math.inf, 9, 5.0),  # of 8, 2, 5, 3, 9, 7, 4
        (4, math.inf, 6, 5.0),  # the upper one of the two in the middle of 8, 2, 5, 3
        (7, 120.0, 4, 8.0),  # the limit counts the calls of the warm-up: 112 + 8 s do not exceed it, 2 more do
        (7, 1.0, 3, 8.0),  # one timed call at least
    ],
)
def test_median_time_of_calls(
    calls: int, limit: float, made: int, median: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    durations = [12.0, 100.0, 8.0, 2.0, 5.0, 3.0, 9.0, 7.0, 4.0]
    now, done = [0.0], [0]

    def call() -> None:
        now[0] += durations[done[0]]
        done[0] += 1

    monkeypatch.setattr(device_choice, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    assert device_choice._median_seconds(call, 2, calls, limit) == median
    assert done == [made]


def test_the_newest_thousand_numbers_are_kept(kept: Path) -> None:
    """A key that is measured again counts as new; damaged entries are left out."""
    old = {f"key {number}": number + 1.0 for number in range(1000)}
    write_private(kept, json.dumps({"bad": "text", "zero": 0.0} | old))
    assert kept_number(kept.name, ("a", 1), lambda: 2.5) == 2.5
    assert kept_number(kept.name, ("a", 1), lambda: 9.0) == 2.5
    entries = json.loads(kept.read_text())
    assert [*entries.values()] == [*list(old.values())[1:], 2.5]
    assert kept_number(kept.name, ("a", 2), lambda: 3.5) == 3.5
    assert [*json.loads(kept.read_text()).values()] == [*list(old.values())[2:], 2.5, 3.5]


def test_each_step_runs_where_it_is_fastest(gpu: Device, device: Device, kept: Path, clock: Clock) -> None:
    """Two steps on a device that pretends to be a GPU: one is slow there, the other one on the CPU."""
    runs: list[tuple[str, str]] = []

    def slow_on(label: str, step: str) -> Any:
        def run(on: Device) -> None:
            runs.append((step, on.label))
            clock.run(3e-2 if on.label == label else 1e-3)

        return run

    for _ in range(2):  # the second job takes the kept times
        devices = StepDevices(None)
        assert devices.choose("rulers", slow_on("gpu", "rulers"), (480, 640), "u1") is device
        assert devices.choose("undistort", slow_on(device.label, "undistort"), (480, 640), "u1") is gpu
        assert set(runs) == {(step, on) for step in ("rulers", "undistort") for on in ("gpu", device.label)}
        counted = len(runs)
        assert json.loads(json.dumps(devices.report()))["rulers"]["device"] == device.label
        assert devices.choices["rulers"].seconds == pytest.approx({"gpu": 3e-2, device.label: 1e-3}, rel=1e-9)
    assert len(runs) == counted
    assert len(json.loads(kept.read_text())) == 4
    StepDevices(None).choose("rulers", slow_on("gpu", "rulers"), (48, 64), "u1")
    assert len(runs) > counted


def test_times_of_steps_are_measured_again_with_other_kernels(
    gpu: Device, device: Device, kept: Path, clock: Clock, tmp_path: Path
) -> None:
    """A changed comment makes the same programs; a changed header, and a kernel in a subfolder, make other programs."""
    folder = tmp_path / "kernels"
    (folder / "edges").mkdir(parents=True)
    texts = ["int a; // once", "int a;  // twice", "int b;", "int b;", "int b;"]
    files = ["sum.h", "sum.h", "sum.h", "edges/edges.cl", "notes.md"]
    runs = []
    for name, text in zip(files, texts, strict=True):
        (folder / name).write_text(text)
        sources_digest.cache_clear()  # each turn is another process
        ran: list[Device] = []

        def run(on: Device, ran: list[Device] = ran) -> None:
            ran.append(on)
            clock.run(1e-2 if on is gpu else 1e-3)

        assert StepDevices(None, kernel_folders=(folder,)).choose("rulers", run) is device
        runs.append(bool(ran))
    assert runs == [True, False, True, True, False]


def test_steps_on_a_given_device_are_not_measured(gpu: Device, device: Device, kept: Path) -> None:
    devices = StepDevices(device)
    assert (devices.first, devices.choose("rulers", pytest.fail, 3)) == (device, device)
    assert str(devices.choices["rulers"]) == f"rulers on {device.label}"
    assert devices.report() == {"rulers": {"device": device.label, "seconds": {}, "unusable": {}}}
    assert not kept.exists()


def test_a_step_leaves_out_a_device_that_cannot_run_it(gpu: Device, device: Device, kept: Path) -> None:
    def run(on: Device) -> None:
        if on is gpu:
            raise BuildError("no\nlog")

    devices = StepDevices(None)
    assert devices.choose("rulers", run) is device
    assert devices.report()["rulers"]["unusable"] == {"gpu": "no"}


@pytest.mark.parametrize("error", ERRORS, ids=lambda each: type(each).__name__)
def test_a_step_that_failed_on_a_device_is_not_run_there_again(
    gpu: Device, device: Device, kept: Path, clock: Clock, error: Exception
) -> None:
    """A full memory and a lost device may be over in the next job: the step is run there again."""
    failed: list[Device] = []
    failing = [gpu]

    def run(on: Device) -> None:
        if on in failing:
            failed.append(on)
            raise error
        clock.run(1e-3)

    for _ in range(3):
        devices = StepDevices(None)
        assert devices.choose("rulers", run, 3) is device
        assert devices.report()["rulers"]["unusable"] == {"gpu": "no"}
    passes = isinstance(error, DeviceLostError | DeviceMemoryError)
    assert failed == [gpu] * (3 if passes else 1)
    failing.append(device)  # a new size: an error of all devices, for example a wrong image, is not kept
    for _ in range(2):
        with pytest.raises(type(error), match="no"):
            StepDevices(None).choose("rulers", run, 4)
    failing.clear()
    assert StepDevices(None).choose("rulers", run, 4) is gpu


def test_a_step_is_measured_for_each_power_of_two_of_a_float(gpu: Device, device: Device, kept: Path) -> None:
    runs: list[float] = []
    for number in (0.5, 0.7, 0.99, 1.0, 1.9, 0.0):
        StepDevices(None).choose("rulers", lambda on, number=number: runs.append(number), number)
    assert set(runs) == {0.5, 1.0, 0.0}


def test_times_of_steps_are_kept_for_thirty_days(
    gpu: Device, device: Device, kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs: list[float] = []
    for day in (0.1, 29.9, 30.1):
        monkeypatch.setattr(kept_numbers, "time", SimpleNamespace(time=lambda day=day: 86400.0 * (3000 + day)))
        StepDevices(None).choose("rulers", lambda on, day=day: runs.append(day))
    assert set(runs) == {0.1, 30.1}


@pytest.mark.parametrize(("seconds", "runs"), [(1e-3, 6), (0.06, 4), (0.5, 2)])
def test_runs_of_a_measurement(
    gpu: Device, device: Device, kept: Path, clock: Clock, seconds: float, runs: int
) -> None:
    """Runs start on each device until 0.2 s have passed: two at least, six at most."""
    ran: list[Device] = []

    def run(on: Device) -> None:
        ran.append(on)
        clock.run(seconds)

    StepDevices(None).choose("rulers", run)
    assert (ran.count(gpu), ran.count(device)) == (runs, runs)


def test_a_damaged_file_of_kept_times_is_replaced(gpu: Device, device: Device, kept: Path, clock: Clock) -> None:
    for damage in ("", "[]", "{", '{"k": "fast", "l": -1, "m": 1e999}'):
        kept.write_text(damage)
        kept.chmod(0o600)
        assert StepDevices(None).choose("rulers", lambda on: clock.run(1e-2 if on is gpu else 1e-3)) is device
        assert len(json.loads(kept.read_text())) == 2
