"""Machine files: the machine of the package, every message, and the reference page of the keys."""

from __future__ import annotations

import math
import re
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from gpuvision.camera.lens import Lens
from gpuvision.formats.camera_file import write_lens
from gpuvision.formats.cmos_sensor_file import read_cmos_sensor
from gpuvision.formats.machine_file import MACHINES, named_files, read_machine
from gpuvision.schema import DescriptionError, Section
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.placement.control import Control, Settling
from gpuvision.servoing.placement.machine import PlacementCamera, ThermalDrift, Tolerance

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "machine_files.md"
PRESET = tomllib.loads(
    resources.files("gpuvision").joinpath("presets", "machines", "look_while_place.toml").read_text(encoding="utf-8")
)


def _written(folder: Path, table: dict[str, Any]) -> Path:
    path = folder / "machine.toml"
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    return path


def test_the_machine_of_the_package_is_what_its_file_says() -> None:
    machine = read_machine("look_while_place")
    assert MACHINES == ("look_while_place",)
    assert machine.rate == PRESET["loop"]["rate"]
    assert machine.camera.window == (512, 512)
    assert machine.camera.sensor.columns == 1024
    assert machine.pipette_in_camera.pose.tolist() == PRESET["calibration"]["pipette"]
    np.testing.assert_allclose(machine.pipette_in_camera.pose_covariance[0, 0], 1.6e-13)
    parts = machine.delay.parts
    assert parts["stage vision"] == 0.5e-3
    assert parts["half exposure"] == 0.1e-3
    assert "stage drive" not in parts
    assert machine.axes[0].speed == 0.5
    assert machine.axes[2].encoder == 2e-5
    assert machine.drift.temperature_sigma == 0.5
    assert read_machine("look_while_place", rate=500.0).rate == 500.0


def test_all_keys_of_an_axis_are_read(tmp_path: Path) -> None:
    axis = {"lag": 2e-3, "viscous": 3.0, "coulomb": 0.01, "acceleration": 20.0, "resonance": 80.0, "damping": 0.1}
    fine = {"lag": 1e-4, "stroke": 5e-5, "recentring": 10.0}
    path = _written(tmp_path, PRESET | {"axes": {"y": axis | {"fine": fine}}, "loop": {"rate": 800.0, "gain": 0.1}})
    machine = read_machine(path)
    found = machine.axes[1]
    assert (found.lag, found.viscous, found.coulomb, found.acceleration, found.damping) == (2e-3, 3.0, 0.01, 20.0, 0.1)
    assert found.resonance == pytest.approx(2 * np.pi * 80.0)
    assert found.fine is not None
    assert (found.fine.lag, found.fine.stroke, found.fine.recentring) == (1e-4, 5e-5, 10.0)
    assert machine.axes[0].lag == 0.0
    assert (machine.rate, machine.loop_gain) == (800.0, 0.1)


def test_all_keys_of_loop_and_settling_are_read(tmp_path: Path) -> None:
    loop = {"rate": 900.0, "observer": "kalman", "controller": "pid", "gain": 0.3, "integral": 0.02}
    more = {"derivative": 1e-3, "motion_sigma": [1e-8, 2e-8, 1e-6], "watchdog": 2.5}
    rule = {"rule": "vibration", "frequency": [80.0, 0.0, 0.0], "damping": [0.03, 0.02, 0.02]}
    rule |= {"miss_probability": 0.01, "window": 30, "lead": 2e-3}
    axes = {"x": {"resonance": 90.0, "swing": 2e-5}}
    machine = read_machine(_written(tmp_path, PRESET | {"loop": loop | more, "settling": rule, "axes": axes}))
    del loop["rate"]
    assert machine.control == Control(**(loop | more | {"motion_sigma": (1e-8, 2e-8, 1e-6)}))
    assert (machine.settling.rule, machine.settling.frequency) == ("vibration", (80.0, 0.0, 0.0))
    assert (machine.settling.miss_probability, machine.settling.window, machine.settling.lead) == (0.01, 30, 2e-3)
    assert machine.swing == (2e-5, 0.0, 0.0)
    assert read_machine("look_while_place").control.watchdog == 1.5
    fixed = read_machine(_written(tmp_path, PRESET | {"settling": {"rule": "fixed", "wait": 0.05}}))
    assert fixed.settling == Settling(rule="fixed", wait=0.05)


def test_all_keys_of_camera_delay_tolerance_and_drift_are_read(tmp_path: Path) -> None:
    camera = {"sensor": "pb1024", "window": [128, 256], "pixel": 2e-5, "exposure": 3e-4, "electrons": 5e3}
    covariance = [[4e-13, 1e-13, 2e-11], [1e-13, 9e-13, 3e-11], [2e-11, 3e-11, 1e-8]]
    tolerance = {"position": 2e-6, "angle": 3e-3, "landing_zone": 2e-4, "landing_angle": 4e-3, "max_time": 2.5}
    drift = {"expansion": [1e-6, -2e-6], "temperature_sigma": 0.25}
    described: dict[str, Any] = {
        "camera": camera | {"blur_px": 0.75},
        "calibration": {"pipette": [1e-3, -2e-3, 0.25], "pipette_covariance": covariance},
        "delay": {"transfer": 2e-4, "landing": 0.03, "vision": 4e-4, "control": 3e-4, "drive": 5e-4},
        "tolerance": tolerance | {"max_refused": 7},
        "drift": drift,
        "axes": {"x": {"speed": 0.5}, "theta": {"resonance": 40.0, "swing": 3e-4, "speed": 2.0}},
    }
    machine = read_machine(_written(tmp_path, PRESET | described))
    assert machine.camera == PlacementCamera(
        sensor=read_cmos_sensor("pb1024"), window=(128, 256), pixel=2e-5, exposure=3e-4, electrons=5e3, blur_px=0.75
    )
    assert machine.pipette_in_camera.pose.tolist() == [1e-3, -2e-3, 0.25]
    np.testing.assert_allclose(machine.pipette_in_camera.pose_covariance, covariance, rtol=1e-9)
    assert (machine.transfer, machine.landing) == (2e-4, 0.03)
    assert machine.stages == {"vision": 4e-4, "control": 3e-4, "drive": 5e-4}
    assert machine.tolerance == Tolerance(**tolerance, max_refused=7)
    assert machine.drift == ThermalDrift(expansion=(1e-6, -2e-6), temperature_sigma=0.25)
    assert machine.swing == (0.0, 0.0, 3e-4)
    assert [each.speed for each in machine.axes] == [0.5, math.inf, 2.0]
    assert machine.axes[2].resonance == pytest.approx(80.0 * math.pi)


def test_tables_that_a_machine_need_not_have(tmp_path: Path) -> None:
    """Axes without a limit, no delay, no drift, and the rule `Settling` has by default."""
    least = {name: PRESET[name] for name in ("camera", "loop", "tolerance")}
    machine = read_machine(_written(tmp_path, least | {"calibration": {"pipette": [0.0, 0.0, 0.0]}}))
    assert (machine.axes, machine.swing) == ((Axis(),) * 3, (0.0, 0.0, 0.0))
    assert (machine.transfer, machine.landing, dict(machine.stages)) == (0.0, 0.0, {})
    assert (machine.drift, machine.settling) == (ThermalDrift(), Settling())
    np.testing.assert_array_equal(machine.pipette_in_camera.pose_covariance, np.zeros((3, 3)))
    limits = PRESET["tolerance"]
    assert machine.tolerance == Tolerance(**limits)


def test_files_that_a_machine_names(tmp_path: Path) -> None:
    """A sensor and a lens beside the machine file; the sensors of the package are no files."""
    own = PRESET["camera"] | {"sensor": "own.toml", "lens": "lens.toml"}
    assert named_files(_written(tmp_path, PRESET | {"camera": own})) == (tmp_path / "own.toml", tmp_path / "lens.toml")
    assert named_files(_written(tmp_path, PRESET)) == ()
    assert named_files("look_while_place") == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"loop": {"rate": 1000.0, "observer": "kalmann"}}, "kalman"),
        ({"loop": {"rate": 1000.0, "observer": "kalman"}}, "loop: motion_sigma belongs to the observer"),
        ({"settling": {"rule": "fixed"}}, "settling: wait belongs to the rule"),
        ({"axes": {"y": {"resonance": 90.0, "swing": -1e-9}}}, "axes.y.swing is -1e-09"),
        ({"loop": {"rte": 1000.0}}, "the key 'loop.rate' is missing"),
        ({"loop": {"rate": 1000.0, "gian": 0.1}}, "did you mean 'loop.gain'"),
        ({"loop": {"rate": 1000.0, "gain": 1.9}}, "limit of stability"),
        ({"camera": PRESET["camera"] | {"window": [64.5, 64]}}, "expected whole numbers of rows and columns"),
        (
            {"camera": PRESET["camera"] | {"sensor": "p\n1"}},
            "p 1; give a file or one of lupa300, pb1024",
        ),
        ({"camera": PRESET["camera"] | {"window": [4096, 64]}}, "camera: window rows is 4096"),
        ({"calibration": {"pipette": [0.0, 0.0]}}, "calibration.pipette is"),
        (
            {"calibration": PRESET["calibration"] | {"pipette_covariance": [[-1.0, 0, 0]] * 3}},
            "calibration: covariance",
        ),
        (
            {"calibration": PRESET["calibration"] | {"pipette_covariance": [[1e-12, 0, 0]] * 2}},
            "calibration.pipette_covariance has 2 rows, expected 3",
        ),
        (
            {"calibration": PRESET["calibration"] | {"pipette_covariance": [[1e-12, 0, 0]] * 4}},
            "calibration.pipette_covariance has 4 rows, expected 3",
        ),
        (
            {"camera": PRESET["camera"] | {"pixel": 10.0}},
            "camera.pixel is 10.0 m, expected a number [m] above 0 and of",
        ),
        ({"camera": PRESET["camera"] | {"k2": 1e-12}}, "camera: give lens, or k1 with k2 or without it"),
        ({"camera": PRESET["camera"] | {"k1": 1e-9, "lens": "c.toml"}}, "camera: give lens, or k1 with k2 or without"),
        ({"camera": PRESET["camera"] | {"lens": "missing.toml"}}, "camera.lens: "),
        ({"camera": PRESET["camera"] | {"k1": -1e-4}}, "camera: lens: the model folds within the window"),
        ({"axes": {"z": {}}}, "unknown key 'axes.z'"),
        ({"axes": {"x": {"coulomb": 1.0}}}, "axes.x: an axis with friction"),
        ({"tolerance": PRESET["tolerance"] | {"max_refused": 0}}, "tolerance.max_refused is 0"),
    ],
)
def test_wrong_files_are_refused_with_the_key(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=re.escape(message)):
        read_machine(_written(tmp_path, PRESET | change))


def test_a_lens_is_read_from_coefficients_or_a_camera_file(tmp_path: Path) -> None:
    """The coefficients hold about the middle of the sensor, the camera file in pixels of the whole sensor."""
    camera = PRESET["camera"] | {"window": [128, 256]}
    found = read_machine(_written(tmp_path, PRESET | {"camera": camera | {"k1": 1e-8, "k2": 2e-14}})).camera
    assert found.lens == Lens(k1=1e-8, k2=2e-14, centre=(511.5, 511.5))
    assert found.window_lens == Lens(k1=1e-8, k2=2e-14, centre=(127.5, 63.5))
    lens = Lens(k1=3e-8, centre=(500.0, 520.0))
    write_lens(tmp_path / "lens.toml", lens, {"image": {"size": [1024, 1024]}})
    path = _written(tmp_path, PRESET | {"camera": camera | {"lens": "lens.toml"}})
    assert read_machine(path).camera.lens == lens
    assert read_machine(path).camera.window_lens == Lens(k1=3e-8, centre=(116.0, 72.0))
    assert named_files(path) == (tmp_path / "lens.toml",)
    write_lens(tmp_path / "lens.toml", lens, {"image": {"size": [640, 480]}}, overwrite=True)
    with pytest.raises(DescriptionError, match="calibrated at 640 x 480; calibrate with images of the whole sensor"):
        read_machine(path)


def _documented() -> set[tuple[str, str]]:
    """Return table and key of every row of the page."""
    found, table = set(), ""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if heading := re.fullmatch(r"### `\[([a-z.]+)\]`.*", line):
            table = heading[1]
        elif row := re.match(r"\| (`[^|]+`) \|", line):
            found |= {(table, key) for key in re.findall(r"`(\w+)`", row[1])}
    return found


def test_the_page_lists_the_keys_of_the_reader(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: set[tuple[str, str]] = set()
    value_of = Section._value

    def recorded(section: Section, key: str, expected: str, default: Any) -> Any:
        asked.add((section.name, key))
        return value_of(section, key, expected, default)

    fine = {"lag": 1e-4, "stroke": 5e-5}
    full = PRESET | {"axes": {"x": {"lag": 1e-3, "fine": fine}}}
    path = _written(tmp_path, full)
    monkeypatch.setattr(Section, "_value", recorded)
    read_machine(path)
    sections = {"camera", "calibration", "axes", "loop", "delay", "tolerance", "drift", "settling"}
    sections |= {"x", "y", "theta", "fine"}
    # The keys of the sensor are those of camera presets.
    sensor = {"array", "response", "noise", "readout"}
    keys = {(table, key) for table, key in asked if table not in sensor and key not in sections | sensor}
    keys = {each for each in keys if each not in {("", "estimated")}} | {("camera", "sensor")}
    assert {each for each in keys if each not in _documented()} == set()
    assert _documented() <= keys
