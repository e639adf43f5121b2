from __future__ import annotations

import copy
import dataclasses
import math
from contextlib import nullcontext

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from hypothesis.extra import numpy as hnp

from canary import shifted
from gpuvision import Device, Status
from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.ranging.range_image import RangeImage, RangePoints
from gpuvision.ranging.sheet import BentSheet, check_orthonormal
from gpuvision.ranging.sheet_motion import RotatingSheet, StraightTransport
from gpuvision.reference import range_image as reference

VARIANTS = ("vector", "work_item")
DTYPES = (np.float32, np.float64)
LENSES = (None, Lens(k1=2e-8, centre=(500.0, 390.0)), Lens(k1=-1e-6, k2=1e-14, centre=(500.0, 390.0)))
SHAPES = ((1, 1), (3, 15), (2, 16), (5, 17), (2, 1024), (3, 1043))
TILTED = StraightTransport(
    step=1e-4,
    start=-2e-3,
    g_axis=(0.0, 1.0, 0.0),
    h_axis=(math.tan(0.7), 0.1, 1.0),
    direction=(1.0, 0.2, 0.0),
    origin=(0.01, -0.02, 0.03),
)
HEAD = RotatingSheet(
    focal_length_px=900.0,
    principal_point_px=(511.5, 380.25),
    axis_point=(0.12, 0.01, -0.02),
    axis_direction=(0.02, 1.0, -0.01),
    sheet_normal=(1.0, 0.1, -0.05),
    sheet_offset=0.004,
    first_angle=-0.5,
    angle_step=0.2,
    scene_axes=((2 / 3, -1 / 3, 2 / 3), (2 / 3, 2 / 3, -1 / 3), (-1 / 3, 2 / 3, 2 / 3)),
    scene_origin=(0.1, 0.7, 1.0),
)


def close(made: RangePoints, points: np.ndarray, status: np.ndarray, tolerance: np.ndarray | float) -> None:
    np.testing.assert_array_equal(made.status, status)
    for axis, values in enumerate(made[:3]):
        truth = points[..., axis]
        np.testing.assert_array_equal(np.isnan(values), np.isnan(truth))
        good = np.isfinite(truth)
        assert np.all(np.abs(values - truth)[good] <= np.broadcast_to(tolerance, truth.shape)[good])


def expect_straight(op: RangeImage, g, h, transport, given):
    points = reference.points_of_straight_transport(op.geometry, g, h, transport)
    unknown = ~np.isfinite(g) | ~np.isfinite(h) | ~np.isfinite(transport)[:, None]
    no_fold = np.zeros(g.shape, bool)
    return reference.apply_status(points, given, unknown, no_fold, no_fold, op.limits)


def expect_rotating(op: RangeImage, position, transport, given):
    points, facing, folded = reference.points_of_rotating_sheet(op.geometry, position, transport)
    unknown = ~np.isfinite(position) | ~np.isfinite(transport)[:, None]
    missed = ~(facing > op.geometry.horizon)
    return (*reference.apply_status(points, given, unknown, missed, folded, op.limits), facing)


def depth_tolerance(op: RangeImage, points: np.ndarray, facing: np.ndarray, dtype: type) -> np.ndarray:
    """Return the depth error by rounding of n . r (about five terms of at most 2), magnified by 1 / (n . r)."""
    pinhole = op.geometry.packed()[:3]
    distance = np.linalg.norm(points - pinhole, axis=-1)
    with np.errstate(divide="ignore"):
        return np.finfo(dtype).eps * (distance * (8.0 + 10.0 / np.abs(facing)) + 4.0)


def beside_an_edge(op: RangeImage, position: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Return the samples at the horizon or the lens' fold within rounding."""
    at_horizon = np.abs(facing - op.geometry.horizon) < 1e-5
    if op.geometry.lens is None:
        return at_horizon
    pixels = [position, np.broadcast_to(np.arange(position.shape[1]), position.shape)]
    if op.geometry.along == "columns":
        pixels.reverse()
    column, row = op.geometry.lens.centre
    return at_horizon | (np.abs(np.hypot(pixels[0] - column, pixels[1] - row) - op.geometry.lens.fold_radius) < 1e-2)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES)
def test_a_straight_transport_lays_profiles_side_by_side(device, rng, shape, dtype, variant):
    g, h = rng.uniform(-0.05, 0.05, (2, *shape)).astype(dtype)
    transport = TILTED.transport(shape[0]).astype(dtype)
    given = rng.choice(np.array([0, 0, 0, 1, 2, 16, 32], np.uint8), shape)
    op = RangeImage(geometry=TILTED, variant=variant)
    # Sums of about five terms below 0.1 m.
    close(
        op(g, h, transport, given, device=device),
        *expect_straight(op, g, h, transport, given),
        tolerance=6 * 0.1 * np.finfo(dtype).eps,
    )


@pytest.mark.parametrize(("samples", "shift"), [(1024, 0), (1024, 1), (1043, 0)])
def test_stores_past_small_caches(device, rng, samples, shift):
    """A device with caches of 1 KiB writes rows of whole vectors past them: at aligned and at other addresses."""
    g, h = rng.uniform(-0.05, 0.05, (2, 3, samples)).astype(np.float32)
    transport = TILTED.transport(3).astype(np.float32)
    given = rng.choice(np.array([0, 0, 0, 1], np.uint8), g.shape)
    small = copy.copy(device)
    small.cache_bytes = 1024
    op = RangeImage(geometry=TILTED)
    defines = op.launch(small, g.shape, g.dtype).defines
    may_bypass = "VECTOR_VARIANT" in defines and device.is_cpu
    assert ("PAST_CACHES" in defines) == (may_bypass and samples == 1024)
    usual = op(g, h, transport, given, device=device)
    past = op(g, h, transport, given, device=small, out=shifted(usual, shift))
    for mine, theirs in zip(past, usual, strict=True):
        np.testing.assert_array_equal(mine, theirs)


# A tilted camera 0.3 m away, whose sheet deviates by up to 1.5 mm in a field of 0.1 m.
BENT = StraightTransport(
    step=1e-4,
    g_axis=(0.0, 1.0, 0.0),
    h_axis=(math.sin(0.3), 0.0, math.cos(0.3)),
    direction=(1.0, 0.1, 0.0),
    origin=(0.01, -0.02, 0.03),
    bend=BentSheet(terms=(0.4, -0.15, 0.25), pinhole=(0.01, 0.25, -0.18)),
)


@pytest.mark.parametrize(
    ("dtype", "variant", "sign"),
    [(np.float32, "vector", 1.0), (np.float64, "vector", -1.0), (np.float32, "work_item", -1.0)],
)
def test_rays_meet_a_bent_sheet(device, rng, dtype, variant, sign):
    """Bent towards the camera and away from it, against a search along the rays."""
    bend = dataclasses.replace(BENT.bend, terms=tuple(sign * each for each in BENT.bend.terms))
    op = RangeImage(geometry=dataclasses.replace(BENT, bend=bend), variant=variant)
    g, h = rng.uniform(-0.05, 0.05, (2, 3, 1043)).astype(dtype)
    transport = op.geometry.transport(3).astype(dtype)
    given = rng.choice(np.array([0, 0, 0, 1, 2, 16, 32], np.uint8), g.shape)
    points, missed = reference.points_of_bent_sheet(op.geometry, g, h, transport)
    assert not missed.any()
    deviation = points - reference.points_of_straight_transport(op.geometry, g, h, transport)
    assert 1e-3 < np.max(np.linalg.norm(deviation, axis=-1)) < 5e-3
    no = np.zeros(g.shape, bool)
    expected = reference.apply_status(points, given, no, no, no, op.limits)
    # About eight terms below 0.1 m.
    close(op(g, h, transport, given, device=device), *expected, tolerance=8 * 0.1 * np.finfo(dtype).eps)


@pytest.mark.double
def test_points_of_a_bent_sheet_and_rays_that_miss_it(device):
    """A point of the surface, seen by the camera, comes back; where the sheet bends away from the ray there is none."""
    bend = BentSheet.from_pose(
        (2.0, 0.5, -1.0), origin=(0.0, 0.02, 0.3), g_axis=(1.0, 0.0, 0.0), h_axis=(0.0, -0.6, -0.8)
    )
    normal = np.cross((1.0, 0.0, 0.0), (0.0, -0.6, -0.8))
    truth = np.array([0.03, 0.02, 2.0 * 0.03**2 + 0.5 * 0.03 * 0.02 - 0.02**2])
    # In the camera frame the pinhole is 0: the ray through the point meets the mean plane at Q.
    point = np.array([0.0, 0.02, 0.3]) + truth @ np.array([(1.0, 0.0, 0.0), (0.0, -0.6, -0.8), normal])
    on_plane = point * (normal @ (0.0, 0.02, 0.3)) / (normal @ point) - (0.0, 0.02, 0.3)
    g, h = np.array([[on_plane[0]]]), np.array([[on_plane @ (0.0, -0.6, -0.8)]])
    geometry = StraightTransport(g_axis=(1.0, 0.0, 0.0), h_axis=(0.0, 0.0, 1.0), bend=bend)
    made = RangeImage(geometry=geometry)(g, h, np.zeros(1), np.zeros((1, 1), np.uint8), device=device)
    # g_axis x h_axis is -y here.
    np.testing.assert_allclose([made.x[0, 0], -made.y[0, 0], made.z[0, 0]], truth[[0, 2, 1]], atol=1e-15)
    # With the pinhole 0.1 m above a sheet of 40 G^2 a ray from Q meets it at s = 400 Q^2 (1 - s)^2; bent the other way
    # s = -400 Q^2 (1 - s)^2, without a solution from Q = 0.025 on.
    g = np.array([[0.0, 0.01, 0.05, 0.3, np.nan, np.inf]])
    for sign, flags in ((1.0, [0, 0, 0, 0, 8, 8]), (-1.0, [0, 0, Status.HORIZON, Status.HORIZON, 8, 8])):
        steep = dataclasses.replace(geometry, bend=BentSheet(terms=(sign * 40.0, 0.0, 0.0), pinhole=(0.0, 0.0, 0.1)))
        made = RangeImage(geometry=steep)(g, np.zeros_like(g), np.zeros(1), np.zeros(g.shape, np.uint8), device=device)
        assert made.status[0].tolist() == flags
        np.testing.assert_array_equal(np.isnan(made.x), made.status != 0)
        good, share = made.status == 0, -made.y / 0.1
        np.testing.assert_allclose(share[good], (sign * 400.0 * g**2 * (1.0 - share) ** 2)[good], atol=1e-14)
        np.testing.assert_allclose(made.x[good], (g * (1.0 - share))[good], atol=1e-15)


@pytest.mark.double
def test_bent_sheets_beyond_the_pinhole_and_saddles(device):
    """The light lies between pinhole and sheet, on the intersection that a flat sheet that bends reaches first."""
    geometry = StraightTransport(bend=BentSheet(terms=(40.0, 0.0, 0.0), pinhole=(0.1, 0.0, 0.1)))
    # The normal through the pinhole meets the sheet at d = 0.4, beyond the pinhole.
    made = RangeImage(geometry=geometry)(
        np.array([[0.1, -0.1]]), np.zeros((1, 2)), np.zeros(1), np.zeros((1, 2), np.uint8), device=device
    )
    assert made.status[0].tolist() == [Status.HORIZON, 0]
    # On a saddle: a ray whose root is lost as the bend grows, and one whose root stays (b is negative for both).
    for start, pinhole, flag in (
        ((0.03, 0.029), (0.33, -0.071, 0.1), Status.HORIZON),
        ((0.02, 0.0), (0.12, 0.2, 0.1), Status.OK),
    ):
        bend = BentSheet(terms=(40.0, 0.0, -40.0), pinhole=pinhole)
        g, h = (np.full((1, 1), each) for each in start)
        op = RangeImage(geometry=dataclasses.replace(geometry, bend=bend))
        made = op(g, h, np.zeros(1), np.zeros((1, 1), np.uint8), device=device)
        assert made.status[0, 0] == flag
    share = -made.y[0, 0] / 0.1
    assert 0.0 < share < 1.0
    assert share == pytest.approx(400.0 * ((0.02 + 0.1 * share) ** 2 - (0.2 * share) ** 2), abs=1e-12)
    assert (made.x[0, 0], made.z[0, 0]) == pytest.approx((0.02 + 0.1 * share, 0.2 * share), abs=1e-15)


def test_axes_may_be_off_by_the_rounding_of_six_decimals():
    """Scalar products up to 1e-6 from 0 or 1 pass, also those of exact axes, which rounding makes nearly 0."""
    turn = 0.3 + 0.1 * np.arange(20)
    for c, s in zip(np.cos(turn), np.sin(turn), strict=True):
        check_orthonormal(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)), "axes")
    for off, is_refused in ((0.9e-6, False), (1.1e-6, True)):
        for wrong in (((1.0, 0.0, 0.0), (off, 1.0, 0.0)), ((1.0 + 0.5 * off, 0.0, 0.0), (0.0, 1.0, 0.0))):
            with pytest.raises(ValueError, match="axes are not two orthonormal") if is_refused else nullcontext():
                check_orthonormal(wrong, "axes")


def test_a_wrong_bent_sheet_is_refused():
    with pytest.raises(ValueError, match=r"g_axis and h_axis of a bent sheet are not two orthonormal"):
        dataclasses.replace(BENT, h_axis=(math.tan(0.3), 0.0, 1.0))
    with pytest.raises(ValueError, match=r"pinhole lies in the mean plane"):
        BentSheet(terms=(0.1, 0.0, 0.0), pinhole=(0.1, 0.2, 0.0))
    with pytest.raises(ValueError, match=r"from_pose: g_axis and h_axis are not two orthonormal"):
        BentSheet.from_pose((0.1, 0.0, 0.0), origin=(0, 0, 1), g_axis=(1, 0, 0), h_axis=(0, 0.5, 0))


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("along", ["rows", "columns"])
@pytest.mark.parametrize("lens", LENSES)
def test_a_rotating_sheet_meets_the_rays(device, rng, lens, along, dtype, variant):
    shape = (6, 1043)
    position = rng.uniform(0, 1000, shape).astype(dtype)
    geometry = dataclasses.replace(HEAD, lens=lens, along=along)
    transport = geometry.transport(shape[0]).astype(dtype)
    given = rng.choice(np.array([0, 0, 0, 1, 2, 16, 32], np.uint8), shape)
    op = RangeImage(geometry=geometry, variant=variant)
    points, status, facing = expect_rotating(op, position, transport, given)
    assert {0, Status.HORIZON} <= set(np.unique(status).tolist())
    assert lens is None or lens.k1 > 0 or np.any(status == Status.NOT_INVERTIBLE)
    edge = beside_an_edge(op, position, facing)
    assert edge.mean() < 0.01
    made = op(position, transport, given, device=device)
    made = RangePoints(*(np.where(edge, np.nan, each) for each in made[:3]), np.where(edge, 0, made.status))
    points[edge], status[edge] = np.nan, 0
    close(made, points, status, depth_tolerance(op, points, facing, dtype))


TILTED_CAMERA = Camera(
    matrix=((910.0, 0.0, 511.5), (0.0, 900.0, 380.25), (0.0, 0.0, 1.0)),
    distortion=(-0.08, 0.03, 3e-4, -2e-4, *(0.0,) * 8, 0.2, -0.15),
)
CALIBRATED = dataclasses.replace(HEAD, focal_length_px=None, principal_point_px=None, camera=TILTED_CAMERA)


@pytest.mark.parametrize(
    ("dtype", "along", "variant"),
    [(np.float32, "rows", "vector"), (np.float64, "columns", "vector"), (np.float32, "columns", "work_item")],
)
def test_a_rotating_sheet_before_a_calibrated_camera(device, rng, along, dtype, variant):
    shape = (2, 760) if along == "rows" else (2, 1020)
    position = rng.uniform(0, 1020 if along == "rows" else 760, shape).astype(dtype)
    op = RangeImage(geometry=dataclasses.replace(CALIBRATED, along=along), variant=variant)
    angles = np.array([-0.4, 0.3], dtype)
    given = np.zeros(shape, np.uint8)
    points, status, facing = expect_rotating(op, position, angles, given)
    made = op(position, angles, given, device=device)
    clear = np.abs(facing - op.geometry.horizon) > 1e-5
    assert clear.mean() > 0.99
    assert 0.3 < np.mean(status[clear] == 0) < 1.0
    points[~clear], status[~clear] = np.stack(made[:3], -1)[~clear], made.status[~clear]
    close(made, points, status, 2.0 * depth_tolerance(op, points, facing, dtype))


@pytest.mark.double
def test_a_camera_without_distortion_is_the_pinhole(device, rng):
    pinhole = Camera(matrix=((900.0, 0.0, 511.5), (0.0, 900.0, 380.25), (0.0, 0.0, 1.0)))
    position, angles = rng.uniform(0, 1000, (3, 700)).astype(np.float32), np.array([-0.2, 0.0, 0.2], np.float32)
    given = np.zeros(position.shape, np.uint8)
    operations = [RangeImage(geometry=each) for each in (HEAD, dataclasses.replace(CALIBRATED, camera=pinhole))]
    made, same = (each(position, angles, given, device=device) for each in operations)
    for values, others in zip(made, same, strict=True):
        np.testing.assert_array_equal(values, others)
    folding = dataclasses.replace(TILTED_CAMERA, distortion=(-1.0, *(0.0,) * 13))
    op = RangeImage(geometry=dataclasses.replace(CALIBRATED, camera=folding))
    # The image of k1 = -1 ends at 2/3 of 3^-1/2; the samples are rows around the principal point.
    position = 511.5 + 910.0 * np.array([[0.1, 0.3, 0.42, 2.0, np.nan, -np.inf]]).repeat(381, 0).T[:, -1:]
    status = op(np.repeat(position, 381, 1), np.zeros(6), np.zeros((6, 381), np.uint8), device=device).status[:, -1]
    assert status.tolist() == [0, 0, 128, 128, 8, 8]


@pytest.mark.double
def test_a_point_of_the_scene_comes_back_from_where_the_camera_sees_it(device, rng):
    points = rng.uniform((-0.4, -0.3, 0.8), (0.4, 0.3, 2.0), (4, 50, 3))
    geometry = dataclasses.replace(
        HEAD, axis_direction=(0.0, 1.0, 0.0), axis_point=(0.1, 0.0, 0.0), sheet_normal=(1.0, 0.0, 0.0), sheet_offset=0.0
    )
    # One profile per point: the angle at which the sheet through the axis contains the point.
    for x, y, z in points.reshape(-1, 3)[:20]:
        angle = np.array([math.atan2(x - 0.1, z)])
        column, row = 511.5 + 900.0 * x / z, 380.25 + 900.0 * y / z
        seen = dataclasses.replace(geometry, principal_point_px=(511.5, 380.25 - row))
        made = RangeImage(geometry=seen)(np.array([[column]]), angle, np.zeros((1, 1), np.uint8), device=device)
        truth = np.array(geometry.scene_axes) @ (np.array([x, y, z]) - geometry.scene_origin)
        np.testing.assert_allclose([made.x[0, 0], made.y[0, 0], made.z[0, 0]], truth, atol=1e-11)


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_cannot_be_trusted_is_flagged_and_nan(device, variant):
    bad = np.array([np.nan, np.inf, -np.inf, 0.0, 0.0, 0.0, 0.0, 3e38], np.float32)
    given = np.array([0, 0, 1, 1, 2, 16, 18, 0], np.uint8)
    geometry = StraightTransport(g_axis=(3.0, 0.0, 0.0))
    made = RangeImage(geometry=geometry, variant=variant)(
        bad[None], np.zeros((1, 8), np.float32), np.zeros(1, np.float32), given[None], device=device
    )
    # Flags of samples with and without a value are kept; a result that overflows is NaN.
    assert made.status[0].tolist() == [8, 8, 1, 1, 2, 16, 18, 8]
    assert np.isfinite(made.z[0]).tolist() == [False] * 4 + [True] * 3 + [False]
    assert np.array_equal(np.isfinite(made.x), np.isfinite(made.z))


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("geometry", [TILTED, HEAD], ids=["straight", "rotating"])
def test_an_unknown_transport_spoils_its_profile_only(device, geometry, variant):
    profile = np.full((3, 20), 300.0 if geometry is HEAD else 0.01, np.float32)
    transport = geometry.transport(3).astype(np.float32)
    given = np.zeros(profile.shape, np.uint8)
    op = RangeImage(geometry=geometry, variant=variant)
    frames = (profile,) * geometry.inputs
    complete = op(*frames, transport, given, device=device)
    transport[1] = np.nan
    spoilt = op(*frames, transport, given, device=device)
    assert np.all(spoilt.status[1] == Status.NOT_FINITE)
    assert np.all(np.isnan(spoilt.x[1]))
    np.testing.assert_array_equal(spoilt.x[::2], complete.x[::2])


@pytest.mark.parametrize("variant", VARIANTS)
def test_limits_are_inclusive(device, variant):
    values = np.array([-0.5, -0.25, 0.0, 0.25, 0.5], np.float32)
    zero = np.zeros((1, 5), np.float32)
    for axis, limits in enumerate([(-0.25, 0.25), (-0.25, 0.25), (0.0, 0.25)]):
        bounds = [(-1.0, 1.0)] * 3
        bounds[axis] = limits
        op = RangeImage(geometry=StraightTransport(), limits=bounds, variant=variant)
        g, h = (values[None] if number == axis else zero for number in (0, 2))
        transport = values if axis == 1 else np.zeros(1, np.float32)
        g, h = (np.broadcast_to(each, (len(transport), 5)).copy() for each in (g, h))
        made = op(g, h, transport, np.zeros(g.shape, np.uint8), device=device)
        status, y = (made.status, made.y) if axis != 1 else (made.status.T, made.y.T)
        inside = (values >= limits[0]) & (values <= limits[1])
        np.testing.assert_array_equal(status, np.broadcast_to(np.where(inside, 0, 4), status.shape))
        np.testing.assert_array_equal(np.isnan(y), status != 0)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_sheet_through_the_pinhole_measures_nothing(device, variant):
    geometry = dataclasses.replace(HEAD, axis_point=(0.0, 0.0, 0.0), sheet_offset=0.0)
    position = np.linspace(0, 1000, 40, dtype=np.float32)[None]
    made = RangeImage(geometry=geometry, variant=variant)(
        position, np.zeros(1, np.float32), np.zeros(position.shape, np.uint8), device=device
    )
    assert np.all(made.status == Status.HORIZON)


@pytest.mark.parametrize("variant", VARIANTS)
def test_nothing_is_written_beyond_the_image(device, variant):
    shape, canary = (3, 37), 1234.5
    op = RangeImage(geometry=StraightTransport(), variant=variant)
    bound = op.bind(device, shape, np.float32)
    room = [cl.array.zeros(device.queue, (5, 37), np.float32) + canary for _ in range(3)]
    status = cl.array.zeros(device.queue, (5, 37), np.uint8) + 77
    # Only the first three profiles of larger arrays are written; the rest does not change.
    small = [cl.array.Array(device.queue, shape, each.dtype, data=each.base_data) for each in (*room, status)]
    bound(out=RangePoints(*small)).wait()
    for each in room:
        assert np.all(each.get()[3:] == canary)
        assert np.all(each.get()[:3] == 0)
    assert np.all(status.get()[3:] == 77)


@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(data=st.data(), shape=hnp.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=40))
def test_any_shape_and_any_number(data, shape):
    values = st.floats(width=32, allow_nan=True, allow_infinity=True, allow_subnormal=False)
    g = data.draw(hnp.arrays(np.float32, shape, elements=values))
    given = data.draw(hnp.arrays(np.uint8, shape, elements=st.sampled_from([0, 1, 2, 16, 32, 64])))
    transport = np.linspace(0, 1, shape[0], dtype=np.float32)
    results = [
        RangeImage(geometry=StraightTransport(), variant=variant)(g, g, transport, given, device=device)
        for device in Device.all()
        for variant in VARIANTS
    ]
    for made in results:
        good = (made.status & ~np.uint8(Status.SATURATED | Status.AMBIGUOUS)) == 0
        for values in made[:3]:
            np.testing.assert_array_equal(np.isfinite(values), good)
        np.testing.assert_array_equal(made.status, results[0].status)
        np.testing.assert_array_equal(made.x, np.where(good, g, np.nan))


def test_bound_and_device_arrays_give_the_same(device, rng):
    g, h = rng.uniform(-0.05, 0.05, (2, 4, 100)).astype(np.float32)
    transport, given = TILTED.transport(4).astype(np.float32), np.zeros((4, 100), np.uint8)
    op = RangeImage(geometry=TILTED)
    truth = op(g, h, transport, given, device=device)
    frames = [cl.array.to_device(device.queue, each) for each in (g, h, transport, given)]
    on_device = op(*frames)
    bound = op.bind(device, g.shape, g.dtype)
    bound(*frames).wait()
    for name in RangePoints._fields:
        np.testing.assert_array_equal(getattr(on_device, name).get(), getattr(truth, name))
        np.testing.assert_array_equal(getattr(bound.outputs, name).get(), getattr(truth, name))


@pytest.mark.double
def test_double_is_asked_for_by_precision(device):
    g = np.full((1, 3), 0.1, np.float32)
    op = RangeImage(geometry=StraightTransport(), precision="double")
    made = op(g, g, np.zeros(1, np.float32), np.zeros((1, 3), np.uint8), device=device)
    assert made.x.dtype == np.float64
    assert made.x[0, 0] == float(np.float32(0.1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"focal_length_px": 0.0}, "focal_length_px is 0.0, expected a number above 0"),
        ({"horizon": -1.0}, "horizon is -1.0"),
        ({"principal_point_px": (1.0,)}, "\\(column, row\\) has shape \\(1,\\), expected \\(2,\\)"),
        ({"axis_point": (0.0, math.nan, 0.0)}, "axis_point has a number that is not finite"),
        ({"axis_direction": (0.0, 0.0, 0.0)}, "axis_direction has length 0, expected a direction"),
        ({"sheet_normal": HEAD.axis_direction}, "normal lies along the axis"),
        ({"along": "row"}, "expected 'rows' or 'columns'"),
        ({"scene_axes": 5}, r"scene_axes has shape \(\), expected \(3, 3\)"),
        ({"scene_axes": ((1, 0, 0), (0, 1, 0), (0, 1, 0))}, "not three orthonormal vectors"),
        ({"camera": TILTED_CAMERA}, "has a camera and focal_length_px, principal_point_px or lens"),
        ({"focal_length_px": None}, "needs a camera, or focal_length_px and principal_point_px"),
    ],
)
def test_a_wrong_rotating_sheet_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(HEAD, **change)


def test_a_wrong_transport_is_refused():
    for name in ("g_axis", "origin", "direction"):
        with pytest.raises(ValueError, match=rf"StraightTransport.{name} has shape \(\), expected \(3,\)"):
            StraightTransport(**{name: 5})
    with pytest.raises(ValueError, match="direction has length inf, expected a direction"):
        StraightTransport(direction=(1.5e308, 1.5e308, 0.0))
    with pytest.raises(ValueError, match="lie in one plane"):
        StraightTransport(direction=(1.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="step is 0"):
        StraightTransport(step=0.0)
    np.testing.assert_array_equal(StraightTransport(step=-1.0, start=2.0).transport(3), [2.0, 1.0, 0.0])
    with pytest.raises(ValueError, match="has no step; give the encoder's positions"):
        StraightTransport().transport(3)
    with pytest.raises(ValueError, match="has no angle_step; give the encoder's angles"):
        dataclasses.replace(HEAD, angle_step=None).transport(3)
    with pytest.raises(ValueError, match="expected \\(lowest, highest\\) for x, y and z"):
        RangeImage(geometry=TILTED, limits=((0, 0), (0, 1), (0, 1)))


def test_wrong_input_is_refused(device):
    op = RangeImage(geometry=StraightTransport())
    g, transport, given = np.zeros((2, 3), np.float32), np.zeros(2, np.float32), np.zeros((2, 3), np.uint8)
    with pytest.raises(TypeError, match="float32 or float64 profiles, got int32"):
        op(g.astype(np.int32), g, transport, given, device=device)
    with pytest.raises(ValueError, match="takes \\(profiles, samples\\), got shape \\(6,\\)"):
        op(g.ravel(), g.ravel(), transport, given, device=device)
    with pytest.raises(ValueError, match="expected shape \\(2,\\), got \\(3,\\)"):
        op(g, g, np.zeros(3, np.float32), given, device=device)
    with pytest.raises(TypeError, match="expected 4 input arrays, got 3"):
        op(g, transport, given, device=device)


@pytest.mark.parametrize(
    "geometry", [TILTED, BENT, CALIBRATED, dataclasses.replace(HEAD, lens=Lens(k1=1e-8, centre=(4.0, 5.0)))]
)
def test_a_geometry_survives_its_table(geometry):
    assert type(geometry).from_dict(geometry.to_dict()) == geometry


def test_an_unknown_key_of_a_table_is_named():
    with pytest.raises(ValueError, match="unknown key 'angle'"):
        RotatingSheet.from_dict({**HEAD.to_dict(), "angle": 3})
