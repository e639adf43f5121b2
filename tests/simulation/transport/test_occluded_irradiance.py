"""OccludedIrradiance on devices: against rays in float64; extremes; inputs."""

from __future__ import annotations

import copy
import functools
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from canary import Guarded
from gpuvision.host import Device
from gpuvision.reference import line_irradiance as closed_form
from gpuvision.reference import occluded_irradiance as reference
from gpuvision.reference.occluded_irradiance import comb, single, soup
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments
from gpuvision.simulation.transport.occluded_irradiance import (
    SELECTION_BLOCK,
    OccludedIrradiance,
    StripIrradiance,
    segment_rows,
)
from gpuvision.status import Status
from tiers import variants_of

ON_DEVICES = settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
# Builds take most of the time: each variant has one of the two types here; other tests use the default of the device.
WAYS = pytest.mark.parametrize(
    ("variant", "dtype"), [("vector", np.float32), ("vector", np.float64), ("work_item", np.float32)]
)
INPUTS = pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.double)])
FLOOR = np.array([-0.5, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0])
NO_TRIANGLES = np.zeros((0, 3, 3))


def segments_of(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return random segments in the cube, each with a perpendicular normal and a random exitance."""
    ends = single(rng.uniform(-1.0, 1.0, (count, 6)))
    normals = np.cross(ends[:, 3:] - ends[:, :3], rng.normal(size=(count, 3)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.hstack([ends, single(normals), single(rng.uniform(0.5, 2.0, (count, 1)))])


def receivers_of(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return single(np.concatenate([rng.uniform(-1.0, 1.0, (*shape, 3)), rng.normal(size=(*shape, 3))], axis=-1))


def light_of(
    corners: np.ndarray, receivers: Any, segments: Any, device: Device, weights: Any = None, **how: Any
) -> Any:
    """Return the irradiance by OccludedIrradiance of receivers (strips, n, 6), in their type."""
    dtype = receivers.dtype
    operation = OccludedIrradiance(scene=Scene(corners), segments=len(segments), **how)
    if weights is None:
        weights = np.ones((*receivers.shape[:2], 2))
    return operation(receivers, weights.astype(dtype), np.ascontiguousarray(segments, dtype), device=device)


def subdivided(mesh: Any, times: int) -> Any:
    for _ in range(times):
        mesh = mesh.subdivide()
    return mesh


# ---- light -----------------------------------------------------------------------------------------------------


@functools.cache
def lit_soup(count: int) -> tuple[np.ndarray, ...]:
    """Return triangles, segments, receivers, and their light by rays."""
    rng = np.random.default_rng(count)
    corners = soup(rng, count, 0.6 if count < 20 else 0.3)
    segments, receivers = segments_of(rng, 5), receivers_of(rng, 3, 23)
    return corners, segments, receivers, *reference.irradiance(corners, receivers.reshape(-1, 6), segments, 1e-5)


@WAYS
@pytest.mark.parametrize("count", [3, 60])
def test_light_as_rays_say(device: Device, variant: Any, dtype: Any, count: int) -> None:
    corners, segments, receivers, value, largest = lit_soup(count)
    result = light_of(corners, receivers.astype(dtype), segments, device, variant=variant, clearance=1e-5)
    assert result.irradiance.dtype == dtype
    assert not result.status.any()
    error = np.abs(result.irradiance.ravel() - value) / np.where(largest > 0.0, largest, 1.0)
    if dtype == np.float64:
        assert error.max() <= 1e-9
    else:
        # For the few receivers near an edge of a triangle, rounding moves shadows more.
        assert np.quantile(error, 0.95) <= 5e-6
        assert error.max() <= 2e-3
    free = light_of(NO_TRIANGLES, receivers.astype(dtype), segments, device, variant=variant).irradiance
    assert np.mean(np.abs(result.irradiance - free) > 0.01 * free) > 0.2


@functools.cache
def lit_board() -> tuple[np.ndarray, ...]:
    """Return the board of the benchmarks: receivers (1, 16, 6), segments, corners, and the light by rays."""
    pytest.importorskip("embreex", reason="the extra 'test' is not installed")
    from gpuvision.profiling.occluded_irradiance import Board

    board = Board.of()
    everywhere = board.receivers.astype(float).reshape(-1, 6)
    segments = segment_rows(board.segments)
    facing = [
        np.any(((each[:3] - segments[:, :3]) * segments[:, 6:9]).sum(axis=1) > 1e-4)
        and np.any((segments[:, :6].reshape(-1, 2, 3) - each[:3]) @ each[3:] > 1e-4)
        for each in everywhere
    ]
    receivers = everywhere[facing][::30][:16]
    value, largest = reference.irradiance(board.scene.corners, receivers, segments, 1e-6)
    return board.scene.corners, receivers[None], segments, value, largest


@WAYS
def test_light_on_a_board_as_rays_say(device: Device, variant: Any, dtype: Any) -> None:
    corners, receivers, segments, value, largest = lit_board()
    result = light_of(corners, receivers.astype(dtype), segments, device, variant=variant, clearance=1e-6).irradiance[0]
    assert np.all(np.abs(result - value) <= (2e-5 if dtype == np.float32 else 1e-10) * largest)
    assert 0.2 < np.mean(value > 0.0) < 0.9


@pytest.mark.double
@ON_DEVICES
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 30), size=st.sampled_from([0.1, 0.3, 3.0]))
def test_light_in_any_soup(device: Device, seed: int, count: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    corners, segments, receivers = soup(rng, count, size), segments_of(rng, 2), receivers_of(rng, 1, 5)
    result = light_of(corners, receivers, segments, device, clearance=1e-7)
    value, largest = reference.irradiance(corners, receivers[0], segments, 1e-7)
    assert np.all(np.abs(result.irradiance[0] - value) <= 1e-8 * largest)


def room(kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the inside of a convex surface with receivers and lit segments on it: no occlusion."""
    rng = np.random.default_rng(5)
    mesh = trimesh.creation.icosphere(3) if kind == "sphere" else subdivided(trimesh.creation.box((1.0, 0.8, 0.6)), 3)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [0.1, 0.7, 0.3]))
    weights = rng.dirichlet(np.ones(3), len(mesh.faces))
    places = np.einsum("nk,nkd->nd", weights, mesh.triangles)
    receivers = np.hstack([places, -mesh.face_normals])[rng.permutation(len(places))[:96]].reshape(2, 48, 6)
    lit = rng.permutation(len(mesh.faces))[:6]
    ends = mesh.triangles[lit, :2].copy()
    ends[3:, 0] = mesh.triangles[lit[3:], 2] * 0.3 + ends[3:, 1] * 0.7
    rows = np.hstack([ends.reshape(-1, 6), -mesh.face_normals[lit], np.ones((6, 1))])
    return np.asarray(mesh.triangles), receivers, rows


@WAYS
@pytest.mark.parametrize("kind", ["box", "sphere"])
def test_the_surfaces_that_they_lie_on_hide_nothing(device: Device, variant: Any, dtype: Any, kind: str) -> None:
    corners, receivers, segments = room(kind)
    seen = light_of(corners, receivers.astype(dtype), segments, device, variant=variant)
    free = light_of(corners, receivers.astype(dtype), segments, device, variant=variant, visibility="none")
    # Except for rounding, where a segment ends in another face.
    np.testing.assert_allclose(seen.irradiance, free.irradiance, rtol=64 * float(np.finfo(dtype).eps))
    assert np.mean(seen.irradiance > 0.0) > 0.7


@WAYS
def test_at_the_foot_of_a_wall(device: Device, variant: Any, dtype: Any) -> None:
    """A line ends at a wall, receivers on the wall from 1e-9 of the line's length: closed form, no occlusion."""
    floor, wall = trimesh.creation.box((2.0, 2.0, 0.2)), trimesh.creation.box((0.2, 2.0, 2.0))
    meshes = [floor.apply_translation((0.0, 0.0, -0.1)), wall.apply_translation((-0.1, 0.0, 0.0))]
    corners = np.concatenate([subdivided(each, 2).triangles for each in meshes])
    height = np.array([1e-9, 1e-7, 1e-5, 1e-3, 0.1, 0.5])
    receivers = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0], (1, 6, 1))
    receivers[0, :, 2] = height
    segments = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0]])
    result = light_of(corners, receivers.astype(dtype), segments, device, variant=variant)
    expected = 1.0 / (2.0 * np.pi * height * (height**2 + 1.0))
    np.testing.assert_allclose(result.irradiance[0], expected, rtol=5e-6 if dtype == np.float32 else 1e-12)


@WAYS
def test_a_wall_between_is_dark(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    """No light passes a closed surface, also through cuts at its edges."""
    corners = single(trimesh.creation.icosphere(3).triangles * 0.4)
    receivers = np.zeros((1, 40, 6))
    receivers[0, :, :2], receivers[0, :, 2] = rng.uniform(-0.01, 0.01, (40, 2)), 0.45
    receivers[0, ::2, :2] = 0.0
    receivers[0, :, 5] = -1.0
    segments = np.array([[-0.3, 0.0, -0.45, 0.3, 0.0, -0.45, 0.0, 0.0, 1.0, 1.0]])
    result = light_of(corners, receivers.astype(dtype), segments, device, variant=variant)
    np.testing.assert_array_equal(result.irradiance, 0.0)
    np.testing.assert_array_equal(result.status, 0)


@pytest.mark.double
@WAYS
def test_light_through_a_comb(device: Device, variant: Any, dtype: Any) -> None:
    """More shadows than the kernel can store: the segment is processed in parts."""
    teeth = 300
    at = (np.arange(teeth) + 0.25) / teeth - 0.5
    visible = np.sort(np.concatenate([[-0.5, 0.5], at, at + 0.5 / teeth])).reshape(-1, 2)
    receivers = np.array([[[0.0, 0.0, 1.0, 0.0, 0.0, -1.0]]], dtype)
    parts = np.tile(FLOOR, (len(visible), 1))
    parts[:, 0], parts[:, 3] = visible.T
    corners = comb(teeth)
    corners[..., 1] *= np.where(corners[..., 1] > 0.0, 1e3, 1.0)
    result = light_of(corners, receivers, FLOOR[None], device, variant=variant)
    expected = light_of(NO_TRIANGLES, receivers.astype(np.float64), parts, device, visibility="none")
    assert result.status[0, 0] == Status.OK
    np.testing.assert_allclose(result.irradiance, expected.irradiance, rtol=1e-4 if dtype == np.float32 else 2e-6)


@pytest.mark.double
@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_rays_come_to_the_same_in_first_order(device: Device, variant: Any, rng: np.random.Generator) -> None:
    corners, segments, receivers = soup(rng, 60, 0.3), segments_of(rng, 5), receivers_of(rng, 4, 64)
    exact = light_of(corners, receivers, segments, device).irradiance
    errors = []
    for samples in (16, 256, 4096):
        sampled = light_of(corners, receivers, segments, device, variant=variant, visibility="rays", samples=samples)
        errors.append(np.mean(np.abs(sampled.irradiance - exact)) / np.mean(exact))
    assert errors[2] < 2e-4
    assert errors[1] < 0.15 * errors[0]
    assert errors[2] < 0.15 * errors[1]


@pytest.mark.double
@WAYS
def test_without_visibility_as_line_irradiance(
    device: Device, variant: Any, dtype: Any, rng: np.random.Generator
) -> None:
    receivers, rows = receivers_of(rng, 3, 37), segments_of(rng, 19)
    segments = LitSegments(rows[:, :6].reshape(-1, 2, 3), rows[:, 6:9], rows[:, 9])
    np.testing.assert_array_equal(segment_rows(segments)[:, 9], rows[:, 9])
    room = segment_rows(segments, 24)
    result = light_of(soup(rng, 20), receivers.astype(dtype), room, device, variant=variant, visibility="none")
    expected = LineIrradiance(segments=segments)(receivers, device=device).irradiance
    tolerance = 4e-6 if dtype == np.float32 else 1e-13
    np.testing.assert_allclose(result.irradiance, expected, rtol=0, atol=tolerance * expected.max())


@WAYS
def test_currents(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    receivers, segments, weights = receivers_of(rng, 5, 70), segments_of(rng, 3), rng.normal(size=(5, 70, 2))
    result = light_of(soup(rng, 20), receivers.astype(dtype), segments, device, weights=weights, variant=variant)
    sums = np.einsum("sn,snk->ks", result.irradiance.astype(float), weights)
    sizes = np.einsum("sn,snk->ks", result.irradiance.astype(float), np.abs(weights))
    for current, expected, size in zip((result.left, result.right), sums, sizes, strict=True):
        assert np.all(np.abs(current - expected) <= 4.0 * np.finfo(dtype).eps * size)


@WAYS
def test_metres_and_micrometres(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    """A scene scaled by 1e-6 has the same power, a million times the irradiance, bit-equal."""
    corners, receivers = soup(rng, 60, 0.3), receivers_of(rng, 2, 40).astype(dtype)
    segments, small = segments_of(rng, 4), 2.0**-20
    result = light_of(corners, receivers, segments, device, variant=variant)
    receivers[..., :3] *= small
    segments[:, :6] *= small
    tiny = light_of(corners * small, receivers, segments, device, variant=variant)
    np.testing.assert_array_equal(tiny.irradiance * dtype(small), result.irradiance)
    assert np.count_nonzero(result.irradiance) > 10


@pytest.mark.double
@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_a_part_of_micrometres_in_a_room_of_metres(device: Device, variant: Any) -> None:
    """A box of 20 um on the floor has the same shadow as in a scene of its size (double; single cannot resolve it)."""
    part = trimesh.creation.box((2e-5, 2e-5, 2e-5)).apply_translation((3e-5, 0.0, 1e-5)).triangles
    room = trimesh.creation.box((8.0, 6.0, 4.0)).apply_translation((0.0, 0.0, 2.0)).triangles
    receivers = np.zeros((1, 32, 6))
    receivers[0, :, 0], receivers[0, :, 2], receivers[0, :, 3] = 1e-4, np.linspace(1e-6, 1e-4, 32), -1.0
    segments = np.array([[-2e-4, 0.0, 0.0, 1.5e-5, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0]])
    alone = light_of(part, receivers, segments, device, variant=variant, clearance=1e-9).irradiance
    both = light_of(
        np.concatenate([part, room]), receivers, segments, device, variant=variant, clearance=1e-9
    ).irradiance
    free = light_of(room, receivers, segments, device, variant=variant, clearance=1e-9).irradiance
    np.testing.assert_allclose(both, alone, rtol=0, atol=1e-7 * free.max())
    assert alone.max() > 0.05 * free.max()
    assert np.mean(alone < 0.5 * free) > 0.3


@WAYS
def test_faces_that_coincide(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    corners, receivers, segments = soup(rng, 60, 0.3), receivers_of(rng, 2, 40).astype(dtype), segments_of(rng, 4)
    once = light_of(corners, receivers, segments, device, variant=variant)
    twice = light_of(np.repeat(corners, 3, axis=0)[:, ::-1], receivers, segments, device, variant=variant)
    np.testing.assert_allclose(twice.irradiance, once.irradiance, rtol=64 * float(np.finfo(dtype).eps), atol=1e-7)


@pytest.mark.double
@WAYS
@pytest.mark.parametrize("angle", [1e-2, 1.7e-4, 1e-6])
def test_grazing(device: Device, variant: Any, dtype: Any, angle: float) -> None:
    """A wall on the floor hides half of the line from a receiver close to the floor; 89.99 degrees is 1.7e-4."""
    wall = trimesh.creation.box((0.01, 1.0, 0.2)).apply_translation((0.5, 0.5, 0.1)).triangles
    floor = trimesh.creation.box((2.0, 2.0, 0.1)).apply_translation((0.0, 0.0, -0.05)).triangles
    receivers = np.array([[[1.0, 0.0, angle, -1.0, 0.0, 0.0]]], dtype)
    segments = np.array([[0.0, -0.5, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 1.0]])
    half = segments.copy()
    half[0, 4] = 0.0
    corners = np.concatenate([wall, floor])
    seen = light_of(corners, receivers, segments, device, variant=variant, clearance=1e-7).irradiance[0, 0]
    free = light_of(NO_TRIANGLES, receivers, half, device, visibility="none").irradiance[0, 0]
    assert seen == pytest.approx(free, rel=1e-5 if dtype == np.float32 else 1e-12)


# ---- pairs of receivers and segments -------------------------------------------------------------------------------


def without_fast_doubles(device: Device) -> Device:
    """Return the device as one whose doubles are slow: the work-item variant takes two floats."""
    slow = copy.copy(device)
    slow.has_fast_double = False
    return slow


@pytest.mark.parametrize("each", [1, 16, 33])
def test_more_segments_than_a_tile(device: Device, each: int, rng: np.random.Generator) -> None:
    """Pairs of several tiles: as the vector variant, as the sum of three parts, and equal in each run."""
    corners, segments = soup(rng, 150, 0.3), segments_of(rng, 150)
    receivers = receivers_of(rng, 3, each).astype(np.float32)
    results = [light_of(corners, receivers, segments, device, variant="work_item") for _ in range(3)]
    for result in results[1:]:
        for one, other in zip(results[0], result, strict=True):
            np.testing.assert_array_equal(one, other)
    together = results[0].irradiance
    parts = [light_of(corners, receivers, segments[k : k + 50], device, variant="work_item") for k in (0, 50, 100)]
    np.testing.assert_allclose(together, sum(part.irradiance for part in parts), rtol=1e-6)
    free = light_of(NO_TRIANGLES, receivers, segments, device, variant="work_item").irradiance
    assert np.mean(together < 0.9 * free) > 0.5
    if device.takes_vectors:
        vectors = light_of(corners, receivers, segments, device, variant="vector").irradiance
        assert np.all(np.abs(together - vectors) <= 2e-5 * free)
    away = segments.copy()
    away[:, 9] = 0.0
    dark = light_of(corners, receivers, away, device, variant="work_item")
    assert not any(array.any() for array in dark)


@pytest.mark.parametrize("count", [3, 60])
@INPUTS
def test_light_with_slow_doubles(device: Device, count: int, dtype: Any) -> None:
    corners, segments, receivers, value, largest = lit_soup(count)
    slow, given = without_fast_doubles(device), receivers.astype(dtype)
    result = light_of(corners, given, segments, slow, variant="work_item", precision="single", clearance=1e-5)
    assert result.irradiance.dtype == np.float32
    if device.kind != "rusticl":
        operation = OccludedIrradiance(scene=Scene(corners), segments=5, precision="single", variant="work_item")
        assert "TWO_FLOAT_POSITIONS" in operation.launch(slow, given.shape, given.dtype).defines
    assert not result.status.any()
    error = np.abs(result.irradiance.ravel() - value) / np.where(largest > 0.0, largest, 1.0)
    assert np.quantile(error, 0.95) <= 5e-6
    assert error.max() <= 2e-3
    sums = result.irradiance.astype(float).sum(axis=1)
    for current in (result.left, result.right):
        np.testing.assert_allclose(current, sums, rtol=4 * np.finfo(np.float32).eps)


@pytest.mark.parametrize(
    ("exponent", "dtype"),
    [
        *((power, np.float32) for power in (0, 60, -60)),
        *(pytest.param(power, np.float64, marks=pytest.mark.double) for power in (0, 400, -400)),
    ],
)
def test_positions_with_slow_doubles(device: Device, exponent: int, dtype: Any, rng: np.random.Generator) -> None:
    """Two floats keep the digits of positions a millionth of the length from a segment; normals of any length."""
    if device.kind == "rusticl":
        pytest.skip("positions are floats on rusticl")
    start, along = rng.uniform(0.5, 1.5, 3).astype(np.float32), rng.normal(size=3).astype(np.float32)
    normal = np.cross(along, rng.normal(size=3)).astype(np.float32)
    rows = np.array([[*start, *(start + along), *(normal * dtype(2.0) ** exponent), 1.0]], dtype).astype(float)
    begin, step, normal = rows[0, :3], rows[0, 3:6] - rows[0, :3], rows[0, 6:9] * 2.0**-exponent
    normal -= step * (step @ normal) / (step @ step)
    normal /= np.linalg.norm(normal)
    # Rounding to float32 moves the receivers: as many as lie above the segment stay.
    heights = np.repeat([3e-7, 1e-6, 1e-5, 1e-3], 16)
    places = (begin + rng.uniform(0.1, 0.9, (64, 1)) * step + heights[:, None] * normal).astype(dtype).astype(float)
    facing = -normal + 0.3 * rng.normal(size=(64, 3))
    receivers = np.hstack([places, facing.astype(dtype).astype(float)])
    receivers = receivers[(places - begin) @ normal > 1e-7]
    assert len(receivers) > 40
    value, most = closed_form.irradiance(receivers, rows[:, :6].reshape(1, 2, 3), normal[None], rows[:, 9])
    result = light_of(
        NO_TRIANGLES,
        receivers[None].astype(dtype),
        rows,
        without_fast_doubles(device),
        variant="work_item",
        precision="single",
        visibility="none",
    )
    far = np.linalg.norm(receivers[:, None, :3] - rows[:, :6].reshape(1, 2, 3), axis=-1).max(axis=1)
    reach = far / ((receivers[:, :3] - begin) @ normal)
    error = np.abs(result.irradiance[0] - value)
    assert np.all(error <= (2e-6 + 2.0**-41 * (1.0 + reach)) * most), f"{np.max(error / most)} of the whole light"


def test_light_of_short_segments_with_slow_doubles(device: Device) -> None:
    """The light of a segment of 1e-12 m is 2^-28 of the light of a segment of 2^-12 m: no square underflows."""
    receivers = np.zeros((1, 4, 6), np.float32)
    receivers[0, :, 2], receivers[0, :, 5] = (0.25, 0.5, 0.75, 1.0), -1.0
    slow = without_fast_doubles(device)
    lights = []
    for length in (2.0**-12, 2.0**-40):
        row = FLOOR * np.where(np.arange(10) < 6, length, 1.0)
        result = light_of(NO_TRIANGLES, receivers, row[None], slow, variant="work_item", visibility="none")
        assert not result.status.any()
        lights.append(result.irradiance / np.float32(length))
    np.testing.assert_allclose(lights[1], lights[0], rtol=5e-6)
    assert lights[0].min() > 0.1


@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_more_shadows_than_the_smallest_part_holds(device: Device, variant: Any) -> None:
    """The 44 teeth of a comb hide intervals of 1e-6 within 1e-4: AMBIGUOUS, with the light of the rest."""
    corners = comb(44)
    corners[..., 0] = (corners[..., 0] + 0.3) * 5.5e-5
    receivers = np.zeros((1, 20, 6), np.float32)
    receivers[0, :, :3], receivers[0, :, 5] = (0.0, 0.0, 1.0), -1.0
    receivers[0, 17, 5] = 1.0
    segments = np.tile(FLOOR, (60, 1))
    segments[:, 9] = 0.0
    segments[40] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0)
    result = light_of(corners, receivers, segments, device, variant=variant, clearance=1e-3)
    turned_away = np.arange(20) == 17
    np.testing.assert_array_equal(result.status[0], np.where(turned_away, Status.OK, Status.AMBIGUOUS))
    free = light_of(NO_TRIANGLES, receivers, segments, device, variant=variant).irradiance
    assert np.all(result.irradiance[0, ~turned_away] > 0.0)
    np.testing.assert_allclose(result.irradiance, free, rtol=1e-3)


# ---- segments on one line --------------------------------------------------------------------------------------


def on_one_line(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return parts of an inclined line in any order, adjacent and overlapping ones, each with its exitance."""
    start, along = rng.uniform(-1.0, 0.0, 3), rng.uniform(0.5, 1.0, 3)
    cuts = np.sort(rng.uniform(0.0, 1.0, (count, 2)) * 0.8 / count + np.arange(count)[:, None] / count, axis=1)
    cuts[1, 0], cuts[3, 1] = cuts[0, 1], cuts[4, 1]
    normal = np.cross(along, rng.normal(size=3))
    ends = start + cuts[..., None] * along
    rows = np.column_stack([ends.reshape(-1, 6), np.tile(normal, (count, 1)), rng.uniform(0.5, 2.0, count)])
    return rng.permutation(rows)


@functools.cache
def lit_line(count: int, receivers: int, dtype: Any) -> tuple[np.ndarray, ...]:
    """Return triangles, receivers, segments on one line (also dark and reversed ones), and their light by rays."""
    rng = np.random.default_rng(count)
    corners, places, rows = soup(rng, 30, 0.4), receivers_of(rng, 1, receivers), on_one_line(rng, count)
    rows[2, 9], rows[4, 6:9], rows[5, :6] = 0.0, -rows[4, 6:9], np.roll(rows[5, :6], 3)
    rows = rows.astype(dtype).astype(float)
    return corners, places, rows, *reference.irradiance(corners, places[0], rows, 1e-5)


@WAYS
@pytest.mark.parametrize(("count", "receivers"), [(6, 19), (35, 7)])
def test_segments_on_one_line(device: Device, variant: Any, dtype: Any, count: int, receivers: int) -> None:
    """Grouped processing agrees with rays to each segment, also for more segments than a group holds."""
    corners, places, rows, value, largest = lit_line(count, receivers, dtype)
    result = light_of(corners, places.astype(dtype), rows, device, variant=variant, clearance=1e-5).irradiance[0]
    error = np.abs(result - value) / np.where(largest > 0.0, largest, 1.0)
    assert error.max() <= (1e-9 if dtype == np.float64 else 2e-3)
    assert np.quantile(error, 0.9) <= 5e-6
    assert np.mean(value > 0.0) > 0.3
    free = light_of(NO_TRIANGLES, places.astype(dtype), rows, device, variant=variant).irradiance[0]
    assert np.mean(np.abs(result - free) > 0.01 * free) > 0.2


# ---- selected -----------------------------------------------------------------------------------------------------


def selected_of(
    corners: Any, receivers: Any, segments: Any, lists: Any, device: Device, variant: Any, room: int = 0
) -> Any:
    starts = np.cumsum([0, *map(len, lists)]).astype(np.int32)
    selected = np.concatenate([*lists, np.zeros(room)]).astype(np.int32)
    operation = OccludedIrradiance(
        scene=Scene(corners), segments=len(segments), selected=len(selected), variant=variant
    )
    dtype = receivers.dtype
    weights = np.ones((*receivers.shape[:2], 2), dtype)
    return operation(receivers, weights, segments.astype(dtype), starts, selected, device=device)


@pytest.mark.parametrize(("variant", "strips"), [("vector", 2), ("vector", 200), ("work_item", 2)])
def test_selected_segments(device: Device, variant: Any, strips: int, rng: np.random.Generator) -> None:
    """Each block has a list of segments: tested for visibility, taken without test, or omitted.

    With 200 strips a work-item of the vector variant has several strips (on fewer than 25 cores).
    """
    corners, segments = soup(rng, 40, 0.3), segments_of(rng, 6)
    receivers = receivers_of(rng, strips, 37).astype(np.float32)
    seen = [light_of(corners, receivers, segments[[k]], device, variant=variant).irradiance for k in range(6)]
    free = [
        light_of(corners, receivers, segments[[k]], device, variant=variant, visibility="none").irradiance
        for k in range(6)
    ]
    lists = [rng.permutation(6)[: rng.integers(0, 7)] for _ in range(3 * strips)]
    lists = [np.where(rng.random(len(some)) < 0.3, ~some, some) for some in lists]
    result = selected_of(corners, receivers, segments, lists, device, variant, room=5)
    for number, some in enumerate(lists):
        strip, block = divmod(number, 3)
        part = np.s_[strip, SELECTION_BLOCK * block : SELECTION_BLOCK * (block + 1)]
        expected = sum((seen[k][part] if k >= 0 else free[~k][part] for k in some), np.zeros_like(seen[0][part]))
        np.testing.assert_allclose(result.irradiance[part], expected, rtol=1e-5, atol=1e-9)
    assert not result.status.any()


@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_selected_indices_without_a_segment(device: Device, variant: Any, rng: np.random.Generator) -> None:
    segments, receivers = segments_of(rng, 3), receivers_of(rng, 1, 64).astype(np.float32)
    lists = [[0, 1], [2, 3], [~5], [2]]
    result = selected_of(soup(rng, 3), receivers, segments, lists, device, variant)
    np.testing.assert_array_equal(result.status[0], np.repeat([0, Status.OUT_OF_RANGE, Status.OUT_OF_RANGE, 0], 16))
    np.testing.assert_array_equal(np.isnan(result.irradiance), result.status != 0)


def test_lists_beyond_the_selection(device: Device, rng: np.random.Generator) -> None:
    """A list begins at 0 at the earliest, and ends with the selection at the latest; others spoil their own block."""
    segments, receivers = segments_of(rng, 3).astype(np.float32), receivers_of(rng, 1, 64).astype(np.float32)
    selected, bad = np.array([0, 2], np.int32), Status.OUT_OF_RANGE
    cases = {
        (-1, 2, 2, 2, 3): [bad, 0, 0, bad],
        (0, 1, 2, 2, 2): [0, 0, 0, 0],
        (-1, -1, 0, 3, 2): [bad, bad, bad, 0],
        (0, 0, 2, 1, 7): [0, 0, 0, bad],
    }
    for variant in variants_of(device):
        operation = OccludedIrradiance(scene=Scene(NO_TRIANGLES), segments=3, selected=2, variant=variant)
        for starts, expected in cases.items():
            numbers = np.array(starts, np.int32)
            result = operation(receivers, np.ones((1, 64, 2), np.float32), segments, numbers, selected, device=device)
            np.testing.assert_array_equal(result.status[0], np.repeat(expected, 16))
            np.testing.assert_array_equal(np.isnan(result.irradiance[0]), np.repeat(expected, 16) != 0)


@pytest.mark.parametrize("is_slow", [False, True])
def test_long_lists_with_a_wrong_index(device: Device, is_slow: bool, rng: np.random.Generator) -> None:
    """Lists of more than two tiles: a wrong index in the second tile spoils the light of its own block only."""
    plain, device = device, without_fast_doubles(device) if is_slow else device
    corners, segments = soup(rng, 40, 0.3), segments_of(rng, 150)
    receivers = receivers_of(rng, 1, 48).astype(np.float32)
    wrong = np.arange(150)
    wrong[100] = 150
    lists = [rng.permutation(150), wrong, ~np.arange(150)]
    result = selected_of(corners, receivers, segments, lists, device, "work_item")
    np.testing.assert_array_equal(result.status[0], np.repeat([0, Status.OUT_OF_RANGE, 0], 16))
    np.testing.assert_array_equal(np.isnan(result.irradiance), result.status != 0)
    seen = light_of(corners, receivers, segments, device, variant="work_item").irradiance[0]
    free = light_of(corners, receivers, segments, plain, visibility="none").irradiance[0]
    np.testing.assert_allclose(result.irradiance[0, :16], seen[:16], rtol=1e-5)
    np.testing.assert_allclose(result.irradiance[0, 32:], free[32:], rtol=1e-5)
    assert np.mean(seen < 0.99 * free) > 0.5


# ---- inputs ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_what_is_not_finite(device: Device, variant: Any, rng: np.random.Generator) -> None:
    corners, segments, receivers = soup(rng, 20, 0.3), segments_of(rng, 2), receivers_of(rng, 2, 40).astype(np.float32)
    good = light_of(corners, receivers, segments, device, variant=variant)
    wrong = receivers.copy()
    wrong[0, np.arange(6), np.arange(6)] = np.nan
    wrong[0, 6 + np.arange(6), np.arange(6)] = np.inf
    wrong[0, 20, 3:] = 0.0
    wrong[1, 39, 3:] = 0.0
    result = light_of(corners, wrong, segments, device, variant=variant)
    np.testing.assert_array_equal(result.status[0, :12], Status.NOT_FINITE)
    assert result.status[0, 20] == result.status[1, 39] == Status.NO_DATA
    np.testing.assert_array_equal(np.isnan(result.irradiance), result.status != 0)
    fine = result.status == 0
    np.testing.assert_array_equal(result.irradiance[fine], good.irradiance[fine])
    assert np.isnan(result.left[0])
    assert result.left[1] == pytest.approx(good.irradiance[1, :39].sum(), rel=1e-6)
    for row, column in ((0, 2), (1, 7), (0, 9)):
        broken = segments.copy()
        broken[row, column] = np.nan
        result = light_of(corners, receivers, broken, device, variant=variant)
        np.testing.assert_array_equal(result.status, Status.NOT_FINITE)
        assert np.isnan(result.irradiance).all()


@pytest.mark.parametrize("variant", ["vector", "work_item"])
@pytest.mark.parametrize(("strips", "each"), [(0, 5), (1, 1), (2, 15), (2, 17), (3, 64), (1, 130)])
def test_sizes_and_canaries(device: Device, variant: Any, strips: int, each: int, rng: np.random.Generator) -> None:
    """In addition, a receiver's light does not depend on its neighbours."""
    corners, segments = soup(rng, 60, 0.3), segments_of(rng, 3).astype(np.float32)
    receivers, weights = receivers_of(rng, strips, each).astype(np.float32), np.ones((strips, each, 2), np.float32)
    operation = OccludedIrradiance(scene=Scene(corners), segments=3, variant=variant)
    size = np.zeros((strips, each), np.float32)
    like = StripIrradiance(size, np.empty(strips, np.float32), np.empty(strips, np.float32), size.astype(np.uint8))
    guarded = Guarded(like)
    operation(receivers, weights, segments, device=device, out=guarded.out)
    guarded.assert_intact()
    alone = operation(receivers.reshape(-1, 1, 6), weights.reshape(-1, 1, 2), segments, device=device).irradiance
    np.testing.assert_allclose(guarded.out.irradiance.ravel(), alone.ravel(), rtol=1e-6)
    np.testing.assert_allclose(guarded.out.left, guarded.out.irradiance.sum(axis=1), rtol=1e-6)


@pytest.mark.double
def test_no_light_and_no_triangles(device: Device, rng: np.random.Generator) -> None:
    receivers, dark = receivers_of(rng, 1, 20), segments_of(rng, 4)
    dark[0, 9], dark[1, 9], dark[2, 3:6], dark[3] = 0.0, -1.0, dark[2, :3], 0.0
    result = light_of(NO_TRIANGLES, receivers, dark, device)
    np.testing.assert_array_equal(result.irradiance, 0.0)
    np.testing.assert_array_equal(result.status, 0)


def test_one_bound_instance_for_all_profiles(device: Device, rng: np.random.Generator) -> None:
    corners, receivers = soup(rng, 60, 0.3), receivers_of(rng, 2, 20).astype(np.float32)
    operation = OccludedIrradiance(scene=Scene(corners), segments=3)
    bound = operation.bind(device, receivers.shape, receivers.dtype)
    bound.inputs[0].set(receivers)
    bound.inputs[1].set(np.ones((2, 20, 2), np.float32))
    for _ in range(3):
        segments = segments_of(rng, 3).astype(np.float32)
        bound.inputs[2].set(segments)
        result = bound.run()
        expected = operation(receivers, np.ones((2, 20, 2), np.float32), segments, device=device)
        np.testing.assert_array_equal(result.irradiance.get(), expected.irradiance)
    given = [cl.array.to_device(device.queue, each) for each in (receivers, np.ones((2, 20, 2), np.float32), segments)]
    np.testing.assert_array_equal(operation(*given).left.get(), expected.left)


@pytest.mark.double
def test_wrong_parameters(device: Device) -> None:
    scene = Scene(NO_TRIANGLES)
    with pytest.raises(TypeError, match=r"OccludedIrradiance\.scene is None, expected a Scene"):
        OccludedIrradiance(scene=None, segments=1)
    with pytest.raises(TypeError, match=r"segments must be a whole number, got 1\.5"):
        OccludedIrradiance(scene=scene, segments=1.5)
    with pytest.raises(ValueError, match="samples is 0, expected 1 to"):
        OccludedIrradiance(scene=scene, segments=1, samples=0)
    with pytest.raises(ValueError, match="visibility is 'some'"):
        OccludedIrradiance(scene=scene, segments=1, visibility="some")
    with pytest.raises(ValueError, match=r"receivers \(strips, n, 6\), n at least 1, got shape \(4, 6\)"):
        light_of(NO_TRIANGLES, np.zeros((4, 6)), np.zeros((1, 10)), device, weights=np.zeros((4, 2)))
    with pytest.raises(TypeError, match="takes float32 or float64 receivers, got int64"):
        light_of(NO_TRIANGLES, np.zeros((1, 4, 6), np.int64), np.zeros((1, 10)), device)
    with pytest.raises(ValueError, match="precision must be"):
        light_of(NO_TRIANGLES, np.zeros((1, 4, 6)), np.zeros((1, 10)), device, precision="half")
    with pytest.raises(ValueError, match="2 segments do not fit into 1 rows"):
        segment_rows(LitSegments([FLOOR[:6].reshape(2, 3)] * 2, [[0, 0, 1]] * 2, [1.0, 1.0]), 1)
