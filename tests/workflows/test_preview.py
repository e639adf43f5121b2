"""Preview of a scan: the line over some frames, before the scan."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.host.outputs import MANIFEST
from gpuvision.sensor.sensor import Sensor
from gpuvision.status import Status
from gpuvision.workflows.preview import Preview, preview_scan
from gpuvision.workflows.scanning import scan
from scanning import Ran, check_refused, currents
from scanning import line_frames as frames_of_lines

PROFILES = 40
ROWS = 10.0 + 1.1 * np.arange(PROFILES)[:, None] + np.linspace(0.0, 1.0, 480)


def recording() -> Any:
    """Return 40 frames in ambient light of 60 grey levels; 48 of 480 columns have no line."""
    frames = frames_of_lines(ROWS, peak=120.0) + np.uint8(60)
    frames[:, :, :48] = 60
    return frames


def daylight() -> Sensor:
    shipped = Sensor.load("camera_line")
    median = dataclasses.replace(shipped.recording, background="median")
    return dataclasses.replace(shipped, recording=median, auto_threshold=True)


@pytest.mark.parametrize(
    ("damaged", "words"), [((), ""), ((3,), "; 1 damaged frame"), ((3, 7, 9), "; 3 damaged frames")]
)
def test_summary_counts_damaged_frames(damaged: tuple[int, ...], words: str) -> None:
    frames: Any = tuple(SimpleNamespace(found_fraction=each) for each in (0.5, 0.25, 0.125))
    preview = Preview(name="", sensor=Sensor.load("camera_line"), frames=frames, damaged_frames=damaged)
    assert preview.summary().startswith("preview of 3 frames at ")
    assert preview.summary().endswith(f": a line in 29.2 % of the samples{words}")


def test_frames_are_spread_over_the_recording(device: Device) -> None:
    found = preview_scan(recording(), daylight(), count=5, device=device)
    numbers = [frame.number for frame in found.frames]
    assert len(numbers) == 5
    assert numbers[0] == 0
    assert numbers[-1] >= PROFILES - 10
    for frame in found.frames:
        # The background is subtracted, and the line is where it was drawn: 0.03 px for rounding and threshold.
        assert np.median(frame.image) == 0
        np.testing.assert_allclose(frame.position[48:], ROWS[frame.number, 48:], rtol=0, atol=0.05)
        assert np.all(frame.status[:48] & Status.LOW_SIGNAL)
        assert frame.found_fraction == pytest.approx(0.9)
    threshold = found.sensor.readout.threshold
    assert 4 <= threshold <= 40
    assert found.summary() == (
        f"preview of 5 frames at threshold {threshold:g} grey levels, background median: "
        "a line in 90.0 % of the samples"
    )


def test_a_short_recording_is_shown_as_a_whole() -> None:
    found = preview_scan(recording()[:3], Sensor.load("camera_line"))
    assert [frame.number for frame in found.frames] == [0, 1, 2]


@pytest.mark.rendered
def test_the_picture_shows_line_and_flags(tmp_path: Path) -> None:
    found = preview_scan(recording(), daylight())
    found.write(tmp_path)
    picture = cv2.imread(str(tmp_path / "preview.png"))
    assert picture is not None
    blue, green, red = np.moveaxis(picture.astype(int), 2, 0)
    # Dots on 432 samples and marks of 48 samples, in 9 frames.
    assert np.count_nonzero(green - np.maximum(red, blue) > 40) > 9 * 432
    assert np.count_nonzero(red - np.maximum(green, blue) > 40) > 9 * 48


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "line.npy", recording())
    np.save(tmp_path / "psd.npy", currents(3))
    arguments = ("scan", tmp_path / "line.npy", "--sensor", "camera_line", "--out", tmp_path / "out", "--preview")
    ran = Ran(capsys, monkeypatch, *arguments)
    assert (ran.code, ran.err) == (0, "")
    first, second = ran.out.splitlines()
    assert first.startswith("preview of 9 frames at threshold 16 grey levels: a line in ")
    assert second == f"look at {tmp_path / 'out' / 'preview.png'}"
    assert [each.name for each in (tmp_path / "out").iterdir() if each.name != MANIFEST] == ["preview.png"]
    assert Ran(capsys, monkeypatch, *arguments).code == 0  # it replaces its own picture
    ran = Ran(
        capsys, monkeypatch, "scan", tmp_path / "psd.npy", "--sensor", "psd_line", "--out", tmp_path / "o", "--preview"
    )
    check_refused(ran, "a preview shows the line in camera frames; the sensor is of kind 'psd'")
    assert not (tmp_path / "o").exists()


@pytest.mark.slow
@pytest.mark.realdata
def test_the_guide_of_a_hobby_rig_finds_the_line_of_a_real_frame(data: Path, tmp_path: Path) -> None:
    guide = Path(__file__).resolve().parents[2] / "docs" / "guides" / "hobby_rig.md"
    (tmp_path / "hobby.toml").write_text(guide.read_text(encoding="utf-8").split("```toml\n")[1].split("```")[0])
    (tmp_path / "background.png").write_bytes((data / "ciclop" / "laser_background.png").read_bytes())
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "0.png").write_bytes((data / "ciclop" / "laser.png").read_bytes())
    sensor = Sensor.load(tmp_path / "hobby.toml")
    found = preview_scan(tmp_path / "frames", sensor)
    assert found.summary().startswith("preview of 1 frames at threshold 40 grey levels, background background.png: ")
    assert found.found_fraction > 0.85
    # Most of the rows have a depth in front of the camera, and the heights belong to the same lines.
    done = scan(tmp_path / "frames", sensor)
    assert done.valid_fraction == pytest.approx(found.found_fraction, abs=0.01)
    assert 0.1 < -float(np.nanmedian(done.points.z)) < 1.0
