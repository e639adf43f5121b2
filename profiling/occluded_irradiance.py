"""Light of a lit line on a board with parts, with occlusion: OccludedIrradiance compared with NumPy and Embree.

The peer samples the line, keeps the pairs that face each other (by matrix products, in blocks), traces a shadow ray for
each pair with Embree on all cores, and sums. The peer computes one profile per call; gpuvision computes eight profiles
in sequence. Both errors are medians over the receivers that get light, relative to OccludedIrradiance in double, which
the tests compare with rays in float64; they are NaN on a device without double. Cases ``growth/...`` have four times
the segments or receivers of the board, or four and sixteen times its triangles. In the cases ``board/p95-...`` the peer
computes the closed form on the visible parts of the segments, found with adaptive shadow rays. Of all settings for
which the 95th percentile of its relative error is below the number in the name, it takes the one with the fewest shadow
rays (devices with double only). It has two forms of Embree, with and without its robust mode.
"""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from gpuvision.host import Bound, Device, to_numpy
from gpuvision.profiling import adaptive_shadow_rays as adaptive
from gpuvision.profiling.harness import Case, Peer, traffic_of
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import LitSegments
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance, segment_rows

_PARTS, _STRIPS, _EACH = 40, 100, 30
CLEARANCE = 1e-6  # clearance from a surface [m]; the rays of the peer use the same clearance at their ends
_PROFILES = 8  # profiles in sequence, as in a scan; the peer gains nothing from a sequence
_BLOCK = 1 << 22  # pairs per block of the peer
_BASE = "board/1024"  # case that the sizes of growth/... refer to
_AT = 0.0  # position of the sheet of light [m]: along the middle row of parts


@dataclass(frozen=True, eq=False)
class Board:
    """Plate with boxes and cylinders, a lit line across it, and receivers on surfaces that face up or sideways."""

    scene: Scene
    segments: LitSegments
    receivers: NDArray[np.float32]

    @classmethod
    def of(cls, *, finer: int = 0, strips: int = _STRIPS, parts_of_segments: int = 1) -> Board:
        """Return the board; triangles are subdivided `finer` times, lit segments cut into `parts_of_segments`."""
        rng = np.random.default_rng(1)
        mesh: Any = trimesh.creation.box((0.1, 0.08, 0.0016)).apply_translation((0.0, 0.0, -0.0008))
        parts = [mesh.subdivide().subdivide().subdivide()]
        tops = [(-0.05, 0.05, 0.0)]
        for number in range(_PARTS):
            row, column = divmod(number, 9)
            x, y = np.array([0.01 * column - 0.04, 0.016 * row - 0.032]) + rng.uniform(-5e-4, 5e-4, 2)
            size = rng.uniform((2e-3, 2e-3, 1e-3), (8e-3, 12e-3, 6e-3))
            if number % 3 == 0:
                part = trimesh.creation.cylinder(3e-3, 5e-3, sections=22)
                size[:] = 2.0 * np.sqrt(max(9e-6 - (_AT - y) ** 2, 0.0)), 6e-3, 5e-3
            else:
                part = trimesh.creation.box(size)
            parts.append(part.apply_translation((x, y, 0.5 * size[2])))
            if abs(_AT - y) < 0.5 * size[1]:
                tops.append((x - 0.5 * size[0], x + 0.5 * size[0], size[2]))
        mesh = trimesh.util.concatenate(parts)
        seen = np.where(mesh.face_normals[:, 2] > -0.5, mesh.area_faces, 0.0)
        points, faces = trimesh.sample.sample_surface(mesh, strips * _EACH, face_weight=seen, seed=3)
        receivers = np.hstack([points, mesh.face_normals[faces]])[np.argsort(points[:, 0])].reshape(strips, _EACH, 6)
        # A strip of the sensor sees a slice across the whole board.
        receivers = np.take_along_axis(receivers, np.argsort(receivers[:, :, 1], axis=1)[:, :, None], axis=1)
        for _ in range(finer):
            mesh = mesh.subdivide()
        return cls(Scene.of(mesh), _line(tops, parts_of_segments), receivers.astype(np.float32))


def _line(tops: list[tuple[float, float, float]], parts: int) -> LitSegments:
    """Return the upper envelope of `tops` (from, to, height) along x, each piece cut into equal parts."""
    cuts = np.unique([edge for top in tops for edge in top[:2]])
    middles = 0.5 * (cuts[1:] + cuts[:-1])
    heights = np.max([np.where((middles > low) & (middles < high), z, -1.0) for low, high, z in tops], axis=0)
    change = np.flatnonzero(np.diff(heights, prepend=-1.0))
    edges = np.append(cuts[change], cuts[-1])
    steps = np.linspace(edges[:-1], edges[1:], parts + 1)
    x = np.stack([steps[:-1], steps[1:]], axis=-1).transpose(1, 0, 2).reshape(-1, 2)
    z = np.repeat(heights[change], parts)
    ends = np.stack([x, np.full_like(x, _AT), np.tile(z[:, None], 2)], axis=-1)
    return LitSegments(ends, np.tile([0.0, 0.0, 1.0], (len(x), 1)), np.ones(len(x)))


def cases(device: Device) -> Iterator[Case]:
    """Yield the board with 1024 and 16384 line samples of the peer, and boards that are larger in one respect."""
    board = Board.of()
    for samples in (1024, 16_384):
        yield _case(device, board, f"board/{samples}", samples)
    if device.has_double:
        for limit, name in ((3e-2, "3e-2"), (2e-3, "2e-3")):
            yield _adaptive_case(device, board, limit, f"board/p95-{name}")
    yield _case(device, Board.of(parts_of_segments=4), "growth/segments-x4", base=_BASE)
    yield _case(device, Board.of(strips=4 * _STRIPS), "growth/receivers-x4", base=_BASE)
    for finer in (1, 2):
        yield _case(device, Board.of(finer=finer), f"growth/triangles-x{4**finer}", base=_BASE)


def _case(device: Device, board: Board, name: str, samples: int = 1024, **more: str) -> Case:
    operation, bound = _bound(device, board)
    ours = to_numpy(bound.run().irradiance).ravel()
    truth = _truth(device, board, operation) if device.has_double else np.full(ours.shape, np.nan)
    peer = functools.partial(irradiance_by_samples, board, samples, embree_of(board.scene))
    metadata = {**_sizes(board), "peer_error": error_of(peer(), truth), **more}
    return _finished_case(board, name, bound, {"numpy+embreex": peer}, error_of(ours, truth), metadata)


def _adaptive_case(device: Device, board: Board, limit: float, name: str) -> Case:
    """Return a case with the cheapest setting of the adaptive peer whose 95th percentile is below `limit`."""
    operation, bound = _bound(device, board)
    ours = to_numpy(bound.run().irradiance).ravel()
    truth = _truth(device, board, operation)
    receivers, table = board.receivers.reshape(-1, 6), adaptive.segment_table(board.segments)
    robust, fast = (
        functools.partial(trace_free, embree_of(board.scene, robust=is_robust)) for is_robust in (True, False)
    )

    def peer(form: adaptive.Form, setting: adaptive.Setting, free: adaptive.Free = robust) -> NDArray[np.float32]:
        return adaptive.irradiance_by_adaptive_rays(form, receivers, table, free, setting, CLEARANCE)

    def p95(setting: adaptive.Setting) -> float:
        return error_of(peer(adaptive.NUMBA, setting), truth, 0.95)

    def shadow_rays(setting: adaptive.Setting) -> int:
        counts: list[int] = []

        def free(start: NDArray[np.float32], step: NDArray[np.float32]) -> NDArray[np.bool_]:
            counts.append(len(start))
            return robust(start, step)

        peer(adaptive.NUMBA, setting, free)
        return sum(counts)

    setting = adaptive.cheapest_setting(p95, shadow_rays, limit)
    metadata = {
        **_sizes(board),
        **setting._asdict(),
        "shadow_rays": shadow_rays(setting),
        "peer_error": error_of(peer(adaptive.NUMBA, setting), truth),
        "peer_p95": p95(setting),
        "p95": error_of(ours, truth, 0.95),
    }
    peers: dict[str, Peer] = {
        name: {
            "robust": functools.partial(peer, form, setting),
            "fast": functools.partial(peer, form, setting, fast),
        }
        for name, form in (("numpy+embreex", adaptive.NUMPY), ("numba+embreex", adaptive.NUMBA))
    }
    return _finished_case(board, name, bound, peers, error_of(ours, truth), metadata)


def _bound(device: Device, board: Board) -> tuple[OccludedIrradiance, Bound[Any]]:
    """Return the operation, and a bound instance with its inputs."""
    rows, receivers = segment_rows(board.segments), board.receivers
    weights = np.ones((*receivers.shape[:2], 2), np.float32)
    operation = OccludedIrradiance(scene=board.scene, segments=len(rows), clearance=CLEARANCE)
    bound = operation.bind(device, receivers.shape, receivers.dtype)
    for target, source in zip(bound.inputs, (receivers, weights, rows.astype(np.float32)), strict=True):
        target.set(source)
    return operation, bound


def _truth(device: Device, board: Board, operation: OccludedIrradiance) -> NDArray[np.float64]:
    """Return the irradiance in double precision."""
    receivers, weights = board.receivers.astype(float), np.ones((*board.receivers.shape[:2], 2))
    light = operation(receivers, weights, segment_rows(board.segments), device=device)
    return np.asarray(to_numpy(light.irradiance), np.float64).ravel()


def _sizes(board: Board) -> dict[str, Any]:
    receivers = board.receivers.size // 6
    return {"triangles": len(board.scene.corners), "segments": len(board.segments.exitance), "receivers": receivers}


# Operations in kernels/occluded_irradiance. Of a receiver and a segment: place 3, height above the segment 5. Of two
# that face each other: two more coordinates 10, normal in the segment's axes 15, heights of the ends 7; view 90; closed
# form 45 (gpuvision.profiling.line_irradiance).
_PAIR, _FACING = 8, 167


def pair_flops(board: Board) -> int:
    """Return the operations of a profile without the search for occluders, whose number depends on the tree.

    It is the least number of a profile.
    """
    receivers = board.receivers.reshape(-1, 6).astype(np.float64)
    start, end = (board.segments.ends[:, number] for number in (0, 1))
    height = np.einsum("ijk,jk->ij", receivers[:, None, :3] - start, board.segments.normals)
    toward, toward_end = (
        np.einsum("ijk,ik->ij", each - receivers[:, None, :3], receivers[:, 3:]) for each in (start, end)
    )
    facing = (height > 0.0) & ((toward > 0.0) | (toward_end > 0.0))
    return int(_PAIR * facing.size + _FACING * facing.sum())


def _finished_case(
    board: Board,
    name: str,
    bound: Bound[Any],
    peers: Mapping[str, Peer],
    error: float,
    metadata: Mapping[str, Any],
) -> Case:
    """Return a case of profiles in sequence; a peer computes one profile."""
    return Case(
        "reflections",
        name,
        functools.partial(_in_a_row, bound),
        peers,
        error,
        traffic_of(bound),
        repeats=_PROFILES,
        metadata=metadata,
        factors=dict.fromkeys(peers, _PROFILES),
        flops=pair_flops(board),
        bound=bound,
        copied=False,
    )


def _in_a_row(bound: Bound[Any]) -> None:
    for _ in range(_PROFILES - 1):
        bound()
    bound.run()


def error_of(values: NDArray[Any], truth: NDArray[np.float64], quantile: float = 0.5) -> float:
    """Return a quantile of the relative error of the lit receivers, default the median; NaN if no receiver is lit."""
    lit = truth > 1e-6 * np.nanmax(truth)
    return float(np.quantile(np.abs(values[lit] / truth[lit] - 1.0), quantile)) if lit.any() else float("nan")


def embree_of(scene: Scene, *, robust: bool = True) -> Any:
    """Return an Embree scene of the triangles; `robust`: no ray passes between two triangles at their common edge."""
    embree = EmbreeScene(robust=robust)
    TriangleMesh(embree, scene.corners.astype(np.float32))
    return embree


def irradiance_by_samples(board: Board, samples: int, embree: Any) -> NDArray[np.float32]:
    """Return the irradiance of all receivers from samples of the line."""
    points, normals, light = _samples(board.segments, samples)
    places, facing = board.receivers.reshape(-1, 6)[:, :3], board.receivers.reshape(-1, 6)[:, 3:]
    plane_offset = np.einsum("nk,nk->n", places, facing)[:, None]
    lit = np.einsum("nk,nk->n", points, normals)[:, None]
    total = np.zeros(len(places), np.float32)
    step = max(_BLOCK // samples, 1)
    for first in range(0, len(places), step):
        some = np.s_[first : first + step]
        toward = facing[some] @ points.T - plane_offset[some]
        height = (normals @ places[some].T - lit).T
        i, j = np.nonzero((toward > 0.0) & (height > 0.0))
        start = places[some][i] + CLEARANCE * facing[some][i]
        step_to = points[j] + CLEARANCE * normals[j] - start
        seen = trace_free(embree, start, step_to)
        i, j = i[seen], j[seen]
        square = np.einsum("nk,nk->n", step_to, step_to)[seen]
        value = toward[i, j] * height[i, j] * light[j] / (square * square)
        total[some] = np.bincount(i, value, minlength=len(toward))
    return total


def _samples(segments: LitSegments, samples: int) -> tuple[NDArray[np.float32], ...]:
    """Return positions, normals and exitance over pi of equidistant samples of the line."""
    lengths = np.linalg.norm(segments.ends[:, 1] - segments.ends[:, 0], axis=1)
    begin = np.cumsum(lengths) - lengths
    at = (np.arange(samples) + 0.5) * (lengths.sum() / samples)
    which = np.searchsorted(begin, at, side="right") - 1
    share = ((at - begin[which]) / lengths[which])[:, None]
    places = (1.0 - share) * segments.ends[which, 0] + share * segments.ends[which, 1]
    light = segments.exitance[which] * (lengths.sum() / samples / np.pi)
    return places.astype(np.float32), segments.normals[which].astype(np.float32), light.astype(np.float32)


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count() or 1)


def trace_free(embree: Any, start: NDArray[np.float32], step: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return whether rays (n, 3) from a start, each as long as its step (n, 3), hit nothing; on all cores."""

    def query(some: slice) -> NDArray[Any]:
        far = np.ones(len(start[some]), np.float32)
        return np.asarray(embree.run(start[some], step[some], dists=far, query="OCCLUDED"))

    cuts = np.linspace(0, len(start), (os.cpu_count() or 1) + 1).astype(int)
    answers = _pool().map(query, itertools.starmap(slice, itertools.pairwise(cuts)))
    free: NDArray[np.bool_] = np.concatenate(list(answers)) != 0
    return free
