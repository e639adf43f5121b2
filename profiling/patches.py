"""Light of patches on points: form factors in a room, and a board with occlusion, compared with NumPy and Embree.

In the room the peer is Lambert's sum over edges in NumPy, float64. There is no occlusion, and no wall crosses the
horizon of a receiver; gpuvision and the peer do not clip patches or trace rays. On the board the peer is the usual
approximation: a patch is a point at its centroid, and Embree tests its visibility. Errors are relative to the largest
irradiance, compared with double precision and sixteen times the number of rays; `peer_error` is the error of the peer.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case
from gpuvision.profiling.rays import board
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.patches import FormFactors, Patches, PatchLight

_CHUNK = 64
_LIFT = 1e-5  # distance of the ray ends from the surfaces [m]


def cases(device: Device) -> Iterator[Case]:
    """Yield an empty room, and a board with coarse and with fine patches."""
    yield _room(device, 1024)
    for size in (0.016, 0.008):
        yield _board(device, size)


def _room(device: Device, receivers: int) -> Case:
    box = trimesh.creation.box((1.0, 0.8, 0.6))
    box.invert()
    patches = Patches.from_scene(Scene.of(box), size=0.1, both_sides=False)
    points = patches.quadrature[0]
    chosen = np.linspace(0, len(points) - 1, receivers).astype(int)
    points = points[chosen]
    bound = FormFactors(patches=patches).bind(device, points.shape, np.float32)
    bound.inputs[0].set(points.astype(np.float32))
    ours = to_numpy(bound.run().factors)
    # Exclude the wall of the receiver: it lies in the plane of the receiver.
    offset = patches.corners[None] - points[:, None, None, :3]
    off_plane = np.abs(np.einsum("nmkd,nd->nmk", offset, points[:, 3:])).max(axis=2) > 1e-9

    def numpy() -> NDArray[np.float64]:
        parts = [_lambert(points[i : i + _CHUNK], patches.corners) for i in range(0, len(points), _CHUNK)]
        return np.where(off_plane, np.concatenate(parts), 0.0)

    theirs = numpy()
    metadata = {"pairs": ours.size, "peer_error": 0.0}
    error = float(np.abs(ours - theirs).max() / theirs.max())
    return Case(
        "reflections",
        f"bounces/room/{len(points)}x{patches.count}",
        bound.run,
        {"numpy": numpy},
        error,
        metadata=metadata,
    )


def _lambert(points: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the form factors (n, m) of fully visible triangles, by Lambert's sum over their edges."""
    a = corners[None] - points[:, None, None, :3]
    b = np.roll(a, -1, axis=2)
    turn = np.cross(b, a)
    sine = np.linalg.norm(turn, axis=3)
    angle = np.arctan2(sine, np.sum(a * b, axis=3))
    shares = np.einsum("nmkd,nd->nmk", turn, points[:, 3:]) * angle / np.maximum(sine, 1e-300)
    return np.asarray(np.maximum(shares.sum(axis=2), 0.0) / (2.0 * np.pi))


def _board(device: Device, size: float) -> Case:
    scene = Scene.of(board(0))
    patches = Patches.from_scene(scene, size=size)
    points = np.resize(Patches.from_scene(scene, size=0.004).quadrature[0], (60_000, 6))[::20]
    # Patches that face up emit light, as under a lamp.
    first = np.searchsorted(np.asarray(patches.patch), np.arange(patches.count))
    exitance = np.maximum(patches.normals[first, 2], 0.0)
    bound = PatchLight(patches=patches, scene=scene).bind(device, points.shape, np.float32)
    bound.inputs[0].set(points.astype(np.float32))
    bound.inputs[1].set(exitance.astype(np.float32))
    ours = to_numpy(bound.run().irradiance)
    real = np.float64 if device.has_double else np.float32
    exact = PatchLight(patches=patches, scene=scene, rays=4096.0)
    truth = to_numpy(exact(points.astype(real), exitance.astype(real), device=device).irradiance)
    by_points = _PointByPoint(scene, patches, exitance, points)
    metadata = {"patches": patches.count, "receivers": len(points), "peer_error": _error(by_points(), truth)}
    peers = {"numpy+embreex": by_points}
    return Case(
        "reflections", f"bounces/board/{patches.count}", bound.run, peers, _error(ours, truth), metadata=metadata
    )


def _error(values: NDArray[Any], truth: NDArray[Any]) -> float:
    """Return the root mean square of the difference, relative to the largest true value."""
    return float(np.sqrt(np.mean((values - truth) ** 2)) / np.max(truth))


class _PointByPoint:
    """Irradiance from the centroids of patches with visibility by Embree, on all cores."""

    def __init__(
        self, scene: Scene, patches: Patches, exitance: NDArray[np.float64], points: NDArray[np.float64]
    ) -> None:
        self._embree = EmbreeScene()
        TriangleMesh(self._embree, scene.corners.astype(np.float32))
        shining = exitance[np.asarray(patches.patch)] > 0.0
        self._middles = patches.corners.mean(axis=1)[shining]
        self._normals = patches.normals[shining]
        areas = 0.5 * np.linalg.norm(
            np.cross(patches.corners[:, 1] - patches.corners[:, 0], patches.corners[:, 2] - patches.corners[:, 0]),
            axis=1,
        )
        self._powers = (areas * exitance[np.asarray(patches.patch)])[shining] / np.pi
        self._parts = np.array_split(points, 8 * (os.cpu_count() or 1))
        self._pool = ThreadPoolExecutor(os.cpu_count() or 1)

    def __call__(self) -> NDArray[np.float64]:
        """Return the irradiance (n,)."""
        return np.concatenate(list(self._pool.map(self._part, self._parts)))

    def _part(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        offset = self._middles - points[:, None, :3]
        square = np.sum(offset * offset, axis=2)
        at = np.einsum("nmd,nd->nm", offset, points[:, 3:])
        out = -np.einsum("nmd,md->nm", offset, self._normals)
        receiver, patch = np.nonzero((at > 0.0) & (out > 0.0))
        start = points[receiver, :3] + _LIFT * points[receiver, 3:]
        end = self._middles[patch] + _LIFT * self._normals[patch]
        reach = np.ones(len(start), np.float32)
        free = self._embree.run(
            start.astype(np.float32), (end - start).astype(np.float32), dists=reach, query="OCCLUDED"
        )
        share = self._powers[patch] * (at * out / square**2)[receiver, patch] * (np.asarray(free) != 0)
        return np.asarray(np.bincount(receiver, share, len(points)), np.float64)
