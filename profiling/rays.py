"""Benchmark of `AnyHit`, `ClosestHit` and the BVH construction on a board with parts, compared with Embree.

The segments are the shadow rays of a simulation: from points on all surfaces of the board to a line of light on it.
Embree runs its occlusion query in one call per core, the fastest way to use it, in two forms: ``robust`` (rays do not
pass between two triangles at their common edge, as ours) and ``fast`` (without this guarantee). The column `error` is
the fraction of segments for which our result differs from the robust one (at silhouettes, by rounding). `ClosestHit`
gets the view rays of a camera above the board; `error` is the fraction of rays that hit another triangle.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from gpuvision.host import Bound, Device, to_numpy
from gpuvision.profiling.harness import Case, traffic_of
from gpuvision.profiling.ray_visits import visits
from gpuvision.simulation.scene.bvh import Bvh
from gpuvision.simulation.scene.rays import AnyHit, ClosestHit
from gpuvision.simulation.scene.scene import Scene

_PARTS, _RECEIVERS, _SAMPLES = 40, 4000, 64
# Rays that may hit another triangle: those within rounding of an edge. Triangles of a millimetre at a distance of
# 0.25 m with positions in single precision (1.5e-8 m): some 1e-4 of the rays.
_MOST_DIFFERENT = 1e-3
_CORES = os.cpu_count() or 1
_COUNTED = 512  # rays whose boxes and triangles are counted
_LIFT = 1e-5  # distance of a segment's start from the surface [m]


def cases(device: Device) -> Iterator[Case]:
    """Yield ordered and shuffled segments on a board, a board with smaller triangles, and a BVH construction."""
    for name, finer, shuffled in (("board", 0, False), ("board-shuffled", 0, True), ("board-fine", 3, False)):
        yield _any_hit(device, name, board(finer), shuffled)
    yield _build(board(3), "1e5")
    yield _closest_hit(device, "board", board(0))


def board(finer: int) -> Any:
    """Return a board of 100 mm x 80 mm with boxes and cylinders, subdivided `finer` times (4 triangles of each one)."""
    rng = np.random.default_rng(1)
    plate = trimesh.creation.box((0.1, 0.08, 0.0016)).subdivide().subdivide().subdivide()
    parts = [plate.apply_translation((0.0, 0.0, -0.0008))]
    for number in range(_PARTS):
        size = rng.uniform((2e-3, 2e-3, 1e-3), (12e-3, 12e-3, 6e-3))
        part = trimesh.creation.cylinder(3e-3, 5e-3, sections=12) if number % 3 == 0 else trimesh.creation.box(size)
        place = (*rng.uniform((-0.045, -0.035), (0.045, 0.035)), 0.5 * part.extents[2])
        parts.append(part.apply_translation(place))
    mesh: Any = trimesh.util.concatenate(parts)
    for _ in range(finer):
        mesh = mesh.subdivide()
    return mesh


def shadow_segments(mesh: Any, shuffled: bool) -> NDArray[np.float32]:
    """Return segments from points on the mesh to samples of a line across the board."""
    points, faces = trimesh.sample.sample_surface(mesh, _RECEIVERS, seed=3)
    points = points + _LIFT * mesh.face_normals[faces]
    along = np.linspace(-0.04, 0.04, _SAMPLES)
    line = np.column_stack([along, np.full(_SAMPLES, 1e-3), np.full(_SAMPLES, 4e-3)])
    segments = np.hstack([np.repeat(points, _SAMPLES, axis=0), np.tile(line, (len(points), 1))]).astype(np.float32)
    if shuffled:
        np.random.default_rng(4).shuffle(segments)
    return segments


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Return the threads that query Embree, one for each core; all cases share them."""
    return ThreadPoolExecutor(_CORES)


def _any_hit(device: Device, name: str, mesh: Any, shuffled: bool) -> Case:
    segments, scene = shadow_segments(mesh, shuffled), Scene.of(mesh)
    bound = AnyHit(scene=scene).bind(device, segments.shape, segments.dtype)
    bound.inputs[0].set(segments)
    queries = [
        (np.ascontiguousarray(some[:, :3]), some[:, 3:] - some[:, :3], np.ones(len(some), np.float32))
        for some in np.array_split(segments, _CORES)
    ]

    def embree(*, robust: bool) -> Callable[[], list[NDArray[Any]]]:
        theirs = embree_scene(scene.corners, robust=robust)

        def query(given: tuple[NDArray[Any], ...]) -> NDArray[Any]:
            return np.asarray(theirs.run(given[0], given[1], dists=given[2], query="OCCLUDED"))

        return lambda: list(_threads().map(query, queries))

    forms = {"robust": embree(robust=True), "fast": embree(robust=False)}
    bound.run()
    occluded = to_numpy(bound.outputs.occluded) != 0
    disagree, fast = (float(np.mean((np.concatenate(form()) == 0) != occluded)) for form in forms.values())
    if max(disagree, fast) > _MOST_DIFFERENT:
        raise AssertionError(f"Embree occludes {disagree:.1%} (robust) and {fast:.1%} (fast) of the rays differently")
    metadata = {"triangles": len(mesh.faces), "segments": len(segments), "occluded": float(np.mean(occluded))}
    tree = _tree_of(device, scene)
    steps = np.hstack([segments[:, :3], segments[:, 3:] - segments[:, :3]])
    return Case(
        "bvh",
        f"any-hit/{name}",
        bound.run,
        {"embreex": forms},
        disagree,
        _tree_traffic(bound, tree),
        metadata=metadata,
        flops=_traced_flops(tree, steps, end=1.0, any_hit=True),
        copied=False,
    )


def _tree_of(device: Device, scene: Scene) -> Bvh:
    """Return the tree that the operations traverse on a device."""
    return scene.bvh if device.prefers_vectors else scene.gpu_bvh


def _tree_traffic(bound: Bound[Any], tree: Bvh) -> tuple[int, int]:
    """Return the bytes of rays and results, and of the tree, which is read once."""
    read, written = traffic_of(bound)
    return read + sum(each.nbytes for each in tree.tables(np.dtype(np.float32))), written


def _traced_flops(tree: Bvh, rays: NDArray[Any], *, end: float, any_hit: bool) -> float:
    """Return the number of operations of all rays, estimated from a regular sample of them."""
    some = rays[:: max(len(rays) // _COUNTED, 1)]
    return len(rays) * visits(tree, some, end=end, any_hit=any_hit).mean_flops()


def view_rays(mesh: Any) -> NDArray[np.float32]:
    """Return rays (n, 6), start and direction, from a camera above the board to points on the mesh in random order."""
    points, _ = trimesh.sample.sample_surface(mesh, _RECEIVERS * _SAMPLES, seed=5)
    camera = np.broadcast_to([0.0, -0.05, 0.25], points.shape)
    return np.hstack([camera, points - camera]).astype(np.float32)


def _closest_hit(device: Device, name: str, mesh: Any) -> Case:
    rays, scene = view_rays(mesh), Scene.of(mesh)
    bound = ClosestHit(scene=scene).bind(device, rays.shape, rays.dtype)
    bound.inputs[0].set(rays)
    theirs = embree_scene(scene.corners)
    queries = [(each[:, :3].copy(), each[:, 3:].copy()) for each in np.array_split(rays, _CORES)]

    def embree() -> list[NDArray[Any]]:
        return list(_threads().map(lambda given: np.asarray(theirs.run(*given)), queries))

    bound.run()
    differs = float(np.mean(np.concatenate(embree()) != to_numpy(bound.outputs.triangle)))
    if differs > _MOST_DIFFERENT:
        raise AssertionError(f"Embree hits another triangle with {differs:.1%} of the rays")
    metadata, tree = {"triangles": len(mesh.faces), "rays": len(rays)}, _tree_of(device, scene)
    return Case(
        "bvh",
        f"closest-hit/{name}",
        bound.run,
        {"embreex": embree},
        differs,
        _tree_traffic(bound, tree),
        metadata=metadata,
        flops=_traced_flops(tree, rays, end=np.inf, any_hit=False),
        copied=False,
    )


def _build(mesh: Any, size: str) -> Case:
    corners = np.asarray(mesh.triangles)
    # Most of embreex's time is the transfer of the triangles; peer_tree_s is the construction alone.
    metadata = {"triangles": len(corners), "peer_tree_s": min(_embree_tree_time(corners) for _ in range(3))}
    peers = {"embreex": lambda: embree_scene(corners)}
    return Case("bvh", f"build/{size}", lambda: Bvh.build(corners), peers, 0.0, metadata=metadata)


def embree_scene(corners: NDArray[Any], *, robust: bool = True) -> Any:
    """Return an Embree scene with its tree built."""
    scene = EmbreeScene(robust=robust)
    TriangleMesh(scene, corners.astype(np.float32))
    _first_query(scene)
    return scene


def _embree_tree_time(corners: NDArray[Any]) -> float:
    scene = EmbreeScene()
    TriangleMesh(scene, corners.astype(np.float32))
    start = time.perf_counter()
    _first_query(scene)
    return time.perf_counter() - start


def _first_query(scene: Any) -> None:
    """Run a query: Embree builds its tree at the first one."""
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), query="OCCLUDED")
