"""The command `demo`: what it simulates, scans and writes, with simulations that take no time."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from gpuvision.cli.main import application
from gpuvision.host import Device
from gpuvision.workflows import demo, scanning, simulated_recording, simulating
from gpuvision.workflows.demo import SENSORS


@pytest.mark.parametrize("options", [[], ["--seed", "7", "--device", "other"]])
def test_each_sensor_is_simulated_scanned_and_written(
    options: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[Any] = []
    best, other = SimpleNamespace(label="best", name="Best"), SimpleNamespace(label="other", name="Other")
    monkeypatch.setattr(Device, "best", staticmethod(lambda: best))
    monkeypatch.setattr(Device, "named", staticmethod(lambda label: {"other": other}[label]))
    monkeypatch.setattr(demo, "make_scan_task", lambda name: SimpleNamespace(name=name, sensor=f"sensor {name}"))

    def simulate(task: Any, folder: str, *, progress: Any = None, **how: Any) -> Any:
        calls.append(("simulate", task.name, Path(folder).is_dir(), how))
        text = f"{task.name} {how.get('mask', 'bare')}"
        return SimpleNamespace(
            summary=lambda: f"simulated {text}",
            report=lambda: {"of": text},
            write=lambda folder: (folder.mkdir(), calls.append(("write", text, folder.name))),
        )

    def record(task: Any, folder: str, **how: Any) -> Any:
        calls.append(("record", task.name, how))
        return np.full(3, len(task.name))

    def scan(recording: Any, sensor: str, **how: Any) -> Any:
        calls.append(("scan", recording.tolist(), sensor, how))
        return SimpleNamespace(
            summary=lambda: f"scanned by {sensor}",
            report=lambda: {"scan": sensor},
            write=lambda folder, *, overwrite: calls.append(("write scan", folder.name, overwrite)),
        )

    monkeypatch.setattr(simulating, "simulate", simulate)
    monkeypatch.setattr(simulated_recording, "simulate_recording", record)
    monkeypatch.setattr(scanning, "scan", scan)
    out = tmp_path / "my parts"
    ran = CliRunner().invoke(application(), ["demo", "--out", str(out), *options], catch_exceptions=False)
    assert ran.exit_code == 0
    device = other if options else best
    how: dict[str, Any] = {"seed": 7 if options else 1, "device": device}
    expected: list[Any] = []
    for name in SENSORS:
        expected += [
            ("simulate", name, True, how),
            ("record", name, how),
            ("scan", [len(name)] * 3, f"sensor {name}", {"device": device}),
            ("write", f"{name} bare", name),
            ("write scan", name, True),
        ]
    last = SENSORS[-1]
    expected += [("simulate", last, True, how | {"mask": "best"}), ("write", f"{last} best", f"{last}_masked")]
    assert calls == expected
    reports: dict[str, Any] = {
        name: {"predicted": {"of": f"{name} bare"}, "scan": f"sensor {name}"} for name in SENSORS
    }
    reports[f"{last}_masked"] = {"predicted": {"of": f"{last} best"}}
    assert json.loads((out / "report.json").read_text()) == reports
    assert (out / "part.ply").read_bytes().startswith(b"ply")
    for name in SENSORS:
        np.testing.assert_array_equal(np.load(out / name / "recording.npy"), np.full(3, len(name)))
    assert ran.stdout.splitlines() == [
        f"device {device.label}: {device.name}",
        *(line for name in SENSORS for line in (f"{name}: scanned by sensor {name}", f"  simulated {name} bare")),
        f"{last} with a mask computed for the part: simulated {last} best",
        f"next: scan a recording yourself: gpuvision scan '{out}/camera_line/recording.npy' "
        f"--sensor camera_line --out '{out}/again'",
        f"Range image of the part: {out}/camera_line/picture.png. Errors of the PSD strips from light in the corners: "
        f"{out}/{last}/errors.png and causes.png in the same folder; with a mask: {out}/{last}_masked/errors.png.",
    ]


def test_solids_of_the_part() -> None:
    """Bounds and volumes in millimetres: a plate, a box, a disc of 64 sides, a cap of a sphere, three steps."""
    solids = sorted(demo.make_part().split(), key=lambda each: tuple(np.round(each.bounds[0], 9)))
    expected = [
        ((-23.0, -18.0, -2.0), (23.0, 18.0, 0.0), 46.0 * 36.0 * 2.0),
        ((-19.0, 4.0, 0.0), (-7.0, 14.0, 6.0), 12.0 * 10.0 * 6.0),
        ((-18.0, -14.0, 0.0), (-8.0, -4.0, 4.0), 4.0 * 32.0 * 25.0 * np.sin(2.0 * np.pi / 64.0)),
        ((1.0, -15.0, 0.0), (7.0, -3.0, 1.0), 6.0 * 12.0 * 1.0),
        ((2.0, 0.0, -11.0), (18.0, 16.0, 5.0), 4.0 / 3.0 * np.pi * 8.0**3),
        ((7.0, -15.0, 0.0), (13.0, -3.0, 2.0), 6.0 * 12.0 * 2.0),
        ((13.0, -15.0, 0.0), (19.0, -3.0, 3.0), 6.0 * 12.0 * 3.0),
    ]
    assert len(solids) == len(expected)
    for solid, (low, high, volume) in zip(solids, expected, strict=True):
        np.testing.assert_allclose(1e3 * solid.bounds, [low, high], atol=0.05)
        is_sphere = volume > 2000.0 and len(solid.faces) > 1000
        assert 1e9 * solid.volume == pytest.approx(volume, rel=0.01 if is_sphere else 1e-6)
