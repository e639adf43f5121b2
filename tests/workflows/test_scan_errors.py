"""Errors of a scan: the predicted standard deviations are the scatter of simulated recordings, in every output file."""

from __future__ import annotations

import dataclasses
import json
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from gpuvision.camera.camera import Camera
from gpuvision.formats.height_files import read_heights
from gpuvision.formats.range_image import read_ply
from gpuvision.host import Device, to_numpy
from gpuvision.ranging.range_image import RangeImage
from gpuvision.ranging.rotating_sigma import RotatingSheetSigma
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.reference.line import pixel_gaussian
from gpuvision.schema import DescriptionError, read_toml
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows.scan_errors import (
    budget_line,
    error_budget,
    phase_scatter,
    predict_errors,
    scatter_about_plane,
    sigma_outputs,
)
from gpuvision.workflows.scan_result import Scan
from gpuvision.workflows.scanning import scan

READ_NOISE, GAIN, JITTER = 1.5, 0.1, 20e-6
PRESETS = Path(__file__).parents[2] / "gpuvision" / "presets" / "sensors"


def noisy_camera(**changes: Any) -> Sensor:
    """Return the shipped camera with a noise model, a jitter of the transport and a covariance of the calibration."""
    sensor = Sensor.load("camera_line")
    readout: Any = sensor.readout
    sheet = dataclasses.replace(readout.triangulation, covariance=np.diag([1e-12] * 6 + [1e-10] * 2))
    readout = dataclasses.replace(
        readout, window=6, read_noise=READ_NOISE, gain=GAIN, triangulation=sheet, outputs=None, **changes
    )
    transport: Any = dataclasses.replace(sensor.transport, jitter=JITTER)
    return dataclasses.replace(sensor, readout=readout, transport=transport, noise_known=True)


def frames_of_plane(rng: np.random.Generator, frames: int) -> Any:
    """Return frames (n, 64, 480) of a line near row 30 that is slightly tilted, with shot noise and read noise."""
    places = 30.2 + 0.01 * np.arange(480)[None, :] + np.zeros((frames, 1))
    light = pixel_gaussian(np.arange(64)[None, :, None], places[:, None, :], 1.5, 150.0, 4.0)
    noisy = rng.poisson(light / GAIN) * GAIN + rng.normal(0.0, READ_NOISE, light.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def test_predicted_errors_are_the_scatter(
    device: Device, rng: np.random.Generator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sensor = noisy_camera()
    made = scan(frames_of_plane(rng, 60), sensor, device=device)
    assert made.errors is not None
    z, x = to_numpy(made.points.z).astype(np.float64), to_numpy(made.points.x).astype(np.float64)
    # Each column sees the same place in all frames: 60 frames x 480 columns determine the scatter to 0.4 %.
    for values, predicted in ((z, made.errors.random.z), (x, made.errors.random.x)):
        assert np.sqrt(np.mean(np.var(values, axis=0, ddof=1))) == pytest.approx(
            np.sqrt(np.mean(predicted**2)), rel=0.05
        )
    np.testing.assert_allclose(made.errors.random.y, JITTER, rtol=1e-6)
    # Cells along a line of the plane: the map interpolates four samples at most.
    heights, sigma = to_numpy(made.heights.z).astype(np.float64), to_numpy(made.heights.sigma)
    inside = heights[5:-5, 20:-20]
    assert np.sqrt(np.mean(np.var(inside, axis=0, ddof=1))) == pytest.approx(
        np.sqrt(np.mean(sigma[5:-5, 20:-20] ** 2)), rel=0.1
    )
    assert np.nanmax(sigma) <= np.nanmax(made.errors.random.z) * (1 + 1e-6)

    budget = made.report()["error_budget"]
    assert budget["measured"]["ratio"] == pytest.approx(1.0, abs=0.06)
    assert budget["random"]["transport"] == {"x": 0.0, "y": pytest.approx(JITTER), "z": 0.0}
    assert budget["random"]["total"]["z"] == pytest.approx(np.median(made.errors.random.z[np.isfinite(z)]), rel=1e-6)
    assert f"; {1e6 * budget['phase']['z']:.3g} um by the phase of the line in its pixel; " in budget_line(budget)
    made.write(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "report.json").read_text())["error_budget"] == budget
    points = read_ply(tmp_path / "out" / "range_image.ply")
    with np.load(tmp_path / "out" / "range_image.npz") as held:
        for axis in "xyz":
            for name in ("sigma", "systematic", "phase"):
                group = made.errors.random if name == "sigma" else getattr(made.errors, name)
                np.testing.assert_array_equal(points[f"{name}_{axis}"], getattr(group, axis))
                np.testing.assert_array_equal(held[f"{name}_{axis}"], getattr(group, axis))
        np.testing.assert_array_equal(held["map_sigma"], sigma)
        np.testing.assert_array_equal(held["map_systematic"], made.errors.map_systematic)
    for file, values in (("sigma", sigma), ("systematic", made.errors.map_systematic)):
        with tifffile.TiffFile(tmp_path / "out" / f"range_image_{file}.tiff") as tiff:
            np.testing.assert_array_equal(tiff.pages[0].asarray(), values)
            assert file[:6] in tiff.pages[0].description


def test_systematic_errors_are_those_of_the_calibration(device: Device, rng: np.random.Generator) -> None:
    """The oracle is the covariance of the triangulation in NumPy, at the sensor positions of the points."""
    sensor = noisy_camera()
    made = scan(frames_of_plane(rng, 3), sensor, device=device)
    assert made.errors is not None
    assert made.errors.systematic is not None
    readout: Any = sensor.readout
    sheet = readout.triangulation
    profile, samples = 1, [10, 200, 470]
    g, h = (to_numpy(each)[profile, samples].astype(np.float64) for each in (made.points.x, made.points.z))
    points = sheet.to_sensor(np.stack([g, h], axis=-1))
    expected = sheet.covariance_at(points)  # without `sigma` it holds the parameters' part only
    systematic = made.errors.systematic
    np.testing.assert_allclose(systematic.x[profile, samples], np.sqrt(expected[:, 0, 0]), rtol=1e-3)
    np.testing.assert_allclose(systematic.z[profile, samples], np.sqrt(expected[:, 1, 1]), rtol=1e-3)
    of_map = made.errors.map_systematic
    assert of_map is not None
    known = np.isfinite(of_map)
    assert known.mean() > 0.5
    assert np.nanmin(systematic.z) * 0.999 <= of_map[known].min()
    assert of_map[known].max() <= np.nanmax(systematic.z) * 1.001


@pytest.mark.double
def test_errors_of_a_rotating_sheet(device: Device, rng: np.random.Generator) -> None:
    sensor = Sensor.load("corner_scene")
    transport: Any = dataclasses.replace(sensor.transport, jitter=2e-4)
    sensor = dataclasses.replace(sensor, transport=transport, noise_known=True)
    trials = 3000
    angles = np.full(trials, float(transport.transport(80)[64]))
    position = np.tile(np.linspace(500.0, 800.0, 16), (trials, 1))
    sigma, status = np.full(position.shape, 0.2), np.zeros(position.shape, np.uint8)
    assemble = RangeImage(geometry=transport)
    noisy = assemble(
        position + rng.normal(0.0, 0.2, position.shape), angles + rng.normal(0.0, 2e-4, trials), status, device=device
    )
    true = assemble(position, angles, status, device=device)
    errors = predict_errors(sensor, {"position": position, "sigma": sigma}, true, angles, device)
    for drawn, predicted in zip(noisy[:3], errors.random, strict=True):
        # 3000 trials determine a standard deviation to 1.3 %.
        np.testing.assert_allclose(np.std(drawn, axis=0), predicted[0], rtol=0.07, atol=1e-7)


def ratios_of(points: Any, truth: Any, predicted: Any) -> list[float]:
    """Return the standard deviations of drawn coordinates (draws, ...) over the predicted ones, for x, y and z."""
    drawn = [np.sqrt(np.mean((np.array([p[i] for p in points]) - np.asarray(truth[i])) ** 2)) for i in range(3)]
    return [float(a / np.sqrt(np.mean(np.square(b)))) for a, b in zip(drawn, predicted, strict=True)]


@pytest.mark.double
def test_systematic_errors_of_the_transport(device: Device, rng: np.random.Generator) -> None:
    """Steps and directions drawn from the covariance move the points by the predicted systematic errors."""
    covariance = np.array([[4e-6, 1e-6, 0.0], [1e-6, 1e-6, -5e-7], [0.0, -5e-7, 9e-6]])
    transport = StraightTransport(step=1e-3, covariance=covariance)
    sensor = dataclasses.replace(noisy_camera(), transport=transport)
    lengths, samples = np.array([0.0, 0.02, 0.1]), 20
    g, h = (rng.uniform(-0.01, 0.01, (3, samples)) for _ in range(2))
    status = np.zeros(g.shape, np.uint8)
    true = RangeImage(geometry=transport)(g, h, lengths, status, device=device)
    fields = {name: np.full(g.shape, 1e-6) for name in ("sigma", "sigma_g", "sigma_h")}
    systematic = predict_errors(sensor, fields, true, lengths, device).systematic
    assert systematic is not None
    assert not np.any([each[0] for each in systematic])  # L = 0
    drawn = []
    for moved in np.array(transport.direction) + rng.multivariate_normal(np.zeros(3), covariance, 400):
        geometry = dataclasses.replace(transport, direction=tuple(moved))
        drawn.append(RangeImage(geometry=geometry)(g, h, lengths * np.linalg.norm(moved), status, device=device))
    assert ratios_of(drawn, true, systematic) == pytest.approx([1.0, 1.0, 1.0], abs=0.1)
    # The errors of the sheet are added.
    fields |= {name: np.full(g.shape, 3e-5) for name in ("systematic_g", "systematic_h")}
    both = predict_errors(sensor, fields, true, lengths, device).systematic
    assert both is not None
    np.testing.assert_allclose(both.x, np.hypot(systematic.x, 3e-5))


@pytest.mark.parametrize("bad", [np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), -np.eye(3)])
def test_no_covariance_of_a_transport(bad: Any) -> None:
    with pytest.raises(ValueError, match="symmetric"):
        StraightTransport(covariance=bad)


@pytest.mark.double
def test_systematic_errors_of_a_rotating_sheet(device: Device, rng: np.random.Generator) -> None:
    """Sheets drawn with every error of the calibration scatter the points by the predicted systematic errors."""
    corner = Sensor.load("corner_scene")
    sheet: Any = corner.transport
    sigma = RotatingSheetSigma(
        focal_length_px=2.0,
        principal_point_px=1.0,
        axis_point=3e-4,
        axis_direction=1e-3,
        sheet_normal=1e-3,
        sheet_offset=3e-4,
        first_angle=5e-4,
        angle_scale=8e-3,
    )
    sensor = dataclasses.replace(corner, noise_known=True, rotating_sigma=sigma)
    angles = sheet.transport(80)[[40, 64]]
    position = np.tile(np.linspace(500.0, 800.0, 16), (2, 1))
    status = np.zeros(position.shape, np.uint8)
    true = RangeImage(geometry=sheet)(position, angles, status, device=device)
    fields = {"position": position, "sigma": np.full(position.shape, 0.1)}
    systematic = predict_errors(sensor, fields, true, angles, device).systematic
    assert systematic is not None

    def turned(direction: Any, angle: float) -> tuple[float, ...]:
        """Add a random vector across the direction: for small angles a rotation."""
        noise = rng.normal(0.0, angle, 3)
        moved = np.array(direction) + noise - (noise @ direction) * np.array(direction)
        return tuple(moved / np.linalg.norm(moved))

    drawn = []
    for _ in range(400):
        other = dataclasses.replace(
            sheet,
            focal_length_px=sheet.focal_length_px + rng.normal(0.0, 2.0),
            principal_point_px=tuple(np.array(sheet.principal_point_px) + rng.normal(0.0, 1.0, 2)),
            axis_point=tuple(np.array(sheet.axis_point) + rng.normal(0.0, 3e-4, 3)),
            axis_direction=turned(sheet.axis_direction, 1e-3),
            sheet_normal=turned(sheet.sheet_normal, 1e-3),
            sheet_offset=sheet.sheet_offset + rng.normal(0.0, 3e-4),
        )
        moved = angles + rng.normal(0.0, 5e-4) + rng.normal(0.0, 8e-3) * (angles - sheet.first_angle)
        drawn.append(RangeImage(geometry=other)(position, moved, status, device=device))
    assert ratios_of(drawn, true, systematic) == pytest.approx([1.0, 1.0, 1.0], abs=0.1)


@pytest.mark.double
def test_a_calibrated_camera_of_a_rotating_sheet(device: Device) -> None:
    """The same pinhole as a calibrated camera has the same systematic errors; no error is negative."""
    corner = Sensor.load("corner_scene")
    pinhole: Any = dataclasses.replace(corner.transport, lens=None)
    (column, row), f = pinhole.principal_point_px, pinhole.focal_length_px
    camera = Camera(matrix=((f, 0.0, column), (0.0, f, row), (0.0, 0.0, 1.0)))
    calibrated = dataclasses.replace(pinhole, camera=camera, focal_length_px=None, principal_point_px=None)
    position, angles = np.full((1, 4), 600.0), pinhole.transport(65)[64:]
    sigma = RotatingSheetSigma(focal_length_px=2.0, principal_point_px=1.0)
    found = []
    for transport in (pinhole, calibrated):
        sensor = dataclasses.replace(corner, transport=transport, rotating_sigma=sigma)
        true = RangeImage(geometry=transport)(position, angles, np.zeros((1, 4), np.uint8), device=device)
        fields = {"position": position, "sigma": np.full((1, 4), 0.1)}
        found.append(predict_errors(sensor, fields, true, angles, device).systematic)
    assert np.min(found[0]) > 0.0
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6)
    with pytest.raises(ValueError, match="angle_scale is -1"):
        RotatingSheetSigma(angle_scale=-1.0)


def test_sigmas_need_a_noise_model_and_a_sheet() -> None:
    """A rotating sheet needs the position's sigma only; a sensor behind a polygon mirror needs those of its sheet."""
    described: Any = types.SimpleNamespace(noise_known=True, polygon=None, transport=None, readout=None)
    assert sigma_outputs(described) == ("sigma",)
    described.transport = StraightTransport()
    assert sigma_outputs(described) == ("sigma", "sigma_g", "sigma_h")
    described.noise_known = False
    assert sigma_outputs(described) == ()
    described.noise_known, described.polygon = True, object()
    assert sigma_outputs(described) == ("sigma", "sigma_g", "sigma_h")


def test_throughput_of_a_short_recording_is_that_of_the_whole_time() -> None:
    stream: Any = types.SimpleNamespace(throughput=0.0, frames=30, seconds=2.0)
    result: Any = types.SimpleNamespace(stream=stream)
    assert Scan.throughput.fget(result) == 15.0
    stream.throughput = 100.0
    assert Scan.throughput.fget(result) == 100.0


def test_scatter_about_a_plane(rng: np.random.Generator) -> None:
    profile, sample = np.mgrid[:80, :90]
    z = 0.01 * profile - 0.02 * sample + rng.normal(0.0, 3e-3, (80, 90))
    z[40:] += 5.0  # a step: its edge is one profile wide
    z[10:14, 10:30] = np.nan
    # 5500 residuals, each from nine samples: the median deviation is determined to about 3 %.
    assert scatter_about_plane(z) == pytest.approx(3e-3, rel=0.08)
    assert np.isnan(scatter_about_plane(z[:2]))
    assert np.isnan(scatter_about_plane(np.full((50, 50), np.nan)))


def test_without_a_noise_model_only_the_scatter_is_known(
    device: Device, rng: np.random.Generator, tmp_path: Path
) -> None:
    made = scan(frames_of_plane(rng, 12), Sensor.load("camera_line"), device=device)
    assert made.errors is None
    assert made.heights.sigma is None
    budget = made.error_budget()
    assert budget["random"] is None
    assert budget["measured"]["scatter"] > 0
    assert budget_line(budget).startswith("z scatters by")
    made.write(tmp_path / "out")
    assert not (tmp_path / "out" / "range_image_sigma.tiff").exists()
    empty = error_budget(None, np.full((5, 5), np.nan), None, camera=True)
    assert budget_line(empty) == ""


def test_speckle_that_explains_the_scatter(device: Device, rng: np.random.Generator) -> None:
    """Noise that is half of the real one: the speckle of the budget, put into the sensor file, makes the ratio 1."""
    frames = frames_of_plane(rng, 40)
    sensor = noisy_camera(speckle=0.0)
    readout: Any = sensor.readout
    weak = dataclasses.replace(
        sensor, readout=dataclasses.replace(readout, read_noise=READ_NOISE / 2, gain=GAIN / 4, outputs=None)
    )
    measured = scan(frames, weak, device=device).error_budget()["measured"]
    assert measured["ratio"] == pytest.approx(2.0, rel=0.1)
    mended = dataclasses.replace(weak, readout=dataclasses.replace(weak.readout, speckle=measured["speckle"]))
    again = scan(frames, mended, device=device).error_budget()["measured"]
    assert again["ratio"] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("kind", ["camera_line", "psd_line"])
def test_sensor_file_gives_noise_and_jitter(tmp_path: Path, kind: str) -> None:
    text = (PRESETS / f"{kind}.toml").read_text()
    assert Sensor.load(kind).noise_known == (kind == "psd_line")
    path = tmp_path / "sensor.toml"
    with_jitter = text.replace('kind = "straight"', 'kind = "straight"\njitter = 3e-6')
    path.write_text(with_jitter.replace("[line]", "[line]\nspeckle = 0.02\ngain = 0.1"))
    sensor = Sensor.from_section(read_toml(path))
    assert sensor.noise_known
    assert sensor.transport.jitter == 3e-6
    path.write_text(text.replace('kind = "straight"', 'kind = "straight"\njitter = -3e-6'))
    with pytest.raises(DescriptionError, match="jitter"):
        Sensor.from_section(read_toml(path))


@pytest.mark.parametrize(("threshold", "more"), [(25.0, 1.1), pytest.param(46.0, 2.0, marks=pytest.mark.slow)])
def test_the_map_scatters_by_noise_and_phase(
    device: Device, threshold: float, more: float, tmp_path: Path, draws: Callable[[int, int], int]
) -> None:
    """A flat board: all profiles have the line at one place in the pixels, and noise alone is too small a sigma."""
    sensor = noisy_camera(threshold=threshold, minimum_peak=None)
    sensor = dataclasses.replace(sensor, readout=dataclasses.replace(sensor.readout, gain=0.0))
    for seed in range(draws(1, 12)):
        rng = np.random.default_rng([14, seed])
        rows = 30.0 + rng.uniform() + (0.01 + 0.01 * rng.uniform()) * np.arange(480.0)
        light = 8.0 + 150.0 * np.exp(-0.5 * ((np.arange(64)[:, None] - rows) / 1.4) ** 2)
        frames = np.clip(np.rint(light + rng.normal(0.0, READ_NOISE, (40, 64, 480))), 0, 255).astype(np.uint8)
        made = scan(frames, sensor, device=device)
        made.write(tmp_path / str(seed))
        read = read_heights(tmp_path / str(seed) / "range_image.npz")
        z = read.z[5:-5, 20:-20].astype(np.float64)
        x, y = np.meshgrid(np.linspace(-1.0, 1.0, z.shape[1]), np.linspace(-1.0, 1.0, z.shape[0]))
        design = np.stack([np.ones(z.size), x.ravel(), y.ravel(), x.ravel() ** 2], axis=1)
        known = np.isfinite(z.ravel())
        residual = z.ravel()[known] - design[known] @ np.linalg.lstsq(design[known], z.ravel()[known])[0]
        assert read.total_sigma is not None
        assert 0.9 < np.std(residual) / np.sqrt(np.mean(read.total_sigma[5:-5, 20:-20].ravel()[known] ** 2)) < 1.15
        assert made.heights.sigma is not None
        assert np.std(residual) > more * np.nanmedian(to_numpy(made.heights.sigma))
        budget = made.report()["error_budget"]
        assert budget["map"]["phase"] == pytest.approx(np.nanmedian(made.errors.map_phase))
        assert budget["measured"]["ratio"] < 1.1  # neighbouring profiles share the error of the phase


def test_no_speckle_is_advised_for_the_phase_of_a_moving_line(device: Device, rng: np.random.Generator) -> None:
    """A line that moves by 0.3 px per profile: its phase scatters, and is not taken for speckle."""
    sensor = noisy_camera(threshold=46.0, minimum_peak=None)
    sensor = dataclasses.replace(sensor, readout=dataclasses.replace(sensor.readout, gain=0.0))
    for speckle in (0.0, 0.06):
        rows = 20.2 + 0.3 * np.arange(60.0)[:, None] + 0.013 * np.arange(480.0) + rng.normal(0.0, speckle, (60, 480))
        light = 8.0 + 150.0 * np.exp(-0.5 * ((np.arange(64)[:, None] - rows[:, None]) / 1.4) ** 2)
        frames = np.clip(np.rint(light + rng.normal(0.0, READ_NOISE, light.shape)), 0, 255).astype(np.uint8)
        made = scan(frames, sensor, device=device)
        assert made.errors is not None
        assert made.errors.phase_scatter > 0.8
        measured = made.error_budget()["measured"]
        if speckle:
            assert measured["speckle"] == pytest.approx(speckle, rel=0.15)
        else:
            assert measured["speckle"] is None
            assert measured["ratio"] < 1.2


def test_the_share_of_the_phase_that_scatters(rng: np.random.Generator) -> None:
    """Against the residuals of a sine and its harmonic from the plane through the 3 x 3 samples."""
    profile, sample = np.mgrid[:120, :130]
    for along, across, expected in ((0.0, 0.01, 0.0), (0.02, 0.015, 0.0), (0.1, 0.013, None), (1.0, 0.0, 0.0)):
        position = 30.0 + along * profile + across * sample
        found = phase_scatter(position + rng.normal(0.0, 0.03, position.shape))
        shares = []
        for harmonic in (1, 2):
            wave = np.exp(2j * np.pi * harmonic * position)
            mean = sum(wave[i : 118 + i, j : 128 + j] for i in range(3) for j in range(3)) / 9.0
            shares.append(float(np.mean(abs(wave[1:-1, 1:-1] - mean) ** 2)) * 9.0 / 8.0)
        assert found == pytest.approx(max(shares), rel=0.15, abs=0.02)
        assert expected is None or found == pytest.approx(expected, abs=0.05)
    assert phase_scatter(30.0 + 0.3 * profile + 0.0 * sample) == 1.0
    assert phase_scatter(np.full((5, 5), np.nan)) == phase_scatter(np.zeros((2, 9))) == 0.0
