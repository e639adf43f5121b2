"""``gpuvision tune``: prints what won, keeps it, and keeps nothing with ``--dry-run``."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gpuvision.cli.main import application
from gpuvision.host import Device, clear_cache, tuning
from gpuvision.host.tuned_settings import TunedSettings, entry_of
from gpuvision.host.tuning import TuningResult
from gpuvision.ranging.merge_heights import MergeHeights

STRIP = TunedSettings(strip=2048)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Use an empty cache folder; return the path of the file of settings."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    clear_cache()
    yield tmp_path / "gpuvision" / "tuned_settings.json"
    clear_cache()


@pytest.fixture
def tuned(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, str, int]]:
    """Replace the measurement: strips of 2048 win for uint16. Return the tuned operations, dtypes, devices, sizes."""
    seen: list[tuple[str, str, str, int]] = []

    def tune(operation: Any, make: Any, device: Device, size: int) -> TuningResult:
        array = make(4**size)[0]
        seen.append((type(operation).__name__, array.dtype.name, device.label, size))
        wins = array.dtype == "uint16"
        best, gain = (STRIP, 1.25) if wins else (TunedSettings(), 1.0)
        return TuningResult(
            operation=type(operation).__name__,
            dtype=array.dtype.name,
            device=device.label,
            elements=array.size,
            best=best,
            default_seconds=5e-6,
            best_seconds=5e-6 / gain,
            gain=gain,
            spread=0.01,
            entry=entry_of(operation, device, array.shape, array.dtype, best, gain),
            rejected={TunedSettings(group=32): "another result: field total"} if wins else {},
        )

    monkeypatch.setattr(tuning, "tune", tune)
    return seen


def test_winners_are_printed_and_kept(cache: Path, tuned: list[Any]) -> None:
    device = Device.best().label
    result = CliRunner().invoke(application(), ["tune", "psd", "--device", device])
    assert result.exit_code == 0, result.output
    assert tuned == [("PsdReadout", dtype, device, size) for dtype in ("float32", "uint16") for size in range(5, 11)]
    rows = [line.split() for line in result.output.splitlines() if line.strip().startswith("PsdReadout")]
    assert rows[0] == ["PsdReadout", "float32", "1024", device, "5", "5", "1.00", "default"]
    assert rows[6] == ["PsdReadout", "uint16", "1024", device, "5", "4", "1.25", "strip", "2048"]
    assert f"rejected: PsdReadout uint16 1024 on {device}, group 32: another result: field total" in result.output
    kept = json.loads(cache.read_text())["entries"]
    assert [(each["dtype"], each["size_class"], each["settings"]["strip"]) for each in kept] == [
        ("uint16", size, 2048) for size in range(5, 11)
    ]
    assert str(cache) in result.output


@pytest.mark.usefixtures("tuned", "cache")
def test_the_report_in_json() -> None:
    device = Device.best().label
    result = CliRunner().invoke(application(), ["tune", "psd", "--device", device, "--json", "-", "--dry-run"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert len(report) == 12
    assert report[6] == {
        "operation": "PsdReadout",
        "dtype": "uint16",
        "device": device,
        "elements": 1024,
        "default_seconds": 5e-6,
        "best_seconds": 5e-6 / 1.25,
        "gain": 1.25,
        "spread": 0.01,
        "settings": {"variant": None, "strip": 2048, "group": None, "inline": None},
        "rejected": {"group 32": "another result: field total"},
    }


@pytest.mark.usefixtures("tuned")
def test_a_dry_run_keeps_nothing(cache: Path) -> None:
    result = CliRunner().invoke(application(), ["tune", "psd", "--dry-run", "--device", Device.best().label])
    assert result.exit_code == 0, result.output
    assert "strip 2048" in result.output
    assert not cache.exists()


def test_an_interrupted_command_keeps_the_winners_of_the_operations_before(
    cache: Path, tuned: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    measure = tuning.tune

    def fail(operation: Any, make: Any, device: Device, size: int) -> TuningResult:
        if isinstance(operation, MergeHeights):
            raise KeyboardInterrupt
        return measure(operation, make, device, size)

    monkeypatch.setattr(tuning, "tune", fail)
    result = CliRunner().invoke(application(), ["tune", "psd", "merge_heights", "--device", Device.best().label])
    assert result.exit_code != 0
    assert len(tuned) == 12
    assert {each["dtype"] for each in json.loads(cache.read_text())["entries"]} == {"uint16"}


def test_unknown_operations_are_named(tuned: list[Any]) -> None:
    result = CliRunner().invoke(application(), ["tune", "psd", "sorting"])
    assert isinstance(result.exception, ValueError)
    assert str(result.exception) == (
        "no operation 'sorting' to tune; expected some of psd, triangulation, points, merge_heights"
    )
    assert not tuned
