"""ClosestHit and AnyHit on devices: against all triangles in float64, against Embree, and without gaps at edges."""

from __future__ import annotations

import copy
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from canary import Guarded
from gpuvision.host import Device, flags
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.reference import rays as reference
from gpuvision.simulation.scene.rays import AnyHit, ClosestHit
from gpuvision.simulation.scene.scene import Scene
from gpuvision.status import Status

ON_DEVICES = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
WAYS = pytest.mark.parametrize(
    ("variant", "dtype"),
    [(variant, dtype) for variant in ("vector", "work_item") for dtype in (np.float32, np.float64)],
)
TRIANGLE = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])


def soup(rng: np.random.Generator, count: int, size: float = 0.2) -> np.ndarray:
    """Return random triangles in a cube; all coordinates are exact in single precision."""
    corners = rng.uniform(-1.0, 1.0, (count, 1, 3)) + rng.normal(0.0, size, (count, 3, 3))
    return corners.astype(np.float32).astype(np.float64)


def some_rays(rng: np.random.Generator, count: int = 500) -> np.ndarray:
    return np.hstack([rng.uniform(-1.5, 1.5, (count, 3)), rng.normal(0.0, 1.0, (count, 3))])


def far_from_edges(corners: np.ndarray, rays: np.ndarray, by: float = 1e-4) -> np.ndarray:
    """Return whether rays are so far from all edges that rounding does not change the hits."""
    _, u, v = reference.crossings(corners, rays[:, :3], rays[:, 3:])
    return (np.minimum.reduce([np.abs(u), np.abs(v), np.abs(1.0 - u - v)]) > by).all(axis=1)


def eps_of(dtype: Any) -> float:
    return float(np.finfo(dtype).eps)


def assert_closest(corners: np.ndarray, rays: np.ndarray, hits: Any) -> None:
    triangle, distance, u, v = reference.closest(corners, rays.astype(np.float64))
    np.testing.assert_array_equal(hits.triangle, triangle)
    np.testing.assert_array_equal(hits.status, np.where(triangle < 0, Status.NO_DATA, 0))
    # Some roundings of coordinates up to 4 m, over the sine of incidence and the size of the triangle.
    hit = triangle >= 0
    one, two = (corners[triangle, n] - corners[triangle, 0] for n in (1, 2))
    along = rays[:, 3:] / np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
    normal = np.cross(one, two)
    thin = np.abs(np.sum(along * normal, axis=1))
    longest = np.maximum(np.linalg.norm(one, axis=1), np.linalg.norm(two, axis=1)) + 1e-9
    bound = 64.0 * eps_of(hits.distance.dtype) * longest**2 / thin
    assert np.all(np.abs(hits.distance - distance)[hit] <= bound[hit])
    for got, expected in zip(hits.barycentric.T, (u, v), strict=True):
        assert np.all(np.abs(got - expected)[hit] <= (bound / longest)[hit])
    assert np.isnan(hits.distance[~hit]).all()
    assert np.isnan(hits.barycentric[~hit]).all()


@WAYS
@pytest.mark.parametrize("count", [1, 2, 16, 17, 300, 3000])
def test_closest_as_every_triangle_says(
    device: Device, variant: Any, dtype: Any, count: int, rng: np.random.Generator
) -> None:
    corners = soup(rng, count, 0.5 if count < 20 else 0.2)
    rays = some_rays(rng, 300).astype(dtype)
    rays = rays[far_from_edges(corners, rays.astype(np.float64), 3e-5)]
    hits = ClosestHit(scene=Scene(corners), variant=variant)(rays, device=device)
    assert hits.distance.dtype == dtype
    assert_closest(corners, rays, hits)
    assert len(rays) > 50
    batch = ClosestHit(scene=Scene(corners), variant=variant)(rays[:30].reshape(2, 3, 5, 6), device=device)
    for one, other in zip(batch, hits, strict=True):
        np.testing.assert_array_equal(one, other[:30].reshape(2, 3, 5, *other.shape[1:]))


@WAYS
@pytest.mark.parametrize("count", [1, 17, 3000])
def test_any_as_every_triangle_says(
    device: Device, variant: Any, dtype: Any, count: int, rng: np.random.Generator
) -> None:
    corners = soup(rng, count)
    segments = rng.uniform(-1.0, 1.0, (400, 6)).astype(dtype)
    expected = reference.occluded(corners, segments.astype(np.float64))
    sure = far_from_edges(corners, np.hstack([segments[:, :3], segments[:, 3:] - segments[:, :3]]).astype(float), 3e-5)
    sure &= reference.occluded(corners, segments.astype(float), -1e-4) == reference.occluded(
        corners, segments.astype(float), 1e-4
    )
    result = AnyHit(scene=Scene(corners), variant=variant)(segments, device=device)
    np.testing.assert_array_equal(result.occluded[sure], expected[sure])
    assert not result.status.any()
    assert sure.mean() > 0.5


@pytest.mark.double
@ON_DEVICES
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 80), size=st.sampled_from([1e-3, 0.1, 2.0]))
def test_any_soup(device: Device, seed: int, count: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    corners, rays = soup(rng, count, size), some_rays(rng, 97)
    hits = ClosestHit(scene=Scene(corners))(rays, device=device)
    triangle = reference.closest(corners, rays)[0]
    sure = far_from_edges(corners, rays, 1e-9)
    np.testing.assert_array_equal(hits.triangle[sure], triangle[sure])


@WAYS
def test_occlusion_does_not_depend_on_the_order(
    device: Device, variant: Any, dtype: Any, rng: np.random.Generator
) -> None:
    """Rays to neighbouring targets test the leaf that occluded the previous ray first; unrelated rays do not."""
    corners = soup(rng, 300)
    origins, ends = rng.uniform(-1.0, 1.0, (2, 40, 1, 3))
    targets = ends + np.linspace(0.0, 1.0, 50)[:, None] * rng.uniform(-1.0, 1.0, (40, 1, 3))
    fans = np.concatenate([np.broadcast_to(origins, targets.shape), targets], axis=2).reshape(-1, 6).astype(dtype)
    any_hit = AnyHit(scene=Scene(corners), variant=variant)
    occluded = any_hit(fans, device=device).occluded
    order = rng.permutation(len(fans))
    np.testing.assert_array_equal(any_hit(fans[order], device=device).occluded, occluded[order])
    off_edges = far_from_edges(corners, np.hstack([fans[:, :3], fans[:, 3:] - fans[:, :3]]).astype(float), 3e-5)
    near, far = (reference.occluded(corners, fans.astype(float), by) for by in (-1e-4, 1e-4))
    sure = off_edges & (near == far)
    np.testing.assert_array_equal(occluded[sure], near[sure])
    assert 0.2 < occluded.mean() < 0.9
    assert sure.mean() > 0.5


@WAYS
def test_rays_to_edges_and_surfaces_do_not_depend_on_the_order(
    device: Device, variant: Any, dtype: Any, rng: np.random.Generator
) -> None:
    """Rays that end on or pass an edge, a corner or a surface: rounding decides, whichever leaf is tested first."""
    corners = soup(rng, 300)
    weights = rng.dirichlet(np.ones(3), (80, 24))
    weights[:, :8, 2] = 0.0  # on an edge
    weights[:, :2] = (1.0, 0.0, 0.0)  # on a corner
    weights /= weights.sum(axis=2, keepdims=True)
    targets = weights @ corners[rng.integers(0, 300, 80)]
    origins = rng.uniform(-1.0, 1.0, (80, 1, 3)) * rng.choice([1.0, 30.0], (80, 1, 1))
    ends = origins + rng.choice([1.0, 1.0 + 1e-5, 1.5], (80, 24, 1)) * (targets - origins)
    fans = np.concatenate([np.broadcast_to(origins, ends.shape), ends], axis=2).reshape(-1, 6).astype(dtype)
    any_hit = AnyHit(scene=Scene(corners), variant=variant)
    occluded = any_hit(fans, device=device).occluded
    for order in (np.arange(len(fans))[::-1], rng.permutation(len(fans))):
        again = any_hit(np.ascontiguousarray(fans[order]), device=device).occluded
        np.testing.assert_array_equal(again, occluded[order])
    assert 0.3 < occluded.mean() < 0.99


def test_as_embree_says(device: Device, rng: np.random.Generator) -> None:
    rtcore_scene = pytest.importorskip("embreex.rtcore_scene", reason="the extra 'test' is not installed")
    construction = pytest.importorskip("embreex.mesh_construction", reason="the extra 'test' is not installed")
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=61, minor_sections=43)
    scene = Scene.of(mesh)
    embree = rtcore_scene.EmbreeScene()
    construction.TriangleMesh(embree, scene.corners.astype(np.float32))
    segments = rng.uniform(-1.5, 1.5, (50_000, 6)).astype(np.float32)
    origins = np.ascontiguousarray(segments[:, :3])
    directions = np.ascontiguousarray(segments[:, 3:] - origins)
    ones = np.ones(len(segments), np.float32)
    theirs = embree.run(origins, directions, dists=ones, query="OCCLUDED") == 0
    occluded = AnyHit(scene=scene)(segments, device=device).occluded != 0
    # Silhouettes and ends in the surface are decided by rounding.
    assert np.mean(occluded != theirs) < 2e-4
    hits = ClosestHit(scene=scene)(np.hstack([origins, directions]), device=device)
    nearest = embree.run(origins, directions, query="INTERSECT")
    assert np.mean(hits.triangle != nearest) < 2e-4
    assert 0.2 < occluded.mean() < 0.8


@WAYS
def test_nothing_slips_through_an_edge(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    """Rays from inside a closed surface, aimed exactly at its corners and at points of its edges."""
    mesh = trimesh.creation.icosphere(3)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [0.1, 0.7, 0.3]))
    corners = mesh.vertices.astype(np.float32).astype(float)[mesh.faces]
    weights = rng.choice([0.0, 0.5, 0.25, 1.0 / 3.0, 1e-6], (len(corners), 1))
    targets = np.concatenate([corners[:, 0], corners[:, 0] * (1 - weights) + corners[:, 1] * weights])
    origins = np.concatenate([np.zeros((1, 3)), rng.uniform(-0.3, 0.3, (7, 3))])[rng.integers(0, 8, len(targets))]
    rays = np.hstack([origins, targets - origins]).astype(dtype)
    hits = ClosestHit(scene=Scene(corners), variant=variant)(rays, device=device)
    assert not hits.status.any()
    segments = np.hstack([origins, origins + 2.0 * (targets - origins)]).astype(dtype)
    assert AnyHit(scene=Scene(corners), variant=variant)(segments, device=device).occluded.all()


BOXES_MET = """#include "common/bvh.h"
kernel void boxes_met(global const real *rays, global const real *nodes, global uint *met) {
    const size_t i = get_global_id(0);
    global const real *at = rays + 6 * i;
    const bvh_ray ray = bvh_ray_of(at[0], at[1], at[2], at[3], at[4], at[5], 0, INFINITY);
    met[i] = bvh_met(&ray, INFINITY, nodes + 6 * WIDTH * i);
}
"""


@WAYS
def test_boxes_that_a_ray_touches_at_an_edge(
    device: Device, variant: Any, dtype: Any, rng: np.random.Generator, tmp_path: Path
) -> None:
    """The ray hits an edge of the box exactly (integer coordinates): rounding must not make the slab test miss."""
    if dtype == np.float64 and not device.has_double:
        pytest.skip(f"{device.label} has no doubles")
    count, pairs = 301, list(itertools.permutations(range(3), 2))
    origin, times = rng.integers(-1000, 1000, (count, 3)), rng.integers(1, 50, (count, 1))
    direction = (2 * rng.integers(1, 500, (count, 3)) + 1) * rng.choice([-1, 1], (count, 3))
    edge, sign = origin + times * direction, np.sign(direction)
    boxes = np.tile(np.repeat([np.inf, -np.inf], 3)[:, None], (count, 1, 16))
    for number, (enters, leaves) in enumerate(pairs):
        # The ray enters the slab of one axis where it leaves the slab of another axis; the third slab contains the
        # whole ray.
        near, end = edge - 4000 * sign, edge + 4000 * sign
        near[:, enters], end[:, leaves] = edge[:, enters], edge[:, leaves]
        late = near.copy()
        late[:, enters] += (sign * np.maximum(np.abs(times * direction) // 64, 1))[:, enters]
        for box, start in ((number, near), (6 + number, late)):
            boxes[:, :3, box], boxes[:, 3:, box] = np.minimum(start, end), np.maximum(start, end)
    (tmp_path / "boxes_met.cl").write_text(BOXES_MET)
    defines = {"BVH_DEPTH": 1, **flags(REAL_IS_DOUBLE=dtype == np.float64, VECTOR_VARIANT=variant == "vector")}
    kernel = build(device, tmp_path, "boxes_met.cl", defines, include_folders=[KERNEL_FOLDER]).boxes_met
    rays = cl.array.to_device(device.queue, np.hstack([origin, direction]).astype(dtype))
    nodes = cl.array.to_device(device.queue, boxes.astype(dtype))
    hit = cl.array.zeros(device.queue, count, np.uint32)
    kernel(device.queue, (count,), None, rays.data, nodes.data, hit.data)
    np.testing.assert_array_equal(hit.get(), 0b111111)


@WAYS
def test_axis_parallel_rays_on_the_grid_of_a_plane(device: Device, variant: Any, dtype: Any) -> None:
    """Rays along each axis, both ways, aimed exactly at the shared corners and edges of coplanar triangles."""
    steps = np.arange(9) / 8.0
    a, b = (each.ravel() for each in np.meshgrid(steps[:-1], steps[:-1]))
    zero, side = np.zeros_like(a), 0.125
    square = [np.stack([a + i * side, b + j * side, zero], axis=1) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
    plane = np.concatenate([np.stack([square[0], square[n], square[n + 1]], axis=1) for n in (1, 2)])
    inner = np.stack(np.meshgrid(np.arange(1, 16) / 16.0, np.arange(1, 16) / 16.0), axis=-1).reshape(-1, 2)
    for axis in range(3):
        corners = np.roll(plane, axis + 1, axis=2)
        for sign in (1.0, -1.0):
            rays = np.zeros((len(inner), 6))
            rays[:, :3] = np.roll(np.column_stack([inner, np.full(len(inner), -sign)]), axis + 1, axis=1)
            rays[:, 3 + axis] = 2.0 * sign
            hits = ClosestHit(scene=Scene(corners), variant=variant)(rays.astype(dtype), device=device)
            assert not hits.status.any()
            np.testing.assert_allclose(hits.distance, 1.0, rtol=4 * eps_of(dtype))
            rays[:, 3:] *= -1.0
            assert (
                ClosestHit(scene=Scene(corners), variant=variant)(rays.astype(dtype), device=device).triangle == -1
            ).all()


@WAYS
def test_a_ray_in_the_plane_passes(device: Device, variant: Any, dtype: Any) -> None:
    in_plane = np.array([[-1.0, 0.25, 0.0, 1.0, 0.0, 0.0], [0.25, 3.0, 0.0, 0.0, -1.0, 0.0]], dtype)
    # A thousandth of a radian above and below it: a hit at 0.25, and no hit.
    grazing = np.array([[-0.75, 0.25, 1e-3, 1.0, 0.0, -1e-3], [-0.75, 0.25, 1e-3, 1.0, 0.0, 1e-3]], dtype)
    operation = ClosestHit(scene=Scene(TRIANGLE), variant=variant)
    assert (operation(in_plane, device=device).status == Status.NO_DATA).all()
    hits = operation(grazing, device=device)
    np.testing.assert_array_equal(hits.triangle, [0, -1])
    np.testing.assert_allclose(hits.barycentric[0], [0.25, 0.25], atol=1e3 * 4 * eps_of(dtype))


@WAYS
def test_an_empty_scene(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    scene = Scene(np.zeros((0, 3, 3)))
    hits = ClosestHit(scene=scene, variant=variant)(some_rays(rng, 33).astype(dtype), device=device)
    assert (hits.triangle == -1).all()
    assert (hits.status == Status.NO_DATA).all()
    assert not AnyHit(scene=scene, variant=variant)(some_rays(rng, 33).astype(dtype), device=device).occluded.any()


@WAYS
def test_what_is_not_a_triangle_is_not_met(device: Device, variant: Any, dtype: Any) -> None:
    bad = np.array([[[0.0, 0, 1], [1, 1, 1], [0.5, 0.5, 1]], [[0.0, 0, 2], [0, 0, 2], [1, 1, 2]], [[np.nan] * 3] * 3])
    scene = Scene(np.concatenate([bad, TRIANGLE]))
    rays = np.array([[0.25, 0.25, 5.0, 0.0, 0.0, -1.0]], dtype)
    np.testing.assert_array_equal(ClosestHit(scene=scene, variant=variant)(rays, device=device).triangle, [3])


@WAYS
def test_numbers_that_are_none(device: Device, variant: Any, dtype: Any) -> None:
    good = [0.25, 0.25, 1.0, 0.25, 0.25, -1.0]
    rows = np.array([good] + [good] * 12 + [good], dtype)
    rows[np.arange(1, 7), np.arange(6)] = np.nan
    rows[np.arange(7, 13), np.arange(6)] = -np.inf
    result = AnyHit(scene=Scene(TRIANGLE), variant=variant)(rows, device=device)
    expected = np.array([0] + [Status.NOT_FINITE] * 12 + [0])
    np.testing.assert_array_equal(result.status, expected)
    np.testing.assert_array_equal(result.occluded, expected == 0)
    rays = rows.copy()
    rays[-1, 3:] = 0.0
    rays[0, 3:5] = 0.0
    hits = ClosestHit(scene=Scene(TRIANGLE), variant=variant)(rays, device=device)
    np.testing.assert_array_equal(hits.status != 0, [False] + [True] * 13)
    np.testing.assert_array_equal(hits.status[1:], Status.NOT_FINITE)


@WAYS
def test_ends_do_not_occlude_within_the_clearance(device: Device, variant: Any, dtype: Any) -> None:
    segments = np.array([[0.25, 0.25, 1e-3, 0.25, 0.25, -1.0], [0.25, 0.25, -1.0, 0.25, 0.25, 1e-3]], dtype)
    for clearance, expected in ((0.0, 1), (0.5e-3, 1), (2e-3, 0), (10.0, 0)):
        result = AnyHit(scene=Scene(TRIANGLE), clearance=clearance, variant=variant)(segments, device=device)
        np.testing.assert_array_equal(result.occluded, expected)
    rays = np.array([[0.25, 0.25, 1e-3, 0.0, 0.0, -7.0]], dtype)
    assert ClosestHit(scene=Scene(TRIANGLE), clearance=2e-3, variant=variant)(rays, device=device).triangle[0] == -1
    # The end itself does not count.
    touching = np.array([[0.25, 0.25, 0.0, 0.25, 0.25, 1.0]], dtype)
    half = np.array([0.0, 0.0, 0.5])
    both = Scene(np.concatenate([TRIANGLE - half, TRIANGLE + half]))
    touching[:, [2, 5]] -= 0.5
    assert not AnyHit(scene=both, variant=variant)(touching, device=device).occluded.any()


@WAYS
def test_a_segment_without_length_is_not_occluded(device: Device, variant: Any, dtype: Any) -> None:
    places = np.array([[0.25, 0.25, 0.0], [0.25, 0.25, 0.5], [7.0, -3.0, 2.0]], dtype)
    result = AnyHit(scene=Scene(TRIANGLE), variant=variant)(np.hstack([places, places]), device=device)
    np.testing.assert_array_equal(result.occluded, 0)
    np.testing.assert_array_equal(result.status, Status.OK)


@pytest.mark.double
def test_far_from_the_origin_in_single(device: Device, rng: np.random.Generator) -> None:
    """The centre of the scene is subtracted in double: details of a micrometre survive at distances of kilometres."""
    corners, away = soup(rng, 200), np.array([5000.0, -3000.0, 1000.0])
    rays = some_rays(rng, 300)
    rays = rays[far_from_edges(corners, rays)]
    moved = rays + np.concatenate([away, np.zeros(3)])
    hits = ClosestHit(scene=Scene(corners + away), precision="single")(moved, device=device)
    assert hits.distance.dtype == np.float32
    assert_closest(corners, rays, hits)


@pytest.mark.double
@WAYS
def test_rays_from_afar(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    """Rays from a distance of a million scene sizes give the same hits in single precision as rays from nearby."""
    corners, away = soup(rng, 200), np.array([3e6, -1e6, 2e6])
    far = np.hstack([rng.normal(0.0, 1e6, (400, 3)) + away, np.zeros((400, 3))]).astype(dtype)
    targets = np.round(rng.uniform(-1.0, 1.0, (400, 3)) * 256.0) / 256.0
    rays = far.astype(np.float64)
    rays[:, 3:] = targets - rays[:, :3]
    sure = far_from_edges(corners, rays, 1e-4)
    assert sure.mean() > 0.9
    triangle, distance, u, v = reference.closest(corners, rays)
    hits = ClosestHit(scene=Scene(corners), variant=variant, precision="single")(rays, device=device)
    np.testing.assert_array_equal(hits.triangle[sure], triangle[sure])
    hit = sure & (triangle >= 0)
    assert 0.3 < hit.mean() < 0.99
    np.testing.assert_allclose(hits.barycentric[hit], np.column_stack([u, v])[hit], atol=1e-4)
    np.testing.assert_allclose(hits.distance[hit], distance[hit], rtol=4 * eps_of(np.float32))
    segments = np.hstack([far[:, :3], targets.astype(dtype)])
    exact = segments.astype(np.float64)
    sure &= reference.occluded(corners, exact, -1e-9) == reference.occluded(corners, exact, 1e-9)
    result = AnyHit(scene=Scene(corners), variant=variant)(segments, device=device)
    np.testing.assert_array_equal(result.occluded[sure], reference.occluded(corners, exact)[sure])
    # Rays that point away, and segments that end before it, have no hit.
    rays[:, 3:] *= -1.0
    assert (ClosestHit(scene=Scene(corners), variant=variant)(rays.astype(dtype), device=device).triangle == -1).all()
    segments[:, 3:] = segments[:, :3] * dtype(0.5)
    assert not AnyHit(scene=Scene(corners), variant=variant)(segments, device=device).occluded.any()


@pytest.mark.parametrize("distance", [0.0, 30.0, 1e3, 1e6])
@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.double)])
def test_rays_without_doubles(device: Device, distance: float, dtype: Any, rng: np.random.Generator) -> None:
    """Two floats keep the digits of rays from a distance, and of a scene far from the origin."""
    slow = copy.copy(device)
    slow.has_fast_double = False
    away = np.array([5000.0, -3000.0, 1000.0])
    corners = soup(rng, 200) + away
    starts = (away + distance * random_directions(rng, 600)).astype(dtype)
    rays = np.hstack([starts, (away + rng.uniform(-0.7, 0.7, (600, 3)) - starts).astype(dtype)])
    closest = ClosestHit(scene=Scene(corners), variant="work_item", precision="single")
    any_hit = AnyHit(scene=Scene(corners), variant="work_item", precision="single")
    assert "TWO_FLOAT_POSITIONS" in closest.launch(slow, rays.shape, np.dtype(dtype)).defines
    exact = rays.astype(np.float64)
    sure = far_from_edges(corners, exact, 3e-4)
    triangle, far, u, v = reference.closest(corners, exact)
    hits = closest(rays, device=slow)
    np.testing.assert_array_equal(hits.triangle[sure], triangle[sure])
    hit = sure & (triangle >= 0)
    assert hit.mean() > (0.3 if distance < 1e6 else 0.1)
    # The sine of incidence and the size of the triangle magnify the rounding of the scene's size.
    np.testing.assert_allclose(hits.barycentric[hit], np.column_stack([u, v])[hit], atol=3e-4)
    np.testing.assert_allclose(hits.distance[hit], far[hit], rtol=4 * eps_of(np.float32), atol=2e-5)
    segments = np.hstack([starts, (away + rng.uniform(-1.0, 1.0, (600, 3))).astype(dtype)])
    ends = segments.astype(np.float64)
    expected = reference.occluded(corners, ends)
    sure = far_from_edges(corners, np.hstack([ends[:, :3], ends[:, 3:] - ends[:, :3]]), 3e-4)
    by = 1e-4 / max(distance, 1.0)
    sure &= reference.occluded(corners, ends, -by) == reference.occluded(corners, ends, by)
    result = any_hit(segments, device=slow)
    np.testing.assert_array_equal(result.occluded[sure], expected[sure])
    assert 0.2 < expected[sure].mean() < 0.95
    # Rays that point away have no hit; lengths beyond the squares of their type are directions, too.
    long = dtype(2.0**80 if dtype == np.float32 else 2.0**600)
    rays[:, 3:] *= long
    again = closest(rays, device=slow)
    np.testing.assert_array_equal(again.triangle[hit], hits.triangle[hit])
    if distance:
        rays[:, 3:] /= -long
        assert (closest(rays, device=slow).triangle[sure] == -1).all()


def random_directions(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@WAYS
def test_writes_only_its_outputs(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    scene = Scene(soup(rng, 100))
    for operation in (ClosestHit(scene=scene, variant=variant), AnyHit(scene=scene, variant=variant)):
        for shape in ((0,), (1,), (3, 7), (257,), (1000,)):
            rays = rng.uniform(-1.0, 1.0, (*shape, 6)).astype(dtype)
            plain = operation(rays, device=device)
            guarded = Guarded(plain)
            operation(rays, device=device, out=guarded.out)
            guarded.assert_intact()
            for one, two in zip(plain, guarded.out, strict=True):
                np.testing.assert_array_equal(one, two)


def test_what_it_does_not_take(device: Device) -> None:
    scene = Scene(TRIANGLE)
    with pytest.raises(TypeError, match="Scene"):
        AnyHit(scene=TRIANGLE)
    with pytest.raises(ValueError, match="clearance"):
        ClosestHit(scene=scene, clearance=-1.0)
    with pytest.raises(ValueError, match="rays"):
        ClosestHit(scene=scene)(np.zeros((4, 5)), device=device)
    with pytest.raises(TypeError, match="float32"):
        AnyHit(scene=scene)(np.zeros((4, 6), np.int32), device=device)
    with pytest.raises(ValueError, match="precision"):
        AnyHit(scene=scene, precision="half")(np.zeros((4, 6)), device=device)
