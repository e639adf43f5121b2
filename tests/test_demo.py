"""The demonstration: a part with a known shape, two simulated sensors, and scans that find the shape again."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpuvision import cli
from gpuvision.demo import PROFILES, SENSORS, cast_down, part, record
from gpuvision.demo_errors import compare
from gpuvision.host import Device
from gpuvision.scan import Scan, scan
from gpuvision.sensor import Sensor


@pytest.fixture(scope="module")
def recordings() -> dict[str, Any]:
    return {name: record(name, part(), 7) for name in SENSORS}


def test_rays_hit_what_stands_there() -> None:
    mesh = part()
    x = np.array([-13.0, -13.0, 4.0, 10.0, 16.0, 0.0, 30.0, 10.0]) * 1e-3
    y = np.array([9.0, -9.0, -9.0, -9.0, -9.0, 0.0, 0.0, 8.0]) * 1e-3
    z, facing = cast_down(mesh, x, y)
    np.testing.assert_allclose(z[:6], np.array([6.0, 4.0, 1.0, 2.0, 3.0, 0.0]) * 1e-3, atol=1e-12)
    assert np.isnan(z[6])
    np.testing.assert_allclose(facing[:7], [1, 1, 1, 1, 1, 1, 0], atol=1e-9)
    # The ball of 1280 faces lies inside the sphere, by the height of a facet at most: r (1 - cos(a)), a half an edge.
    assert 5e-3 - 8e-3 * (1 - math.cos(0.09)) < z[7] <= 5e-3 + 1e-12


def crossed(a: Any, b: Any) -> Any:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def test_rays_agree_with_every_triangle_in_turn(rng: np.random.Generator) -> None:
    mesh = part()
    x, y = rng.uniform(-0.025, 0.025, 300), rng.uniform(-0.02, 0.02, 300)
    z, _ = cast_down(mesh, x, y)
    a, b, c = (mesh.triangles[:, k] for k in range(3))
    area = crossed(b - a, c - a)
    seen = np.abs(area) > 1e-15
    a, b, c, area = a[seen], b[seen], c[seen], area[seen]
    for k in range(len(x)):
        p = np.array([x[k], y[k]])
        beta = crossed(p - a[:, :2], c - a) / area
        gamma = crossed(b - a, p - a[:, :2]) / area
        hit = (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1)
        heights = a[hit, 2] + beta[hit] * (b - a)[hit, 2] + gamma[hit] * (c - a)[hit, 2]
        expected = heights.max() if hit.any() else np.nan
        np.testing.assert_allclose(z[k], expected, atol=1e-12)


def test_a_recording_is_what_a_sensor_gives(recordings: dict[str, Any]) -> None:
    camera, psd = recordings["camera_line"], recordings["psd_line"]
    assert (camera.shape, camera.dtype) == ((PROFILES, 64, 480), np.uint8)
    assert (psd.shape, psd.dtype) == ((PROFILES, 96, 2), np.uint16)
    assert 100 < camera.max() < 255
    assert 10_000 < psd.max() < 65535
    np.testing.assert_array_equal(record("psd_line", part(), 7), psd)
    assert np.any(record("psd_line", part(), 8) != psd)


def compared(name: str, recordings: dict[str, Any], device: Device | None = None) -> tuple[Scan, Any]:
    done = scan(recordings[name], Sensor.load(name), device=device)
    return done, compare(done, part())


def test_the_scan_finds_the_part(recordings: dict[str, Any], device: Device) -> None:
    done, camera = compared("camera_line", recordings, device)
    # 0.03 pixel at 0.24 mm a pixel; the windowed centre of gravity of a line of 1.2 pixel reaches 0.01 to 0.02.
    assert camera.rms < 0.03 * 0.24e-3
    assert camera.smooth > 0.85
    assert 0.7 < done.valid_fraction < 0.85  # the rest of the view is beside the part, or covered by it
    _, psd = compared("psd_line", recordings, device)
    assert psd.rms < 15e-6
    assert psd.smooth > 0.6


def test_the_noise_is_what_the_sensor_file_predicts(recordings: dict[str, Any]) -> None:
    """On the plate, where a strip sees one height, the spread of the heights is sigma_u dH/du."""
    done, errors = compared("psd_line", recordings)
    sensor = Sensor.load("psd_line")
    readout: Any = sensor.readout
    predicted = readout(recordings["psd_line"])
    slope = (0.1e-3) / float(np.diff(readout.triangulation.to_sensor([[0.0, 0.0], [0.0, 0.1e-3]])[:, 0])[0])
    on_plate = np.isfinite(errors.map) & (np.abs(done.points.z) < 0.06e-3) & (np.abs(errors.map) < 0.06e-3)
    assert np.count_nonzero(on_plate) > 5000
    spread = float(np.std(errors.map[on_plate]))
    expected = float(np.sqrt(np.mean((predicted.sigma[on_plate] * slope) ** 2)))
    assert spread == pytest.approx(expected, rel=0.1)


def test_what_the_lens_does_not_see_is_dark(recordings: dict[str, Any]) -> None:
    """The box covers the plate on the side away from the lens; the ground beside the part throws nothing back."""
    done, _ = compared("camera_line", recordings)
    y = 0.25e-3 * np.arange(PROFILES) - 0.125e-3 * (PROFILES - 1)
    behind = np.flatnonzero((y > 1.2e-3) & (y < 3.7e-3))  # the box ends at 4 mm, and covers 6 mm x 80/144
    columns = slice(70, 160)  # x from -18 to -8 mm
    assert np.all(np.isnan(done.points.z[behind, columns]))
    assert np.all(done.points.status[behind, columns] == 1)
    assert np.all(np.isnan(done.points.z[0]))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "demo"
    monkeypatch.setattr(sys, "argv", ["gpuvision", "demo", "--out", str(out), "--seed", "3"])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 0
    told = capsys.readouterr()
    assert told.err == ""
    last = told.out.strip().splitlines()[-1]
    assert str(out / "camera_line" / "picture.png") in last
    report = json.loads((out / "report.json").read_text())
    for name in SENSORS:
        for file in ("picture.png", "errors.png", "range_image.tiff", "report.json", "recording.npy"):
            assert (out / name / file).stat().st_size > 0
        assert 0 < report[name]["errors"]["rms"] <= report[name]["errors"]["p95"] * 2 <= 1e-4
        assert report[name]["status"]["OK"] > 0
    again = tmp_path / "again"
    recording = out / "psd_line" / "recording.npy"
    monkeypatch.setattr(sys, "argv", ["gpuvision", "scan", str(recording), "--sensor", "psd_line", "--out", str(again)])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 0
    assert (again / "range_image.tiff").read_bytes() == (out / "psd_line" / "range_image.tiff").read_bytes()
