"""Triangulation with a calibrated camera: tilted sensor and OpenCV's coefficients, against the float64 oracle."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import Any

import cv2
import numpy as np
import pytest

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.reference import camera as camera_reference
from gpuvision.reference import triangulation as reference
from gpuvision.status import Status

MATRIX = ((1720.0, 0.0, 655.0), (0.0, 1700.0, 498.0), (0.0, 0.0, 1.0))
COEFFICIENTS = {
    "radial": (-0.11, 0.07, *(0.0,) * 12),
    "tilted": (-0.11, 0.07, *(0.0,) * 10, 0.45, -0.08),
    "tilt": (*(0.0,) * 12, 0.3, 0.1),
    "all": (-0.2, 0.12, 7e-4, -4e-4, 0.05, 0.06, -0.02, 0.01, 3e-4, -5e-4, -2e-4, 4e-4, 0.35, -0.12),
}
CAMERAS = {name: Camera(matrix=MATRIX, distortion=each) for name, each in COEFFICIENTS.items()}
REGION = ((0.0, 1023.0), (0.0, 1279.0))  # rows and columns
ALL = [
    (name, dtype, along, variant)
    for name, dtype, along, variant in product(
        COEFFICIENTS, (np.float32, np.float64), ("columns", "rows"), ("vector", "work_item")
    )
]
# Every coefficient set, precision, axis and variant occurs.
FEW = [
    ("radial", np.float32, "columns", "vector"),
    ("tilted", np.float32, "rows", "vector"),
    ("all", np.float32, "columns", "vector"),
    ("all", np.float64, "rows", "work_item"),
    ("tilt", np.float64, "columns", "work_item"),
]
# Roundings of the homography as for a lens, and the relative error of the camera's correction (half roundings).
ROUNDINGS, CORRECTION_ROUNDINGS = 8.0, 17.0


def scanner(camera: Camera, along: Any = "columns", **more: Any) -> Triangulation:
    """Return a camera that sees a sheet of light at 35 degrees, 0.3 m away."""
    angle = math.radians(35.0)
    pose = {
        "origin": (0.002, 0.001, 0.3),
        "g_axis": (1.0, 0.0, 0.0),
        "h_axis": (0.0, -math.cos(angle), math.sin(angle)),
    }
    region = REGION if along == "columns" else REGION[::-1]
    return Triangulation.from_camera(camera, along=along, **{"region": region, **pose, **more})


def oracle(operation: Triangulation, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
    assert operation.camera is not None
    return reference.triangulate(
        np.asarray(u, np.float64),
        np.asarray(v, np.float64),
        operation.homography,
        operation.region,
        horizon=operation.horizon,
        camera=(operation.camera.matrix, operation.camera.distortion),
        along=operation.along,
    )


def drawn(operation: Triangulation, rng: np.random.Generator, shape: Any, dtype: Any) -> tuple[np.ndarray, np.ndarray]:
    u, v = (rng.uniform(*bounds, shape).astype(dtype) for bounds in operation.region)
    return u, v


def check_against_the_oracle(device: Device, case: tuple[Any, ...], rng: np.random.Generator) -> None:
    name, dtype, along, variant = case
    operation = scanner(CAMERAS[name], along, variant=variant)
    u, v = drawn(operation, rng, (3, 211), dtype)
    result = operation(u, v, device=device)
    g, h, status = oracle(operation, u, v)
    assert not status.any()
    np.testing.assert_array_equal(result.status, status)
    points = np.stack([u, v], -1).astype(np.float64)
    corrections = operation.distortion.undistort(points) - points
    correction = np.max(np.abs(corrections)) / (0.5 * np.ptp(operation.region[1]))
    # In double precision the oracle has the same number of roundings as the kernel.
    eps = np.finfo(dtype).eps * (1.0 if dtype == np.float32 else 2.0)
    atol = 0.5 * eps * (ROUNDINGS + CORRECTION_ROUNDINGS * correction) * np.max(np.abs([g, h]))
    np.testing.assert_allclose(result.g, g, rtol=0, atol=atol)
    np.testing.assert_allclose(result.h, h, rtol=0, atol=atol)


@pytest.mark.parametrize("case", FEW, ids=lambda case: "-".join(map(str, (case[0], case[1].__name__, *case[2:]))))
def test_against_the_oracle(device: Device, case: tuple[Any, ...], rng: np.random.Generator) -> None:
    check_against_the_oracle(device, case, rng)


@pytest.mark.slow
@pytest.mark.parametrize("case", ALL, ids=lambda case: "-".join(map(str, (case[0], case[1].__name__, *case[2:]))))
def test_every_combination_against_the_oracle(device: Device, case: tuple[Any, ...], rng: np.random.Generator) -> None:
    check_against_the_oracle(device, case, rng)


@pytest.mark.parametrize("name", COEFFICIENTS)
def test_the_oracle_is_opencv_s_inverse(name: str, rng: np.random.Generator) -> None:
    pixels = rng.uniform((0.0, 0.0), (1279.0, 1023.0), (200, 2))
    matrix, coefficients = np.array(MATRIX), np.array(COEFFICIENTS[name])
    until_converged = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    expected = cv2.undistortPoints(pixels[:, None], matrix, coefficients, P=matrix, criteria=until_converged)[:, 0]
    found = camera_reference.undistort_pixels(pixels, matrix, coefficients)
    np.testing.assert_allclose(found.astype(np.float64), expected, rtol=0, atol=1e-9)


def test_pixels_without_an_ideal_position_are_flagged(device: Device) -> None:
    """Beyond the fold, behind the tilted sensor, and not finite."""
    # The image of k1 = -1 folds at the ideal radius 3^-1/2, measured radius 2/3 of it.
    folding = Camera(matrix=MATRIX, distortion=(-1.0, *(0.0,) * 13))
    radius = 1700.0 * 2.0 / 3.0 / math.sqrt(3.0)
    operation = scanner(folding, region=((-200.0, 1200.0), (0.0, 1279.0)))
    u = (498.0 + radius * np.array([0.0, 0.5, 0.99, 1.001, 1.5, -0.99, -1.001, 30.0])).astype(np.float32)
    result = operation(u, np.full(8, 655.0, np.float32), device=device)
    expected = Status.NOT_INVERTIBLE * np.array([0, 0, 0, 1, 1, 0, 1, 1], np.uint8)
    np.testing.assert_array_equal(result.status, expected)
    np.testing.assert_array_equal(oracle(operation, u, np.full(8, 655.0))[2], expected)
    np.testing.assert_array_equal(np.isnan(result.g), expected != 0)
    np.testing.assert_array_equal(np.isnan(result.h), expected != 0)
    tilted = scanner(CAMERAS["tilted"])
    # By 0.45 rad about x: the plane of the sensor passes the pinhole at f / tan(0.45) rows from the centre.
    real, largest = (np.float64, 1e300) if device.has_double else (np.float32, 1e38)
    u = np.array([498.0, 498.0 + 9000.0, 498.0 - 9000.0, math.nan, math.inf, -math.nan, 498.0, 498.0], real)
    v = np.array([655.0, 655.0, 655.0, 655.0, 655.0, 655.0, -math.nan, largest], real)
    result = tilted(u, v, device=device)
    assert set(result.status[1:3]) & {Status.NOT_INVERTIBLE}
    np.testing.assert_array_equal(result.status, oracle(tilted, u, v)[2] * (np.arange(8) < 7) + 8 * (np.arange(8) == 7))
    np.testing.assert_array_equal(result.status[3:], Status.NOT_FINITE)
    np.testing.assert_array_equal(np.isnan(result.g), result.status != 0)


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_sigmas_against_the_host_and_the_host_against_differences(
    device: Device, along: Any, rng: np.random.Generator
) -> None:
    covariance = tuple(map(tuple, np.diag(rng.uniform(1e-12, 1e-10, 8))))
    operation = scanner(CAMERAS["all"], along, sigma=(0.2, 0.3), covariance=covariance)
    u, v = drawn(operation, rng, 100, np.float32)
    points = np.stack([u, v], -1).astype(np.float64)
    result = operation(u, v, device=device)
    full = operation.covariance_at(points)
    rtol = 64.0 * np.finfo(np.float32).eps
    np.testing.assert_allclose(result.sigma_g, np.sqrt(full[:, 0, 0]), rtol=rtol)
    np.testing.assert_allclose(result.sigma_h, np.sqrt(full[:, 1, 1]), rtol=rtol)
    noise_only, step = replace(operation, covariance=None), 1e-3
    slopes = np.zeros((100, 2, 2))
    for axis in (0, 1):
        ahead, behind = (oracle(operation, *(points + sign * step * np.eye(2)[axis]).T)[:2] for sign in (1, -1))
        slopes[:, :, axis] = (np.array(ahead) - np.array(behind)).T / (2.0 * step)
    scaled = slopes * (0.2, 0.3)
    np.testing.assert_allclose(noise_only.covariance_at(points), scaled @ np.swapaxes(scaled, 1, 2), rtol=1e-6)


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_points_of_the_sheet_and_back(along: Any, rng: np.random.Generator) -> None:
    """Project by OpenCV, triangulate by the host's inverse: pose, order of the axes and camera agree."""
    operation = scanner(CAMERAS["all"], along)
    sheet = rng.uniform((-0.07, -0.06), (0.07, 0.06), (200, 2))
    angle = math.radians(35.0)
    down = np.array([0.0, -math.cos(angle), math.sin(angle)])
    scene = np.array([0.002, 0.001, 0.3]) + sheet[:, :1] * np.array([1.0, 0.0, 0.0]) + sheet[:, 1:] * down
    image = cv2.projectPoints(scene, np.zeros(3), np.zeros(3), np.array(MATRIX), np.array(COEFFICIENTS["all"]))[0]
    expected = image[:, 0, ::-1] if along == "columns" else image[:, 0]
    sensor = operation.to_sensor(sheet)
    np.testing.assert_allclose(sensor, expected, rtol=0, atol=1e-8)
    g, h, _ = oracle(operation, *sensor.T)
    np.testing.assert_allclose(np.stack([g, h], -1), sheet, rtol=0, atol=1e-12)


def test_fit_with_a_camera(rng: np.random.Generator) -> None:
    truth = scanner(CAMERAS["tilted"])
    sheet = rng.uniform((-0.07, -0.06), (0.07, 0.06), (60, 2))
    seen = truth.to_sensor(sheet)
    fitted = Triangulation.fit(seen, sheet, camera=CAMERAS["tilted"], region=REGION, model="H8")
    assert fitted.camera == CAMERAS["tilted"]
    np.testing.assert_allclose(fitted.conditioned(), truth.conditioned(), rtol=1e-8, atol=1e-12)
    without = Triangulation.fit(seen, sheet, region=REGION, model="H8")
    assert np.max(np.abs(without.to_sensor(sheet) - seen)) > 1.0
    with pytest.raises(ValueError, match="a lens and a camera"):
        Triangulation.fit(seen, sheet, camera=CAMERAS["tilted"], lens=Lens(k1=1e-9))


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_fused_in_the_readout_with_axes(device: Device, along: Any, rng: np.random.Generator) -> None:
    """The readout and the triangulation at its positions give the same g and h, for windows and binned pixels too."""
    camera = CAMERAS["tilted"]
    operation = scanner(camera, along)
    frames = rng.integers(0, 20, (2, 48, 64)).astype(np.uint8)
    frames[:, 20:24] = 200
    frames = np.ascontiguousarray(np.swapaxes(frames, 1, 2)) if along == "rows" else frames
    axes = SampleAxes(position_origin=400.0, position_pitch=-1.0, sample_origin=300.0, sample_pitch=2.0)
    readout = LineReadout(along=along, threshold=50.0, window=4, triangulation=operation, axes=axes)
    reading = readout(frames, device=device)
    u = 400.0 - np.asarray(reading.position, np.float64)
    v = np.broadcast_to(300.0 + 2.0 * np.arange(64.0), u.shape)
    g, h, status = oracle(operation, u, v)
    assert not status.any()
    np.testing.assert_array_equal(reading.status, status)
    np.testing.assert_allclose(reading.g, g, rtol=0, atol=2e-6 * 0.07)
    np.testing.assert_allclose(reading.h, h, rtol=0, atol=2e-6 * 0.07)


@pytest.mark.parametrize(("along", "samples"), [("columns", 1024), ("columns", 211), ("rows", 211)])
def test_table_of_the_profiles_in_the_readout(
    device: Device, along: Any, samples: int, rng: np.random.Generator
) -> None:
    """All coefficients: within the roundings of a triangulation without a camera, in every column and up to the end."""
    operation = scanner(CAMERAS["all"], along)
    assert operation.profile_correction(np.float32, SampleAxes(), 700, samples) is not None
    rows = rng.integers(10, 690, (2, samples))
    rows[0, :2], rows[1, -2:] = (10, 689), (689, 10)
    frames = np.zeros((2, 700, samples), np.uint8)
    for offset, level in ((-1, 90), (0, 200), (1, 70)):
        np.put_along_axis(frames, rows[:, None] + offset, level, axis=1)
    frames = np.ascontiguousarray(np.swapaxes(frames, 1, 2)) if along == "rows" else frames
    reading = LineReadout(along=along, threshold=50.0, window=4, triangulation=operation)(frames, device=device)
    v = np.broadcast_to(np.arange(float(samples)), (2, samples))
    g, h, status = oracle(operation, np.asarray(reading.position, np.float64), v)
    np.testing.assert_array_equal(reading.status, status)
    # The homography's roundings, and one of the correction's last sum.
    atol = 0.5 * np.finfo(np.float32).eps * (ROUNDINGS + 1.0) * np.max(np.abs([g, h]))
    np.testing.assert_allclose(reading.g, g, rtol=0, atol=atol)
    np.testing.assert_allclose(reading.h, h, rtol=0, atol=atol)


def test_sigmas_in_the_readout_with_the_table_of_the_profiles(device: Device, rng: np.random.Generator) -> None:
    operation = scanner(CAMERAS["all"], sigma=(0.2, 0.0))
    frames = rng.integers(0, 20, (1, 64, 64)).astype(np.uint8)
    frames[:, 30:33] = 200
    readout = LineReadout(
        threshold=50.0, window=4, triangulation=operation, outputs=("position", "status", "sigma", "sigma_g", "sigma_h")
    )
    reading = readout(frames, device=device)
    points = np.stack([np.asarray(reading.position, np.float64)[0], np.arange(64.0)], -1)
    full = operation.covariance_at(points) * (np.asarray(reading.sigma, np.float64)[0] / 0.2)[:, None, None] ** 2
    rtol = 64.0 * np.finfo(np.float32).eps
    np.testing.assert_allclose(reading.sigma_g[0], np.sqrt(full[:, 0, 0]), rtol=rtol)
    np.testing.assert_allclose(reading.sigma_h[0], np.sqrt(full[:, 1, 1]), rtol=rtol)


def test_no_table_where_a_pixel_has_no_ideal_position_or_in_double_precision() -> None:
    operation = scanner(CAMERAS["all"])
    table = operation.profile_correction(np.float32, SampleAxes(), 1024, 1280)
    assert table is not None
    assert operation.defines(np.float32, table)["CAMERA_PROFILES"] == table.terms.shape[1]
    assert "CAMERA_STEPS" not in operation.defines(np.float32, table)
    assert operation.profile_correction(np.float64, SampleAxes(), 1024, 1280) is None
    assert scanner(Camera(matrix=MATRIX)).profile_correction(np.float32, SampleAxes(), 1024, 1280) is None
    # The image of k1 = -1 folds 654 rows from the centre; near the fold the polynomials do not reach the tolerance.
    folding = scanner(Camera(matrix=MATRIX, distortion=(-1.0, *(0.0,) * 13)))
    for first, length in ((498.0, 700), (498.0, 630)):
        axes = SampleAxes(position_origin=first, sample_origin=645.0)
        assert folding.profile_correction(np.float32, axes, length, 20) is None
    assert folding.profile_correction(np.float32, SampleAxes(position_origin=398.0, sample_origin=645.0), 200, 20)


def test_only_what_the_camera_has_is_compiled() -> None:
    def options(coefficients: tuple[float, ...]) -> set[str]:
        return set(scanner(Camera(matrix=MATRIX, distortion=coefficients)).defines(np.float32))

    assert not options((0.0,) * 14)
    pinhole = scanner(Camera(matrix=MATRIX))
    np.testing.assert_array_equal(pinhole.packed(np.float32), replace(pinhole, camera=None).packed(np.float32))
    assert "CAMERA_TILTED" not in options(COEFFICIENTS["radial"])
    assert "CAMERA_DECENTRED" not in options(COEFFICIENTS["tilted"])
    assert {"CAMERA_TILTED", "CAMERA_DECENTRED", "CAMERA_PRISM"} <= options(COEFFICIENTS["all"])


def test_the_start_polynomials_fit_the_region(device: Device, rng: np.random.Generator) -> None:
    """A window far from the principal point needs no step and no test, as the whole sensor."""
    moved = CAMERAS["tilted"].in_window((900.0, 700.0))
    operation = scanner(moved, region=((0.0, 300.0), (0.0, 300.0)))
    options = operation.defines(np.float32)
    assert options["CAMERA_STEPS"] == 0
    assert "CAMERA_SURE" in options
    u, v = drawn(operation, rng, 500, np.float32)
    g, h, _ = oracle(operation, u, v)
    result = operation(u, v, device=device)
    np.testing.assert_allclose(result.g, g, rtol=0, atol=4e-6 * 0.1)
    np.testing.assert_allclose(result.h, h, rtol=0, atol=4e-6 * 0.1)


def test_a_region_beyond_the_reach_of_the_start_polynomials(device: Device, rng: np.random.Generator) -> None:
    """Positions outside of the region, and lenses near their fold, are found by the tested iteration."""
    operation = scanner(CAMERAS["all"], region=((400.0, 600.0), (500.0, 800.0)))
    wide = replace(operation, region=REGION)
    u, v = drawn(wide, rng, 500, np.float32)
    g, h, status = oracle(operation, u, v)
    assert not status.any()
    result = operation(u, v, device=device)
    np.testing.assert_array_equal(result.status, 0)
    for found, expected in ((result.g, g), (result.h, h)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * 0.1)
    near_fold = Camera(
        matrix=((500.0, 0.0, 640.0), (0.0, 500.0, 512.0), (0.0, 0.0, 1.0)), distortion=(-0.3, 0.1, 1e-4, *(0.0,) * 11)
    )
    assert "CAMERA_SURE" not in scanner(near_fold).defines(np.float32)


def test_tables_and_errors() -> None:
    operation = scanner(CAMERAS["all"], sigma=(0.1, 0.2))
    assert Triangulation.from_dict(operation.to_dict()) == operation
    with pytest.raises(ValueError, match=r"has a lens and a camera; the camera includes a lens"):
        replace(operation, lens=Lens(k1=1e-9))
