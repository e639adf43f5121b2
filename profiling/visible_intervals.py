"""Benchmark of `VisibleIntervals` on a board, compared with shadow rays of Embree to samples of a line.

Embree is called once per core, the fastest way to use it. Errors are mean errors of the visible fraction of the line,
relative to our result in double precision. The error of Embree's samples is in ``peer_error``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case
from gpuvision.profiling.rays import board, embree_scene
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.scene.visible_intervals import VisibleIntervals

_FANS, _SAMPLES = 4000, 256
_LIFT = 1e-5  # distance of a fan's apex from the surface [m]


def cases(device: Device) -> Iterator[Case]:
    """Yield a board, and the same board with 64 times the number of triangles."""
    for name, finer in (("board", 0), ("board-fine", 3)):
        yield _case(device, name, board(finer))


def _case(device: Device, name: str, mesh: Any) -> Case:
    points, faces = trimesh.sample.sample_surface(mesh, _FANS, seed=3)
    fans = np.zeros((_FANS, 11), np.float32)
    fans[:, :3] = points + _LIFT * mesh.face_normals[faces]
    fans[:, 3:9] = -0.04, 1e-3, 8e-3, 0.04, 1e-3, 8e-3
    scene = Scene.of(mesh)
    bound = VisibleIntervals(scene=scene).bind(device, fans.shape, fans.dtype)
    bound.inputs[0].set(fans)
    ours = _visible_fraction(to_numpy(bound.run().intervals))
    exact = VisibleIntervals(scene=scene, precision="double" if device.has_double else "single", max_intervals=49)(
        fans, device=device
    )
    truth = _visible_fraction(to_numpy(exact.intervals))
    known = (to_numpy(exact.status) == 0) & (to_numpy(bound.outputs.status) == 0)
    peer = _Samples(scene, fans)
    metadata = {"triangles": len(mesh.faces), "fans": _FANS, "peer_error": _error(peer(), truth, known)}
    return Case("visible_intervals", name, bound.run, {"embreex": peer}, _error(ours, truth, known), metadata=metadata)


def _visible_fraction(intervals: NDArray[Any]) -> NDArray[Any]:
    """Return the visible fraction of the segment of each fan, (n,)."""
    shares: NDArray[Any] = np.nansum(intervals[..., 1] - intervals[..., 0], axis=-1)
    return shares


def _error(shares: NDArray[Any], truth: NDArray[Any], known: NDArray[np.bool_]) -> float:
    return float(np.mean(np.abs(shares - truth)[known]))


class _Samples:
    """Visible fractions by Embree: shadow rays to samples of the segments, on all cores."""

    def __init__(self, scene: Scene, fans: NDArray[np.float32]) -> None:
        self._embree = embree_scene(scene.corners)
        share = ((np.arange(_SAMPLES) + 0.5) / _SAMPLES).astype(np.float32)[:, None]
        ends = fans[:, None, 3:6] * (1.0 - share) + fans[:, None, 6:9] * share
        starts = np.repeat(fans[:, None, :3], _SAMPLES, axis=1)
        pairs = starts.reshape(-1, 3), (ends - starts).reshape(-1, 3)
        cores = os.cpu_count() or 1
        self._queries = list(zip(*(np.array_split(each, cores) for each in pairs), strict=True))
        self._reach = [np.ones(len(start), np.float32) for start, _ in self._queries]
        self._pool = ThreadPoolExecutor(cores)

    def __call__(self) -> NDArray[np.float64]:
        """Return the visible fractions, (n,)."""
        parts = self._pool.map(self._query, self._queries, self._reach)
        return np.asarray((np.concatenate(list(parts)) != 0).reshape(-1, _SAMPLES).mean(axis=1))

    def _query(self, query: tuple[NDArray[Any], ...], reach: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(self._embree.run(*query, dists=reach, query="OCCLUDED"))
