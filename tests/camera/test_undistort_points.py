"""UndistortPoints on devices: agreement with the host models in both directions, to half the spacing of floats."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import gpuvision as gv
from canary import Guarded, shifted_copy
from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.camera.undistort_points import UndistortedPoints, UndistortPoints
from gpuvision.host import Device
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.reference import camera as reference
from gpuvision.status import Status
from tiers import variants_of

ON_DEVICES = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
MATRIX = ((1700.0, 0.0, 642.5), (0.0, 1650.0, 509.25), (0.0, 0.0, 1.0))
ANOTHER = ((1500.0, 0.0, 600.0), (0.0, 1480.0, 500.0), (0.0, 0.0, 1.0))
FULL = (-0.12, 0.08, 1e-3, -2e-3, 0.01, 0.02, 0.03, 0.001, 1e-3, 2e-3, -1e-3, 3e-3)
VARIANTS = ("vector", "work_item")
# All models run with these two options; tests that do not depend on the model run with all four.
TWO_WAYS = pytest.mark.parametrize(("variant", "dtype"), [("vector", np.float32), ("work_item", np.float64)])


def camera(*coefficients: float, tilt: tuple[float, float] = (0.0, 0.0), matrix: Any = MATRIX) -> Camera:
    distortion = (*coefficients, *(0.0,) * (12 - len(coefficients)), *np.radians(tilt))
    return Camera(matrix=matrix, distortion=distortion)


CAMERAS = {
    "pinhole": camera(),
    "k1": camera(-0.25),
    "tangential": camera(-0.28, 0.11, 5e-4, -3e-4, -0.02),
    "rational": camera(0.1, 0.0, 0.0, 0.0, 0.0, 0.2, 0.01),
    "tilt": camera(-0.12, 0.08, tilt=(45.0, 0.0)),
    "all": camera(*FULL, tilt=(-25.0, 20.0)),
}
LENSES = {
    "lens k1": Lens(k1=-2e-7, centre=(650.0, 500.0)),
    "lens k1 k2": Lens(k1=-2e-7, k2=5e-14, centre=(650.0, 500.0)),
    "lens out": Lens(k1=3e-7, k2=1e-13, centre=(650.0, 500.0)),
    "lens k3": Lens(k1=-3e-7, k2=1e-13, k3=-3e-20, centre=(650.0, 500.0)),
    "lens k4": Lens(k1=-5e-7, k2=4e-13, k3=-2.5e-19, k4=9e-26, centre=(650.0, 500.0)),
    "lens k2": Lens(k1=0.0, k2=-1e-13, centre=(650.0, 500.0)),
}
MODELS = CAMERAS | LENSES


@pytest.fixture(params=MODELS.values(), ids=MODELS)
def model(request: pytest.FixtureRequest) -> Camera | Lens:
    """Return each test model."""
    return request.param


def image_points(rng: np.random.Generator, count: int = 5003) -> np.ndarray:
    return rng.uniform(0.0, 1.0, (count, 2)) * [1279.0, 1023.0]


def expected_of(operation: UndistortPoints, points: np.ndarray) -> np.ndarray:
    """Return the results of the host model, which other tests compare with its equations."""
    function = operation.model.distort if operation.inverse else operation.model.undistort
    more = {} if operation.matrix is None else {"matrix": operation.matrix}
    return function(points.astype(np.float64), **more)


def half_spacing(values: np.ndarray) -> np.ndarray:
    """Return the allowed rounding error of a float."""
    return 0.5 * np.spacing(np.abs(values).astype(np.float32))


def tolerance(given_: np.ndarray, expected: np.ndarray, real: Any) -> np.ndarray:
    """Return 16 half-roundings of the displacement plus rounding of the result; in double also of the host."""
    eps = float(np.finfo(real).eps)
    with np.errstate(invalid="ignore"):
        moved = np.abs(expected - given_).max(axis=-1, keepdims=True)
    rounding = half_spacing(expected) if real == np.float32 else 4e-12
    return rounding + 8.0 * eps * (moved + 10.0)


def assert_as_expected(operation: UndistortPoints, result: UndistortedPoints, points: np.ndarray) -> np.ndarray:
    expected = expected_of(operation, points)
    real = result.points.dtype
    good = np.isfinite(expected[..., 0])
    np.testing.assert_array_equal(result.status == 0, good)
    np.testing.assert_array_equal(np.isfinite(result.points), np.broadcast_to(good[..., None], expected.shape))
    error = np.abs(result.points - expected)[good]
    assert np.all(error <= tolerance(points, expected, real)[good]), f"off by {error.max(initial=0.0)}"
    return good


@pytest.mark.parametrize(
    "kernel",
    [
        ("vector", np.float32, False),
        ("work_item", np.float64, True),
        ("vector", np.float32, True),
        ("work_item", np.float64, False),
    ],
    ids=lambda each: f"{each[0]}-{each[1].__name__}-{'distort' if each[2] else 'undistort'}",
)
def test_as_the_host_says(device: Device, model: Any, kernel: tuple[Any, ...], rng: np.random.Generator) -> None:
    variant, dtype, inverse = kernel
    operation = UndistortPoints(model=model, variant=variant, inverse=inverse)
    points = image_points(rng).astype(dtype)
    result = operation(points, device=device)
    assert result.points.dtype == dtype
    assert assert_as_expected(operation, result, points).mean() > 0.9
    # An array may begin at an address that is aligned to an element only, not to a pair.
    for ours, same in zip(operation(shifted_copy(points, 1), device=device), result, strict=True):
        np.testing.assert_array_equal(ours, same)


@pytest.mark.double
@pytest.mark.parametrize("name", ["all", "lens k1 k2"])
@pytest.mark.parametrize("inverse", [False, True], ids=["undistort", "distort"])
def test_the_other_two_ways(device: Device, name: str, inverse: bool, rng: np.random.Generator) -> None:
    for variant, dtype in (("vector", np.float64), ("work_item", np.float32)):
        operation = UndistortPoints(model=MODELS[name], variant=variant, inverse=inverse)
        points = image_points(rng).astype(dtype)
        assert assert_as_expected(operation, operation(points, device=device), points).mean() > 0.9


@pytest.mark.parametrize("name", [pytest.param("tilt", marks=pytest.mark.slow), "all"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("inverse", [False, True], ids=["undistort", "distort"])
def test_another_matrix(device: Device, name: str, dtype: Any, inverse: bool, rng: np.random.Generator) -> None:
    operation = UndistortPoints(model=CAMERAS[name], matrix=ANOTHER, inverse=inverse)
    points = image_points(rng).astype(dtype)
    assert assert_as_expected(operation, operation(points, device=device), points).mean() > 0.9


@pytest.mark.double
@pytest.mark.parametrize("variant", VARIANTS)
def test_double_arithmetic_on_single_points(device: Device, variant: Any, rng: np.random.Generator) -> None:
    operation = UndistortPoints(model=CAMERAS["all"], precision="double", variant=variant)
    points = image_points(rng).astype(np.float32)
    result = operation(points, device=device)
    assert result.points.dtype == np.float64
    assert_as_expected(operation, result, points)
    with pytest.raises(TypeError, match="single"):
        UndistortPoints(model=CAMERAS["all"], precision="single")(points.astype(float), device=device)


@pytest.mark.double
@pytest.mark.parametrize("name", ["k1", "tangential", pytest.param("tilt", marks=pytest.mark.slow), "all"])
def test_round_trip_in_double(device: Device, name: str, rng: np.random.Generator) -> None:
    points = image_points(rng)
    ideal = UndistortPoints(model=CAMERAS[name])(points, device=device)
    good = ideal.status == 0
    back = UndistortPoints(model=CAMERAS[name], inverse=True)(np.ascontiguousarray(ideal.points[good]), device=device)
    np.testing.assert_allclose(back.points, points[good], rtol=0, atol=1e-9)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("inverse", [False, True], ids=["undistort", "distort"])
def test_a_sensor_of_8000_pixels_in_single(
    device: Device, variant: Any, inverse: bool, rng: np.random.Generator
) -> None:
    """The correction is accurate to 1e-4 px; rounding of the result adds up to 2.4e-4 px."""
    matrix = ((9000.0, 0.0, 4012.3), (0.0, 9000.0, 2987.7), (0.0, 0.0, 1.0))
    big = camera(-0.1, 0.05, 2e-4, -3e-4, 0.01, tilt=(5.0, -2.0), matrix=matrix)
    points = (rng.uniform(0.0, 1.0, (20_001, 2)) * [7999.0, 5999.0]).astype(np.float32)
    operation = UndistortPoints(model=big, variant=variant, inverse=inverse)
    result, expected = operation(points, device=device), expected_of(operation, points)
    assert np.all(result.status == 0)
    assert np.abs(expected - points).max() > 200.0
    assert np.all(np.abs(result.points - expected) <= half_spacing(expected) + 1e-4)
    lens = UndistortPoints(model=Lens(k1=-2e-9, k2=1e-17, centre=(4012.3, 2987.7)), variant=variant, inverse=inverse)
    result, expected = lens(points, device=device), expected_of(lens, points)
    assert np.all(np.abs(result.points - expected) <= half_spacing(expected) + 1e-4)


# ---- the fold ------------------------------------------------------------------------------------------------


@TWO_WAYS
@pytest.mark.parametrize(
    "coefficients",
    [
        pytest.param((-0.4,), marks=pytest.mark.slow),
        pytest.param((-0.5, 0.1), marks=pytest.mark.slow),
        (-0.3, 0.02, 0.02, -0.03),
        (0.1, 0.0, 0.01, 0.02, 0.0, 0.5, 0.1, 0.05),
    ],
    ids=["k1", "k1 k2", "tangential", "rational decentred"],
)
def test_at_the_fold(device: Device, coefficients: tuple[float, ...], variant: Any, dtype: Any) -> None:
    """On rays through the fold, ideal points beyond it and measured points beyond its image are flagged."""
    wide = camera(*coefficients, matrix=((800.0, 0.0, 640.0), (0.0, 800.0, 512.0), (0.0, 0.0, 1.0)))
    rays = []
    for angle in np.linspace(0.1, 6.3, 23):
        fold = min(reference.fold_radius(angle, wide.distortion, 5.0, 4000), 3.0)
        parts = np.array([0.0, 0.3, 0.8, 0.95, 0.98, 1.02, 1.1, 1.5, 2.0])
        rays.append(fold * parts[:, None] * [math.cos(angle), math.sin(angle)])
    ideal = (np.concatenate(rays) * 800.0 + [640.0, 512.0]).astype(dtype)
    distort = UndistortPoints(model=wide, inverse=True, variant=variant)
    shown = distort(ideal, device=device)
    np.testing.assert_array_equal(shown.status == 0, np.isfinite(wide.distort(ideal)[:, 0]))
    assert set(shown.status.tolist()) == {0, Status.NOT_INVERTIBLE}
    measured = np.concatenate([wide.distort(ideal), [[640.0 + 3000.0, 512.0], [640.0, -2000.0]]]).astype(dtype)
    known = np.isfinite(measured[:, 0])
    result = UndistortPoints(model=wide, variant=variant)(measured, device=device)
    np.testing.assert_array_equal(result.status[~known], Status.NOT_FINITE)
    exact = wide.undistort(measured)
    np.testing.assert_array_equal(result.status[known] == 0, np.isfinite(exact[known, 0]))
    good = known & np.isfinite(exact[:, 0])
    # The inverse magnifies the rounding of the measured point and of the correction.
    magnified = np.linalg.norm(wide.jacobian(measured[good]), 2, axis=(-2, -1))[:, None]
    error = np.abs(result.points[good] - exact[good])
    # Three roundings of up to 2700 pixels.
    assert np.all(error <= 8e3 * np.finfo(dtype).eps * magnified)


@pytest.mark.double
def test_lens_at_its_fold(device: Device) -> None:
    lens = Lens(k1=-4e-7, k2=1e-14, centre=(640.0, 512.0))
    radius = lens.fold_radius * np.array([0.0, 0.5, 0.99, 0.9999, 1.0001, 1.5, 3.0])
    points = np.stack([640.0 + radius, np.full(7, 512.0)], -1)
    flags = [0, 0, 0, 0] + 3 * [Status.NOT_INVERTIBLE]
    straight = UndistortPoints(model=lens)(np.tile(points, (3, 1)), device=device)
    np.testing.assert_array_equal(straight.status, 3 * flags)
    furthest = lens.undistort(points[3:4])[0, 0] - 640.0
    ideal = np.stack([640.0 + furthest * np.array([0.0, 0.5, 0.99, 0.9999, 1.0001, 1.5, 3.0]), np.full(7, 512.0)], -1)
    back = UndistortPoints(model=lens, inverse=True)(np.tile(ideal, (3, 1)), device=device)
    np.testing.assert_array_equal(back.status, 3 * flags)
    np.testing.assert_allclose(back.points[:3], lens.distort(ideal[:3]), rtol=0, atol=1e-9)


@pytest.mark.double
@pytest.mark.parametrize("seed", range(2))
def test_wild_cameras_agree_with_the_host(device: Device, seed: int) -> None:
    """Random coefficients with arbitrary folds: kernel and host flag the same points and agree on the others."""
    rng = np.random.default_rng(seed)
    for _ in range(3):
        radial, decentred = rng.normal(0.0, 0.3, 6), rng.normal(0.0, 0.02, 6)
        wild = camera(*radial[:2], *decentred[:2], *radial[2:], *decentred[2:], tilt=tuple(rng.uniform(-30.0, 30.0, 2)))
        points = rng.uniform(-1.0, 2.0, (4000, 2)) * [1279.0, 1023.0]
        for inverse in (False, True):
            operation = UndistortPoints(model=wild, inverse=inverse)
            result, expected = operation(points, device=device), expected_of(operation, points)
            good = np.isfinite(expected[:, 0])
            # A point at the fold within rounding may be on either side.
            assert np.mean((result.status == 0) == good) > 0.999
            both = good & (result.status == 0)
            ideal = points[both] if inverse else expected[both]
            magnified = np.linalg.norm(wild.jacobian(wild.distort(ideal)), 2, axis=(-2, -1))
            magnified = np.maximum(magnified, 1.0 / magnified)
            error = np.abs(result.points[both] - expected[both]).max(axis=1)
            assert np.all(error <= 1e-10 * np.maximum(magnified, 1.0) ** 2)


# ---- inputs -------------------------------------------------------------------------------------------


@ON_DEVICES
@given(
    shape=st.lists(st.integers(1, 40), max_size=3).map(lambda batch: (*batch, 2)),
    variant=st.sampled_from(VARIANTS),
    name=st.sampled_from(["tangential", "lens k1 k2"]),
    inverse=st.booleans(),
    seed=st.integers(0, 9),
)
def test_any_shape(device: Device, shape: tuple[int, ...], variant: Any, name: str, inverse: bool, seed: int) -> None:
    assume(variant in variants_of(device))
    points = (np.random.default_rng(seed).uniform(0.0, 1.0, shape) * [1279.0, 1023.0]).astype(np.float32)
    operation = UndistortPoints(model=MODELS[name], variant=variant, inverse=inverse)
    result = operation(points, device=device)
    assert result.points.shape == shape
    assert result.status.shape == shape[:-1]
    assert_as_expected(operation, result, points)


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 31, 255, 256, 257, 1023, 1025, 5000, 300_001])
@pytest.mark.parametrize("variant", VARIANTS)
def test_sizes_around_the_groups_and_canaries(
    device: Device, count: int, variant: Any, rng: np.random.Generator
) -> None:
    operation = UndistortPoints(model=CAMERAS["k1"], variant=variant)
    points = image_points(rng, count).astype(np.float32)
    guarded = Guarded(UndistortedPoints(np.empty((count, 2), np.float32), np.empty(count, np.uint8)))
    assert operation(points, device=device, out=guarded.out) is guarded.out
    guarded.assert_intact()
    assert_as_expected(operation, guarded.out, points)


@pytest.mark.parametrize("shift", [1, 3])
def test_arrays_anywhere(device: Device, shift: int, rng: np.random.Generator) -> None:
    """Arrays that are aligned only to their element size are accepted."""
    points = image_points(rng, 1000).astype(np.float32)
    given_, moved = (np.zeros(2000 + 16, np.float32)[shift:][:2000].reshape(1000, 2) for _ in range(2))
    given_[...] = points
    out = UndistortedPoints(moved, np.zeros(1016, np.uint8)[shift:][:1000])
    operation = UndistortPoints(model=CAMERAS["tangential"])
    assert_as_expected(operation, operation(given_, device=device, out=out), points)


@TWO_WAYS
@pytest.mark.parametrize("inverse", [False, True], ids=["undistort", "distort"])
def test_not_finite(device: Device, model: Any, dtype: Any, variant: Any, inverse: bool) -> None:
    inf, nan = math.inf, math.nan
    bad = [(nan, 5.0), (5.0, nan), (inf, 5.0), (5.0, -inf), (nan, inf), (inf, -inf), (300.0, 200.0), (650.0, 500.0)]
    operation = UndistortPoints(model=model, variant=variant, inverse=inverse)
    result = operation(np.tile(np.array(bad, dtype), (5, 1)), device=device)
    np.testing.assert_array_equal(result.status, 5 * (6 * [Status.NOT_FINITE] + [0, 0]))
    np.testing.assert_array_equal(np.isnan(result.points).all(axis=1), result.status != 0)


@TWO_WAYS
@pytest.mark.parametrize("inverse", [False, True], ids=["undistort", "distort"])
def test_far_points_are_flagged_or_finite(device: Device, model: Any, variant: Any, dtype: Any, inverse: bool) -> None:
    far = np.geomspace(1e4, 1e38 if dtype == np.float32 else 1e300, 64)
    points = np.concatenate([np.stack(each, -1) for each in ((far, far), (-far, 0 * far), (0 * far, far))])
    operation = UndistortPoints(model=model, inverse=inverse, variant=variant)
    result = operation(points.astype(dtype), device=device)
    np.testing.assert_array_equal(np.isfinite(result.points).all(axis=1), result.status == 0)
    np.testing.assert_array_equal(np.isnan(result.points).all(axis=1), result.status != 0)


@pytest.mark.parametrize("variant", VARIANTS)
def test_results_that_overflow_are_flagged(device: Device, variant: Any) -> None:
    """With a principal point near the largest float, 3.4e38, columns to the right of it overflow."""
    huge = ((1e38, 0.0, 3.3e38), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    points = np.tile(np.array([[100.0, 500.0], [1200.0, 500.0]], np.float32), (10, 1))
    result = UndistortPoints(model=CAMERAS["k1"], matrix=huge, variant=variant)(points, device=device)
    np.testing.assert_array_equal(result.status, 10 * [0, Status.NOT_FINITE])
    np.testing.assert_array_equal(np.isnan(result.points).all(axis=1), result.status != 0)


@pytest.mark.double
def test_behind_a_tilted_sensor(device: Device) -> None:
    given_ = camera(tilt=(45.0, 0.0))
    points = np.tile([[642.5, 509.25 + 1650.0 * 0.99], [642.5, 509.25 + 1650.0 * 1.01]], (10, 1))
    result = UndistortPoints(model=given_, inverse=True)(points, device=device)
    np.testing.assert_array_equal(result.status, 10 * [0, Status.NOT_INVERTIBLE])


def test_bound_and_device_arrays_say_the_same(device: Device, rng: np.random.Generator) -> None:
    operation = UndistortPoints(model=CAMERAS["all"])
    points = image_points(rng, 777).astype(np.float32)
    expected = operation(points, device=device)
    on_device = cl.array.to_device(device.queue, points)
    result = operation(on_device)
    assert isinstance(result.points, cl.array.Array)
    np.testing.assert_array_equal(result.points.get(), expected.points)
    bound = operation.bind(device, points.shape, points.dtype)
    bound(on_device).wait()
    np.testing.assert_array_equal(bound.outputs.points.get(), expected.points)
    np.testing.assert_array_equal(bound.outputs.status.get(), expected.status)


@pytest.mark.parametrize("variant", VARIANTS)
def test_neighbours_do_not_matter(device: Device, variant: Any, rng: np.random.Generator) -> None:
    """A point's result is bit-equal with and without neighbours that need the safeguarded search."""
    wide = camera(-0.28, 0.11, 5e-4, -3e-4, -0.02)
    points = image_points(rng, 160).astype(np.float32)
    alone = UndistortPoints(model=wide, variant=variant)(points, device=device)
    points[::5] = (1e5, 1e5)
    among = UndistortPoints(model=wide, variant=variant)(points, device=device)
    others = np.arange(160) % 5 != 0
    np.testing.assert_array_equal(among.points[others], alone.points[others])


# ---- derivatives of the models -------------------------------------------------------------------------------

# Errors of the derivatives cost the searches steps, or make them search again by another method: their results stay.
DERIVATIVES = """
#include "common/camera.h"
#include "common/lens.h"
#include "common/plane.h"

// Of a point, a displacement and a gradient (6 numbers): 14 numbers by a camera or a polynomial, 5 by a lens.
kernel void derive(global const real *given, global real *made, constant real *model, constant real *lens) {
    const size_t n = get_global_id(0);
    global const real *in = given + 6 * n;
    real out[19];
    for (int k = 0; k < 19; k++) out[k] = 0;
    const real x = in[0], y = in[1], back_x = in[2], back_y = in[3];
#ifdef PLANE
    plane_slopes(x, y, model + PLANE_A, out, out + 1);
    plane_slopes(x, y, model + PLANE_B, out + 2, out + 3);
    out[4] = plane_newton(x, y, back_x, back_y, model, out + 5, out + 6, out + 7);
#endif
#ifdef CAMERA
    out[8] = camera_slopes(x, y, model, out, out + 1, out + 2, out + 3);
    out[4] = camera_newton(x, y, back_x, back_y, model, out + 5, out + 6, out + 7);
    real along = in[4], across = in[5];
    const real column = model[CAMERA_CENTRE_X] + x / model[CAMERA_PER_X];
    const real row = model[CAMERA_CENTRE_Y] + y / model[CAMERA_PER_Y];
    real found_x, found_y;
    out[9] = camera_correction(column, row, model, &found_x, &found_y);
    camera_pull_back(column, row, found_x, found_y, model, &along, &across);
    out[10] = along;
    out[11] = across;
    out[12] = camera_approach(x, y, model, out + 13, &across);
#endif
#ifdef LENS
    const real square = x * x + y * y;
    out[14] = lens_newton(square, back_x, lens, out + 15, out + 16);
    out[17] = in[4];
    out[18] = in[5];
    lens_pull_back(x + lens[LENS_CENTRE_X], y + lens[LENS_CENTRE_Y], lens, out + 17, out + 18);
#endif
    for (int k = 0; k < 19; k++) made[19 * n + k] = out[k];
}
"""
STRETCHES = (-0.3, 0.2, -0.15, 0.1)
BENDS = np.array([[0.03, -0.02, 0.05, 0.01, -0.04, 0.02, 0.03], [0.02, 0.04, -0.03, 0.05, 0.01, -0.02, 0.06]])


def plane_of(x: Any, y: Any) -> tuple[Any, Any]:
    """Return the bent point of the polynomials `BENDS`."""
    powers = np.array([x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
    return x + BENDS[0] @ powers, y + BENDS[1] @ powers


def jacobian(function: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, 2, 2) of a mapping of points by complex steps."""
    tiny = 1e-30
    by_x, by_y = function(x + 1j * tiny, y + 0j), function(x + 0j, y + 1j * tiny)
    rows = [[each[axis].imag / tiny for each in (by_x, by_y)] for axis in (0, 1)]
    return np.moveaxis(np.array(rows, np.float64), -1, 0)


@pytest.mark.double
@pytest.mark.parametrize(("name", "order"), [("plane", 1), ("rational", 2), ("tangential", 3), ("all", 4)])
def test_derivatives(device: Device, name: str, order: int, tmp_path: Path, rng: np.random.Generator) -> None:
    count = 64
    points = rng.uniform(-0.3, 0.3, (count, 2))
    back, gradient = rng.uniform(-0.02, 0.02, (count, 2)), rng.uniform(-1.0, 1.0, (count, 2))
    if name == "plane":
        model, defines = np.concatenate([np.zeros(16), BENDS.ravel()]), {"PLANE": None}
    else:
        model = CAMERAS[name].packed(np.float64, "undistort")
        steps = CAMERAS[name].undistort_defines(np.float64)
        defines = {**CAMERAS[name].defines(), "CAMERA_STEPS": steps["CAMERA_STEPS"]}
    lens = Lens(**{f"k{n}": k for n, k in enumerate(STRETCHES[:order], 1)}, centre=(0.4, -0.7))
    defines |= {**lens.defines, "REAL_IS_DOUBLE": None}
    (tmp_path / "derive.cl").write_text(DERIVATIVES)
    program = build(device, tmp_path, "derive.cl", defines, include_folders=(KERNEL_FOLDER,))
    tables = (model, lens.packed((0.0, 0.0), 1.0))
    given_, made, *packed = (
        cl.array.to_device(device.queue, np.ascontiguousarray(each, np.float64))
        for each in (np.hstack([points, back, gradient]), np.zeros((count, 19)), *tables)
    )
    program.derive(device.queue, (count,), None, given_.data, made.data, *(each.data for each in packed))
    found = made.get()
    bent = plane_of if name == "plane" else partial(reference.distort, distortion=CAMERAS[name].distortion)
    np.testing.assert_allclose(
        found[:, :4], (jacobian(bent, *points.T) - (name == "plane") * np.eye(2)).reshape(-1, 4), rtol=0, atol=1e-14
    )
    # Newton: the step that the inverse Jacobian makes from the remaining distance.
    ideal = points + back
    slopes, left = jacobian(bent, *ideal.T), np.stack(bent(*ideal.T), axis=-1).astype(np.float64) - points
    np.testing.assert_allclose(found[:, 5:7], -np.linalg.solve(slopes, left[..., None])[..., 0], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found[:, 7], np.sum(left**2, axis=-1), rtol=1e-10)
    assert found[:, 4].all()
    if name != "plane":
        np.testing.assert_allclose(found[:, 8], np.linalg.det(jacobian(bent, *points.T)), rtol=1e-13)
        assert_gradients(CAMERAS[name], points, gradient, found[:, 9:12])
        # The start and its steps reach the inverse of the lens without a search.
        assert not found[:, 12].any()

    # Lens: the derivative of the radius, and the gradient of the displaced point.
    def stretched(x: Any, y: Any) -> tuple[Any, Any]:
        square = x * x + y * y
        stretch = 1.0 + sum(k * square**n for n, k in enumerate(STRETCHES[:order], 1))
        return x * stretch, y * stretch

    radius = np.hypot(*points.T)
    measured = radius * (1.0 + back[:, 0])
    slope = jacobian(stretched, measured, 0.0 * measured)[:, 0, 0]
    residual = stretched(measured, 0.0)[0] / radius - 1.0
    np.testing.assert_allclose(found[:, 16], residual, rtol=0, atol=1e-15)
    np.testing.assert_allclose(found[:, 15], -residual / slope, rtol=1e-11, atol=1e-15)
    pulled = np.einsum("nij,ni->nj", jacobian(stretched, *points.T), gradient)
    np.testing.assert_allclose(found[:, 17:19], pulled, rtol=1e-12, atol=1e-14)


def assert_gradients(given_: Camera, points: np.ndarray, gradient: np.ndarray, found: np.ndarray) -> None:
    """Compare gradients over measured points with differences of the oracle's ideal points."""
    focal, centre = np.diag(given_.matrix)[:2], np.array(given_.matrix)[:2, 2]
    step = 1e-4
    moves = np.array([[step, 0.0], [-step, 0.0], [0.0, step], [0.0, -step]])
    pixels = centre + focal * (points + moves[:, None])
    ideal = reference.undistort_pixels(pixels.reshape(-1, 2), given_.matrix, given_.distortion)
    right, left, below, above = (ideal.reshape(*pixels.shape) - centre) / focal
    slopes = np.stack([right - left, below - above], axis=-1).astype(np.float64) / (2.0 * step)
    assert not found[:, 0].any()
    # The error of the differences is the square of the step times third derivatives.
    np.testing.assert_allclose(found[:, 1:], np.einsum("nij,ni->nj", slopes, gradient), rtol=0, atol=1e-6)


# ---- the plane -----------------------------------------------------------------------------------------------


@TWO_WAYS
def test_plane_polynomial(device: Device, dtype: Any, variant: Any, rng: np.random.Generator) -> None:
    p = (-0.064, 1.02e-4, -1.7e-6, 4e-9, 3e-9, -1e-9, 4e-12, 4e-12)
    q = (-0.051, 1.01e-4, 1.8e-6, -2e-9, 5e-9, 1e-9, 4e-12, 4e-12)
    polynomial = PlanePolynomial(p=p, q=q, region=((0.0, 1279.0), (0.0, 1023.0)))
    points = (image_points(rng) * 1.1).astype(dtype)
    outside = (points > [1279.0, 1023.0]).any(axis=1)
    points[17] = math.nan
    status = np.where(outside, Status.OUT_OF_RANGE, 0)
    status[17] = Status.NOT_FINITE
    result = UndistortPoints(model=polynomial, variant=variant)(points, device=device)
    np.testing.assert_array_equal(result.status, status)
    # Ten roundings of 0.1 m.
    eps = float(np.finfo(dtype).eps)
    np.testing.assert_allclose(result.points, polynomial.to_plane(points), rtol=0, atol=eps)
    inner = result.points[(status == 0) & (points < [1278.0, 1022.0]).all(axis=1) & (points > 1.0).all(axis=1)]
    back = UndistortPoints(model=polynomial, inverse=True, variant=variant)(np.ascontiguousarray(inner), device=device)
    assert np.all(back.status == 0)
    np.testing.assert_allclose(back.points, polynomial.to_sensor(inner), rtol=0, atol=1e4 * eps)
    far = np.tile(np.array([[0.2, 0.0], [0.0, -0.2], [1e20, 0.0], [0.0, 0.0]], dtype), (5, 1))
    lost = UndistortPoints(model=polynomial, inverse=True, variant=variant)(far, device=device)
    np.testing.assert_array_equal(lost.status, 5 * (3 * [Status.OUT_OF_RANGE] + [0]))


# ---- errors -----------------------------------------------------------------------------------------


@pytest.mark.double
def test_wrong_inputs(device: Device) -> None:
    operation = UndistortPoints(model=CAMERAS["k1"])
    with pytest.raises(TypeError, match="float32 or float64 points, got int64"):
        operation(np.zeros((4, 2), np.int64), device=device)
    with pytest.raises(ValueError, match=r"takes points \(\.\.\., 2\), got shape \(4, 3\)"):
        operation(np.zeros((4, 3)), device=device)
    with pytest.raises(ValueError, match="contiguous"):
        operation(np.zeros((8, 4))[:, ::2], device=device)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"model": 3}, TypeError, "expected a Camera, a Lens or a PlanePolynomial"),
        ({"model": LENSES["lens k1"], "matrix": ANOTHER}, ValueError, "goes with a Camera only"),
        ({"model": CAMERAS["k1"], "matrix": np.eye(2)}, ValueError, r"matrix has shape \(2, 2\)"),
        ({"model": CAMERAS["k1"], "matrix": np.zeros((3, 3))}, ValueError, "focal lengths 0 and 0"),
    ],
)
def test_wrong_parameters(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        UndistortPoints(**options)


@pytest.mark.double
def test_against_a_converged_opencv(device: Device, rng: np.random.Generator) -> None:
    given_ = CAMERAS["all"]
    points = image_points(rng)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    matrix, coefficients = given_.to_opencv()
    theirs = cv2.undistortPoints(points[:, None], matrix, coefficients, P=matrix, criteria=stop)[:, 0]
    ours = UndistortPoints(model=given_)(points, device=device)
    good = ours.status == 0
    assert good.mean() > 0.9
    np.testing.assert_allclose(ours.points[good], theirs[good], rtol=0, atol=1e-8)


def test_the_public_names() -> None:
    assert gv.UndistortPoints is UndistortPoints
    assert gv.Camera is Camera
    assert gv.PlanePolynomial is PlanePolynomial
    assert replace(UndistortPoints(model=CAMERAS["k1"]), inverse=True).inverse
