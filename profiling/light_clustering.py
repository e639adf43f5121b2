"""Speed and accuracy of indirect light: ClusteredIrradiance at several range tolerances, compared with all pairs.

The peer is this library without clustering: `OccludedIrradiance` over all pairs, with its copies to and from the
device. Our time includes the traversal of the light tree. `error` is the largest error of the range among the strips
[m], against all pairs in double; ``within`` is the share of strips that keep the tolerance, ``bound`` the largest bound
of a strip. Strips lie across the sheet and see the lit line and its surroundings; one metre of their reading is one
metre of range. If ``traversed`` is false, all pairs are computed, as at tolerance 0: no tolerance takes longer.

``groove``: a line through a groove of 90 degrees, whose sides light each other without occlusion. ``valley``: a curved
surface that occludes parts of itself. ``board``: a board with parts. ``small-...``, ``large-...``: the same with fewer
and with more segments and receivers. ``growth/...``: the groove with two and four times the segments and receivers,
always traversed; ``exponent`` is the growth of the work with the number of pairs since the smallest, 1 for all pairs.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.profiling.harness import Case
from gpuvision.profiling.occluded_irradiance import Board
from gpuvision.simulation.clustering.clustered_irradiance import ClusteredIrradiance
from gpuvision.simulation.errors.range_error import StripErrorModel
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance, segment_rows

Reals = NDArray[np.float64]
Heights = Callable[[Reals, Reals], Reals]

_TOLERANCES = (0.0, 1e-6, 5e-6, 5e-5, 5e-4)
_FEW_TOLERANCES = (0.0, 5e-6, 5e-4)
_AT_GROWTH = 5e-6  # tolerance of the cases growth/... [m]
_SIZES = (1, 2, 4)
_STRIPS, _EACH = 64, 64
_X, _LOW, _HIGH = 0.1, -0.02, 0.04  # half length along the sheet, and limits across it [m]
_ALBEDO = 0.5
_ROUNDING = 1e-9  # rounding error of the kernel in single precision [m]
_OFF_BOARD = 1e-6  # clearance [m]: the receivers on the board have single precision


@dataclass(frozen=True, eq=False)
class Part:
    """Scene with its lit segments and the receivers of its strips."""

    scene: Scene
    segments: Reals
    receivers: Reals
    weights: Reals
    reading: StripErrorModel
    clearance: float | None = None

    @classmethod
    def of(cls, scene: Scene, segments: Reals, receivers: Reals, area: float, width: float, *more: float) -> Part:
        """Return a part with strips of a width [m] that read y.

        ``area`` is the area that a receiver stands for [m^2]. The solid angle of the lens is the same for all
        receivers, so it cancels.
        """
        seen = np.full(receivers.shape[:2], area * _ALBEDO / math.pi)
        limits = receivers[..., 1].min(), receivers[..., 1].max()
        direct = np.full(len(receivers), segments[0, 9] * width / math.pi)
        reading = StripErrorModel(power=direct, moment=0.0 * direct, slope=np.ones(len(direct)), limits=limits)
        return cls(scene, segments, receivers, reading.weights(seen, receivers[..., 1]), reading, *more)

    @classmethod
    def surface(cls, heights: Heights, cells: int, across: int, strips: int = _STRIPS, each: int = _EACH) -> Part:
        """Return a mesh of cells with heights(x, y), lit along y = 0; each strip lies at one x."""
        mesh = _Mesh(heights, cells, across)
        x = np.linspace(-_X, _X, 2 * cells + 1)
        middle, half = 0.5 * (x[1:] + x[:-1]), 0.5 * (x[1] - x[0])
        z, normal = mesh.at(middle, 0.0 * middle)
        slope = -normal[:, 0] / normal[:, 2] * half
        ends = [np.column_stack([middle + s * half, 0.0 * middle, z + s * slope]) for s in (-1.0, 1.0)]
        along, aside = (np.arange(strips) + 0.5) / strips, (np.arange(each) + 0.5) / each
        places = np.meshgrid(_X * (2.0 * along - 1.0), _LOW + (_HIGH - _LOW) * aside, indexing="ij")
        seen, facing = mesh.at(*places)
        width = 2.0 * _X / strips
        return cls.of(
            mesh.scene,
            np.hstack([*ends, normal, np.ones((len(middle), 1))]),
            np.concatenate([np.stack([*places, seen], axis=-1), facing], axis=-1),
            width * (_HIGH - _LOW) / each,
            width,
        )

    @classmethod
    def board(cls, **more: int) -> Part:
        """Return the board of the operation `reflections`, with four times the number of lit segments."""
        board = Board.of(parts_of_segments=4, **more)
        count = board.receivers[..., 0].size
        area, width = 0.1 * 0.08 / count, 0.1 / len(board.receivers)
        rows = segment_rows(board.segments)
        return cls.of(board.scene, rows, board.receivers.astype(float), area, width, _OFF_BOARD)

    def shifts(self, irradiance: NDArray[Any]) -> Reals:
        """Return the readings of the strips, (strips,) [m]."""
        power, moment = (np.sum(self.weights[..., k] * irradiance, axis=1) for k in range(2))
        return np.asarray((self.reading.moment + moment) / (self.reading.power + power))

    def all_pairs(self, device: Device) -> Callable[[], NDArray[Any]]:
        """Return a function that computes all pairs in single, from host to host."""
        real = np.dtype(np.float64 if device.has_double else np.float32)
        operation = OccludedIrradiance(
            scene=self.scene, segments=len(self.segments), clearance=self.clearance, precision="single"
        )
        bound = operation.bind(device, self.receivers.shape, real)
        zeros = np.zeros_like(self.weights)

        def call() -> NDArray[Any]:
            inputs = [each.astype(real, copy=False) for each in (self.receivers, zeros, self.segments)]
            return np.asarray(bound.on_host(inputs).irradiance)

        return call

    def exactly(self, device: Device) -> NDArray[Any]:
        """Return the irradiance of all pairs, in double where the device has it."""
        real = np.dtype(np.float64 if device.has_double else np.float32)
        operation = OccludedIrradiance(scene=self.scene, segments=len(self.segments), clearance=self.clearance)
        inputs = (each.astype(real) for each in (self.receivers, 0.0 * self.weights, self.segments))
        return np.asarray(operation(*inputs, device=device).irradiance)


class _Mesh:
    """Height field on a grid, two triangles per cell; y = 0 runs through the middle of cells."""

    def __init__(self, heights: Heights, cells: int, across: int) -> None:
        self.step = np.array([2.0 * _X / cells, (_HIGH - _LOW) / across])
        self.origin = np.array([-_X, _LOW + self.step[1] * ((0.5 - _LOW / self.step[1]) % 1.0 - 1.0)])
        grid = np.stack(np.meshgrid(np.arange(cells + 1.0), np.arange(across + 2.0), indexing="ij"), axis=-1)
        places = self.origin + self.step * grid
        self.heights = heights(places[..., 0], places[..., 1])
        points = np.concatenate([places, self.heights[..., None]], axis=-1)
        a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
        self.scene = Scene(
            np.concatenate([np.stack(each, axis=2).reshape(-1, 3, 3) for each in ([a, b, c], [a, c, d])])
        )

    def at(self, x: Reals, y: Reals) -> tuple[Reals, Reals]:
        """Return heights and normals of the mesh at positions (x, y)."""
        part = (np.stack([x, y], axis=-1) - self.origin) / self.step
        last = np.array(self.heights.shape) - 2
        cell = np.clip(np.floor(part).astype(int), 0, last)
        i, j = cell[..., 0], cell[..., 1]
        h, part = self.heights, part - cell
        under = part[..., 0] >= part[..., 1]
        by_x = np.where(under, h[i + 1, j] - h[i, j], h[i + 1, j + 1] - h[i, j + 1])
        by_y = np.where(under, h[i + 1, j + 1] - h[i + 1, j], h[i, j + 1] - h[i, j])
        normal = np.stack([-by_x / self.step[0], -by_y / self.step[1], np.ones_like(x)], axis=-1)
        return h[i, j] + by_x * part[..., 0] + by_y * part[..., 1], normal / np.linalg.norm(
            normal, axis=-1, keepdims=True
        )


def _groove(x: Reals, y: Reals) -> Reals:
    return np.asarray(np.abs(x) + 0.0 * y)


def _valley(x: Reals, y: Reals) -> Reals:
    return np.asarray(0.02 * np.cos(x / 0.02) + 0.004 * np.cos(y / 0.01 + 1.0))


def cases(device: Device) -> Iterator[Case]:
    """Yield the scenes at each tolerance, and the groove in increasing sizes."""
    scenes: dict[str, Callable[[], Part]] = {
        "groove": functools.partial(Part.surface, _groove, 64, 16),
        "valley": functools.partial(Part.surface, _valley, 64, 24),
        "board": Part.board,
    }
    sizes: dict[str, Callable[[], Part]] = {
        "small-groove": functools.partial(Part.surface, _groove, 16, 8, strips=16, each=32),
        "small-valley": functools.partial(Part.surface, _valley, 24, 12, strips=32, each=32),
        "large-groove": functools.partial(Part.surface, _groove, 128, 16, strips=128),
        "large-valley": functools.partial(Part.surface, _valley, 128, 48, strips=128),
        "large-board": functools.partial(Part.board, strips=800),
    }
    for name, make in (scenes | sizes).items():
        part = make()
        exact = part.exactly(device)
        for tolerance in _TOLERANCES if name in scenes else _FEW_TOLERANCES:
            yield _case(device, f"{name}/{tolerance:g}", part, tolerance, exact)
    first: Case | None = None
    for times in _SIZES:
        part = Part.surface(_groove, 32 * times, 16, strips=32 * times)
        grown = _case(
            device, f"growth/x{times}", part, _AT_GROWTH, part.exactly(device), since=first, min_facing_pairs=None
        )
        first = first or grown
        yield grown


def _case(
    device: Device,
    name: str,
    part: Part,
    tolerance: float,
    exact: NDArray[Any],
    since: Case | None = None,
    **least: int | None,
) -> Case:
    light = ClusteredIrradiance(scene=part.scene, tolerance=tolerance, clearance=part.clearance, device=device, **least)
    call = functools.partial(light, part.segments, part.receivers, part.weights, part.reading)
    result = call()
    off = np.abs(part.shifts(result.irradiance) - part.shifts(exact))
    counts = result.cut.counts
    pairs = max(counts["pairs"], 1)
    metadata: dict[str, Any] = {
        "tolerance": tolerance,
        "bound": float(result.cut.bound.max()),
        "within": float(np.mean(off <= max(tolerance, _ROUNDING))),
        "shift": float(np.median(np.abs(part.shifts(exact)))),
        "pairs": pairs,
        "traversed": result.cut.traversed,
        **{kind: counts[kind] / pairs for kind in ("exact", "clear", "clustered", "work")},
    }
    if since is not None:
        more = math.log(pairs / since.metadata["pairs"])
        metadata["exponent"] = 1.0 + math.log(metadata["work"] / since.metadata["work"]) / more
    return Case(
        "light_clustering", name, call, {"gpuvision": part.all_pairs(device)}, float(off.max()), metadata=metadata
    )
