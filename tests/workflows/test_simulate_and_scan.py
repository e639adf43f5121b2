"""Files from ``gpuvision simulate --recording`` to ``gpuvision scan``: heights against the mesh, by its own rays."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import tomli_w
import trimesh

import laser_sensor
from conftest import Draws
from gpuvision.formats.range_image import read_npz
from gpuvision.ranging.line_parameters import METHODS
from gpuvision.ranging.range_image import StraightTransport
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows.simulated_recording import recording_sensor
from gpuvision.workflows.simulating import load_part, prepare_simulation
from mesh_heights import mesh_heights
from scanning import Ran, check_refused

Float64 = npt.NDArray[np.float64]


class Commands:
    """Commands in a folder with a part (millimetres) and the files of a sensor."""

    def __init__(
        self,
        folder: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
        truth: laser_sensor.LaserSensor,
        window: tuple[int, int],
        frame: tuple[int, int],
    ) -> None:
        self.folder, self._fixtures = folder, (capsys, monkeypatch)
        self.mesh = part()
        millimetres = self.mesh.copy()
        millimetres.apply_scale(1e3)
        millimetres.export(folder / "part.stl")
        (folder / "sensor").mkdir()
        self.table = laser_sensor.sensor_table(truth, window, frame)
        self.write("sensor.toml", self.table)
        self.write("camera.toml", laser_sensor.camera_table(truth))

    def write(self, name: str, table: dict[str, Any]) -> None:
        (self.folder / "sensor" / name).write_text(tomli_w.dumps(table))

    def __call__(self, *words: object) -> Ran:
        return Ran(*self._fixtures, *words)

    def simulate(self, *more: object, out: str = "sim") -> Ran:
        sensor = self.folder / "sensor" / "sensor.toml"
        files = (self.folder / "part.stl", "--unit", "mm", "--sensor", sensor, "--out", self.folder / out)
        return self("simulate", *files, "--paths", "direct", "--recording", *more)

    def scan(self, recording: Path, out: str = "scan") -> dict[str, npt.NDArray[Any]]:
        files = (recording / "recording.npy", "--sensor", recording / "recording.toml", "--out", self.folder / out)
        ran = self("scan", *files, "--overwrite")
        assert ran.code == 0, ran.err
        return read_npz(self.folder / out / "range_image.npz")[0]

    def deviations(self, scanned: dict[str, npt.NDArray[Any]]) -> Float64:
        """Return height errors of the valid points over their predicted sigma; the truth by vertical rays."""
        valid = np.isfinite(scanned["z"])
        x, y, z, sigma = (np.float64(scanned[name][valid]) for name in ("x", "y", "z", "sigma_z"))
        true = mesh_heights(self.mesh, x, y)
        return np.where(np.isfinite(true), (z - true) / sigma, np.inf)


def part() -> trimesh.Trimesh:
    """Return a plate with a cap of a sphere and a wedge [m], larger than the field of view."""
    plate = trimesh.creation.box((0.2, 0.06, 4e-3))
    plate.apply_translation((0.0, 0.0, -2e-3))
    ball = trimesh.creation.icosphere(4, 30e-3)
    ball.apply_translation((2e-3, 3e-3, -24e-3))
    wedge = trimesh.creation.box((40e-3, 80e-3, 12e-3))
    wedge.apply_transform(trimesh.transformations.rotation_matrix(0.15, (0.0, 1.0, 0.0)))
    wedge.apply_translation((-48e-3, 0.0, -3e-3))
    joined: Any = trimesh.util.concatenate([plate, ball, wedge])
    made: trimesh.Trimesh = joined
    return made


def tilted(degrees: float, bend: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> laser_sensor.LaserSensor:
    """Return a sensor whose camera uses all 14 coefficients."""
    truth = laser_sensor.sensor(degrees, bend)
    distortion = truth.distortion + np.array(
        [0, 0, 1e-3, -8e-4, 0.02, 0.01, -5e-3, 2e-3, 4e-4, -2e-4, 3e-4, 1e-4, 0, 0]
    )
    return dataclasses.replace(truth, distortion=distortion)


@pytest.fixture
def commands(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Commands:
    """A small window of a tilted camera; the sheet is bent by 0.1 mm at 40 mm from its middle."""
    return Commands(tmp_path, capsys, monkeypatch, tilted(15.0, (0.06, -0.02, 0.03)), (170, 150), (120, 64))


def test_a_scan_of_the_files_finds_the_part(commands: Commands) -> None:
    ran = commands.simulate("--profiles", 6)
    assert ran.code == 0, ran.err
    sim = commands.folder / "sim"
    assert f"gpuvision scan {sim / 'recording.npy'} --sensor {sim / 'recording.toml'}" in ran.out
    scanned = commands.scan(sim)
    simulated, _ = read_npz(sim / "simulation.npz")
    for name in ("x", "y", "z"):
        np.testing.assert_array_equal(scanned[name], simulated[name])
    found = commands.deviations(scanned)
    assert len(found) > 0.95 * scanned["z"].size
    assert not np.any(scanned["status"])  # no saturation
    assert np.mean(np.abs(found) < 3.0) > 0.95
    # The predicted sigma is not too large either.
    assert 0.8 < 1.4826 * np.median(np.abs(found)) < 1.25


@pytest.mark.slow
@pytest.mark.parametrize(
    ("degrees", "bend"),
    [(25.0, 0.06), *(pytest.param(*each, marks=pytest.mark.nightly) for each in ((10.0, 0.0), (40.0, -0.06)))],
)
def test_heights_are_within_their_sigma(
    degrees: float,
    bend: float,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    draws: Draws,
) -> None:
    truth = tilted(degrees, (bend, -0.3 * bend, 0.5 * bend))
    commands = Commands(tmp_path, capsys, monkeypatch, truth, (120, 132), (240, 96))
    for seed in range(draws(2, 2, 7)):
        assert commands.simulate("--profiles", 16, "--seed", seed).code == 0
        scanned = commands.scan(tmp_path / "sim")
        found = commands.deviations(scanned)
        assert len(found) > 0.95 * scanned["z"].size
        assert np.mean(np.abs(found) < 3.0) > 0.95
        assert 0.8 < 1.4826 * np.median(np.abs(found)) < 1.25


def test_the_sensor_file_of_a_recording(commands: Commands) -> None:
    table = commands.table
    table["line"] |= {"read_noise": 0.7}
    table["recording"] = {"background": "median", "rate": 100.0}
    commands.write("sensor.toml", table)
    path = commands.folder / "sensor" / "sensor.toml"
    scene, materials = load_part(commands.folder / "part.stl", 1e-3, None, 0.5)
    task = prepare_simulation(scene, materials, Sensor.load(path), profiles=4)
    made = tomllib.loads(recording_sensor(task, path))
    assert made["camera"]["file"] == str((path.parent / "camera.toml").resolve())
    assert made["recording"] == {"rate": 100.0}
    assert made["line"] == table["line"]  # it has a noise model already
    np.testing.assert_allclose(
        made["transport"]["start"] + made["transport"]["step"] * np.arange(4), task.transports, rtol=0, atol=1e-12
    )
    uneven = dataclasses.replace(task, transports=np.array([0.0, 1e-3, 3e-3]))
    with pytest.raises(ValueError, match="not evenly spaced"):
        recording_sensor(uneven, path)
    table["recording"] = {"background": "dark_after"}
    commands.write("sensor.toml", table)
    with pytest.raises(ValueError, match="needs frames without light"):
        recording_sensor(task, path)


def test_a_sensor_without_a_recording_is_refused_before_the_work(commands: Commands) -> None:
    commands.write("second.toml", commands.table | {"recording": {"background": "dark_before"}})
    ran = commands.simulate("--profiles", 2, "--second", commands.folder / "sensor" / "second.toml")
    check_refused(ran, r"second\.toml: .* needs frames without light")
    assert not (commands.folder / "sim" / "light").exists()


@pytest.mark.parametrize("profiles", [1, 5])
def test_the_sensor_file_of_a_sensor_with_an_encoder(commands: Commands, profiles: int) -> None:
    folder = commands.folder / "sensor"
    (folder / "counts.txt").write_text("0\n7\n15\n")
    moving = commands.table["transport"] | {"encoder": "counts.txt", "encoder_bits": 16, "metres_per_count": 2e-6}
    del moving["step"]
    commands.write("second.toml", commands.table | {"transport": moving})
    scene, materials = load_part(commands.folder / "part.stl", 1e-3, None, 0.5)
    places = 1e-3 + 0.3e-3 * np.arange(profiles)
    task = prepare_simulation(scene, materials, Sensor.load(folder / "second.toml"), transports=places)
    (commands.folder / "recording.toml").write_text(recording_sensor(task, folder / "second.toml"))
    read = Sensor.load(commands.folder / "recording.toml")
    assert read.encoder is None
    assert isinstance(read.transport, StraightTransport)
    assert read.transport.start == pytest.approx(1e-3)
    assert read.transport.step == pytest.approx(0.3e-3 if profiles > 1 else 2e-6)


@pytest.mark.parametrize(
    "method", [pytest.param(name, marks=[] if name == "ml" else pytest.mark.slow) for name in METHODS]
)
@pytest.mark.parametrize("noise", [pytest.param("--noise", marks=pytest.mark.slow), "--no-noise"])
def test_a_scan_has_the_readings_of_the_simulation(commands: Commands, method: str, noise: str) -> None:
    commands.table["line"] |= {"method": method}
    commands.write("sensor.toml", commands.table)
    ran = commands.simulate("--profiles", 2, noise)
    assert ran.code == 0, ran.err
    scanned = commands.scan(commands.folder / "sim")
    simulated, _ = read_npz(commands.folder / "sim" / "simulation.npz")
    assert np.isfinite(scanned["z"]).mean() > 0.9
    for name in ("x", "y", "z"):
        np.testing.assert_array_equal(scanned[name], simulated[name])


@pytest.mark.parametrize("noise", ["--noise", "--no-noise"])
def test_the_threshold_of_the_recording(commands: Commands, noise: str) -> None:
    """``threshold = "auto"`` in simulate: the threshold, and with it each reading, is that of a scan of the frames."""
    commands.table["line"] |= {"threshold": "auto"}
    commands.table["recording"] = {"background": "median"}  # the simulated frames have no background
    commands.write("sensor.toml", commands.table)
    ran = commands.simulate("--profiles", 2, noise)
    assert ran.code == 0, ran.err
    sim = commands.folder / "sim"
    scanned = commands.scan(sim)
    estimated = [json.loads((sim.parent / name / "report.json").read_text())["threshold"] for name in ("sim", "scan")]
    assert estimated[0] == estimated[1]
    frames = np.load(sim / "recording.npy")
    assert np.median(frames) < estimated[0] < 0.75 * np.median(frames.max(axis=1))
    simulated, _ = read_npz(sim / "simulation.npz")
    assert np.isfinite(scanned["z"]).mean() > 0.9
    for name in ("x", "y", "z"):
        np.testing.assert_array_equal(scanned[name], simulated[name])


def test_a_recording_does_not_outlive_its_simulation(commands: Commands) -> None:
    assert commands.simulate("--profiles", 2).code == 0
    sim = commands.folder / "sim"
    assert np.load(sim / "recording.npy").shape == (2, 64, 120)
    sensor = commands.folder / "sensor" / "sensor.toml"
    words = ("simulate", commands.folder / "part.stl", "--unit", "mm", "--sensor", sensor, "--out", sim)
    assert commands(*words, "--paths", "direct", "--profiles", 2).code == 0
    assert not (sim / "recording.npy").exists()
    assert not (sim / "recording.toml").exists()
    # A file of the user is not replaced, and the simulation does not begin.
    (sim / "recording.toml").write_text("mine\n")
    check_refused(commands.simulate("--profiles", 2), r"cannot write .*recording\.toml: the file exists")
