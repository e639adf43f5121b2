"""Drawn layers of a board as polygons [m], and the parts of a straight line that they cover."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from gerbonara import graphic_objects, graphic_primitives
from gerbonara.apertures import ApertureMacroInstance, CircleAperture, ExcellonTool
from gerbonara.utils import MM

from gpuvision.host.reading import FileLimit
from gpuvision.matching.artwork.gerber_parser import TransformedAperture

Float64 = npt.NDArray[np.float64]
Crossings = list[tuple[bool, Float64]]

MAX_BOARD_SIZE = FileLimit("GPUVISION_MAX_BOARD_SIZE", 2.0)
"""Largest coordinate of a board [m]. Chosen: 2 m; production panels have up to 1.5 m."""
SAGITTA = 0.5e-6
"""Largest distance [m] between an arc and the chord that stands for it."""
_METRE = 1e-3  # all calls of gerbonara use millimetres
_MOST_CHORDS = 100_000  # of one arc; a full circle with a radius of 1 m has 3200
_MOST_LINES = 10_000  # of an arc that is drawn with an aperture; a circle with a radius of 1 m has 3200
_MOST_CORNERS = 5_000_000  # of a layer. Chosen: they take 300 MiB with the arrays of `Layer`
_MOST_VERTICES = 1000  # of a regular polygon; the Gerber format allows 12
# Of the grid over the shapes of a layer. Chosen: it takes at most 64 MiB; fewer than 64 shapes are compared at once.
_MOST_CELLS, _FEWEST_CELLS = 1000, 8  # along each axis
_MOST_CELLS_OF_A_BOX = 64
# A query, a shape near its line, and a shape that crosses it take the time of as many comparisons (measured: 40, 10 and
# 40 us, and 50 ns for a comparison).
_PER_QUERY, _PER_SHAPE, _PER_CROSSING = 800, 200, 800
_POLYGON_CODE = 5
# Codes of primitives of aperture macros that gerbonara 1.5 draws wrongly, or cannot draw.
_MOIRE_CODE = 6
_THERMAL_CODE = 7


@dataclass(frozen=True, eq=False)
class Shape:
    """Area of a layer; later areas are drawn over earlier ones.

    Attributes
    ----------
    outline : (n, 2)
        Corners [m], closed from the last to the first; points with an odd number of crossings to the outside are
        inside.
    dark
        True where the layer's material (copper, ink, mask opening) is added, False where it is cleared.
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
        low, high = np.minimum(start, end), np.maximum(start, end)
        near = self._boxes.near(low, high)
        near = near[np.all((self._low[near] <= high) & (self._high[near] >= low), axis=1)]
        self.comparisons += _PER_QUERY
        if not len(near):
            return []
        along = end - start
        sides = _ranges(self._start[near], self._stop[near])
        self.comparisons += len(sides) + _PER_SHAPE * len(near)
        # Few sides cross the line: only these are sorted by shape.
        side_a, side_b = (_side(ends[sides] - start, along) for ends in (self._from, self._to))
        crossing = sides[(side_a > 0) != (side_b > 0)]
        owner = np.searchsorted(self._stop, crossing, side="right")
        first = np.searchsorted(owner, near)
        last = np.searchsorted(owner, near, side="right")
        found = []
        for index, begin, stop in zip(near, first, last, strict=True):
            if begin == stop:
                continue
            self.comparisons += _PER_CROSSING
            span = crossing[begin:stop]
            where = _places_on_line(self._from[span] - start, self._to[span] - start, along)
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
        (left, bottom), (right, top) = self._cell(low), self._cell(high)
        rows = np.arange(bottom, top + 1) * self._cells
        parts = [self._box[self._first[row + left] : self._first[row + right + 1]] for row in rows]
        return np.asarray(np.unique(np.concatenate([self._large, *parts])), np.int64)


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
    crossing = (side_a > 0) != (side_b > 0)
    share = side_a[crossing] / (side_a[crossing] - side_b[crossing])
    points = a[crossing] + share[:, None] * (b[crossing] - a[crossing])
    return np.sort(points @ along / (along @ along))


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


def drawn_objects(layer: Any) -> tuple[DrawnObject, ...]:
    """Return the objects of a Gerber layer read by gerbonara, without strokes of no area.

    Raises
    ------
    ValueError
        An aperture macro has a moiré, which is obsolete and not supported. Or an object lies or extends beyond
        `MAX_BOARD_SIZE`, or the layer has too many corners.
    """
    drawn, corners = [], 0
    for item in layer.objects:
        each = _drawn(item)
        if each is None:
            continue
        corners += sum(len(outline) for shape in each.shapes for outline in (shape.outline, *shape.holes))
        if corners > _MOST_CORNERS:
            raise ValueError(f"a layer of more than {_MOST_CORNERS} corners; are its arcs and apertures too large?")
        farthest = float(np.max(np.abs(each.bounds))) if corners else 0.0
        MAX_BOARD_SIZE.check(farthest, f"an object that extends to {farthest:.4g} m", ValueError)
        drawn.append(each)
    return tuple(drawn)


def _drawn(item: Any) -> DrawnObject | None:
    if isinstance(item, graphic_objects.Region):
        (primitive,) = item.to_primitives(MM)
        return DrawnObject("region", (Shape(_outline(primitive), bool(item.polarity_dark)),))
    attributes = _attributes(item)
    if isinstance(item, graphic_objects.Flash):
        place = np.array([MM(item.x, item.unit), MM(item.y, item.unit)]) * _METRE
        areas = tuple(_flashed(item.aperture, place, bool(item.polarity_dark)))
        return DrawnObject("flash", areas, **attributes) if areas else None
    if not isinstance(item, graphic_objects.Line):
        _check_arc(item)
    lines = [item] if isinstance(item, graphic_objects.Line) else item.approximate(SAGITTA / _METRE, MM)
    ends = [np.array([[MM(x, item.unit), MM(y, item.unit)] for x, y in (each.p1, each.p2)]) * _METRE for each in lines]
    shapes = tuple(shape for each in ends for shape in _swept(item.aperture, each, bool(item.polarity_dark)))
    if not shapes:
        return None
    straight = len(ends) == 1 and math.dist(*ends[0]) > 0
    return DrawnObject("stroke", shapes, ends[0] if straight else None, _round_width(item.aperture), **attributes)


def _check_arc(item: Any) -> None:
    """Check the number of lines that approximate an arc before gerbonara makes them."""
    start, centre = np.array([item.x1, item.y1]), np.array([item.x1 + item.cx, item.y1 + item.cy])
    radius, sweep = _radius_and_sweep(start, np.array([item.x2, item.y2]), centre, item.clockwise)
    radius = float(MM(radius, item.unit)) * _METRE
    lines = _chords(radius, abs(sweep))
    if lines > _MOST_LINES:
        raise ValueError(f"an arc with a radius of {radius:.4g} m takes {lines} lines, which is too large for a board")


def _attributes(item: Any) -> dict[str, Any]:
    function = dict(item.aperture.attrs or ()).get(".AperFunction", ("",)) if item.aperture is not None else ("",)
    net, place = item.attrs.get(".N", ("",)), item.attrs.get(".P", ("", ""))
    return {"function": function[0], "net": net[0], "part": place[0], "pin": place[1] if len(place) > 1 else ""}


def _round_width(aperture: Any) -> float:
    if isinstance(aperture, CircleAperture | ExcellonTool):
        return float(aperture.equivalent_width(MM)) * _METRE
    return math.nan


def _flashed(aperture: Any, place: Float64, dark: bool) -> Iterator[Shape]:
    """Yield the areas of a flashed aperture; a hole of the aperture does not affect earlier objects.

    Gerber format specification 2024.05, section 4.4.6: "Standard apertures may have a round hole in them. When an
    aperture is flashed only the solid part affects the image, the hole does not." Likewise an area that a macro erases
    is erased from the macro only (section 4.5.1). An area belongs to the aperture if it lies in an exposed primitive
    and in no later erasing one.
    """
    areas = list(_areas(aperture))
    for index, (outline, exposed) in enumerate(areas):
        if exposed:
            holes = (hole for hole, later in areas[index + 1 :] if not later and _may_overlap(hole, outline))
            yield Shape(outline + place, dark, tuple(hole + place for hole in holes))


def _may_overlap(one: Float64, other: Float64) -> bool:
    """Return whether the bounding boxes of two outlines overlap."""
    return bool(np.all(one.min(axis=0) < other.max(axis=0)) and np.all(one.max(axis=0) > other.min(axis=0)))


def _areas(aperture: Any) -> Iterator[tuple[Float64, bool]]:
    """Yield the outlines of the primitives of an aperture at the origin in order, and whether they are exposed."""
    if isinstance(aperture, TransformedAperture):
        for outline, exposed in _areas(aperture.aperture):
            yield outline @ aperture.matrix.T, exposed
    elif isinstance(aperture, ApertureMacroInstance):
        values = dict(enumerate(aperture.parameters, start=1))
        for primitive in aperture.macro.primitives:
            yield from _macro_areas(primitive, aperture.macro.name, values)
    else:
        for each in aperture.flash(0.0, 0.0, MM, True):
            yield _outline(each), bool(each.polarity_dark)


def _macro_areas(primitive: Any, macro: str, values: dict[int, float]) -> Iterator[tuple[Float64, bool]]:
    """Yield the outlines of a primitive of an aperture macro, and whether they are exposed."""
    code = getattr(primitive, "code", 0)
    if code == _MOIRE_CODE:
        raise ValueError(f"aperture macro {macro}: a moiré is not supported; draw it as regions")
    if code == _THERMAL_CODE:
        for outline in _thermal(primitive, values):
            yield outline, True
    elif code == _POLYGON_CODE:
        corners = primitive.n_vertices.calculate(values)
        if not corners <= _MOST_VERTICES:
            raise ValueError(f"aperture macro {macro}: a polygon of more than {_MOST_VERTICES} corners")
        yield _macro_polygon(primitive, values), bool(primitive.exposure.calculate(values))
    else:
        for each in primitive.to_graphic_primitives((0.0, 0.0), 0.0, values, MM, True):
            yield _outline(each), bool(each.polarity_dark)


def _macro_polygon(primitive: Any, values: dict[int, float]) -> Float64:
    """Return the corners [m] of a regular polygon, rotated about the origin of the macro.

    gerbonara 1.5 does not rotate the polygon's centre. Gerber format specification 2024.05, section 4.5.1.7.
    """
    x, y, diameter = (getattr(primitive, name).calculate(values, MM) for name in ("x", "y", "diameter"))
    angle = math.radians(primitive.rotation.calculate(values))
    x, y = _rotated(np.array([x, y]), angle)
    count = int(primitive.n_vertices.calculate(values))
    return _outline(graphic_primitives.ArcPoly.from_regular_polygon(x, y, diameter / 2, count, angle))


def _thermal(primitive: Any, values: dict[int, float]) -> Iterator[Float64]:
    """Yield the outlines [m] of the parts of a thermal: a ring, cut by a cross of gaps into four.

    gerbonara 1.5 reads an exposure, which a thermal does not have, before the centre: its fields are shifted by one.
    Gerber format specification 2024.05, section 4.5.1.8.
    """
    shifted = (primitive.exposure, primitive.x, primitive.y, primitive.d_outer, primitive.d_inner, primitive.gap_w)
    x, y, outer, inner, gap, degrees = (float(each.calculate(values)) for each in shifted)
    x, y, outer, inner, half = (MM(each, primitive.unit) * _METRE for each in (x, y, outer / 2, inner / 2, gap / 2))
    if not outer > half * math.sqrt(2):
        return
    origin = np.zeros(2)

    def ends(radius: float) -> tuple[Float64, Float64]:
        """Return the points of a circle on the sides of the gaps, counter-clockwise."""
        along = math.sqrt(radius**2 - half**2)
        return np.array([along, half]), np.array([half, along])

    first, last = ends(outer)
    quarter = [_arc(first, last, origin, clockwise=False), last[None]]
    if inner > half * math.sqrt(2):
        last, first = ends(inner)
        quarter += [_arc(first, last, origin, clockwise=True), last[None]]
    else:
        quarter += [np.array([[half, half]])]
    part = np.concatenate(quarter)
    for turns in range(4):
        yield _rotated(_rotated(part, turns * math.pi / 2) + np.array([x, y]), math.radians(degrees))


def _rotated(points: Float64, angle: float) -> Float64:
    """Return points rotated about the origin, counter-clockwise."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]))


def _swept(aperture: Any, ends: Float64, dark: bool) -> Iterator[Shape]:
    width = _round_width(aperture)
    if not math.isnan(width):
        if width > 0:
            yield Shape(capsule(ends[0], ends[1], width / 2), dark)
        return
    if aperture is None:
        return
    for outline, exposed in _areas(aperture):
        if exposed:
            yield Shape(hull(np.concatenate([outline + ends[0], outline + ends[1]])), dark)


def _outline(primitive: Any) -> Float64:
    """Return the polygon [m] of a primitive of gerbonara [mm], whose own polygons of rotated rectangles are wrong."""
    if isinstance(primitive, graphic_primitives.Circle):
        return disk(np.array([primitive.x, primitive.y]) * _METRE, primitive.r * _METRE)
    if isinstance(primitive, graphic_primitives.Rectangle):
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array([primitive.w, primitive.h]) / 2
        return np.asarray((_rotated(half, primitive.rotation) + np.array([primitive.x, primitive.y])) * _METRE)
    if isinstance(primitive, graphic_primitives.Line):
        start, end = np.array([[primitive.x1, primitive.y1], [primitive.x2, primitive.y2]]) * _METRE
        return capsule(start, end, primitive.width / 2 * _METRE)
    corners: list[Float64] = []
    for start, end, (clockwise, centre) in primitive.segments:
        first, last = np.array(start) * _METRE, np.array(end) * _METRE
        bent = clockwise is not None
        corners.append(_arc(first, last, np.array(centre) * _METRE, bool(clockwise)) if bent else first[None])
    return np.concatenate(corners)


def disk(centre: Float64, radius: float) -> Float64:
    """Return the regular polygon with the area of a circle: (n, 2) corners within `SAGITTA` of it.

    The polygon is symmetric in x and y.
    """
    count = 4 * math.ceil(_chords(radius, 2 * math.pi) / 4)
    angle = np.arange(count) * (2 * math.pi / count)
    step = 2 * math.pi / count
    radius *= math.sqrt(step / math.sin(step))
    return np.asarray(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def capsule(start: Float64, end: Float64, radius: float) -> Float64:
    """Return the polygon that a disk of a radius [m] sweeps along a segment: straight sides, chords around the ends."""
    along = end - start
    if not along.any():
        return disk(start, radius)
    angle = math.atan2(along[1], along[0]) + np.linspace(-math.pi / 2, math.pi / 2, _chords(radius, math.pi) + 1)
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


def _chords(radius: float, angle: float) -> int:
    """Return the number of chords of an arc."""
    half = math.acos(1 - min(SAGITTA / max(radius, SAGITTA), 0.05))
    if not angle <= 2 * half * _MOST_CHORDS:
        raise ValueError(f"an arc or aperture with a radius of {radius:.4g} m, which is too large for a board")
    return max(math.ceil(angle / (2 * half)), 1)


def _arc(start: Float64, end: Float64, centre: Float64, clockwise: bool) -> Float64:
    """Return the corners of an arc from its start, without its end; an arc from a point to itself is a full circle."""
    a = start - centre
    radius, sweep = _radius_and_sweep(start, end, centre, clockwise)
    count = _chords(radius, abs(sweep))
    angle = math.atan2(a[1], a[0]) + np.arange(count) * (sweep / count)
    return np.asarray(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _radius_and_sweep(start: Float64, end: Float64, centre: Float64, clockwise: bool) -> tuple[float, float]:
    """Return the radius of an arc and its angle, negative where it runs clockwise; equal ends are a full circle."""
    a, b = start - centre, end - centre
    sweep = (math.atan2(b[1], b[0]) - math.atan2(a[1], a[0])) % (2 * math.pi)
    sweep = sweep - 2 * math.pi if clockwise and sweep > 0 else sweep
    if np.allclose(start, end, rtol=0, atol=1e-9):
        sweep = -2 * math.pi if clockwise else 2 * math.pi
    return math.hypot(*a), sweep
