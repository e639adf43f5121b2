"""The commands of the tutorial from a box of parts to a volume map, on simulated images."""

from __future__ import annotations

import csv
import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import laser_sensor
from gpuvision.formats.range_image import read_npz
from scanning import Ran

Float64 = npt.NDArray[np.float64]
PAGE = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "box_of_parts_to_volume_map.md"
NOISE = "[line]\nread_noise = 1.5\n"  # what the page adds to the sensor file
# Truncated cones of 8 mm and 6.4 mm diameter: place on the stage and height [mm].
SPOTS = (
    (-20, 10, 2.0), (-6, 12, 2.0), (8, 9, 2.0), (21, 12, 1.0),
    (-19, 28, 2.0), (-4, 30, 2.6), (9, 27, 2.0), (22, 31, 0.0),
)  # fmt: skip


def _heights(x: Float64, y: Float64) -> Float64:
    z = np.zeros_like(x)
    for left, up, height in SPOTS:
        rise = (4e-3 - np.hypot(x - 1e-3 * left, y - 1e-3 * up)) / 0.8e-3
        z = np.maximum(z, 1e-3 * height * np.clip(rise, 0.0, 1.0))
    return z


def _frames(truth: laser_sensor.LaserSensor, count: int, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Render the laser line on the moving deposits; the points of the sheet on the surface by fixed-point iteration."""
    up = laser_sensor.up(truth)
    along = truth.step / np.linalg.norm(truth.step)
    across = np.cross(up, along)
    across *= -np.sign(across @ truth.g)  # x of the scene runs against g
    g, row = np.linspace(-0.07, 0.07, 1400), np.arange(float(laser_sensor.SIZE[1]))[:, None]
    frames = np.empty((count, *laser_sensor.SIZE[::-1]), np.uint8)
    for profile in range(count):
        h = np.zeros_like(g)
        for _ in range(25):
            points = truth.surface(np.stack([g, h], axis=1)) - truth.origin - profile * truth.step
            h += 0.6 * (_heights(points @ across, -(points @ along)) - points @ up)
        column, at = truth.project(truth.surface(np.stack([g, h], axis=1))).T
        order = np.argsort(column)
        rows = np.interp(np.arange(float(laser_sensor.SIZE[0])), column[order], at[order])
        light = 8.0 + rng.normal(0.0, 1.5, frames.shape[1:]) + 150.0 * np.exp(-0.5 * ((row - rows) / 1.4) ** 2)
        frames[profile] = np.clip(np.rint(light), 0, 255)
    return frames


def _inputs(folder: Path) -> None:
    """Write what the page takes for given: images of the target, a recording, and a paste layer."""
    truth, rng = laser_sensor.sensor(20.0, (0.06, -0.02, 0.03)), np.random.default_rng(1)
    (folder / "shots").mkdir()
    laser_sensor.write_images(folder / "shots", truth, rng, 8, 3)
    (folder / "shots" / "moved").rename(folder / "moved")
    np.save(folder / "recording.npy", _frames(truth, 210, rng))
    (folder / "gerbers").mkdir()
    flashes = "".join(f"X{round((x + 30) * 1e6)}Y{round(y * 1e6)}D03*\n" for x, y, _ in SPOTS)
    head = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n%ADD10C,8*%\nD10*\n"
    (folder / "gerbers" / "paste.gbr").write_text(f"{head}{flashes}M02*\n")


@pytest.mark.slow
def test_the_commands_of_the_page_measure_the_volumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _inputs(tmp_path)
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text().replace("\\\n", " ")
    commands: list[str] = re.findall(r"^    gpuvision (.*)$", text, re.MULTILINE)
    assert [each.split()[0] for each in commands] == ["calibrate", "scan", "inspect"]
    for each in commands:
        shots = sorted(str(path) for path in Path("shots").glob("*.png"))
        words = [name for word in shlex.split(each) for name in (shots if "*.png" in word else [word])]
        ran = Ran(capsys, monkeypatch, *words)
        assert ran.code == 0, ran.err
        if words[0] == "calibrate":
            assert NOISE in text
            sensor = Path("sensor.toml")
            sensor.write_text(sensor.read_text().replace("[line]\n", NOISE))
    with Path("paste", "paste.csv").open() as file:
        rows = list(csv.DictReader(file))
    names = ("volume_m3", "volume_sigma_m3", "volume_systematic_sigma_m3")
    volume, sigma, systematic = (np.array([float(each[name]) for each in rows]) for name in names)
    true = np.array([math.pi * 1e-3 * height / 3 * (4e-3**2 + 4e-3 * 3.2e-3 + 3.2e-3**2) for _, _, height in SPOTS])
    assert np.all(np.abs(volume - true) < 3 * np.hypot(sigma, systematic))
    # The systematic sigma of 0.1 % of heights and of lengths, which count twice.
    np.testing.assert_allclose(systematic, np.abs(volume) * math.hypot(1e-3, 2e-3), rtol=1e-9)
    # The sigma of the heights is that of the scan: the noise of the camera, and the phase of the line in its pixel.
    report = json.loads(Path("scan", "report.json").read_text())
    assert report["error_budget"]["measured"]["ratio"] == pytest.approx(1.0, abs=0.1)
    inspected, arrays = (
        json.loads(Path("paste", "report.json").read_text()),
        read_npz(Path("scan", "range_image.npz"))[0],
    )
    noise = inspected["noise_m"]
    assert noise == pytest.approx(np.nanmedian(np.hypot(arrays["map_sigma"], arrays["map_phase"])), rel=0.1)
    assert 0.9 < inspected["board_scatter_m"] / noise < 1.15
    assert [each["verdict"] for each in rows] == ["pass"] * 3 + ["low"] + ["pass"] * 3 + ["low"]
