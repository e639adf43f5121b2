"""Steps for a GPU machine: limits of time, parts of the results file, and numbers computed from logs and traces."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.profiling.gpu_run import __main__ as steps
from gpuvision.profiling.gpu_run import breakage, build, streams, suite, times
from gpuvision.profiling.gpu_run.worker import Worker


def twice(value: int) -> int:
    """Return twice a value, from the worker."""
    return 2 * value


def crash() -> None:
    """End the process."""
    os._exit(7)


def fail() -> None:
    """Raise an error of two lines."""
    raise ValueError("first\nsecond")


@pytest.mark.slow
def test_worker_outlives_errors_crashes_and_hangs() -> None:
    with Worker() as worker:
        assert worker.call(twice, 4, seconds=60) == (8, "")
        assert "ValueError: first second (fail" in worker.call(fail, seconds=60).failure
        assert worker.call(crash, seconds=60).failure == "the process ended with exit code 7"
        assert worker.call(twice, 5, seconds=60) == (10, "")
        assert worker.call(time.sleep, 60, seconds=0.5).failure == "no end within 0.5 s"


LOG = """
ptxas info    : Compiling entry function 'other' for 'sm_90'
ptxas info    : Function properties for other
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 8 registers, 400 bytes cmem[0]
ptxas info    : Compiling entry function 'psd' for 'sm_90'
ptxas info    : Function properties for psd
    64 bytes stack frame, 12 bytes spill stores, 16 bytes spill loads
ptxas info    : Used 178 registers, used 1 barriers, 400 bytes cmem[0]
"""


def test_registers_and_spills_are_those_of_the_kernel() -> None:
    assert build.read_log(LOG, "psd") == {"registers": 178, "stack": 64, "spill_stores": 12, "spill_loads": 16}
    assert build.read_log("successfully vectorised", "psd") == {}


@pytest.mark.slow
def test_an_example_is_built(device: Device) -> None:
    row = build.build_example(device.label, 0)
    assert row["source"] == "psd/psd.cl"
    assert row["seconds"] > 0.0
    assert row["group"] >= 1
    assert "failure" not in row


def event(name: str, start: float, duration: float) -> dict[str, Any]:
    return {"name": name, "ts": start, "dur": duration}


def test_overlap_of_stages() -> None:
    apart = [event("upload", 0, 10), event("compute", 10, 10), event("download", 20, 20), event("source", 0, 99)]
    assert streams.overlap(apart) == {
        "upload_share": 0.25,
        "compute_share": 0.25,
        "download_share": 0.5,
        "busy_share": 1.0,
        "overlap": 0.0,
    }
    together = [event(name, 5, 10) for name in ("upload", "compute", "download")]
    assert streams.overlap(together)["overlap"] == pytest.approx(2 / 3, abs=1e-4)
    gap = [event("upload", 0, 10), event("compute", 5, 10), event("download", 35, 5)]
    assert streams.overlap(gap)["busy_share"] == 0.5
    assert streams.overlap(gap)["overlap"] == pytest.approx(1 - 20 / 25)
    assert streams.overlap([]) == {}
    assert streams.overlap([event("upload", 3, 0), event("compute", 3, 0)]) == {}, "a runtime without device times"


@pytest.mark.slow
def test_a_stream_is_measured(device: Device) -> None:
    row = streams.measure(device, 4, 0.2)
    assert row["batch"] == 8
    assert 0.0 < row["gb_per_second"] < 1e3
    assert 0.0 < row["busy_share"] <= 1.0


def test_device_times_and_the_copy(device: Device) -> None:
    sample = next(times.samples())
    small = sample._replace(make_inputs=lambda: tuple(each[:1000].copy() for each in sample.make_inputs()))
    row = times.measure(device, small)
    assert (row["operation"], row["size"]) == ("psd", "1e+05")
    assert row["us"] > 0.0
    assert row["copy_us"] > 0.0


def test_a_runtime_without_device_times_is_measured_by_the_host() -> None:
    class Event:
        profile = SimpleNamespace(start=5, end=5)

        def wait(self) -> None:
            time.sleep(1e-3)

    seconds, clock = times.launch_seconds(Event)
    assert clock == "host"
    assert seconds > 1e-3
    Event.profile = SimpleNamespace(start=5, end=2005)
    assert times.launch_seconds(Event) == (pytest.approx(2e-6), "device")


def test_every_operation_has_three_sizes() -> None:
    names = [sample.name for sample in times.samples()]
    assert {names.count(name) for name in names} == {3}
    assert next(sample.make_inputs()[1].shape for sample in times.samples() if sample.name == "ruler") == (100, 4)
    assert {"psd", "triangulation", "points", "line", "undistort", "ruler"} <= set(names)


@pytest.mark.parametrize("case", [each for each in breakage.CASES if each is not breakage.many_rows])
def test_the_device_withstands(device: Device, case: Any) -> None:
    assert case(device.label).startswith("ok")


@pytest.mark.slow
def test_the_device_withstands_many_rows(device: Device) -> None:
    assert breakage.many_rows(device.label) == "ok"


def test_a_wrong_result_is_a_failure(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(breakage, "_expected", lambda pairs: np.zeros(len(pairs)) + 7.0)
    with pytest.raises(AssertionError, match="1 samples give wrong positions"):
        breakage.sizes(device.label)


def test_times_leave_out_what_may_not_end(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of the 21 measurements takes 10 s, the next one may take 40 s: within 95 s, six of them begin."""
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])

    def slow(device: Device, sample: Any) -> dict[str, Any]:
        clock[0] += 10.0
        return {"operation": sample.name}

    monkeypatch.setattr(times, "measure", slow)
    result = times.run(device, 95.0)
    assert (len(result["rows"]), result["not_reached"]) == (6, 15)
    assert clock[0] == 60.0


def test_slow_kernels_are_launched_a_few_times(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    for seconds, expected in ((0.0, 23), (0.5, 10), (20.0, 5)):
        launches: list[float] = []

        def launch(seconds: float = seconds, launches: list[float] = launches) -> Any:
            launches.append(seconds)
            profile = SimpleNamespace(start=0, end=int(1e9 * seconds) or 1000)
            return SimpleNamespace(wait=lambda: clock.__setitem__(0, clock[0] + seconds), profile=profile)

        times.launch_seconds(launch)
        assert len(launches) == expected


def test_summary_of_the_suite() -> None:
    text = "....F\nFAILED tests/a.py::test_x[nvidia] - boom\nERROR tests/b.py\n1 failed, 4 passed, 1 error in 3.2s\n"
    assert suite.read_summary(text) == {
        "failed": 1,
        "passed": 4,
        "error": 1,
        "failures": ["FAILED tests/a.py::test_x[nvidia] - boom", "ERROR tests/b.py"],
    }


class Running:
    """Process that ends when it is interrupted, or only when it is killed."""

    def __init__(self, ends: bool) -> None:
        self.calls: list[Any] = []
        self._ends = ends

    def wait(self, seconds: float) -> int:
        self.calls.append(seconds)
        if signal.SIGINT in self.calls and self._ends:
            return 2
        raise subprocess.TimeoutExpired("pytest", seconds)

    def send_signal(self, number: int) -> None:
        self.calls.append(number)

    def kill(self) -> None:
        self.calls.append("killed")


@pytest.mark.parametrize("ends", [True, False])
def test_suite_is_interrupted_before_its_limit(ends: bool) -> None:
    """Interrupted tests print their summary; tests that do not react are killed."""
    running: Any = Running(ends)
    assert suite._end_of(running, 570.0) == "no end within 570 s"
    assert running.calls == [550.0, signal.SIGINT, 20.0, *([] if ends else ["killed"])]


@pytest.mark.slow
def test_suite_runs_on_the_device(device: Device) -> None:
    result = suite.run(device, 120.0, "tests/host/test_probe.py")
    assert (result["end"], result["failures"]) == ("exit code 0", [])
    assert result["passed"] >= 1


def test_each_step_writes_its_part(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "run.json"
    monkeypatch.setitem(steps.STEPS, "build", lambda device, seconds: {"examples": 3})
    monkeypatch.setitem(steps.STEPS, "times", lambda device, seconds: {"rows": [], "seconds": seconds})
    common = ["--here", "--device", device.label, "--out", str(out), "--seconds", "5"]
    assert steps.main([*common, "--step", "build"]) == 0
    assert steps.main([*common, "--step", "times"]) == 0
    whole = json.loads(out.read_text())
    assert (whole["build"]["examples"], whole["times"]["seconds"]) == (3, 5.0)
    assert steps.main([*common, "--step", "times", "--begun", str(time.time() - 2.0)]) == 0
    assert 1.0 <= json.loads(out.read_text())["times"]["seconds"] <= 3.0  # the start of the process took 2 s or more
    assert whole["machine"]["device"] == device.label
    assert [*tmp_path.iterdir()] == [out]
