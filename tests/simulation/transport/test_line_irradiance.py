"""LineIrradiance on devices: closed forms, extremes, and inputs."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from canary import Guarded
from gpuvision.host import Device
from gpuvision.reference import line_irradiance as reference
from gpuvision.simulation.transport.line_irradiance import Irradiance, LineIrradiance, LitSegments
from gpuvision.status import Status

ON_DEVICES = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
VARIANTS = ("vector", "work_item")
TWO_WAYS = pytest.mark.parametrize("variant", VARIANTS)
PRECISIONS = pytest.mark.parametrize("precision", ["single", "double"])
# Corner, parallel plates, groove of 60 degrees, side wall; M = 1, L = 100, by quadrature in 30 digits.
SINE, COSINE = math.sin(math.pi / 3.0), 0.5
KNOWN = {
    "corner": (
        ((0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        lambda y, z: (0.0, y, z, 1.0, 0.0, 0.0),
        {
            (0.0, 0.01): 15.915494150034593,
            (0.0, 1.0): 0.15913902918897646,
            (0.0, 10.0): 0.0157579151576134,
            (0.0, 50.0): 0.00254647908947033,
            (0.0, 100.0): 0.000795774715459477,
            (5.0, 1.0): 0.006105469743739175,
            (20.0, 30.0): 0.0032502711318971138,
            (50.0, 100.0): 0.0005658842421045168,
        },
    ),
    "parallel": (
        ((-50.0, 0.0, 0.0), (50.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        lambda x, y, h: (x, y, h, 0.0, 0.0, -1.0),
        {
            (0.0, 0.0, 1.0): 0.4999983031617979,
            (0.0, 0.0, 10.0): 0.04983804814617278,
            (0.0, 0.0, 100.0): 0.00274907572123950,
            (50.0, 0.0, 10.0): 0.02498951564423367,
            (60.0, 0.0, 10.0): 0.00453435951184480,
            (0.0, 20.0, 10.0): 0.00433588655664168,
            (30.0, 40.0, 50.0): 0.00298725145336944,
        },
    ),
    "groove": (
        ((0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        lambda b, y: (b * COSINE, y, b * SINE, SINE, 0.0, -COSINE),
        {
            (0.01, 0.0): 35.16050316279494,
            (1.0, 0.0): 0.35159293645897377,
            (10.0, 0.0): 0.03502473673401216,
            (50.0, 0.0): 0.0060698502077860,
            (10.0, 5.0): 0.02394342149974045,
            (50.0, 30.0): 0.00335089628554996,
        },
    ),
    "side wall": (
        ((-50.0, 0.0, 0.0), (50.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        lambda x, z, d: (x, d, z, 0.0, -1.0, 0.0),
        {
            (0.0, 1.0, 1.0): 0.17677499927226142,
            (0.0, 10.0, 10.0): 0.01752291192105445,
            (40.0, 5.0, 20.0): 0.004373367335908006,
        },
    ),
}


def lit(*segments: Any, exitance: float = 1.0) -> LitSegments:
    """Return segments (start, end, normal)."""
    table = np.array(segments, float).reshape(-1, 3, 3)
    return LitSegments(table[:, :2], table[:, 2], np.full(len(table), exitance))


def pairs(rng: np.random.Generator, count: int) -> tuple[np.ndarray, LitSegments]:
    """Return random receivers and segments in a cube."""
    ends = rng.uniform(-1.0, 1.0, (count, 2, 3))
    normals = np.cross(ends[:, 1] - ends[:, 0], rng.normal(size=(count, 3)))
    receivers = np.concatenate([rng.uniform(-1.0, 1.0, (count, 3)), rng.normal(size=(count, 3))], axis=1)
    return receivers, LitSegments(ends, normals, rng.uniform(0.1, 2.0, count))


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a random rotation."""
    return np.linalg.qr(rng.normal(size=(3, 3)))[0]


def moved_scene(
    receivers: np.ndarray, segments: Any, rotation: np.ndarray, shift: Any
) -> tuple[np.ndarray, LitSegments]:
    """Return the same scene at another place."""
    receivers, table = np.array(receivers, float), np.array(segments, float).reshape(-1, 3, 3)
    there = np.concatenate([receivers[:, :3] @ rotation + shift, receivers[:, 3:] @ rotation], axis=1)
    return there, LitSegments(table[:, :2] @ rotation + shift, table[:, 2] @ rotation, np.ones(len(table)))


@functools.cache
def exact(receiver: bytes, ends: bytes, normal: bytes, exitance: float) -> tuple[float, float]:
    """Return the reference with 60 digits, once for all devices, kernel variants and precisions."""
    return reference.exact(np.frombuffer(receiver), np.frombuffer(ends).reshape(2, 3), np.frombuffer(normal), exitance)


def assert_exact(
    receivers: np.ndarray, segments: LitSegments, device: Device, variant: Any, precision: Any
) -> np.ndarray:
    """Check the documented bounds against 60 digits; receivers are repeated to fill strips."""
    each = [
        [
            exact(*(np.asarray(one, float).tobytes() for one in (receiver, ends, normal)), float(exitance))
            for ends, normal, exitance in zip(segments.ends, segments.normals, segments.exitance, strict=True)
        ]
        for receiver in receivers
    ]
    value, most = np.moveaxis(np.array(each), 2, 0)
    operation = LineIrradiance(segments=segments, precision=precision, variant=variant)
    result = operation(np.tile(receivers, (16, 1)), device=device)
    assert np.all(result.status == 0)
    bound = 2e-6 * most.sum(axis=1)
    if precision == "double":
        bound = np.sum(1e-14 * most * reach(receivers, segments), axis=1)
    error = np.abs(result.irradiance.reshape(16, -1) - value.sum(axis=1))
    assert np.all(error <= bound), f"{np.max(error / np.maximum(bound, 1e-300))} of the bound"
    return value


def reach(receivers: np.ndarray, segments: LitSegments) -> np.ndarray:
    """Return 1 + distance of the farther end / height over the lit surface: magnification of rounding."""
    d = receivers[:, None, None, :3] - segments.ends[None]
    return 1.0 + np.linalg.norm(d, axis=-1).max(axis=-1) / heights(receivers, segments)


def heights(receivers: np.ndarray, segments: LitSegments) -> np.ndarray:
    """Return the distances of receivers from the lit surfaces, (receivers, segments) [m]."""
    d = receivers[:, None, :3] - segments.ends[None, :, 0]
    return np.maximum(np.abs(np.sum(d * segments.normals, axis=-1)), 1e-300)


def by_segment(receivers: np.ndarray, segments: LitSegments) -> np.ndarray:
    """Return irradiance and E0 of each segment at each receiver by the reference, (2, segments, receivers)."""
    parts = (segments.ends[:, None], segments.normals[:, None], segments.exitance[:, None])
    each = [reference.irradiance(receivers, *one) for one in zip(*parts, strict=True)]
    return np.moveaxis(np.array(each), 1, 0)


# ---- the reference ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_closed_form_is_the_definition(rng: np.random.Generator) -> None:
    receivers, segments = pairs(rng, 16)
    for receiver, *one in zip(receivers, segments.ends, segments.normals, segments.exitance, strict=True):
        value, most = reference.exact(receiver, *one)
        assert abs(reference.by_definition(receiver, *one) - value) <= 1e-12 * most


@pytest.mark.slow
def test_the_quadrature_is_the_closed_form(rng: np.random.Generator) -> None:
    receivers, segments = pairs(rng, 100)
    for number in range(100):
        one = [each[number : number + 1] for each in (segments.ends, segments.normals, segments.exitance)]
        value, most = reference.irradiance(receivers, *one)
        exact = np.array([reference.exact(receiver, *(each[0] for each in one)) for receiver in receivers[:5]])
        np.testing.assert_allclose(value[:5], exact[:, 0], rtol=0, atol=1e-13 * (exact[:, 1].max() + 1e-300))
        np.testing.assert_allclose(most[:5], exact[:, 1], rtol=1e-12)


# ---- closed forms ----------------------------------------------------------------------------------------------


@pytest.mark.double
@TWO_WAYS
@PRECISIONS
@pytest.mark.parametrize("name", KNOWN)
def test_known_values(device: Device, name: str, variant: Any, precision: Any) -> None:
    segment, receiver, table = KNOWN[name]
    receivers = np.tile(np.array([receiver(*at) for at in table]), (4, 1))
    result = LineIrradiance(segments=lit(segment), precision=precision, variant=variant)(receivers, device=device)
    # The normal of the groove is rounded, which is magnified 1e2 times near its edge.
    tolerance = 5e-7 if precision == "single" else 1e-12
    np.testing.assert_allclose(result.irradiance, 4 * list(table.values()), rtol=tolerance)


@pytest.mark.double
@TWO_WAYS
@PRECISIONS
def test_any_geometry(
    device: Device, variant: Any, precision: Any, rng: np.random.Generator, draws: Callable[[int, int], int]
) -> None:
    receivers, segments = pairs(rng, draws(25, 60))  # each receiver with each segment
    value = assert_exact(receivers, segments, device, variant, precision)
    assert 0.1 < np.mean(value > 0.0) < 0.6


@pytest.mark.double
@TWO_WAYS
def test_many_pairs_against_the_quadrature(device: Device, variant: Any, rng: np.random.Generator) -> None:
    _, segments = pairs(rng, 37)
    receivers = pairs(rng, 1013)[0]
    value, most = reference.irradiance(receivers, segments.ends, segments.normals, segments.exitance)
    for precision, tolerance in (("single", 2e-6), ("double", 1e-12)):
        result = LineIrradiance(segments=segments, precision=precision, variant=variant)(receivers, device=device)
        assert np.all(np.abs(result.irradiance - value) <= tolerance * most)


@pytest.mark.double
@TWO_WAYS
@PRECISIONS
def test_segments_that_lie_alike(device: Device, variant: Any, precision: Any, rng: np.random.Generator) -> None:
    """Segments on two surfaces, directions equal up to rounding, rotated and shifted; each near some receivers."""
    start = np.column_stack([rng.uniform(-0.1, 0.1, (41, 2)), np.zeros(41)])
    ends = np.stack([start, start + rng.uniform(0.01, 0.1, (41, 1)) * [1.0, 0.0, 0.0]], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (41, 1))
    ends[::3], normals[::3] = ends[::3][:, :, [0, 2, 1]], [0.0, 1.0, 0.0]
    rotation = random_rotation(rng)
    segments = LitSegments(ends @ rotation + 0.3, normals @ rotation, np.ones(41))
    places = ends[:, 0] + rng.uniform(1e-4, 1e-2, (41, 3)) * normals + [1e-3, 1e-3, 1e-3]
    receivers = np.hstack([places @ rotation + 0.3, rng.normal(size=(41, 3))])
    frames = segments.tables(np.dtype(np.float32))[1]
    assert len(frames) < 8
    assert_exact(receivers[:8], segments, device, variant, precision)


# ---- extremes --------------------------------------------------------------------------------------------------

FLOOR = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


@pytest.mark.double
@TWO_WAYS
@PRECISIONS
@pytest.mark.parametrize("distance", [1e-1, 1e-3, 1e-6, 1e-9])
def test_at_a_millionth_of_its_length(
    device: Device, variant: Any, precision: Any, distance: float, rng: np.random.Generator
) -> None:
    """Receivers above the middle and the ends of a segment, and beyond; rotated, far away; also in single."""
    receivers = [
        (x, y * distance, distance, 0.3, 0.2, -1.0) for x in (0.0, 0.5, 1.0, 1.0 + distance) for y in (0.0, 1.0)
    ]
    receivers += [(1.5, 0.0, distance, -1.0, 0.0, 0.0), (-0.25, distance, distance, 0.9, 0.1, -0.3)]
    for shift in (0.0, 1.0):
        assert_exact(*moved_scene(np.array(receivers), FLOOR, random_rotation(rng), shift), device, variant, precision)
    assert_exact(np.array(receivers, np.float32), lit(FLOOR), device, variant, precision)


@TWO_WAYS
@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.double)])
def test_positions_without_doubles(
    device: Device, variant: Any, alike: bool, dtype: Any, rng: np.random.Generator
) -> None:
    """Two floats keep the digits of positions where single precision would lose all of them."""
    slow = copy.copy(device)
    slow.has_fast_double = False
    receivers = [(x, 0.0, h, 0.3, 0.2, -1.0) for x in (0.2, 0.5, 1.0) for h in (1e-6, 1e-5, 1e-3)]
    scene = [(np.add(FLOOR[0], by), np.add(FLOOR[1], by), FLOOR[2]) for by in rng.uniform(-0.1, 0.1, (19, 3))]
    if not alike:  # each in a frame of its direction
        scene = [(start, start + rng.normal(size=3) * [1.0, 1.0, 0.0], normal) for start, _, normal in scene]
    rounded, segments = moved_scene(np.array(receivers), [FLOOR, *scene], random_rotation(rng), 1.0)
    rounded = rounded.astype(dtype)
    frames = len(segments.tables(np.dtype(np.float32))[1])
    assert frames == (1 if alike else 20)
    value, most = reference.irradiance(rounded.astype(float), segments.ends, segments.normals, segments.exitance)
    operation = LineIrradiance(segments=segments, precision="single", variant=variant)
    result = operation(np.tile(rounded, (16, 1)), device=slow)
    if variant == "work_item":
        assert "TWO_FLOAT_POSITIONS" in operation.launch(slow, rounded.shape, np.dtype(dtype)).defines
    worst = most * np.max(reach(rounded.astype(float), segments), axis=1)
    error = np.abs(result.irradiance.reshape(16, -1) - value)
    assert np.all(error <= 2e-6 * most + 2.0**-42 * worst), f"{np.max(error / most)} of the whole light"


@pytest.mark.double
@TWO_WAYS
@PRECISIONS
def test_grazing(device: Device, variant: Any, precision: Any, rng: np.random.Generator) -> None:
    """Angles of a millionth of a radian above the lit surface, and above the receiver's plane."""
    low = [(0.5, 0.3, 0.3 * angle, 0.0, -1.0, 0.0) for angle in (1e-1, 1e-3, 1e-6)]
    assert np.all(assert_exact(np.array(low), lit(FLOOR), device, variant, precision) > 0.0)
    tilted = [(x, 0.3, 0.3, 0.0, -1.0, angle + 1.0) for x in (0.5, 2.0) for angle in (1e-3, 1e-6, 0.0, -1e-6)]
    assert_exact(np.array(tilted), lit(FLOOR), device, variant, precision)
    assert_exact(*moved_scene(np.array(low + tilted), FLOOR, random_rotation(rng), 0.3), device, variant, precision)


@pytest.mark.double
@TWO_WAYS
@PRECISIONS
def test_end_on(device: Device, variant: Any, precision: Any) -> None:
    """Receivers beyond an end, close to the line, where the common form loses all digits; relative error."""
    beyond = [(1.0 + t, 0.0, height, -1.0, 0.0, 0.0) for t in (1e-3, 1e-1, 1.0, 10.0, 1e4) for height in (1e-5, 1e-2)]
    receivers = np.array(beyond)
    value = assert_exact(receivers, lit(FLOOR), device, variant, precision)[:, 0]
    result = LineIrradiance(segments=lit(FLOOR), precision=precision, variant=variant)(receivers, device=device)
    np.testing.assert_allclose(result.irradiance, value, rtol=2e-6 if precision == "single" else 1e-9)


@pytest.mark.double
@TWO_WAYS
@PRECISIONS
def test_lengths_a_million_to_one(device: Device, variant: Any, precision: Any, rng: np.random.Generator) -> None:
    lengths = (1e-6, 1e-3, 1.0, 1e3)
    segments = lit(*(((0.0, 0.0, 0.0), (length, 0.0, 0.0), (0.0, 0.0, 1.0)) for length in lengths))
    directions = rng.normal(size=(12, 3))
    distances = np.tile([1e-6, 1e-3, 1.0, 100.0], 3)[:, None]
    places = np.abs(directions / np.linalg.norm(directions, axis=1, keepdims=True)) * distances
    receivers = np.concatenate([places, [0.5, 0.0, 0.0] - places], axis=1)
    for number in range(4):
        one = LitSegments(segments.ends[[number]], segments.normals[[number]], np.ones(1))
        assert_exact(receivers, one, device, variant, precision)


@pytest.mark.double
@TWO_WAYS
@PRECISIONS
def test_through_the_receivers_plane(device: Device, variant: Any, precision: Any, rng: np.random.Generator) -> None:
    """Parts behind the receiver's plane do not count, wherever the plane cuts the segment."""
    cuts = np.concatenate([rng.uniform(0.0, 1.0, 12), [1e-6, 1.0 - 1e-6, 0.0, 1.0, -1e-6, 1.0 + 1e-6]])
    receivers = np.column_stack([cuts, 0.0 * cuts + 0.01, 0.0 * cuts + 0.02, np.tile([[0.5, -1.0, 0.5]], (18, 1))])
    receivers[::2, 3:] = (-0.7, 0.4, -0.2)
    assert_exact(receivers, lit(FLOOR), device, variant, precision)
    upright = np.column_stack([cuts, 0.0 * cuts, 0.0 * cuts + 0.3, np.tile([[1.0, 0.0, 0.0]], (18, 1))])
    assert_exact(upright, lit(FLOOR), device, variant, precision)
    assert_exact(*moved_scene(upright, FLOOR, random_rotation(rng), 0.7), device, variant, precision)


@pytest.mark.double
@TWO_WAYS
@PRECISIONS
def test_in_the_lit_plane_and_behind(device: Device, variant: Any, precision: Any) -> None:
    """Receivers on the segment, on its line, beside it, or behind the surface get no light and no flag."""
    dark = [
        (0.5, 0.0, 0.0, 0.0, 0.0, 1.0),
        (0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
        (2.0, 0.0, 0.0, -1.0, 0.0, 0.0),
        (0.5, 0.1, 0.0, 0.0, -1.0, 0.0),
        (0.5, 0.1, -0.1, 0.0, 0.0, 1.0),
        (0.5, 0.1, 0.1, 0.0, 0.0, 1.0),
    ]
    result = LineIrradiance(segments=lit(FLOOR), precision=precision, variant=variant)(
        np.tile(dark, (8, 1)), device=device
    )
    np.testing.assert_array_equal(result.irradiance, 0.0)
    np.testing.assert_array_equal(result.status, 0)


@pytest.mark.double
@TWO_WAYS
def test_no_light(device: Device, variant: Any) -> None:
    receivers = np.tile((0.5, 0.1, 0.1, 0.0, 0.0, -1.0), (20, 1))
    point = (FLOOR[0], FLOOR[0], FLOOR[2])
    for segments in (lit(), lit(point), lit(FLOOR, exitance=0.0)):
        result = LineIrradiance(segments=segments, variant=variant)(receivers, device=device)
        np.testing.assert_array_equal(result.irradiance, 0.0)
    both = LineIrradiance(segments=lit(point, FLOOR), variant=variant)(receivers, device=device)
    alone = LineIrradiance(segments=lit(FLOOR), variant=variant)(receivers, device=device)
    np.testing.assert_array_equal(both.irradiance, alone.irradiance)


@TWO_WAYS
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_not_finite(device: Device, variant: Any, dtype: Any) -> None:
    """NaN is flagged even if the receiver would get no light; neighbours are bit-equal."""
    good = np.tile(np.array((0.5, 0.1, 0.1, 0.0, 0.0, -1.0), dtype), (48, 1))
    wrong = good.copy()
    for number, value in enumerate((math.nan, math.inf, -math.inf)):
        wrong[6 * number + np.arange(6), np.arange(6)] = value
    wrong[18, 3:] = 0.0
    wrong[19] = (0.5, 0.1, -0.1, math.nan, 0.0, 1.0)
    operation = LineIrradiance(segments=lit(FLOOR), variant=variant)
    result, other = operation(wrong, device=device), operation(good, device=device)
    np.testing.assert_array_equal(result.status, 20 * [Status.NOT_FINITE] + 28 * [0])
    np.testing.assert_array_equal(np.isnan(result.irradiance), result.status != 0)
    np.testing.assert_array_equal(result.irradiance[20:], other.irradiance[20:])


@pytest.mark.double
@TWO_WAYS
def test_neighbours_do_not_count(device: Device, variant: Any, rng: np.random.Generator) -> None:
    """A receiver's result is bit-equal next to far, near and clipped neighbours."""
    receivers, segments = pairs(rng, 64)
    operation = LineIrradiance(segments=segments, variant=variant, precision="single")
    alone = [operation(np.tile(each, (16, 1)), device=device).irradiance[0] for each in receivers]
    np.testing.assert_array_equal(operation(receivers, device=device).irradiance, alone)


# ---- inputs ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 31, 63, 64, 65, 257, 20_011])
@TWO_WAYS
def test_sizes_and_canaries(device: Device, count: int, variant: Any, rng: np.random.Generator) -> None:
    _, segments = pairs(rng, 3)
    receivers = pairs(rng, count)[0].astype(np.float32)
    guarded = Guarded(Irradiance(np.empty(count, np.float32), np.empty(count, np.uint8)))
    LineIrradiance(segments=segments, variant=variant)(receivers, device=device, out=guarded.out)
    guarded.assert_intact()
    value, largest = by_segment(receivers, segments)
    error = 2e-6 + 2.0**-42 * reach(receivers, segments).T
    assert np.all(np.abs(guarded.out.irradiance - value.sum(axis=0)) <= np.sum(error * largest, axis=0))
    assert np.all(guarded.out.status == 0)


@pytest.mark.double
@ON_DEVICES
@given(shape=st.lists(st.integers(1, 20), max_size=3), variant=st.sampled_from(VARIANTS), seed=st.integers(0, 9))
@example(shape=[19, 16, 6], variant="vector", seed=3)  # a receiver 3e-5 of its distance above a segment's surface
def test_any_shape(device: Device, shape: list[int], variant: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, segments = pairs(rng, 5)
    receivers = pairs(rng, math.prod(shape))[0].reshape(*shape, 6)
    result = LineIrradiance(segments=segments, variant=variant)(receivers, device=device)
    assert result.irradiance.shape == result.status.shape == tuple(shape)
    receivers = receivers.reshape(-1, 6)
    value, largest = by_segment(receivers, segments)
    # Error of the quadrature plus the documented error of the operation.
    bound = np.sum(largest * (1e-12 + 1e-14 * reach(receivers, segments).T), axis=0)
    assert np.all(np.abs(result.irradiance.ravel() - value.sum(axis=0)) <= bound)


@pytest.mark.double
def test_device_arrays(device: Device, rng: np.random.Generator) -> None:
    receivers, segments = pairs(rng, 33)
    operation = LineIrradiance(segments=segments)
    on_device = operation(cl.array.to_device(device.queue, receivers))
    np.testing.assert_array_equal(on_device.irradiance.get(), operation(receivers, device=device).irradiance)


@pytest.mark.double
def test_wrong_inputs(device: Device) -> None:
    operation = LineIrradiance(segments=lit(FLOOR))
    with pytest.raises(TypeError, match="float32 or float64 receivers, got int64"):
        operation(np.zeros((4, 6), np.int64), device=device)
    with pytest.raises(ValueError, match=r"\(\.\.\., 6\), place and normal, got shape \(4, 3\)"):
        operation(np.zeros((4, 3)), device=device)
    with pytest.raises(ValueError, match="precision must be"):
        LineIrradiance(segments=lit(FLOOR), precision="half")(np.zeros((4, 6)), device=device)
    with pytest.raises(TypeError, match="expected LitSegments"):
        LineIrradiance(segments=FLOOR)


@pytest.mark.parametrize(
    ("segments", "error", "message"),
    [
        (([[[0, 0, 0], [1, 0, 0]]], [[0, 0, 1]], "a"), TypeError, "exitance must be numbers"),
        (([[[0, 0, 0], [1, 0, 0]]], [[0, 0, 1]], [[1.0]]), ValueError, r"exitance has shape \(1, 1\), expected \(m,\)"),
        (([[0, 0, 0, 1, 0, 0]], [[0, 0, 1]], [1.0]), ValueError, r"ends has shape \(1, 6\), expected \(1, 2, 3\)"),
        (([[[0, 0, 0], [1, 0, 0]]], [[0, 0]], [1.0]), ValueError, r"normals has shape \(1, 2\), expected \(1, 3\)"),
        (([[[0, 0, 0], [1, 0, math.nan]]], [[0, 0, 1]], [1.0]), ValueError, "segment 0 has ends that are not finite"),
        (([[[0, 0, 0], [1, 0, 0]]], [[0, 0, 0]], [1.0]), ValueError, "segment 0 has no normal"),
        (([[[0, 0, 0], [1, 0, 0]]], [[0.1, 0, 1]], [1.0]), ValueError, "segment 0 does not lie in its surface"),
        (([[[0, 0, 0], [1, 0, 0]]], [[0, 0, 1]], [-1.0]), ValueError, "segment 0 has a negative exitance"),
    ],
)
def test_wrong_segments(segments: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        LitSegments(*segments)
