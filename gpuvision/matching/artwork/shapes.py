"""Drawn layers of a board as polygons [m], and the parts of a straight line that they cover."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from gpuvision.host.reading import FileLimit

Float64 = npt.NDArray[np.float64]
Crossings = list[tuple[bool, Float64]]
Number = TypeVar("Number", np.float64, np.int64)

MAX_BOARD_SIZE = FileLimit("GPUVISION_MAX_BOARD_SIZE", 2.0)
"""Largest coordinate of a board [m]. Chosen: 2 m; production panels have up to 1.5 m."""
SAGITTA = 0.5e-6
"""Largest distance [m] between an arc and the chord that stands for it."""
_MOST_CHORDS = 100_000  # of one arc; a full circle with a radius of 1 m has 3200
# Of the grid over the shapes of a layer. Chosen: it takes at most 64 MiB; fewer than 64 shapes are compared at once.
_MOST_CELLS, _FEWEST_CELLS = 1000, 8  # along each axis
_MOST_CELLS_OF_A_BOX = 64
# A query, a shape near its line, and a shape that crosses it take the time of as many comparisons (measured: 40, 10 and
# 40 us, and 50 ns for a comparison).
_PER_QUERY, _PER_SHAPE, _PER_CROSSING = 800, 200, 800


@dataclass(frozen=True, eq=False)
class Shape:
    """Area of a layer; later areas are drawn over earlier ones.

    Attributes
    ----------
    outline : (n, 2)
        Corners [m], closed from the last to the first; points with an odd number of crossings to the outside are
        inside.
    dark
        True where the layer's material (copper, ink, mask opening) is added, False where it is cleared. Default True.
    holes
        Outlines (n, 2) of areas [m] that do not belong to the shape: earlier shapes of the layer are visible there.
    """

    outline: Float64
    dark: bool = True
    holes: tuple[Float64, ...] = ()


@dataclass(frozen=True, eq=False)
class DrawnObject:
    """Object of a layer: its areas, and its attributes in the file.

    Attributes
    ----------
    kind
        "flash", "stroke" or "region".
    shapes
        Its areas, all of them added or all of them cleared.
    ends : (2, 2), optional
        Ends of the centre line of a straight stroke [m]; None for all else.
    width
        Width of a stroke with a round aperture [m], otherwise NaN.
    function
        ``.AperFunction`` of Gerber X2, ``""`` where the file does not have it.
    net, part, pin
        ``.N`` and ``.P`` of Gerber X2, ``""`` where the file does not have them.
    """

    kind: str
    shapes: tuple[Shape, ...]
    ends: Float64 | None = None
    width: float = math.nan
    function: str = ""
    net: str = ""
    part: str = ""
    pin: str = ""

    @cached_property
    def bounds(self) -> Float64:
        """(2, 2) least and greatest x, y [m] of the areas."""
        points = np.concatenate([each.outline for each in self.shapes])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @property
    def centre(self) -> Float64:
        """(2,) centre of the bounds [m]."""
        return np.asarray(self.bounds.mean(axis=0))


class Layer:
    """Shapes of one layer in drawing order, for queries along lines.

    Parameters
    ----------
    shapes
        Shapes in drawing order.

    Attributes
    ----------
    comparisons : int
        Comparisons of sides of shapes with a line in all queries so far, a measure of their time.
    """

    def __init__(self, shapes: tuple[Shape, ...]) -> None:
        self.shapes = shapes
        counts = np.array([len(each.outline) for each in shapes], dtype=np.int64)
        self._stop = np.cumsum(counts)
        self._start = self._stop - counts
        outlines = [each.outline for each in shapes] or [np.empty((0, 2))]
        self._from = np.concatenate(outlines)
        self._to = np.concatenate([np.roll(each, -1, axis=0) for each in outlines])
        self._low = np.array([each.outline.min(axis=0) for each in shapes]).reshape(-1, 2)
        self._high = np.array([each.outline.max(axis=0) for each in shapes]).reshape(-1, 2)
        self._boxes = _BoxIndex(self._low, self._high)
        self.comparisons = 0

    def crossings(self, start: Float64, end: Float64) -> Crossings:
        """Return the shapes at a segment, in drawing order: whether dark, and where the infinite line crosses them.

        These are the shapes that the line crosses and whose bounding box overlaps the bounding box of the segment.

        Parameters
        ----------
        start, end
            (2,) ends of the segment [m]; the crossings are 0 at the start and 1 at the end.
        """
        if not self.shapes:
            self.comparisons += _PER_QUERY
            return []
        low, high = np.minimum(start, end), np.maximum(start, end)
        near = self._boxes.near(low, high)
        overlaps = (self._low[near] <= high) & (self._high[near] >= low)
        near = near[overlaps[:, 0] & overlaps[:, 1]]
        self.comparisons += _PER_QUERY
        if not len(near):
            return []
        along = end - start
        sides = _ranges(self._start[near], self._stop[near])
        self.comparisons += len(sides) + _PER_SHAPE * len(near)
        # Few sides cross the line: only these are sorted by shape.
        side_a, side_b = (_side(ends[sides] - start, along) for ends in (self._from, self._to))
        crosses = (side_a > 0) != (side_b > 0)
        crossing = sides[crosses]
        if not len(crossing):
            return []
        points = _on_line(self._from[crossing] - start, self._to[crossing] - start, side_a[crosses], side_b[crosses])
        owner = np.searchsorted(self._stop, crossing, side="right")
        first = np.searchsorted(owner, near)
        last = np.searchsorted(owner, near, side="right")
        found = []
        for index, begin, stop in zip(near, first, last, strict=True):
            if begin == stop:
                continue
            self.comparisons += _PER_CROSSING
            where = np.sort(points[begin:stop] @ along / (along @ along))
            shape = self.shapes[index]
            if shape.holes:
                holes = [
                    _places_on_line(each - start, np.roll(each, -1, axis=0) - start, along) for each in shape.holes
                ]
                where = _without(where, holes)
            found.append((shape.dark, where))
        return found


class _BoxIndex:
    """Uniform grid over bounding boxes: the boxes near a place are found without comparing all of them.

    A box that covers many cells is listed apart, and found by every query.
    """

    def __init__(self, low: Float64, high: Float64) -> None:
        self._count = len(low)
        self._cells = min(int(math.sqrt(self._count)), _MOST_CELLS)
        if self._cells < _FEWEST_CELLS:
            return
        self._origin = low.min(axis=0)
        self._size = np.maximum((high.max(axis=0) - self._origin) / self._cells, SAGITTA)
        self._corner, self._extent = self._origin.tolist(), self._size.tolist()
        first, last = self._cell(low), self._cell(high)
        spans = last - first + 1
        is_large = np.prod(spans, axis=1) > _MOST_CELLS_OF_A_BOX
        self._large = np.flatnonzero(is_large)
        small = np.flatnonzero(~is_large)
        covered = np.prod(spans[small], axis=1)
        box = np.repeat(small, covered)
        within = _ranges(np.zeros_like(covered), covered)
        column = first[box, 0] + within % spans[box, 0]
        row = first[box, 1] + within // spans[box, 0]
        cell = row * self._cells + column
        order = np.argsort(cell, kind="stable")
        self._box = box[order]
        self._first = np.searchsorted(cell[order], np.arange(self._cells**2 + 1))

    def _cell(self, point: Float64) -> npt.NDArray[np.int64]:
        """Return column and row of the cells of points; points outside belong to the nearest cell."""
        return np.asarray(np.clip((point - self._origin) / self._size, 0, self._cells - 1), np.int64)

    def near(self, low: Float64, high: Float64) -> npt.NDArray[np.int64]:
        """Return, ascending, the indices of all boxes that overlap the box from low to high, and of some others."""
        if self._cells < _FEWEST_CELLS:
            return np.arange(self._count)
        (left, bottom), (right, top) = (self._cell_of(*each.tolist()) for each in (low, high))
        rows = range(bottom * self._cells, (top + 1) * self._cells, self._cells)
        parts = [self._box[self._first[row + left] : self._first[row + right + 1]] for row in rows]
        return sorted_unique(np.concatenate([self._large, *parts]))

    def _cell_of(self, x: float, y: float) -> tuple[int, int]:
        """Return `_cell` of one point, without the cost of small arrays."""
        last, (left, bottom), (width, height) = self._cells - 1, self._corner, self._extent
        return int(min(max((x - left) / width, 0), last)), int(min(max((y - bottom) / height, 0), last))


def sorted_unique(values: npt.NDArray[Number]) -> npt.NDArray[Number]:
    """Return the different values in ascending order: `numpy.unique`, 5 times faster for a few numbers."""
    ordered = np.sort(values)
    is_new = np.empty(len(ordered), np.bool_)
    is_new[:1] = True
    np.not_equal(ordered[1:], ordered[:-1], out=is_new[1:])
    return np.asarray(ordered[is_new])


def _ranges(start: npt.NDArray[np.int64], stop: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the integers from each start to before its stop, one range after the other."""
    lengths = stop - start
    total = np.cumsum(lengths)
    return np.asarray(np.arange(total[-1] if len(total) else 0) + np.repeat(start - total + lengths, lengths), np.int64)


def _side(points: Float64, along: Float64) -> Float64:
    """Return the cross products of a vector with points: above 0 on the left of the line along the vector."""
    return np.asarray(along[0] * points[:, 1] - along[1] * points[:, 0])


def _places_on_line(a: Float64, b: Float64, along: Float64) -> Float64:
    """Return where the sides from a to b cross the line from the origin along a vector (1 at its end), ascending."""
    side_a, side_b = _side(a, along), _side(b, along)
    crosses = (side_a > 0) != (side_b > 0)
    points = _on_line(a[crosses], b[crosses], side_a[crosses], side_b[crosses])
    return np.sort(points @ along / (along @ along))


def _on_line(a: Float64, b: Float64, side_a: Float64, side_b: Float64) -> Float64:
    """Return where the sides from a to b cross a line, from the cross products of a and b with it."""
    share = side_a / (side_a - side_b)
    return np.asarray(a + share[:, None] * (b - a))


def _without(where: Float64, holes: list[Float64]) -> Float64:
    """Return the crossings of a shape without its holes, from the crossings of its outline and of each hole."""
    cuts = np.sort(np.concatenate([where, *holes]))
    middle = (cuts[1:] + cuts[:-1]) / 2
    inside = np.searchsorted(where, middle) % 2 == 1
    for each in holes:
        inside &= np.searchsorted(each, middle) % 2 == 0
    return np.asarray(cuts[np.diff(inside, prepend=False, append=False)])


def is_covered(crossings: Crossings, at: Float64) -> npt.NDArray[np.bool_]:
    """Return whether the material of a layer lies at places along a line; see `Layer.crossings`."""
    is_dark = np.zeros(len(at), dtype=np.bool_)
    for dark, where in crossings:
        is_dark[np.searchsorted(where, at) % 2 == 1] = dark
    return is_dark


def disk(centre: Float64, radius: float) -> Float64:
    """Return the regular polygon with the area of a circle: (n, 2) corners within `SAGITTA` of it.

    The polygon is symmetric in x and y.
    """
    count = 4 * math.ceil(count_chords(radius, 2 * math.pi) / 4)
    angle = np.arange(count) * (2 * math.pi / count)
    step = 2 * math.pi / count
    radius *= math.sqrt(step / math.sin(step))
    return np.asarray(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def capsule(start: Float64, end: Float64, radius: float) -> Float64:
    """Return the polygon that a disk of a radius [m] sweeps along a segment: straight sides, chords around the ends."""
    along = end - start
    if not along.any():
        return disk(start, radius)
    angle = math.atan2(along[1], along[0]) + np.linspace(-math.pi / 2, math.pi / 2, count_chords(radius, math.pi) + 1)
    cap = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([end + cap, start - cap])


def hull(points: Float64) -> Float64:
    """Return the corners of the convex hull, counter-clockwise (Andrew's monotone chain)."""
    order = sorted(set(map(tuple, points.tolist())))

    def half(sequence: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
        chain: list[tuple[float, ...]] = []
        for x, y in sequence:
            while len(chain) > 1:
                (ax, ay), (bx, by) = chain[-2:]
                if (bx - ax) * (y - by) - (by - ay) * (x - bx) > 0:
                    break
                chain.pop()
            chain.append((x, y))
        return chain[:-1]

    return np.array(half(order) + half(order[::-1]))


def area(outline: Float64) -> float:
    """Return the signed area [m^2] inside an outline, positive where it runs counter-clockwise."""
    x, y = (outline - outline[0]).T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def count_chords(radius: float, angle: float) -> int:
    """Return the number of chords of an arc."""
    half = math.acos(1 - min(SAGITTA / max(radius, SAGITTA), 0.05))
    if not angle <= 2 * half * _MOST_CHORDS:
        raise ValueError(f"an arc or aperture with a radius of {radius:.4g} m, which is too large for a board")
    return max(math.ceil(angle / (2 * half)), 1)


def arc(start: Float64, end: Float64, centre: Float64, clockwise: bool) -> Float64:
    """Return the corners of an arc from its start, without its end; an arc from a point to itself is a full circle."""
    a = start - centre
    radius, sweep = radius_and_sweep(start, end, centre, clockwise)
    count = count_chords(radius, abs(sweep))
    angle = math.atan2(a[1], a[0]) + np.arange(count) * (sweep / count)
    return np.asarray(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def radius_and_sweep(start: Float64, end: Float64, centre: Float64, clockwise: bool) -> tuple[float, float]:
    """Return the radius of an arc and its angle, negative where it runs clockwise; equal ends are a full circle."""
    a, b = start - centre, end - centre
    sweep = (math.atan2(b[1], b[0]) - math.atan2(a[1], a[0])) % (2 * math.pi)
    sweep = sweep - 2 * math.pi if clockwise and sweep > 0 else sweep
    if np.allclose(start, end, rtol=0, atol=1e-9):
        sweep = -2 * math.pi if clockwise else 2 * math.pi
    return math.hypot(*a), sweep
