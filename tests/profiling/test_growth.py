"""Time against size: sizes, knees, results and picture."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from typer.testing import CliRunner

from gpuvision.cli import profile_growth
from gpuvision.cli.main import application
from gpuvision.profiling import growth, growth_plot
from gpuvision.profiling.growth_plot import draw_growth
from gpuvision.profiling.run import Failure, Probe


def curve(*times: float, each: int = 16) -> list[growth.Point]:
    """Return a curve of 1, 4, 16, ... items of some bytes."""
    return [
        growth.Point("psd", "pocl", "sample", 4**k, each * 4**k, time, 0.9 * time, 1.1 * time)
        for k, time in enumerate(times)
    ]


def test_the_launch_knee_is_at_twice_the_shortest_time() -> None:
    assert growth.launch_knee(curve(1.0, 1.0, 4.0)) == pytest.approx(8.0)
    assert growth.launch_knee(curve(1.0, 1.1, 1.9)) is None
    assert growth.launch_knee(curve(20.0, 1.0, 4.0)) == pytest.approx(8.0)  # one item takes longer than four


def test_the_cache_knee_is_where_the_arrays_fill_the_cache() -> None:
    assert growth.cache_knee(curve(1.0, 1.0, 1.0), 160) == pytest.approx(10.0)
    assert growth.cache_knee(curve(1.0, 1.0, 1.0), 1000) is None
    assert growth.cache_knee(curve(1.0, 1.0, 1.0), 10) == 1.0  # one item does not fit


@pytest.mark.slow
def test_a_curve_goes_from_one_item_to_the_limit_of_memory(device: Any) -> None:
    """A sample of float32 currents with position and status takes 13 bytes."""
    found = growth.measure_growth(["psd"], [device], memory=13 * 4**5, seconds=0.002)
    (points,) = found.curves.values()
    assert [point.items for point in points] == [1, 4, 16, 64, 256, 1024]
    assert [point.bytes for point in points] == [13 * 4**k for k in range(6)]
    assert all(0.0 < point.low <= point.seconds <= point.high for point in points)
    assert json.loads(found.to_json())["growth"][3]["items"] == 64
    assert len(found.probes) == 1
    assert found.caches == {device.label: device.cache_bytes}


@pytest.mark.parametrize("name", sorted(growth.workloads()))
def test_the_items_of_a_workload_are_repeated(name: str, device: Any) -> None:
    """More items than differ: the first ones come again; the operation accepts the shapes."""
    workload = growth.workloads()[name]
    place = next(k for k, axis in enumerate(workload.axes) if axis is not None)
    different = workload.samples[place].shape[workload.axes[place]]
    inputs = workload.inputs(different + 3)
    assert inputs[0].shape == workload.first_shape(different + 3)
    for values, samples, axis in zip(inputs, workload.samples, workload.axes, strict=True):
        if axis is None:
            assert np.array_equal(values, samples)
            continue
        assert values.shape[axis] == different + 3
        parts = np.split(values, [different], axis=axis)
        assert np.array_equal(parts[0], samples)
        assert np.array_equal(parts[1], np.take(samples, range(3), axis=axis))
    specs = workload.operation(different + 3).specs(device, inputs[0].shape, inputs[0].dtype)
    assert [(tuple(shape), dtype) for shape, dtype in specs.inputs] == [(each.shape, each.dtype) for each in inputs]


@pytest.mark.slow
def test_inputs_beyond_the_limit_of_memory_are_not_made(monkeypatch: pytest.MonkeyPatch, device: Any) -> None:
    made: list[int] = []
    inputs = growth.Workload.inputs
    monkeypatch.setattr(growth.Workload, "inputs", lambda self, items: made.append(items) or inputs(self, items))
    growth.measure_growth(["psd"], [device], memory=13 * 4**2, seconds=0.002)
    assert made == [1, 4, 16]


@pytest.mark.slow
def test_the_other_workloads_are_measured_when_one_fails(monkeypatch: pytest.MonkeyPatch, device: Any) -> None:
    known = growth.workloads()
    broken = dataclasses.replace(known["line"], samples=[np.zeros((4, 0, 0), np.uint8)])
    monkeypatch.setattr(growth, "workloads", lambda: known | {"line": broken})
    lines: list[str] = []
    found = growth.measure_growth(
        ["psd", "line", "triangulation"], [device], memory=1000, seconds=0.002, progress=lines.append
    )
    assert [name for name, _ in found.curves] == ["psd", "triangulation"]
    (failure,) = found.failures
    assert (failure.operation, failure.device) == ("line", device.label)
    assert f"  failed: {failure.reason}" in lines
    assert json.loads(found.to_json())["failures"][0]["reason"] == failure.reason


def test_without_points_a_message_says_so(tmp_path: Any, device: Any) -> None:
    lines: list[str] = []
    found = growth.measure_growth(["psd"], [device], memory=12, progress=lines.append)
    assert found.lines() == []
    assert lines[-1] == "  not measured: inputs and outputs of one sample exceed 12 bytes"
    with pytest.raises(ValueError, match="no points to draw"):
        draw_growth(tmp_path, found)


@pytest.mark.slow
def test_a_slow_operation_is_not_measured_with_more_items(monkeypatch: pytest.MonkeyPatch, device: Any) -> None:
    monkeypatch.setattr(growth, "take_turns", lambda calls, *_, **__: {"": np.full(7, 1.5)})
    found = growth.measure_growth(["psd"], [device], memory=1 << 20)
    assert [point.items for point in found.points] == [1]


def test_the_picture_has_the_curves_and_their_knees(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[str, Any] = {}
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: drawn.update(lines=self.axes[0].lines))
    found = growth.Growth(curve(1.0, 1.0, 4.0), [], {"pocl": 160}, {})
    assert draw_growth(tmp_path, found) == "sizes.png"
    line, launch, cache = (each.get_xydata() for each in drawn["lines"])
    assert line.tolist() == [[1.0, 1e3], [4.0, 1e3], [16.0, 4e3]]
    assert launch[0] == pytest.approx([8.0, 2e3])
    assert cache[0] == pytest.approx([10.0, 2500.0])
    assert found.lines() == [
        "psd on pocl: 1000000.0 µs for one sample, 1000000.0 µs at least, twice as long from 8, "
        "beyond the cache from 10; 4 samples/s and 6.4e-08 GB/s for 16"
    ]


@pytest.mark.slow
@pytest.mark.parametrize(("after", "code"), [(101e9, 0), (55e9, 1)])
def test_the_command_measures_and_writes(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch, device: Any, after: float, code: int
) -> None:
    rates = iter((100e9, 100e9, after))  # description of the machine, before and after the measurement
    monkeypatch.setattr(growth.ceiling, "flop_rate", lambda *_: next(rates))
    args = ["profile", "psd", "--growth", "--memory-mib", "0.001", "--json", str(tmp_path / "g.json")]
    ran = CliRunner().invoke(application(), [*args, "--device", device.label], catch_exceptions=False)
    assert ran.exit_code == code
    assert ("the machine changed its speed during psd" in ran.output) == bool(code)
    assert "µs for one sample" in ran.output
    assert {point["items"] for point in json.loads((tmp_path / "g.json").read_text())["growth"]} == {1, 4, 16, 64}


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["psd", "abacus", "--growth"], "no operation 'abacus' to profile over its size"),
        (["psd", "--memory-mib", "1"], "--memory-mib has no effect without --growth"),
        (["psd", "--growth", "--quick"], "--quick has no effect with --growth"),
    ],
)
def test_what_does_not_fit_is_refused(args: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CliRunner().invoke(application(), ["profile", *args], catch_exceptions=False)


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Request of the command, and the curves that it gets: two points of psd, a failure, one unsteady probe."""
    calls: dict[str, Any] = {}

    def measure(operations: Any, devices: Any, *, memory: int, progress: Any) -> growth.Growth:
        progress("measures")
        calls.update(operations=operations, devices=devices, memory=memory)
        return calls["growth"]

    probes = [Probe("psd", "pocl", 1.0, 1.0, True), Probe("line", "pocl", 1.0, 0.5, False)]
    failures = [Failure("pose", "pocl", "no memory", "")]
    calls["growth"] = growth.Growth(curve(1.0, 4.0), probes, {"pocl": 160}, {}, failures)
    monkeypatch.setattr(growth, "measure_growth", measure)
    monkeypatch.setattr(profile_growth, "devices_of", lambda labels: list(labels))
    monkeypatch.setattr(growth_plot, "write_png", lambda figure, path: path.touch())
    return calls


def test_the_command_reports_curves_and_what_is_not_valid(measured: dict[str, Any], tmp_path: Any) -> None:
    args = ["profile", "psd", "--growth", "--memory-mib", "0.75", "--device", "pocl", "--plots", str(tmp_path / "p")]
    ran = CliRunner().invoke(application(), [*args, "--json", str(tmp_path / "g.json")], catch_exceptions=False)
    found = measured["growth"]
    assert (measured["operations"], measured["devices"], measured["memory"]) == (["psd"], ["pocl"], 3 * 2**18)
    assert ran.exit_code == 1
    assert ran.stdout == "\n".join([*found.lines(), ""])
    assert ran.stderr.splitlines() == [
        "measures",
        f"look at {tmp_path / 'p' / 'sizes.png'}",
        "not valid: the machine changed its speed during line on pocl",
        "not measured: pose on pocl: no memory",
    ]
    assert (tmp_path / "p" / "sizes.png").exists()
    assert (tmp_path / "g.json").read_text() == found.to_json()


@pytest.mark.parametrize(
    ("changes", "code"),
    [({}, 1), ({"failures": []}, 1), ({"probes": []}, 1), ({"failures": [], "probes": []}, 0)],
)
def test_the_exit_code_says_whether_all_is_valid(measured: dict[str, Any], changes: dict[str, Any], code: int) -> None:
    measured["growth"] = dataclasses.replace(measured["growth"], **changes)
    ran = CliRunner().invoke(application(), ["profile", "psd", "--growth", "--json", "-"], catch_exceptions=False)
    assert ran.exit_code == code
    assert measured["memory"] == 256 * 2**20  # the default
    assert ran.stdout == measured["growth"].to_json()  # without other text
    assert measured["growth"].lines()[0] in ran.stderr.splitlines()
    assert ("not valid" in ran.stderr) == ("probes" not in changes)
    assert ("not measured" in ran.stderr) == ("failures" not in changes)


def test_nothing_measured_is_said(measured: dict[str, Any], tmp_path: Any) -> None:
    measured["growth"] = growth.Growth([], [], {}, {})
    args = ["profile", "psd", "--growth", "--memory-mib", "0.001", "--plots", str(tmp_path / "p")]
    ran = CliRunner().invoke(application(), args, catch_exceptions=False)
    assert ran.exit_code == 1
    assert ran.stderr.splitlines() == [
        "measures",
        "nothing measured: no operation has a size within 0.001 MiB, or all failed",
    ]
    assert not (tmp_path / "p" / "sizes.png").exists()
