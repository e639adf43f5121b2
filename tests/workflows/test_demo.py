"""The demonstration: a part with a known shape, two simulated sensors, and scans that recover the shape."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpuvision.cli import main as cli
from gpuvision.host import Device
from gpuvision.workflows.demo import SENSORS, make_scan_task
from gpuvision.workflows.light_cache import SimulationTask
from gpuvision.workflows.scanning import scan
from gpuvision.workflows.simulated_recording import simulate_recording
from gpuvision.workflows.simulating import simulate

PROFILES = 20  # every second one of the middle of the part, 10 mm: a tenth of the box, half of the cylinder, most steps


def task_of(name: str) -> SimulationTask:
    """Return the scan of the middle of the part, with every second profile."""
    task = make_scan_task(name, 2 * PROFILES)
    return replace(task, transports=task.transports[::2])


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Common input of the tests: the light of all profiles."""
    return tmp_path_factory.mktemp("light")


def away_from_edges(height: Any) -> Any:
    """Return where the true height has no step within two samples and profiles; (profiles, samples)."""
    from scipy.ndimage import maximum_filter, minimum_filter

    known = np.nan_to_num(height, nan=1.0)
    return maximum_filter(known, 5) - minimum_filter(known, 5) < 1e-3


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=pytest.mark.slow if each == "camera_line" else ()) for each in SENSORS]
)
def test_a_scan_of_the_recording_is_what_was_predicted(name: str, light: Path, device: Device) -> None:
    task = task_of(name)
    recording = simulate_recording(task, light, seed=7)
    shape = {"camera_line": (PROFILES, 64, 480), "psd_line": (PROFILES, 96, 2)}[name]
    assert (recording.shape, recording.dtype) == (shape, np.uint8 if name == "camera_line" else np.uint16)
    done = scan(recording, task.sensor, device=device)
    known = simulate(task, light, seed=7, device=device)
    np.testing.assert_allclose(done.points.z, known.points.z, atol=1e-8)
    np.testing.assert_array_equal(done.points.status, known.points.status)


def test_a_camera_finds_the_part_again(light: Path) -> None:
    attribution = simulate(task_of("camera_line"), light, seed=7).attribution
    smooth = away_from_edges(attribution.truth.h) & np.isfinite(attribution.error)
    assert smooth.sum() > 3500
    # 0.03 pixel at 0.24 mm per pixel; a windowed centre of gravity of this line reaches 0.01 to 0.02.
    assert np.sqrt(np.mean(attribution.error[smooth] ** 2)) < 0.03 * 0.24e-3


def test_the_noise_is_what_the_sensor_predicts(light: Path) -> None:
    attribution = simulate(task_of("psd_line"), light, seed=7).attribution
    noise, sigma = attribution.causes["noise"], attribution.reading.sigma
    known = np.isfinite(noise) & np.isfinite(sigma) & away_from_edges(attribution.truth.h)
    assert known.sum() > 500
    assert np.sqrt(np.mean((noise[known] / sigma[known]) ** 2)) == pytest.approx(1.0, abs=0.1)


def test_what_the_lens_does_not_see_is_dark(light: Path) -> None:
    """The box covers the plate on the side away from the lens."""
    done = simulate(task_of("camera_line"), light, seed=7)
    y = done.task.transports
    in_shadow = np.flatnonzero((y > 1.2e-3) & (y < 3.7e-3))  # the box ends at 4 mm, and covers 6 mm x 80/144
    columns = slice(70, 160)  # x from -18 to -8 mm
    assert np.all(np.isnan(done.points.z[in_shadow, columns]))
    assert np.all(done.points.status[in_shadow, columns] == 1)


@pytest.mark.slow
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "demo"
    monkeypatch.setattr(sys, "argv", ["gpuvision", "demo", "--out", str(out), "--seed", "3"])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 0
    output = capsys.readouterr()
    assert output.err == ""
    last = output.out.strip().splitlines()[-1]
    assert str(out / "camera_line" / "picture.png") in last
    report = json.loads((out / "report.json").read_text())
    for name in SENSORS:
        for file in ("picture.png", "errors.png", "causes.png", "range_image.tiff", "report.json", "recording.npy"):
            assert (out / name / file).stat().st_size > 0
        assert report[name]["status"]["OK"] > 0
        assert 0 < report[name]["predicted"]["errors"]["median"] < 20e-6
    without, masked = (report[name]["predicted"]["errors"] for name in ("psd_line", "psd_line_masked"))
    assert masked["p95"] < 0.7 * without["p95"]
    again = tmp_path / "again"
    recording = out / "psd_line" / "recording.npy"
    monkeypatch.setattr(sys, "argv", ["gpuvision", "scan", str(recording), "--sensor", "psd_line", "--out", str(again)])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 0
    assert (again / "range_image.tiff").read_bytes() == (out / "psd_line" / "range_image.tiff").read_bytes()
