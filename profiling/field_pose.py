"""Localization of a robot on a field, compared with NumPy, Numba and SciPy.

Cases:

- ``global``: search over 44 226 positions (243 x 182 at 1 cm) with 64 rays; the heading is known from a compass. Every
  candidate returns the scores of all poses and the smallest score of each block of 64 poses. The tuned forms of Numba
  use our algorithm: for one heading a ray is a shift of the map, and rows of the map are added in 16 bits, which
  vectorises (`gpuvision.profiling.shift_peers`). The first loop of Numba and the NumPy peer look up every ray of every
  pose.
- ``global-shifts``: the same search; NumPy adds shifted maps.
- ``turns``: a field of 22 m with 72 headings; Numba as in ``global``.
- ``local``: refinement of one pose; SciPy uses exact distances and their gradients as we do, in double.
- ``map``: the distance map of a field (`gpuvision.profiling.distance_map`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from gpuvision.formats.field_file import read_field
from gpuvision.host import Device, to_numpy
from gpuvision.matching.field.distance_map import COST_LEVELS, DistanceMap
from gpuvision.matching.field.field_pose import FieldPoseRefinement, FieldPoseSearch
from gpuvision.profiling import distance_map, shift_peers
from gpuvision.profiling.harness import Case, Peer, traffic_of

_BLOCK, _RAYS = 64, 64


def cases(device: Device) -> Iterator[Case]:
    """Yield the global search, with one heading and with 72 headings, the local refinement, and the distance map."""
    junior = DistanceMap(field=read_field("robocup_junior"), cell=0.01, scale=0.05, max_range=1.5, device=device)
    large = DistanceMap(field=read_field("robocup_msl"), cell=0.1, scale=0.25, max_range=6.0, device=device)
    pose = (0.213, -0.177, 0.4)
    yield from _global(device, junior, pose)
    yield _turns(device, large, (3.1, -2.2, 0.7))
    yield _local(device, large, (3.1, -2.2, 0.7))
    yield from distance_map.cases(device)


def _points(field_map: DistanceMap, pose: tuple[float, ...], sigma: float) -> NDArray[np.float32]:
    """Return noisy points on lines within the range of the map, one for each ray, in the frame of a pose."""
    rng = np.random.default_rng(5)
    sampled: list[NDArray[np.float64]] = []
    for x0, y0, x1, y1 in field_map.field.lines:
        part = np.linspace(0.0, 1.0, int(np.hypot(x1 - x0, y1 - y0) / field_map.cell) + 2)[:, None]
        sampled.append(np.array([x0, y0]) * (1.0 - part) + np.array([x1, y1]) * part)
    x, y, heading = pose
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    points = (np.concatenate(sampled) - [x, y]) @ turn
    points = points[np.hypot(*points.T) < 0.95 * field_map.max_range]
    points = points[rng.choice(len(points), _RAYS, replace=False)]
    return np.asarray(points + rng.normal(0.0, sigma, points.shape), np.float32)


# ---- global --------------------------------------------------------------------------------------------------


@numba.njit(error_model="numpy")
def _shifts(points, headings, per_cell, border):
    columns = np.empty((headings.shape[0], points.shape[0]), np.int64)
    rows = np.empty((headings.shape[0], points.shape[0]), np.int64)
    for turn in range(headings.shape[0]):
        c, s = np.float32(np.cos(headings[turn])), np.float32(np.sin(headings[turn]))
        for i in range(points.shape[0]):
            x, y = points[i, 0], points[i, 1]
            columns[turn, i] = np.int64(np.rint((c * x - s * y) * per_cell)) + border
            rows[turn, i] = np.int64(np.rint((s * x + c * y) * per_cell)) + border
    return columns, rows


@functools.cache
def _search_form(rays: int, wide: int) -> Any:
    """Return a Numba function that adds shifted rows of the map, `rays` of them in a pass."""
    search = shift_peers.search_form(rays, wide, is_long=False)

    @numba.njit(error_model="numpy")
    def search_field(points, headings, per_cell, border, flat, stride, scores, least, where):
        columns, rows = _shifts(points, headings, per_cell, border)
        search(flat, stride, rows * stride + columns, scores, least, where)

    return search_field


@numba.njit(parallel=True, error_model="numpy")
def _numba_poses(level, columns, rows, scores, least, where):
    """Look up every ray of every pose."""
    _, height, width = scores.shape
    scale = np.float32(1.0 / (1023.0 * columns.shape[1]))
    for row in numba.prange(height):
        for x in range(width):
            total = np.int32(0)
            for i in range(columns.shape[1]):
                total += level[row + rows[0, i], x + columns[0, i]]
            scores[0, row, x] = np.float32(total) * scale
        for block in range(least.shape[2]):
            at = min(block * 64, width - 64)
            at += np.argmin(scores[0, row, at : at + 64])
            least[0, row, block] = scores[0, row, at]
            where[0, row, block] = at


def _numpy_least(scores: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    first = [min(at, scores.shape[2] - _BLOCK) for at in range(0, scores.shape[2], _BLOCK)]
    blocks = np.stack([scores[:, :, at : at + _BLOCK] for at in first], axis=2)
    return blocks.min(axis=-1), blocks.argmin(axis=-1) + first


class _Search:
    """Bound search on a map, and the arrays and functions of the peers."""

    def __init__(
        self, device: Device, field_map: DistanceMap, points: NDArray[Any], headings: tuple[float, ...]
    ) -> None:
        self.map, self.points, self.headings = field_map, points, np.array(headings)
        self.bound = FieldPoseSearch(map=field_map, headings=headings, with_scores=True).bind(
            device, points.shape, "f4"
        )
        self.bound.inputs[0].set(points)
        self.ours = self.bound.run()
        assert self.ours.scores is not None  # because of with_scores
        self.our_scores = self.ours.scores
        self.scores = np.empty(self.our_scores.shape, np.float32)
        self.least = np.empty(self.ours.least.shape, np.float32)
        self.where = np.empty(self.ours.column.shape, np.int64)
        self.float_level = field_map.cells.level.astype(np.float32)

    @property
    def flops(self) -> int:
        """Operations on levels: a sum for each ray of each pose, and its scale."""
        return self.scores.size * (_RAYS + 1)

    @property
    def traffic(self) -> tuple[int, int]:
        """Bytes read from the map and bytes written."""
        return self.map.cells.level.nbytes, self.scores.nbytes + 2 * self.least.nbytes

    def shifts(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the column and row offsets of the rays for each heading, (headings, rays) each."""
        result: tuple[NDArray[Any], NDArray[Any]] = _shifts(
            self.points, self.headings, np.float32(1.0 / self.map.cell), self.map.border
        )
        return result

    def numba_forms(self) -> dict[str, Callable[[], None]]:
        """Return functions that add shifted rows of the map, the algorithm of our kernel, by name."""
        level, per_cell = to_numpy(self.map.cells.level), np.float32(1.0 / self.map.cell)
        flat, wide = shift_peers.padded(level, self.scores.shape[2])
        given = (self.points, self.headings, per_cell, self.map.border, flat, level.shape[1])
        results = (self.scores, self.least, self.where)
        return {f"{rays} rays": functools.partial(_search_form(rays, wide), *given, *results) for rays in (4, 8, 16)}

    def numba_poses(self) -> None:
        """Look up every ray of every pose, compiled."""
        _numba_poses(self.map.cells.level, *self.shifts(), self.scores, self.least, self.where)

    def numpy_poses(self) -> None:
        """Look up every ray of every pose."""
        columns, rows = (each[0] for each in self.shifts())
        _, height, width = self.scores.shape
        at = (np.arange(height)[:, None, None] + rows, np.arange(width)[:, None] + columns)
        self.scores[0] = self.float_level[at].sum(axis=-1) * np.float32(1.0 / (COST_LEVELS * _RAYS))
        self.least[:], self.where[:] = _numpy_least(self.scores)

    def numpy_shifts(self) -> None:
        """Add shifted maps."""
        _, height, width = self.scores.shape
        total = np.zeros((height, width), np.float32)
        for column, row in zip(*(each[0] for each in self.shifts()), strict=True):
            total += self.float_level[row : row + height, column : column + width]
        self.scores[0] = total * np.float32(1.0 / (COST_LEVELS * _RAYS))
        self.least[:], self.where[:] = _numpy_least(self.scores)

    def check(self, *peers: Callable[[], None]) -> None:
        """Raise an error if the result of a peer differs from ours."""
        ours: tuple[NDArray[Any], ...]
        ours = to_numpy(self.our_scores), to_numpy(self.ours.least), to_numpy(self.ours.column)
        for peer in peers:
            self.scores[...], self.least[...], self.where[...] = np.nan, np.nan, -1
            peer()
            theirs: tuple[NDArray[Any], ...] = (self.scores, self.least, self.where)
            if not all(np.allclose(each, other, atol=1e-6) for each, other in zip(theirs, ours, strict=True)):
                raise AssertionError("the scores of a peer differ from ours")

    @property
    def error(self) -> float:
        """Largest error of our scores at a sample of the poses, compared with exact distances in double."""
        turn, row, column = (each[:: max(each.size // 200, 1)] for each in np.indices(self.scores.shape).reshape(3, -1))
        x0, y0 = self.map.first_position
        c, s = np.cos(self.headings[turn])[:, None], np.sin(self.headings[turn])[:, None]
        px, py = self.points.astype(np.float64).T
        x = x0 + self.map.cell * column[:, None] + c * px - s * py
        y = y0 + self.map.cell * row[:, None] + s * px + c * py
        shapes = self.map.field.shapes
        away = [np.abs(_offsets(shapes, np.full(x.shape, each), x, y)[0]) for each in range(len(shapes))]
        square = np.min(away, axis=0) ** 2
        exact = np.mean(square / (self.map.scale**2 + square), axis=1)
        return float(np.max(np.abs(to_numpy(self.our_scores)[turn, row, column] - exact)))


def _global(device: Device, field_map: DistanceMap, pose: tuple[float, ...]) -> Iterator[Case]:
    search = _Search(device, field_map, _points(field_map, pose, 0.003), (pose[2],))
    height, width = field_map.positions
    metadata = {"poses": height * width, "rays": _RAYS}
    forms = search.numba_forms()
    search.check(*forms.values(), search.numpy_poses, search.numba_poses, search.numpy_shifts)
    peers: dict[str, Peer] = {"numba": forms, "numba-plain": search.numba_poses, "numpy": search.numpy_poses}
    error, traffic, flops = search.error, search.traffic, search.flops
    yield Case("field", "global", search.bound.run, peers, error, traffic, metadata=metadata, flops=flops)
    peers = {"numpy": search.numpy_shifts}
    yield Case("field", "global-shifts", search.bound.run, peers, error, traffic, metadata=metadata, flops=flops)


def _turns(device: Device, field_map: DistanceMap, pose: tuple[float, ...]) -> Case:
    headings = tuple(np.arange(72) * (np.pi / 36.0))
    search = _Search(device, field_map, _points(field_map, pose, 0.02), headings)
    forms = search.numba_forms()
    search.check(*forms.values())
    metadata = {"poses": search.scores.size, "rays": _RAYS}
    peers: dict[str, Peer] = {"numba": forms}
    error, traffic, flops = search.error, search.traffic, search.flops
    return Case("field", "turns", search.bound.run, peers, error, traffic, metadata=metadata, flops=flops)


# ---- local ---------------------------------------------------------------------------------------------------


def _offsets(shapes: NDArray[Any], which: NDArray[Any], x: NDArray[Any], y: NDArray[Any]) -> tuple[Any, Any, Any]:
    """Return signed distances of points to straight lines, circles and quarter circles, and their gradients."""
    sx, sy, c, s, half, end, radius = np.moveaxis(shapes[which], -1, 0)
    dx, dy = x - sx, y - sy
    along, across = c * dx + s * dy, c * dy - s * dx
    far = np.hypot(dx, dy)
    over = np.where(radius > 0.0, 0.0, np.copysign(np.maximum(np.abs(along) - half, 0.0), along))
    on_line = (radius > 0.0) & (along < far * half)
    ox = np.where(on_line, along - radius * half, np.where(radius > 0.0, along, over))
    oy = np.where(on_line, across - np.copysign(radius * end, across), across)
    length = np.hypot(ox, oy) + 1e-300
    straight = (radius == 0.0) & (over == 0.0)
    away = np.where(straight, across, np.where((radius > 0.0) & ~on_line, far - radius, length))
    nx, ny = np.where(straight, 0.0, ox / length), np.where(straight, 1.0, oy / length)
    return away, c * nx - s * ny, s * nx + c * ny


# Operations in kernels/field_pose/field_refinement.h. Of a point at a pose: its place 8, cell 4, distance from a line
# 9, turn 3, weight 5, cost 2, normal equations 21; in the covariance place, distance and turn, weights 11, two matrices
# 45. Of a step: damping 12, cofactors 18, solution 24. Of a pose: squared distances 5 for each point; covariance 300.
_POINT, _OF_COVARIANCE, _STEP, _COVARIANCE, _LINE = 43, 67, 54, 300, 9


def refinement_flops(points: int, steps: int) -> int:
    """Return the operations of a refinement in which the first line of each cell is the nearest: the least number."""
    evaluations = (steps + 1) * points * (_POINT + _LINE)
    return evaluations + steps * _STEP + points * (_OF_COVARIANCE + _LINE + 5) + _COVARIANCE


def steps_of(device: Device, field_map: DistanceMap, points: NDArray[Any], start: NDArray[Any]) -> int:
    """Return the number of steps after which the refinement of a start does not change its pose."""
    refined = [
        to_numpy(FieldPoseRefinement(map=field_map, max_iterations=steps)(points, start[None], device=device).poses)
        for steps in range(1, FieldPoseRefinement(map=field_map).max_iterations + 1)
    ]
    return 1 + next(steps for steps, pose in enumerate(refined) if np.array_equal(pose, refined[-1]))


def _local(device: Device, field_map: DistanceMap, pose: tuple[float, ...]) -> Case:
    points = _points(field_map, pose, 0.02)
    start = np.add(pose, [0.06, -0.05, 0.06])
    bound = FieldPoseRefinement(map=field_map, count=1).bind(device, points.shape, "f4")
    bound.inputs[0].set(points)
    bound.inputs[1].set(start[None].astype(np.float32))
    ours = bound.run()
    shapes, nearest, scale = field_map.field.shapes, field_map.cells.nearest, field_map.scale
    x0, y0 = field_map.first
    px, py = points.astype(np.float64).T

    def rows(at: NDArray[Any]) -> tuple[Any, ...]:
        c, s = np.cos(at[2]), np.sin(at[2])
        dx, dy = c * px - s * py, s * px + c * py
        x, y = at[0] + dx, at[1] + dy
        row = np.clip(np.rint((y - y0) / field_map.cell).astype(int), 0, nearest.shape[0] - 1)
        column = np.clip(np.rint((x - x0) / field_map.cell).astype(int), 0, nearest.shape[1] - 1)
        candidates = _offsets(shapes, nearest[row, column].T, x, y)
        least = np.argmin(np.abs(candidates[0]), axis=0)
        return (*(each[least, np.arange(_RAYS)] for each in candidates), dx, dy)

    def residuals(at: NDArray[Any]) -> NDArray[Any]:
        away = rows(at)[0]
        return np.array(away / np.sqrt(scale**2 + away**2))

    def slopes(at: NDArray[Any]) -> NDArray[Any]:
        away, nx, ny, dx, dy = rows(at)
        steep = scale**2 / (scale**2 + away**2) ** 1.5
        return np.array(np.stack([nx, ny, ny * dx - nx * dy], axis=-1) * steep[:, None])

    def scipy() -> Any:
        fit = least_squares(residuals, start, slopes, method="lm", xtol=1e-6, ftol=1e-9)
        return fit.x, np.linalg.inv(fit.jac.T @ fit.jac)

    error = float(np.max(np.abs(to_numpy(ours.poses)[0] - scipy()[0])))
    flops = refinement_flops(_RAYS, steps_of(device, field_map, points, start.astype(np.float32)))
    return Case(
        "field",
        "local",
        bound.run,
        {"scipy": scipy},
        error,
        traffic_of(bound),
        metadata={"rays": _RAYS},
        flops=flops,
        copied=False,
    )
