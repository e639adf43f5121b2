"""A field's lines, and a map over them: which line is the nearest everywhere, and what a point there costs."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Launch, LaunchBuilder, WorkSize
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite, numbers

LEVELS = 1023
"""Steps of a point's cost in the map: 64 points fit 16 bits."""
_BLOCK, _NEAREST, _MOST_LINES = 64, 4, 256
_MOST_CELLS = 1 << 26


class Arc(NamedTuple):
    """A part of a circle, counter-clockwise from ``start`` to ``end`` [rad]; a whole circle where they are 2 pi apart.

    Attributes
    ----------
    x, y, radius
        Centre and radius, m.
    start, end
        rad.
    """

    x: float
    y: float
    radius: float
    start: float = 0.0
    end: float = 2.0 * math.pi


@dataclass(frozen=True, kw_only=True)
class Field:
    """The lines of a field, in metres about its middle.

    Parameters
    ----------
    length, width
        Of the area in x and in y, m.
    lines
        Straight ones, (x, y, x, y) of their ends.
    arcs
        Parts of circles.
    name
        What it is called.

    Raises
    ------
    ValueError
        A size is not positive, a line has no length, or there is no line at all or more than 256.
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
            if arc.radius <= 0.0 or not 0.0 < arc.end - arc.start <= 2.0 * math.pi + 1e-9:
                raise ValueError(f"Field.arcs has {arc}, expected a radius above 0 and start < end <= start + 2 pi")
        object.__setattr__(self, "lines", lines)
        object.__setattr__(self, "arcs", arcs)

    @property
    def shapes(self) -> npt.NDArray[np.float64]:
        """The table of ``kernels/field/field.h``, (lines + arcs, 7)."""
        rows = []
        for x0, y0, x1, y1 in self.lines:
            half = 0.5 * math.hypot(x1 - x0, y1 - y0)
            turn = (0.5 * (x1 - x0) / half, 0.5 * (y1 - y0) / half)
            rows.append((0.5 * (x0 + x1), 0.5 * (y0 + y1), *turn, half, 0.0, 0.0))
        for arc in self.arcs:
            middle, half = 0.5 * (arc.start + arc.end), 0.5 * (arc.end - arc.start)
            ends = (-2.0, 0.0) if half > math.pi - 1e-9 else (math.cos(half), math.sin(half))
            rows.append((arc.x, arc.y, math.cos(middle), math.sin(middle), *ends, arc.radius))
        return np.array(rows)

    @property
    def is_symmetric(self) -> bool:
        """Whether half a turn leaves the field as it is: then every pose has a twin that looks the same."""
        lines = {_rounded(min((x0, y0, x1, y1), (x1, y1, x0, y0))) for x0, y0, x1, y1 in self.lines}
        turned = {_rounded(min((-x0, -y0, -x1, -y1), (-x1, -y1, -x0, -y0))) for x0, y0, x1, y1 in self.lines}
        arcs = {_arc_key(arc) for arc in self.arcs}
        half_turned = {_arc_key(Arc(-x, -y, r, a + math.pi, b + math.pi)) for x, y, r, a, b in self.arcs}
        return lines == turned and arcs == half_turned


def _rounded(values: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(round(each, 6) + 0.0 for each in values)


def _arc_key(arc: Arc) -> tuple[float, ...]:
    opening = arc.end - arc.start
    middle = 0.0 if opening > 2.0 * math.pi - 1e-9 else 0.5 * (arc.start + arc.end)
    return _rounded((arc.x, arc.y, arc.radius, opening, math.cos(middle), math.sin(middle)))


class FieldCells(NamedTuple):
    """What is known of every cell, (rows, columns), rows along y.

    Attributes
    ----------
    distance
        float32, of the cell's middle to the nearest line, m.
    nearest
        uint8 (rows, columns, 4), which lines (arcs after the straight ones) may be the nearest within the cell, that
        of its middle first; it stands again where there are fewer.
    level
        uint16, `LEVELS` times d^2 / (c^2 + d^2), rounded.
    """

    distance: Any
    nearest: Any
    level: Any


@dataclass(frozen=True, kw_only=True)
class DistanceMapBuilder(VisionOperation[FieldCells]):
    """Cells over a field: ``op(x) -> FieldCells``, x float32 (columns,): where the columns are [m].

    Parameters
    ----------
    field
        Its lines.
    first_y, cell, rows
        The first row, the distance of rows [m], and how many there are.
    scale
        c of d^2 / (c^2 + d^2), m.

    Notes
    -----
    Distances are exact to single precision: 2e-6 m in a field of 20 m.
    """

    Result: ClassVar[type[Any]] = FieldCells

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
        return build.launch(
            "field/distance_map.cl",
            "field_map",
            work=WorkSize((shape[0], self.rows), None),
            outputs=build.outputs(
                {"distance": cells, "nearest": (*cells, _NEAREST), "level": cells}, nearest=np.uint8, level=np.uint16
            ),
            defines={"FIELD_LEVELS": LEVELS},
            arguments=[
                np.float32(self.first_y),
                np.float32(self.cell),
                shapes.ravel(),
                np.int32(len(shapes)),
                np.float32(self.scale**2),
            ],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceMap:
    """A field on a grid: made once, searched with every view.

    Poses are looked for on the cells' middles, over the field and ``outside`` it; the map goes on for ``reach`` beyond
    them, as far as points are seen.

    Parameters
    ----------
    field
        Its lines.
    cell
        Distance of cells, m.
    scale
        c of a point's cost d^2 / (c^2 + d^2) at a distance d from the nearest line, m: what is much further away is no
        line of this field (about 0.25 m in a field of 20 m).
    reach
        Points further from the robot than this are not used, m.
    outside
        How far beside the field the robot may be, m.
    device
        Which makes it; None: the best.

    Raises
    ------
    ValueError
        A size is not positive (``outside``: negative), or they make too many cells.
    """

    field: Field
    cell: float = 0.05
    scale: float = 0.25
    reach: float = 6.0
    outside: float = 0.0
    device: Device | None = None
    cells: FieldCells = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("cell", "scale", "reach"):
            if finite(getattr(self, name), f"DistanceMap.{name}") <= 0.0:
                raise ValueError(f"DistanceMap.{name} is {getattr(self, name)}, expected metres above 0")
        if finite(self.outside, "DistanceMap.outside") < 0.0:
            raise ValueError(f"DistanceMap.outside is {self.outside}, expected metres, 0 or more")
        extent = max(self.field.length, self.field.width) + 2.0 * (self.outside + self.reach)
        if extent / self.cell > math.sqrt(_MOST_CELLS):
            raise ValueError(
                f"DistanceMap.cell is {self.cell} m, expected {extent / math.sqrt(_MOST_CELLS):.2g} m or more for this "
                f"field; make it larger or the reach shorter"
            )
        rows, columns = self.positions
        border = self.border
        x0, y0 = self.first
        # A whole block of positions is read.
        wide = max(columns, _BLOCK) + 2 * border
        x = (x0 + self.cell * np.arange(wide)).astype(np.float32)
        op = DistanceMapBuilder(field=self.field, first_y=y0, cell=self.cell, rows=rows + 2 * border, scale=self.scale)
        object.__setattr__(self, "cells", op(x, device=self.device))

    @property
    def positions(self) -> tuple[int, int]:
        """Rows and columns of positions that are looked at."""
        rows, columns = (
            round((size + 2.0 * self.outside) / self.cell) or 1 for size in (self.field.width, self.field.length)
        )
        return rows, columns

    @property
    def border(self) -> int:
        """Cells beyond the positions, on every side."""
        return math.ceil(self.reach / self.cell) + 1

    @property
    def first(self) -> tuple[float, float]:
        """Place (x, y) of the first cell, m."""
        rows, columns = self.positions
        return -self.cell * (0.5 * (columns - 1) + self.border), -self.cell * (0.5 * (rows - 1) + self.border)

    @property
    def first_position(self) -> tuple[float, float]:
        """The first position (x, y) that is looked at, m."""
        rows, columns = self.positions
        return -self.cell * 0.5 * (columns - 1), -self.cell * 0.5 * (rows - 1)
