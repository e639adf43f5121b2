"""Lines of a field, and their distance map: the nearest lines, and the cost of a point, in each cell of a grid."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Array, Device, FloatArray, Launch, LaunchBuilder, StatusArray, padded_rows, vector_work
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite, numbers

COST_LEVELS = 1023
"""Steps of a point's cost in the map: 64 points fit 16 bits."""
ANGLE_ROUNDING = 1e-9
"""Largest difference [rad] of an arc's opening from 2 pi at which it is a circle: rounding of angles, with a margin."""
_BLOCK, _NEAREST, _MOST_LINES = 64, 4, 256
_MOST_CELLS = 1 << 26
# Tile of the vector variant. Rows: chosen, a field of 20 m in cells of 5 cm has 33 work-items; columns: LANES in
# kernels/common/lanes.h.
_TILE_ROWS, _TILE_COLUMNS = 16, 16


class Arc(NamedTuple):
    """Arc of a circle, counter-clockwise from ``start`` to ``end``; a full circle where these differ by 2 pi.

    Attributes
    ----------
    x, y, radius
        Centre and radius [m].
    start, end
        Angles [rad].
    """

    x: float
    y: float
    radius: float
    start: float = 0.0
    end: float = 2.0 * math.pi


@dataclass(frozen=True, kw_only=True)
class Field:
    """Lines of a field, in metres relative to its centre.

    Parameters
    ----------
    length, width : float
        Size of the field in x and in y [m], above 0.
    lines : tuple of (float, float, float, float)
        Straight lines: x, y of both ends [m].
    arcs : tuple of Arc
        Arcs of circles.
    name : str
        Name of the field.

    Raises
    ------
    ValueError
        A size is not positive, a line has no length, or there are no lines and arcs, or more than 256.
    """

    length: float
    width: float
    lines: tuple[tuple[float, float, float, float], ...] = ()
    arcs: tuple[Arc, ...] = ()
    name: str = ""

    def __post_init__(self) -> None:
        for name in ("length", "width"):
            if finite(getattr(self, name), f"Field.{name}") <= 0.0:
                raise ValueError(f"Field.{name} is {getattr(self, name)}, expected metres above 0")
        lines = tuple(numbers(each, (4,), "Field.lines") for each in self.lines)
        arcs = tuple(Arc(*numbers(each, (5,), "Field.arcs")) for each in self.arcs)
        if not lines and not arcs:
            raise ValueError("Field has neither lines nor arcs; expected one at least")
        if len(lines) + len(arcs) > _MOST_LINES:
            raise ValueError(f"Field has {len(lines) + len(arcs)} lines and arcs, expected {_MOST_LINES} at most")
        if any(line[:2] == line[2:] for line in lines):
            raise ValueError("Field.lines has one that begins where it ends; leave it out")
        for arc in arcs:
            if arc.radius <= 0.0 or not 0.0 < arc.end - arc.start <= 2.0 * math.pi + ANGLE_ROUNDING:
                raise ValueError(f"Field.arcs has {arc}, expected a radius above 0 and start < end <= start + 2 pi")
        object.__setattr__(self, "lines", lines)
        object.__setattr__(self, "arcs", arcs)

    @property
    def shapes(self) -> npt.NDArray[np.float64]:
        """Table of ``kernels/distance_map/field.h``, (lines + arcs, 7)."""
        rows = []
        for x0, y0, x1, y1 in self.lines:
            half = 0.5 * math.hypot(x1 - x0, y1 - y0)
            turn = (0.5 * (x1 - x0) / half, 0.5 * (y1 - y0) / half)
            rows.append((0.5 * (x0 + x1), 0.5 * (y0 + y1), *turn, half, 0.0, 0.0))
        for arc in self.arcs:
            middle, half = 0.5 * (arc.start + arc.end), 0.5 * (arc.end - arc.start)
            ends = (-2.0, 0.0) if half > math.pi - ANGLE_ROUNDING else (math.cos(half), math.sin(half))
            rows.append((arc.x, arc.y, math.cos(middle), math.sin(middle), *ends, arc.radius))
        return np.array(rows)

    @property
    def is_symmetric(self) -> bool:
        """Whether half a turn maps the field to itself: then every pose has a symmetric twin with the same image."""
        lines = {_rounded(min((x0, y0, x1, y1), (x1, y1, x0, y0))) for x0, y0, x1, y1 in self.lines}
        turned = {_rounded(min((-x0, -y0, -x1, -y1), (-x1, -y1, -x0, -y0))) for x0, y0, x1, y1 in self.lines}
        arcs = {_arc_key(arc) for arc in self.arcs}
        half_turned = {_arc_key(Arc(-x, -y, r, a + math.pi, b + math.pi)) for x, y, r, a, b in self.arcs}
        return lines == turned and arcs == half_turned


def _rounded(values: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(round(each, 6) + 0.0 for each in values)


def _arc_key(arc: Arc) -> tuple[float, ...]:
    opening = arc.end - arc.start
    middle = 0.0 if opening > 2.0 * math.pi - ANGLE_ROUNDING else 0.5 * (arc.start + arc.end)
    return _rounded((arc.x, arc.y, arc.radius, opening, math.cos(middle), math.sin(middle)))


class DistanceMapCells(NamedTuple):
    """Cells of a distance map, (rows, columns), rows along y.

    Attributes
    ----------
    distance : float32
        Distance from the cell's centre to the nearest line [m].
    nearest : uint8, (rows, columns, 4)
        Indices of the lines (arcs after the straight lines) that may be the nearest one in the cell, the nearest line
        of its centre first; it is repeated where there are fewer than four.
    level : uint16
        Cost d^2 / (c^2 + d^2) of a point in `COST_LEVELS` steps, rounded.
    """

    distance: FloatArray
    nearest: StatusArray
    level: Array


@dataclass(frozen=True, kw_only=True)
class DistanceMapBuilder(VisionOperation[DistanceMapCells]):
    """Computation of a distance map: ``op(x) -> DistanceMapCells``.

    The input x is float32 (columns,), the positions of the columns [m].

    Parameters
    ----------
    field : Field
        Lines of the field.
    first_y, cell : float
        Position of the first row, and distance between rows [m].
    rows : int
        Number of rows.
    scale : float
        c of the cost d^2 / (c^2 + d^2) [m].

    Notes
    -----
    Distances are exact to single precision: 2e-6 m in a field of 20 m.
    """

    Result: ClassVar[type[Any]] = DistanceMapCells

    field: Field
    first_y: float
    cell: float
    rows: int
    scale: float

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype)
        build.check_dtype("float32", of="coordinates")
        build.check_shape(len(shape) == 1 and shape[0] > 0, "coordinates (columns,)")
        shapes = self.field.shapes.astype(np.float32)
        cells = (self.rows, *shape)
        in_tiles = build.uses_vectors and shape[0] >= _TILE_COLUMNS
        return build.launch(
            "distance_map/distance_map.cl",
            "distance_map",
            work=vector_work(self.rows, _TILE_ROWS) if in_tiles else padded_rows(self.rows, shape[0]),
            outputs=build.outputs(
                {"distance": cells, "nearest": (*cells, _NEAREST), "level": cells}, nearest=np.uint8, level=np.uint16
            ),
            defines={"COST_LEVELS": COST_LEVELS, "TILE_ROWS": _TILE_ROWS, "MAX_SHAPES": _MOST_LINES},
            arguments=[
                np.float32(self.first_y),
                np.float32(self.cell),
                shapes.ravel(),
                np.int32(len(shapes)),
                np.float32(self.scale**2),
                np.uint32(shape[0]),
                np.uint32(self.rows),
            ],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceMap:
    """Distance map of a field: computed once, searched with the points of every image.

    Poses are searched at the centres of the cells, over the field and ``margin`` around it; the map extends by
    ``max_range`` beyond them.

    Parameters
    ----------
    field : Field
        Lines of the field.
    cell : float
        Distance between cells [m], above 0, default 0.05.
    scale : float
        c of a point's cost d^2 / (c^2 + d^2) at a distance d from the nearest line [m], above 0, default 0.25: points
        much farther away count as outliers. 0.25 m suits a field of 20 m.
    max_range : float
        Points farther from the robot are not used [m], above 0, default 6.
    margin : float
        Width of the border around the field in which the robot may be [m], 0 or more, default 0.
    device : Device, optional
        Where to compute the map; None: `Device.best`.

    Raises
    ------
    ValueError
        A size is out of its range, or the map would have too many cells.
    """

    field: Field
    cell: float = 0.05
    scale: float = 0.25
    max_range: float = 6.0
    margin: float = 0.0
    device: Device | None = None
    cells: DistanceMapCells = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("cell", "scale", "max_range"):
            if finite(getattr(self, name), f"DistanceMap.{name}") <= 0.0:
                raise ValueError(f"DistanceMap.{name} is {getattr(self, name)}, expected metres above 0")
        if finite(self.margin, "DistanceMap.margin") < 0.0:
            raise ValueError(f"DistanceMap.margin is {self.margin}, expected metres, 0 or more")
        extent = max(self.field.length, self.field.width) + 2.0 * (self.margin + self.max_range)
        if extent / self.cell > math.sqrt(_MOST_CELLS):
            raise ValueError(
                f"DistanceMap.cell is {self.cell} m, expected {extent / math.sqrt(_MOST_CELLS):.2g} m or more for this "
                f"field; make it larger or max_range smaller"
            )
        rows, columns = self.positions
        border = self.border
        x0, y0 = self.first
        # The kernel reads complete blocks of positions.
        wide = max(columns, _BLOCK) + 2 * border
        x = (x0 + self.cell * np.arange(wide)).astype(np.float32)
        op = DistanceMapBuilder(field=self.field, first_y=y0, cell=self.cell, rows=rows + 2 * border, scale=self.scale)
        object.__setattr__(self, "cells", op(x, device=self.device))

    @property
    def positions(self) -> tuple[int, int]:
        """Rows and columns of searched positions."""
        rows, columns = (
            round((size + 2.0 * self.margin) / self.cell) or 1 for size in (self.field.width, self.field.length)
        )
        return rows, columns

    @property
    def border(self) -> int:
        """Cells beyond the searched positions, on every side."""
        return math.ceil(self.max_range / self.cell) + 1

    @property
    def first(self) -> tuple[float, float]:
        """Position (x, y) of the first cell [m]."""
        rows, columns = self.positions
        return -self.cell * (0.5 * (columns - 1) + self.border), -self.cell * (0.5 * (rows - 1) + self.border)

    @property
    def first_position(self) -> tuple[float, float]:
        """First searched position (x, y) [m]."""
        rows, columns = self.positions
        return -self.cell * 0.5 * (columns - 1), -self.cell * 0.5 * (rows - 1)
