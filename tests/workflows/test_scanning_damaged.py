"""Scans of damaged recordings: damaged frames have no points, and the report names them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gpuvision.host import Device, NoDeviceError, to_numpy
from gpuvision.host.sources import ArraySource
from gpuvision.schema import Section
from gpuvision.sensor.sensor import Damaged, Sensor
from gpuvision.status import Status
from gpuvision.workflows.preview import preview_scan
from gpuvision.workflows.scanning import scan
from scanning import line_frames

ROWS = 20.0 + 0.5 * np.arange(8)[:, None] + np.linspace(0.0, 3.0, 480)


class Scratched(ArraySource):
    """Array of which frames 2 and 5 are damaged."""

    def damaged_frames(self) -> frozenset[int]:
        return frozenset(each for each in (2, 5) if each < self._next)


def camera(damaged: Damaged) -> Sensor:
    shipped = Sensor.load("camera_line")
    return dataclasses.replace(shipped, recording=dataclasses.replace(shipped.recording, damaged=damaged))


@pytest.mark.parametrize("damaged", ["drop", "keep"])
def test_damaged_frames_are_flagged_and_named(device: Device, damaged: Damaged) -> None:
    done = scan(Scratched(line_frames(ROWS)), camera(damaged), device=device)
    flagged = (to_numpy(done.points.status) & Status.NO_DATA) != 0
    lost = np.isin(np.arange(8), [2, 5] if damaged == "drop" else [])
    np.testing.assert_array_equal(flagged, np.broadcast_to(lost[:, None], (8, 480)))
    np.testing.assert_array_equal(np.isnan(to_numpy(done.points.z)), flagged)
    assert done.report()["damaged_frames"] == [2, 5]
    assert done.summary().endswith("; 2 damaged frames")


class Closing(Scratched):
    """Array that is closed, and read or not."""

    is_closed = False

    def close(self) -> None:
        self.is_closed = True


def test_a_scan_that_fails_before_its_first_frame_closes_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Closing(line_frames(ROWS))
    with pytest.raises(ValueError, match="rate"):
        scan(source, camera("drop"), rate=-1.0)
    assert source.is_closed

    def refuse(*_: object) -> Device:
        raise NoDeviceError("no device")

    monkeypatch.setattr(Device, "best", refuse)
    source = Closing(line_frames(ROWS))
    with pytest.raises(NoDeviceError):
        scan(source, camera("drop"))
    assert source.is_closed
    source = Closing(np.zeros((8, 20, 30), np.float32))
    with pytest.raises(NoDeviceError):
        scan(source, focus_sensor())
    assert source.wait()
    assert source._next == 0  # not read


def test_a_focus_stack_without_memory_for_its_frames_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise MemoryError

    monkeypatch.setattr("gpuvision.workflows.focus_frames.default_batch", refuse)
    source = Closing(np.zeros((8, 20, 30), np.float32))
    with pytest.raises(MemoryError):
        scan(source, focus_sensor())
    assert source.is_closed


def test_a_preview_counts_the_damaged_frames() -> None:
    found = preview_scan(Scratched(line_frames(ROWS)), camera("drop"))
    assert found.damaged_frames == (2, 5)
    assert found.summary().endswith("% of the samples; 2 damaged frames")
    found = preview_scan(line_frames(ROWS), camera("drop"))
    assert "damaged" not in found.summary()


def test_a_good_recording_has_none() -> None:
    done = scan(line_frames(ROWS), camera("drop"))
    assert done.report()["damaged_frames"] == []
    assert "damaged" not in done.summary()


def test_a_damaged_image_of_a_folder(tmp_path: Path) -> None:
    for number, frame in enumerate(line_frames(ROWS)):
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), frame)
    content = bytearray((tmp_path / "6.jpg").read_bytes())
    content[len(content) // 2 : len(content) // 2 + 9] = bytes(9)
    (tmp_path / "6.jpg").write_bytes(content)
    done = scan(tmp_path, camera("drop"))
    assert done.report()["damaged_frames"] == [6]
    assert np.all(to_numpy(done.points.status)[6] & Status.NO_DATA)
    assert np.isfinite(to_numpy(done.points.z)[:6]).mean() > 0.99


def test_what_to_try_with_a_recording_that_is_damaged_throughout() -> None:
    class Broken(ArraySource):
        def damaged_frames(self) -> frozenset[int]:
            return frozenset(range(8))

    with pytest.raises(ValueError, match=r'many frames are damaged: copy it again, or .* damaged = "keep"'):
        scan(Broken(line_frames(ROWS)), camera("drop"))


def focus_sensor(**focus: Any) -> Sensor:
    table: dict[str, Any] = {
        "kind": "focus",
        "focus": {"stage_step": 1e-4, "pixel_size": 1e-5, "measure": "intensity"} | focus,
        "output": {"cell": 1e-5},
    }
    return Sensor.from_section(Section(table, "sensor.toml"))


def test_pixels_without_a_sharpest_frame_keep_their_status() -> None:
    """The first frame is damaged; pixels without texture are LOW_SIGNAL."""

    class FirstScratched(ArraySource):
        def damaged_frames(self) -> frozenset[int]:
            return frozenset({0})

    number = np.arange(8)[:, None, None]
    peaks = np.broadcast_to(np.linspace(0.6, 6.9, 30), (20, 30))
    frames = (200.0 * np.exp(-0.5 * ((number - peaks) / 1.3) ** 2)).astype(np.float32)
    frames[:, :4] = 0.0
    done = scan(FirstScratched(frames), focus_sensor(threshold=10.0))
    status = to_numpy(done.points.status)
    assert np.all(status[:4] == Status.LOW_SIGNAL)
    near = np.broadcast_to(np.rint(peaks[4:]) == 1, (16, 30))
    np.testing.assert_array_equal((status[4:] & Status.NO_DATA) != 0, near)


def test_a_damaged_frame_of_a_focus_stack() -> None:
    """Pixels that are sharpest near the damaged frame have no height."""
    number = np.arange(8)[:, None, None]
    peaks = np.broadcast_to(np.linspace(0.6, 6.9, 30), (20, 30))
    frames = (200.0 * np.exp(-0.5 * ((number - peaks) / 1.3) ** 2)).astype(np.float32)
    done = scan(Scratched(frames), focus_sensor())
    near = np.isin(np.rint(peaks), [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal((to_numpy(done.points.status) & Status.NO_DATA) != 0, near)
    kept = dataclasses.replace(done.sensor, recording=dataclasses.replace(done.sensor.recording, damaged="keep"))
    assert np.all(np.isfinite(to_numpy(scan(Scratched(frames), kept).points.z)))
