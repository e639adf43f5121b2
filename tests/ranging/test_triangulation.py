"""Triangulation on devices: against the float64 oracle, at the extremes, and fused into readouts."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from canary import shifted
from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.host.program import options
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.ranging.sheet import SampleAxes, SheetPoints
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.reference import triangulation as reference
from gpuvision.status import Status
from tiers import variants_of

REGION = ((0.0, 1023.0), (0.0, 1279.0))
CAMERA = np.array([[1700.0, 0.0, 640.0], [0.0, 1700.0, 512.0], [0.0, 0.0, 1.0]])
LENSES = [None, Lens(k1=-2e-7, centre=(650.0, 500.0)), Lens(k1=-2e-7, k2=5e-14, centre=(650.0, 500.0))]
ON_DEVICES = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
# x, w, p (two roundings), the products, their sum and the offset: about eight half-ulps of the largest value.
ROUNDINGS = 8.0


def scanner(**more: Any) -> Triangulation:
    """Return a camera at 0.3 m that views the sheet at 35 degrees, rolled by 2 degrees."""
    tilt, roll = math.radians(35.0), math.radians(2.0)
    down = np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])
    turn = np.array([[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]])
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    options = {"matrix": CAMERA, "region": REGION, **more}
    return Triangulation.from_camera(options.pop("matrix"), turn @ down @ upright, [0.01, 0.02, 0.3], **options)


def oracle(operation: Triangulation, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
    lens = operation.lens and (operation.lens.k1, operation.lens.k2, operation.lens.centre)
    return reference.triangulate(
        u,
        v,
        operation.homography,
        operation.region,
        horizon=operation.horizon,
        lens=lens,
        along=operation.along,
    )


def assert_close(result: SheetPoints, operation: Triangulation, u: np.ndarray, v: np.ndarray) -> None:
    g, h, status = oracle(operation, u.astype(np.float64), v.astype(np.float64))
    np.testing.assert_array_equal(result.status, status)
    # In double precision the oracle has the same number of roundings as the kernel.
    eps = np.finfo(result.g.dtype).eps * (1.0 if result.g.dtype == np.float32 else 2.0)
    for value, expected in ((result.g, g), (result.h, h)):
        largest = np.nanmax(np.abs([g, h]), initial=0.0)
        np.testing.assert_allclose(value, expected, rtol=0, atol=0.5 * ROUNDINGS * eps * largest)


@pytest.mark.parametrize("lens", LENSES, ids=["no lens", "k1", "k1 k2"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("along", ["columns", "rows"])
@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_against_the_oracle(
    device: Device, lens: Lens | None, dtype: type, along: Any, variant: Any, rng: np.random.Generator
) -> None:
    region = REGION if along == "columns" else REGION[::-1]
    operation = scanner(lens=lens, along=along, region=region, variant=variant)
    u = rng.uniform(*region[0], (7, 1003)).astype(dtype)
    v = rng.uniform(*region[1], (7, 1003)).astype(dtype)
    result = operation(u, v, device=device)
    assert result.g.dtype == dtype
    assert result.sigma_g is None
    assert_close(result, operation, u, v)


@pytest.mark.parametrize("shift", [0, 1])
def test_stores_past_small_caches(device: Device, shift: int, rng: np.random.Generator) -> None:
    """A device with caches of 1 KiB writes past them: at aligned addresses and at other addresses, flags included."""
    u, v = (rng.uniform(low, high, 4003).astype(np.float32) for low, high in REGION)
    u[[7, 1000, 4002]] = np.nan
    small = copy.copy(device)
    small.cache_bytes = 1024
    operation = scanner()
    defines = operation.launch(small, u.shape, u.dtype).defines
    assert ("PAST_CACHES" in defines) == ("VECTOR_VARIANT" in defines and device.is_cpu)
    usual = operation(u, v, device=device)
    past = operation(u, v, device=small, out=shifted(usual, shift))
    for mine, theirs in zip(past, usual, strict=True):
        if theirs is not None:
            np.testing.assert_array_equal(mine, theirs)


@ON_DEVICES
@given(
    shape=st.lists(st.integers(1, 40), max_size=3).map(tuple),
    variant=st.sampled_from(["vector", "work_item"]),
    seed=st.integers(0, 9),
)
def test_any_shape(device: Device, shape: tuple[int, ...], variant: Any, seed: int) -> None:
    assume(variant in variants_of(device))
    rng = np.random.default_rng(seed)
    operation = scanner(variant=variant)
    u = rng.uniform(*REGION[0], shape).astype(np.float32)
    v = rng.uniform(*REGION[1], shape).astype(np.float32)
    u, v = np.asarray(u), np.asarray(v)
    result = operation(u, v, device=device)
    assert result.h.shape == shape
    assert_close(result, operation, u, v)


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 31, 255, 256, 257, 1023, 1024, 1025, 5000, 300_001])
@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_sizes_around_the_groups_and_canaries(
    device: Device, count: int, variant: Any, rng: np.random.Generator
) -> None:
    operation = scanner(sigma=(0.1, 0.1), variant=variant)
    u, v = (rng.uniform(*bounds, count).astype(np.float32) for bounds in REGION)
    real = [np.full(count + 128, 7.0, np.float32) for _ in range(4)]
    status = np.full(count + 128, 7, np.uint8)
    inner = slice(64, 64 + count)
    out = SheetPoints(real[0][inner], real[1][inner], status[inner], real[2][inner], real[3][inner])
    assert operation(u, v, device=device, out=out) is out
    assert_close(out, operation, u, v)
    for array in (*real, status):
        assert np.all(array[:64] == 7)
        assert np.all(array[64 + count :] == 7)


def test_device_arrays_and_bound(device: Device, rng: np.random.Generator) -> None:
    operation = scanner()
    u, v = (rng.uniform(*bounds, (3, 500)).astype(np.float32) for bounds in REGION)
    on_device = [cl.array.to_device(device.queue, each) for each in (u, v)]
    result = operation(*on_device)
    assert isinstance(result.g, cl.array.Array)
    assert_close(SheetPoints(result.g.get(), result.h.get(), result.status.get()), operation, u, v)
    bound = operation.bind(device, u.shape, u.dtype)
    bound(*on_device).wait()
    np.testing.assert_array_equal(bound.outputs.h.get(), result.h.get())


@pytest.mark.double
def test_double_arithmetic_on_single_coordinates(device: Device, rng: np.random.Generator) -> None:
    operation = scanner(precision="double")
    u, v = (rng.uniform(*bounds, 999).astype(np.float32) for bounds in REGION)
    result = operation(u, v, device=device)
    assert result.h.dtype == np.float64
    assert_close(result, operation, u, v)


def test_single_precision_stays_near_rounding_far_from_the_origin(device: Device, rng: np.random.Generator) -> None:
    # A small window far away from pixel 0 and around the sheet's origin: only conditioned coordinates keep the
    # accuracy.
    region = ((3000.0, 3255.0), (4000.0, 4063.0))
    moved = np.array([[1.0, 0.0, 3400.0], [0.0, 1.0, 2600.0], [0.0, 0.0, 1.0]]) @ CAMERA
    operation = scanner(region=region, matrix=moved)
    # Quarter pixels near 4000 are exact in single precision.
    u = (rng.integers(12000, 13020, 4000) / 4.0).astype(np.float32)
    v = (rng.integers(16000, 16252, 4000) / 4.0).astype(np.float32)
    result = operation(u, v, device=device)
    g, h, _ = oracle(operation, u.astype(np.float64), v.astype(np.float64))
    # One half-ulp for the last addition, and a few half-ulps of the part that varies over the window.
    for value, expected in ((result.g, g), (result.h, h)):
        atol = 0.5 * np.finfo(np.float32).eps * (np.max(np.abs(expected)) + 6.0 * np.ptp(expected))
        np.testing.assert_allclose(value, expected, rtol=0, atol=atol)


@pytest.mark.double
def test_horizon(device: Device) -> None:
    # w = 1 - u / 100 about the middle of the region: the horizon lies at u = 100.
    operation = Triangulation(
        homography=((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (-0.01, 0.0, 1.0)), region=((-1.0, 1.0), (-1.0, 1.0))
    )
    u = np.array([0.0, 50.0, 99.8, 99.95, 100.0, 100.5, 1e5], np.float64)
    result = operation(u, np.zeros(7), device=device)
    np.testing.assert_array_equal(result.status, [0, 0, 0] + 4 * [Status.HORIZON])
    np.testing.assert_allclose(result.h[:3], u[:3] / (1.0 - u[:3] / 100.0), rtol=1e-12)
    assert np.all(np.isnan(result.h[3:]))
    assert np.all(np.isnan(result.g[3:]))


@pytest.mark.double
def test_sign_of_the_homography_does_not_matter(device: Device, rng: np.random.Generator) -> None:
    operation = scanner()
    turned = Triangulation(
        homography=tuple(tuple(-7.0 * x for x in row) for row in operation.homography), region=REGION
    )
    u, v = (rng.uniform(*bounds, 100) for bounds in REGION)
    np.testing.assert_allclose(turned(u, v, device=device).h, operation(u, v, device=device).h, rtol=1e-12)


@pytest.mark.parametrize("lens", LENSES, ids=["no lens", "k1", "k1 k2"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_not_finite(device: Device, lens: Lens | None, dtype: type, variant: Any) -> None:
    # The processor's own NaN (0 / 0) has the sign bit set, math.nan has not.
    bad = np.array([math.nan, math.inf, -math.inf, 5.0, 5.0, 5.0, math.nan, -math.nan, 5.0, 5.0], dtype)
    other = np.array([5.0, 5.0, 5.0, math.nan, math.inf, -math.inf, math.nan, 5.0, -math.nan, 5.0], dtype)
    assert np.signbit(bad[7])
    assert np.signbit(other[8])
    operation = scanner(lens=lens, sigma=(0.1, 0.1), variant=variant)
    result = operation(np.tile(bad, 3), np.tile(other, 3), device=device)
    np.testing.assert_array_equal(result.status, 3 * (9 * [Status.NOT_FINITE] + [0]))
    for values in (result.g, result.h, result.sigma_g, result.sigma_h):
        np.testing.assert_array_equal(np.isfinite(values), result.status == 0)


@pytest.mark.parametrize("lens", [*LENSES, Lens(k1=1e-7, k2=1e-13)], ids=["no lens", "k1", "k1 k2", "no fold"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_huge_coordinates_are_flagged_not_invented(
    device: Device, lens: Lens | None, dtype: type, variant: Any
) -> None:
    huge = np.tile(np.array([1e10, 1e18, 1e30, 3e38] + [1e300] * (dtype == np.float64), dtype), 5)
    one = np.ones_like(huge)
    for u, v in ((huge, one), (-huge, one), (one, huge), (one, -huge), (huge, huge), (huge, -huge)):
        result = scanner(lens=lens, variant=variant)(u, v, device=device)
        np.testing.assert_array_equal(result.status, Status.NOT_FINITE)
        assert np.all(np.isnan(result.g))


@pytest.mark.parametrize("lens", LENSES[:2], ids=["no lens", "k1"])
def test_a_flag_among_good_points(device: Device, lens: Lens | None, rng: np.random.Generator) -> None:
    """The vector variant tests blocks of 256 points for flags, and computes a block with a flag again."""
    u, v = (rng.uniform(*bounds, 9 * 256 + 40).astype(np.float32) for bounds in REGION)
    operation = scanner(lens=lens)
    clean = operation(u, v, device=device)
    assert not clean.status.any()
    flagged = {0: np.nan, 511: np.inf, 512: -np.inf, 256 * 5 + 17: 1e30, 256 * 6 + 255: -1e30, len(u) - 1: np.nan}
    # About 7e5 half extents: too far for the quick test, but not for the limit of NOT_FINITE.
    for where, value in ((flagged, list(flagged.values())), ([256 * 3 + 100], [4e8])):
        u_bad = u.copy()
        u_bad[list(where)] = value
        result = operation(u_bad, v, device=device)
        # Fewer than 16 points would run as work-items, which round differently.
        bad = list(where)
        together = operation(np.tile(u_bad[bad], 16), np.tile(v[bad], 16), device=device)
        g, h, status = (values[: len(bad)] for values in together[:3])
        np.testing.assert_array_equal(status == 0, np.isfinite(g))
        good = np.delete(np.arange(len(u)), bad)
        for values, expected, of_bad in zip(result[:3], clean[:3], (g, h, status), strict=True):
            np.testing.assert_array_equal(values[good], expected[good])
            np.testing.assert_array_equal(values[bad], of_bad)


@pytest.mark.parametrize("lens", [*LENSES, Lens(k1=1e-7, k2=1e-13)], ids=["no lens", "k1", "k1 k2", "no fold"])
def test_far_coordinates_are_finite_or_flagged(device: Device, lens: Lens | None) -> None:
    far = np.geomspace(1e3, 5e8, 500).astype(np.float32)
    for u, v in ((far, -far), (-far, far), (far, far), (-far, -far), (far, 0 * far), (0 * far, -far)):
        result = scanner(lens=lens)(u, v, device=device)
        np.testing.assert_array_equal(np.isfinite(result.g) & np.isfinite(result.h), result.status == 0)


@pytest.mark.double
def test_lens_at_its_fold(device: Device) -> None:
    lens = Lens(k1=-4e-6, centre=(640.0, 512.0))
    operation = scanner(lens=lens)
    radius = lens.fold_radius
    v = 640.0 + radius * np.array([0.0, 0.5, 0.999, 0.9999, 1.0001, 1.5, 3.0])
    result = operation(np.full(7, 512.0), v, device=device)
    np.testing.assert_array_equal(result.status, [0, 0, 0, 0] + 3 * [Status.NOT_INVERTIBLE])
    np.testing.assert_array_equal(np.isnan(result.g), result.status != 0)


@pytest.mark.parametrize("lens", LENSES, ids=["no lens", "k1", "k1 k2"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_sigmas_against_the_host(
    device: Device, lens: Lens | None, dtype: type, variant: Any, rng: np.random.Generator
) -> None:
    truth = scanner(lens=lens)
    sheet = np.stack(np.meshgrid(np.linspace(-0.05, 0.05, 7), np.linspace(-0.04, 0.04, 5)), -1).reshape(-1, 2)
    seen = truth.to_sensor(sheet)
    operation = Triangulation.fit(
        seen + rng.normal(0.0, 0.2, seen.shape), sheet, sigma=(0.2, 0.3), region=REGION, lens=lens, model="H8"
    )
    operation = replace(operation, variant=variant)
    u, v = (rng.uniform(200.0, 900.0, 500).astype(dtype) for _ in range(2))
    result = operation(u, v, device=device)
    points = np.stack([u, v], -1).astype(np.float64)
    full = operation.covariance_at(points)
    # About thirty roundings, most of them under a root; in double also the roundings of the covariance factors.
    rtol = 32.0 * np.finfo(dtype).eps * (1.0 if dtype == np.float32 else 10.0)
    np.testing.assert_allclose(result.sigma_g, np.sqrt(full[:, 0, 0]), rtol=rtol)
    np.testing.assert_allclose(result.sigma_h, np.sqrt(full[:, 1, 1]), rtol=rtol)
    without = Triangulation(homography=operation.homography, region=REGION, lens=lens, sigma=(0.2, 0.3))(
        u, v, device=device
    )
    assert np.all(without.sigma_h < result.sigma_h)


FUSED = """
#include "common/sheet.h"
kernel void fused(global const real *position, global real *g, global real *h, global uchar *status, global real *sigma,
                  constant SheetTable *sheet) {
    const size_t i = get_global_id(0);
    real16 at_g, at_h, of_g, of_h;
    const real16 samples = (real)(16 * i) + (real16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const real16 at = vload16(i, position);
    vstore16(sheet_point(at, samples, sheet, &at_g, &at_h), i, status);
    sheet_sigma(at, samples, (real16)0.1, (real16)0.05, sheet, &of_g, &of_h);
    vstore16(at_g, i, g);
    vstore16(at_h, i, h);
    vstore16(of_h, i, sigma);
}
"""


@pytest.mark.filterwarnings("ignore::pyopencl.CompilerWarning")
@pytest.mark.parametrize("lens", LENSES, ids=["no lens", "k1", "k1 k2"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_fused_strips_take_positions_and_sample_numbers(
    device: Device, lens: Lens | None, dtype: type, rng: np.random.Generator
) -> None:
    axes = SampleAxes(sample_origin=1100.0, sample_pitch=-4.0, position_origin=40.0, position_pitch=0.5)
    covariance = np.diag(rng.uniform(1e-12, 1e-10, 8))
    operation = scanner(lens=lens, covariance=tuple(map(tuple, covariance)), sigma=(0.05, 0.2))
    defines = {
        **operation.defines(dtype),
        "VECTOR_VARIANT": None,
        **({"REAL_IS_DOUBLE": None} if dtype == np.float64 else {}),
    }
    program = cl.Program(device.context, FUSED).build([*options(defines), "-I", str(KERNEL_FOLDER)])
    position = rng.uniform(0.0, 1800.0, 256).astype(dtype)
    position[[17, 200]] = math.nan
    queue = device.queue
    given_, g, h, sigma = (cl.array.to_device(queue, position) for _ in range(4))
    status = cl.array.zeros(queue, 256, np.uint8)
    table = cl.array.to_device(queue, operation.packed(dtype, axes))
    program.fused(queue, (16,), None, *(each.data for each in (given_, g, h, status, sigma, table)))
    u = 40.0 + 0.5 * position.astype(np.float64)
    v = 1100.0 - 4.0 * np.arange(256.0)
    result = SheetPoints(g.get(), h.get(), status.get())
    assert_close(result, operation, u, v)
    # 0.1 positions of half a pixel are 0.05 pixels, 0.05 samples of four pixels are 0.2: the sigma of the operation.
    expected = np.sqrt(operation.covariance_at(np.stack([u, v], -1))[:, 1, 1])
    good = result.status == 0
    np.testing.assert_allclose(sigma.get()[good], expected[good], rtol=64.0 * np.finfo(dtype).eps)


@pytest.mark.double
def test_single_beam(device: Device) -> None:
    operation = Triangulation.from_constants((2.0, 1e-3, 40.0), region=((-3e-3, 3e-3), (0.0, 0.0)))
    u = np.linspace(-3e-3, 3e-3, 11)
    result = operation(u, np.zeros(11), device=device)
    np.testing.assert_allclose(result.h, (2.0 * u + 1e-3) / (40.0 * u + 1.0), rtol=1e-12)
    np.testing.assert_array_equal(result.g, 0.0)


def test_wrong_inputs(device: Device) -> None:
    operation = scanner()
    u = np.zeros(4, np.float32)
    with pytest.raises(TypeError, match="float32 or float64"):
        operation(u.astype(np.uint16), u.astype(np.uint16), device=device)
    with pytest.raises(TypeError, match="dtype"):
        operation(u, u.astype(np.float64), device=device)
    with pytest.raises(ValueError, match="shape"):
        operation(u, np.zeros(5, np.float32), device=device)
    with pytest.raises(ValueError, match="contiguous"):
        operation(np.zeros(8, np.float32)[::2], np.zeros(8, np.float32)[::2], device=device)
    with pytest.raises(TypeError, match="2 input arrays"):
        operation(u, device=device)
