"""``gpuvision profile``: passes its arguments on, prints the rows, names missing packages."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gpuvision.cli.main import application
from gpuvision.host import Device, GpuVisionError, NoDeviceError
from gpuvision.profiling import harness
from gpuvision.profiling.run import Failure, Probe, Row, Run

ROW = Row(
    operation="psd",
    case="float32/1e6",
    device="pocl",
    seconds=0.0123,
    peer="numpy",
    peer_version="2.9",
    peer_seconds=4.56e-5,
    ratio=3.14159,
    ratio_low=3.11,
    ratio_high=3.3,
    confidence=0.96,
    form="words",
    device_seconds=0.0117,
    error=1.5e-9,
    fraction=0.5,
    metadata={"rate": 4000, "p50": 1e-4},
)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Replace the measurement; return the arguments of its calls."""
    seen: dict[str, Any] = {}

    def profile(operations: Sequence[str], devices: Sequence[Device], **options: Any) -> Run:
        seen.update(operations=list(operations), devices=[each.label for each in devices], **options)
        probes = [Probe("psd", "pocl", 101e9, 99e9, True), Probe("line", "pocl", 98e9, 55e9, False)]
        return Run([ROW], seen.get("valid", True), {"processor": "abacus"}, seen.get("failures", ()), probes)

    monkeypatch.setattr(harness, "profile", profile)
    return seen


@pytest.mark.parametrize(("option", "name"), [("--json", "."), ("--json", "file/rows.json"), ("--plots", "file")])
def test_what_cannot_be_written_is_told_before_the_measurement(
    asked: dict[str, Any], tmp_path: Path, option: str, name: str
) -> None:
    (tmp_path / "file").touch()
    ran = CliRunner().invoke(application(), ["profile", "psd", option, str(tmp_path / name)])
    assert isinstance(ran.exception, OSError)
    assert str(ran.exception).startswith("cannot write ")
    assert asked == {}


def test_what_was_asked_for_is_measured_and_shown(asked: dict[str, Any], tmp_path: Path) -> None:
    label = Device.best().label
    file = tmp_path / "rows.json"
    args = ["profile", "psd", "line", "--device", label, "--seconds", "0.5", "--json", str(file)]
    ran = CliRunner().invoke(application(), args, env={"COLUMNS": "80"})
    assert ran.exit_code == 0
    assert (asked["operations"], asked["devices"], asked["seconds"]) == (["psd", "line"], [label], 0.5)
    for shown in (
        "float32/1e6",
        "12.3 ms",
        "(11.7 ms)",
        "numpy",
        "45.6 µs",
        "3.14 ±10%",
        "(words)",
        "1.5e-09",
        "50 %",
        "float32/1e6 on pocl: rate 4000, p50 0.0001",
    ):
        assert shown in ran.output
    # Words stand at the left of their columns, numbers at the right; in 80 columns only the case is wrapped.
    table = [line.strip() for line in ran.output.splitlines() if line.startswith((" case", " float32/1  ", " e6 "))]
    assert table == [
        "case       device       time  peer     peer time      ratio    error  ceiling",
        "float32/1  pocl      12.3 ms  numpy      45.6 µs  3.14 ±10%  1.5e-09     50 %",
        "e6                 (11.7 ms)  (words)",
    ]
    written = json.loads(file.read_text())
    assert (written["valid"], written["machine"]) == (True, {"processor": "abacus"})
    assert written["rows"][0]["case"] == "float32/1e6"


def test_rows_on_standard_output_are_json_alone(asked: dict[str, Any]) -> None:
    ran = CliRunner().invoke(application(), ["profile", "psd", "--json", "-"])
    assert json.loads(ran.stdout)["rows"][0]["case"] == "float32/1e6"
    assert "12.3 ms" in ran.stderr


def test_the_trace_of_the_speed_probe_is_shown(asked: dict[str, Any]) -> None:
    ran = CliRunner().invoke(application(), ["profile", "psd"])
    assert "speed of pocl before and after each operation [GFLOP/s]: 101 99 98 55\n" in ran.stderr
    assert "not steady: line on pocl, 98 -> 55 GFLOP/s\n" in ran.stderr


def test_a_quick_run_is_short_and_on_the_default_device(asked: dict[str, Any]) -> None:
    CliRunner().invoke(application(), ["profile", "--quick"])
    assert (asked["quick"], asked["seconds"], asked["total"]) == (True, 0.3, 180.0)
    assert asked["devices"] == [Device.best().label]
    CliRunner().invoke(application(), ["profile"])
    assert (asked["quick"], asked["seconds"], asked["total"]) == (False, 2.0, 1200.0)
    CliRunner().invoke(application(), ["profile", "--minutes", "1.5", "--seconds", "1"])
    assert (asked["quick"], asked["total"], asked["seconds"]) == (False, 90.0, 1.0)


def test_without_plots_it_says_which_operations_have_some(asked: dict[str, Any], tmp_path: Path) -> None:
    ran = CliRunner().invoke(application(), ["profile", "psd", "--plots", str(tmp_path / "plots")])
    assert "no plots: " in ran.stderr


def test_without_names_everything_is_measured_everywhere(asked: dict[str, Any]) -> None:
    asked["valid"] = False
    ran = CliRunner().invoke(application(), ["profile"])
    assert asked["operations"] == list(harness.OPERATIONS)
    assert asked["devices"] == [each.label for each in Device.all()]
    assert "not valid: the machine changed its speed" in ran.output
    assert ran.exit_code == 1


def test_an_operation_that_fails_is_named_and_the_rows_of_the_others_are_written(
    asked: dict[str, Any], tmp_path: Path
) -> None:
    asked["failures"] = [Failure("line", "pocl", "ValueError: no such table", "Traceback")]
    file = tmp_path / "rows.json"
    ran = CliRunner().invoke(application(), ["profile", "psd", "line", "--json", str(file)])
    assert ran.exit_code == 1
    assert "not measured: line on pocl: ValueError: no such table\n" in ran.stderr
    assert "not valid" not in ran.stderr
    written = json.loads(file.read_text())
    assert [each["case"] for each in written["rows"]] == ["float32/1e6"]
    assert [each["reason"] for each in written["failures"]] == ["ValueError: no such table"]


@pytest.mark.parametrize(
    ("args", "kind", "message"),
    [
        (["psd", "abacus"], ValueError, "no operation 'abacus' to profile; expected some of servo, psd"),
        (["psd", "--device", "abacus"], NoDeviceError, "no device matches 'abacus'"),
    ],
)
def test_what_is_not_there(asked: dict[str, Any], args: list[str], kind: type[Exception], message: str) -> None:
    with pytest.raises(kind, match=message):
        CliRunner().invoke(application(), ["profile", *args], catch_exceptions=False)
    assert not asked


def test_without_numba_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "numba" else find(name, *more))
    with pytest.raises(GpuVisionError, match=r"pip install 'gpuvision\[profile\]'"):
        CliRunner().invoke(application(), ["profile", "psd"], catch_exceptions=False)
