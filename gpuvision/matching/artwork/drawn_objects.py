"""Objects of Gerber layers as polygons: flashes, strokes and regions of gerbonara's layers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from gerbonara import graphic_objects, graphic_primitives
from gerbonara.apertures import ApertureMacroInstance, CircleAperture, ExcellonTool
from gerbonara.utils import MM

from gpuvision.matching.artwork.gerber_parser import TransformedAperture
from gpuvision.matching.artwork.shapes import (
    MAX_BOARD_SIZE,
    SAGITTA,
    DrawnObject,
    Float64,
    Shape,
    arc,
    capsule,
    count_chords,
    disk,
    hull,
    radius_and_sweep,
)

_METRE = 1e-3  # all calls of gerbonara use millimetres
_MOST_LINES = 10_000  # of an arc that is drawn with an aperture; a circle with a radius of 1 m has 3200
_MOST_CORNERS = 5_000_000  # of a layer. Chosen: they take 300 MiB with the arrays of `Layer`
_MOST_VERTICES = 1000  # of a regular polygon; the Gerber format allows 12
_POLYGON_CODE = 5
# Codes of primitives of aperture macros that gerbonara 1.5 draws wrongly, or cannot draw.
_MOIRE_CODE = 6
_THERMAL_CODE = 7


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
    radius, sweep = radius_and_sweep(start, np.array([item.x2, item.y2]), centre, item.clockwise)
    radius = float(MM(radius, item.unit)) * _METRE
    lines = count_chords(radius, abs(sweep))
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
    quarter = [arc(first, last, origin, clockwise=False), last[None]]
    if inner > half * math.sqrt(2):
        last, first = ends(inner)
        quarter += [arc(first, last, origin, clockwise=True), last[None]]
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
        corners.append(arc(first, last, np.array(centre) * _METRE, bool(clockwise)) if bent else first[None])
    return np.concatenate(corners)
