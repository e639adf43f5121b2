"""Scans with an encoder: a position for each profile, its order, its regularity, and refusals."""

from __future__ import annotations

import copy
import json
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from gpuvision.host import Device, to_numpy
from gpuvision.schema import DescriptionError
from gpuvision.sensor.sensor import Sensor
from gpuvision.status import Status
from gpuvision.workflows.scanning import scan
from scanning import Ran, check_refused, currents

PSD: dict[str, Any] = tomllib.loads(
    resources.files("gpuvision").joinpath("presets", "sensors", "psd_line.toml").read_text(encoding="utf-8")
)
CORNER: dict[str, Any] = tomllib.loads(
    resources.files("gpuvision").joinpath("presets", "sensors", "corner_scene.toml").read_text(encoding="utf-8")
)


def sensor_file(folder: Path, counts: Any, table: dict[str, Any] = PSD, **transport: Any) -> Path:
    """Write a sensor file whose transport has an encoder, and the encoder's file."""
    changed = copy.deepcopy(table)
    changed["transport"].pop("step", None)
    changed["transport"].pop("angle_step", None)
    changed["transport"] |= {"encoder": "belt.csv"} | transport
    (folder / "belt.csv").write_text("\n".join(map(str, counts)))
    (folder / "sensor.toml").write_text(tomli_w.dumps(changed))
    return folder / "sensor.toml"


def test_profiles_lie_where_the_encoder_measured_them(device: Device, tmp_path: Path) -> None:
    counts = [0, 10, 21, 29, 40, 52]
    sensor = Sensor.load(sensor_file(tmp_path, counts, metres_per_count=25e-6, start=0.1))
    done = scan(currents(6), sensor, device=device)
    expected = 0.1 + 25e-6 * np.array(counts)
    np.testing.assert_allclose(to_numpy(done.points.y)[:, 0], expected, rtol=0, atol=1e-8)
    assert done.valid_fraction == 1.0
    found = done.report()["encoder"]
    assert found["file"] == str(tmp_path / "belt.csv")
    assert (found["profiles"], found["not_advancing"]) == (6, 0)
    assert found["step_mean"] == pytest.approx(52 / 5 * 25e-6)
    assert found["step_smallest"] == pytest.approx(8 * 25e-6)
    bends = np.array([1.0, -3.0, 3.0, 1.0]) * 25e-6
    assert found["jitter"] == pytest.approx(np.sqrt(np.mean(bends**2) / 6.0))


def test_profiles_that_do_not_advance_are_flagged(tmp_path: Path) -> None:
    sensor = Sensor.load(sensor_file(tmp_path, [0, 10, 900, 20, 20, 30], metres_per_count=25e-6))
    done = scan(currents(6), sensor)
    flagged = (to_numpy(done.points.status) & Status.NOT_INVERTIBLE) != 0
    np.testing.assert_array_equal(flagged, np.isin(np.arange(6), [2, 4])[:, None].repeat(96, axis=1))
    np.testing.assert_array_equal(np.isnan(to_numpy(done.points.z)), flagged)
    assert done.report()["encoder"]["not_advancing"] == 2
    assert np.ptp(done.grid.y) < 50 * 25e-6
    assert done.summary().endswith("; 2 profiles do not advance")


def test_one_profile_has_no_jitter_in_the_report(tmp_path: Path) -> None:
    done = scan(currents(1), Sensor.load(sensor_file(tmp_path, [7], metres_per_count=1e-3)))
    assert done.report()["encoder"]["jitter"] is None
    json.dumps(done.report(), allow_nan=False)


def test_an_encoder_measures_the_angle_of_a_rotating_sheet(tmp_path: Path) -> None:
    path = sensor_file(tmp_path, [0, 4, 9], CORNER, radians_per_count=1e-3, first_angle=-0.25)
    sensor = Sensor.load(path)
    np.testing.assert_allclose(sensor.transports(3), [-0.25, -0.246, -0.241], rtol=0, atol=1e-15)
    assert sensor.transport.transport is not None
    with pytest.raises(ValueError, match=r"belt\.csv: holds 3 positions, the recording has 4 profiles"):
        sensor.transports(4)


@pytest.mark.parametrize("counts", [range(5), range(7)])
def test_another_number_of_positions_is_refused(
    tmp_path: Path, counts: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save(tmp_path / "belt.npy", currents(6))
    path = sensor_file(tmp_path, counts, metres_per_count=1e-4)
    ran = Ran(capsys, monkeypatch, "scan", tmp_path / "belt.npy", "--sensor", path, "--out", tmp_path / "out")
    check_refused(ran, rf"belt\.csv: holds {len(counts)} positions, .*belt\.npy has 6 profiles")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("transport", "message"),
    [
        ({}, r"'transport\.metres_per_count' is missing, expected a number \[m per count\]"),
        ({"metres_per_count": 0.0}, r"transport\.metres_per_count is 0, expected the size of a count"),
        ({"metres_per_count": 1e-3, "step": 1e-3}, r"\[transport\] has encoder and step at once"),
        ({"metres_per_count": 1e-3, "encoder": "no.csv"}, r"no\.csv"),
        (
            {"metres_per_count": 1e-3, "encoder": "sensor.toml"},
            r"sensor\.toml: line \d+ has .*, expected a finite number",
        ),
        ({"metres_per_count": 1e-3, "encoder_key": "x"}, r"belt\.csv: holds no column 'x'"),
        ({"radians_per_count": 1e-3}, r"'transport\.metres_per_count' is missing"),
    ],
)
def test_refusals(
    tmp_path: Path,
    transport: dict[str, Any],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    np.save(tmp_path / "belt.npy", currents(3))
    path = sensor_file(tmp_path, range(3), **transport)
    ran = Ran(capsys, monkeypatch, "scan", tmp_path / "belt.npy", "--sensor", path, "--out", tmp_path / "out")
    check_refused(ran, message)


def test_the_file_of_the_encoder_is_never_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save(tmp_path / "belt.npy", currents(3))
    path = sensor_file(tmp_path, range(3), metres_per_count=1e-4)
    before = (tmp_path / "belt.csv").read_bytes()
    ran = Ran(
        capsys, monkeypatch, "scan", tmp_path / "belt.npy", "--sensor", path, "--out", tmp_path / "out",
        "--json", tmp_path / "belt.csv", "--overwrite",
    )  # fmt: skip
    check_refused(ran, r"belt\.csv")
    assert (tmp_path / "belt.csv").read_bytes() == before


def test_the_trace_never_replaces_a_file_of_the_scan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save(tmp_path / "belt.npy", currents(3))
    path = sensor_file(tmp_path, range(3), metres_per_count=1e-4)
    for file in (path, tmp_path / "belt.csv", tmp_path / "belt.npy"):
        before = file.read_bytes()
        ran = Ran(
            capsys, monkeypatch, "scan", tmp_path / "belt.npy", "--sensor", path, "--out", tmp_path / "out",
            "--trace", file, "--overwrite",
        )  # fmt: skip
        check_refused(ran, "it is the input")
        assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("first", "step", "signed"), [(250, 3, False), (5, -3, False), (120, 3, True), (-120, -3, True)]
)
def test_a_counter_of_8_bits_wraps_around(tmp_path: Path, first: int, step: int, signed: bool) -> None:
    counts = first + step * np.arange(400)
    read = (counts + 128) % 256 - 128 if signed else counts % 256
    path = sensor_file(tmp_path, read, metres_per_count=1e-3, encoder_bits=8)
    np.testing.assert_allclose(Sensor.load(path).transports(400), 1e-3 * counts, rtol=0, atol=1e-12)


def test_a_count_beyond_the_bits(tmp_path: Path) -> None:
    path = sensor_file(tmp_path, [1, 2, 256], metres_per_count=1e-3, encoder_bits=8)
    with pytest.raises(DescriptionError, match="count 256 of profile 2 does not fit 8 bits"):
        Sensor.load(path)


def test_the_encoder_of_one_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """--encoder replaces the step, or the encoder file, of the sensor file; its file is an input."""
    np.save(tmp_path / "belt.npy", currents(3))
    (tmp_path / "today.csv").write_text("0\n10\n30\n")
    table = copy.deepcopy(PSD)
    table["transport"]["metres_per_count"] = 1e-4
    (tmp_path / "step.toml").write_text(tomli_w.dumps(table))
    assert Sensor.load(tmp_path / "step.toml").encoder is None
    words: list[Any] = ["scan", tmp_path / "belt.npy", "--encoder", tmp_path / "today.csv", "--sensor"]
    for file in (tmp_path / "step.toml", sensor_file(tmp_path, range(7), metres_per_count=1e-4)):
        out = tmp_path / file.stem
        ran = Ran(capsys, monkeypatch, *words, file, "--out", out)
        assert ran.code == 0, ran.err
        with np.load(out / "range_image.npz") as held:
            np.testing.assert_allclose(held["y"][:, 0], [0.0, 1e-3, 3e-3], rtol=0, atol=1e-9)
    ran = Ran(capsys, monkeypatch, *words, tmp_path / "step.toml", "--out", tmp_path / "out", "--overwrite",
              "--json", tmp_path / "today.csv")  # fmt: skip
    check_refused(ran, r"today\.csv")
    (tmp_path / "plain.toml").write_text(tomli_w.dumps(PSD))
    ran = Ran(capsys, monkeypatch, *words, tmp_path / "plain.toml", "--out", tmp_path / "out")
    check_refused(ran, r"'transport\.metres_per_count' is missing")
