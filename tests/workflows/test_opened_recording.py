"""Recordings in ambient light: the background is subtracted and the threshold estimated before the readout."""

from __future__ import annotations

import dataclasses
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.ndimage import median_filter

from gpuvision.host import Device, RecordingError, to_numpy
from gpuvision.host.image_files import read_frame
from gpuvision.host.sources import ArraySource
from gpuvision.ranging.line import LineReadout
from gpuvision.sensor.sensor import Background, Recording, Sensor
from gpuvision.workflows.opened_recording import open_for_scan, sensor_with_threshold
from gpuvision.workflows.scanning import scan
from scanning import Ran, check_refused, line_frames

PROFILES, NOISE = 7, 1.5
# The line has a standard deviation of 1.2 pixels: from frame to frame it moves by more than its width.
LIGHT_ROWS = 10.0 + 7.0 * np.arange(PROFILES)[:, None] + np.linspace(0.0, 1.0, 480)


def sensor(background: Background | Path = "none", *, automatic: bool = True) -> Sensor:
    """Return the shipped camera with a background and a threshold of the recording."""
    shipped = Sensor.load("camera_line")
    recording = dataclasses.replace(shipped.recording, background=background)
    return dataclasses.replace(shipped, recording=recording, auto_threshold=automatic)


def ambient(seed: int = 1) -> Any:
    """Return a textured scene in ambient light, (64, 480): brighter than the line in places."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(20.0, 140.0, (16, 120)), 4, axis=0).repeat(4, axis=1)


def noisy(frames: Any, seed: int = 2) -> Any:
    rng = np.random.default_rng(seed)
    return np.clip(np.rint(frames + rng.normal(0.0, NOISE, frames.shape)), 0, 255).astype(np.uint8)


def daylight(background: str) -> Any:
    """Return frames of a moving line in ambient light; for pairs the light is off in every second frame."""
    line = line_frames(LIGHT_ROWS, peak=100.0).astype(float)
    if background.startswith("dark"):
        pairs = [line, np.zeros_like(line)] if background == "dark_after" else [np.zeros_like(line), line]
        line = np.stack(pairs, axis=1).reshape(-1, *line.shape[1:])
    return noisy(line + ambient())


@pytest.mark.parametrize("background", ["median", "previous", "dark_after", "dark_before"])
def test_daylight_needs_no_tuning(device: Device, background: Background) -> None:
    clean = scan(line_frames(LIGHT_ROWS, peak=100.0), sensor(automatic=False), device=device)
    done = scan(daylight(background), sensor(background), device=device)
    first = 1 if background == "previous" else 0
    assert done.points.z.shape == clean.points.z.shape
    error = to_numpy(done.points.z)[first:] - to_numpy(clean.points.z)[first:]
    assert np.mean(np.isfinite(error)) > 0.995
    # Noise of a centroid: about NOISE * sqrt(2) * 5 px / 300 grey levels = 0.04 px, at 0.24 mm per pixel.
    assert np.nanstd(error) < 0.06 * 0.24e-3
    assert abs(np.nanmedian(error)) < 0.02 * 0.24e-3
    assert done.report()["background"] == background
    assert done.advice() == ()


def test_daylight_with_an_image_of_the_scene(device: Device, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "dark.png"), noisy(ambient(), 9))
    done = scan(daylight("median"), sensor(tmp_path / "dark.png"), device=device)
    assert done.valid_fraction > 0.995


def test_a_failed_scan_says_what_to_try(device: Device) -> None:
    with pytest.raises(ValueError, match=r"no valid sample in 7 frames .*: try .*\[recording\] background"):
        scan(np.zeros((7, 64, 480), np.uint8), sensor(automatic=False), device=device)
    dark = line_frames(LIGHT_ROWS, peak=100.0)
    dark[:, :, :300] = 0
    assert any("[recording] background" in each for each in scan(dark, sensor(automatic=False), device=device).advice())


def test_the_threshold_lies_between_noise_and_line() -> None:
    opened = open_for_scan(daylight("median"), sensor("median"))
    threshold: Any = opened.sensor.readout.threshold
    assert 6 * NOISE <= threshold <= 0.3 * 100.0
    previous = open_for_scan(daylight("median"), sensor("previous")).sensor
    assert previous.readout.threshold >= threshold


@pytest.mark.parametrize("background", ["median", "previous", "none"])
def test_the_first_frame_of_a_group_gives_the_threshold(background: Background) -> None:
    """The second frame of each group is much noisier; only pairs with a dark frame use it."""
    frames = daylight("median")
    groups = np.stack([frames, noisy(frames + np.random.default_rng(4).normal(0.0, 30.0, frames.shape))], axis=1)
    found: Any = sensor_with_threshold(sensor(background), groups).readout
    alone: Any = sensor_with_threshold(sensor(background), groups[:, :1]).readout
    noisier: Any = sensor_with_threshold(sensor(background), groups[:, 1:]).readout
    assert found.threshold == alone.threshold < noisier.threshold
    assert found.minimum_peak == max(40.0, found.threshold)


def test_grey_levels_far_from_zero_keep_their_noise() -> None:
    """An offset that the background removes changes nothing; float32 would round these levels to multiples of 64."""
    frames = daylight("median").astype(np.float64)[:, None]
    plain: Any = sensor_with_threshold(sensor("median"), frames).readout
    moved: Any = sensor_with_threshold(sensor("median"), frames + 2.0**29).readout
    assert moved.threshold == plain.threshold


def test_a_source_that_gives_its_frames_once_is_refused() -> None:
    for given in (sensor("median", automatic=False), sensor()):
        with pytest.raises(RecordingError, match="need a recording that can be read twice"):
            open_for_scan(ArraySource(daylight("median")), given)
    # The previous frame needs no second reading.
    assert open_for_scan(ArraySource(daylight("median")), sensor("previous", automatic=False)).source.length == PROFILES


def test_the_command_reads_the_background_beside_the_sensor_file_and_keeps_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, device: Device
) -> None:
    text = resources.files("gpuvision").joinpath("presets", "sensors", "camera_line.toml").read_text()
    text = text.replace("[recording]", '[recording]\nbackground = "picture.png"')
    assert 'background = "picture.png"' in text
    (tmp_path / "sensor.toml").write_text(text)
    np.save(tmp_path / "sweep.npy", daylight("median"))
    arguments = ("scan", tmp_path / "sweep.npy", "--sensor", tmp_path / "sensor.toml", "--device", device.label)
    check_refused(
        Ran(capsys, monkeypatch, *arguments, "--out", tmp_path / "out"),
        r"picture\.png.*(no such|does not exist|No such)",
    )
    image = tmp_path / "picture.png"
    cv2.imwrite(str(image), noisy(ambient(), 9))
    before = image.read_bytes()
    assert Ran(capsys, monkeypatch, *arguments, "--out", tmp_path / "out").code == 0
    # The scan would write its own picture.png here, over an input.
    check_refused(Ran(capsys, monkeypatch, *arguments, "--out", tmp_path, "--overwrite"), r"picture\.png")
    assert image.read_bytes() == before


@pytest.mark.parametrize("along", ["columns", "rows"])
@pytest.mark.parametrize("step", [0.0, 0.3])
def test_a_line_that_stands_still(step: float, along: Any) -> None:
    """On a flat part the median of the frames contains the line, which covers more than 3 % of a small window."""
    rows = 30.0 + step * np.arange(PROFILES)[:, None] + np.zeros(480)
    frames = noisy(line_frames(rows, peak=100.0).astype(float) + 10.0)
    if along == "rows":
        frames = np.ascontiguousarray(frames.swapaxes(1, 2))
    camera = dataclasses.replace(sensor(), readout=LineReadout(along=along), frame=frames.shape[1:])
    threshold = open_for_scan(frames, camera).sensor.readout.threshold
    # The unlit level and 6.2 standard deviations of the noise; the slow line adds to the differences.
    assert 10.0 + 6.0 * NOISE <= threshold <= 10.0 + 14.0 * NOISE


@pytest.mark.realdata
def test_a_real_line_on_a_textured_board(device: Device, data: Path) -> None:
    """A red line on a chequered board in a lit room, with an image of the board without the line."""
    image = read_frame(data / "ciclop" / "laser.png", "red")
    shipped = Sensor.load("camera_line")
    with_background = dataclasses.replace(
        shipped,
        readout=LineReadout(along="rows"),
        recording=Recording(channel="red", background=data / "ciclop" / "laser_background.png"),
        frame=image.shape,
        auto_threshold=True,
    )
    opened = open_for_scan(image[None], with_background)
    frames = np.empty((1, *image.shape), np.uint8)
    opened.source.read_into(frames, np.zeros(1, np.int64))
    position = to_numpy(opened.sensor.readout(frames, device=device).position)[0]
    found = np.isfinite(position)
    # The line leaves the board at the lower end of the image.
    assert np.mean(found) > 0.85
    # The board is flat and hand-held: the line is smooth over its width of some pixels.
    smooth = median_filter(position[found], 31)
    assert np.mean(np.abs(position[found] - smooth) < 3.0) > 0.9
