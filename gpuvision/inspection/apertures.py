"""Apertures of a solder paste stencil, from the paste layer of a board's Gerber files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.path import Path as Outline

from gpuvision.host.errors import ReadError
from gpuvision.host.reading import reading
from gpuvision.inspection.coverage import area_and_centroid
from gpuvision.matching.artwork.board_artwork import Pad, Side
from gpuvision.matching.artwork.board_files import open_board, parsed
from gpuvision.matching.artwork.drawn_objects import drawn_objects
from gpuvision.matching.artwork.shapes import DrawnObject, Float64, Shape

_SMALLEST_AREA = 1e-10  # [m^2]: 10 x 10 um; smaller objects of a paste layer are marks or rounding. Chosen


@dataclass(frozen=True, kw_only=True, eq=False)
class Aperture:
    """Aperture of a stencil, or another region of a board: its shapes in drawing order.

    Attributes
    ----------
    name
        Name: part and pin such as ``U3.5`` where the files state them, otherwise a number.
    shapes
        Areas in drawing order, in the coordinates of the files or of a height map [m].
    area
        Area that the shapes cover [m^2].
    centroid : (2,)
        Centroid of this area [m].
    """

    name: str
    shapes: tuple[Shape, ...]
    area: float
    centroid: Float64

    @cached_property
    def bounds(self) -> Float64:
        """(2, 2) least and greatest x, y [m]."""
        points = np.concatenate([each.outline for each in self.shapes])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def moved(self, pose: BoardPlacement) -> Aperture:
        """Return the aperture in the coordinates of the height map."""
        shapes = tuple(
            Shape(pose.to_map(each.outline), each.dark, tuple(pose.to_map(hole) for hole in each.holes))
            for each in self.shapes
        )
        return Aperture(name=self.name, shapes=shapes, area=self.area, centroid=pose.to_map(self.centroid))


@dataclass(frozen=True, kw_only=True)
class BoardPlacement:
    """Place of a board in a height map: a rotation and a shift; the bottom side is mirrored (x changes its sign).

    Attributes
    ----------
    x, y : float
        Position of the origin of the board's files in the height map [m].
    theta : float
        Direction of the board's x axis in the height map [rad], counter-clockwise; on the bottom side of its negative
        x axis.
    side : {"top", "bottom"}
        Side of the board that the height map shows. Default "top".
    """

    x: float
    y: float
    theta: float
    side: Side = "top"

    @property
    def matrix(self) -> Float64:
        """(2, 2) linear part of the transform from the board to the height map."""
        cos, sin = math.cos(self.theta), math.sin(self.theta)
        mirror = -1.0 if self.side == "bottom" else 1.0
        return np.array([[mirror * cos, -sin], [mirror * sin, cos]])

    def to_map(self, points: Float64) -> Float64:
        """Return points (..., 2) [m] of the board in the height map."""
        return np.asarray(points @ self.matrix.T + np.array([self.x, self.y]))


def make_aperture(name: str, shapes: Sequence[Shape]) -> Aperture:
    """Return an aperture of shapes, with its area and centroid."""
    covered, centroid = area_and_centroid(shapes)
    return Aperture(name=name, shapes=tuple(shapes), area=covered, centroid=centroid)


def read_apertures(
    path: str | Path, *, side: Side = "top", layers: Mapping[str, str] | None = None, pads: Sequence[Pad] = ()
) -> tuple[Aperture, ...]:
    """Read the apertures of the paste layer of a board.

    Parameters
    ----------
    path : str or Path
        Folder, or ZIP file, of Gerber files.
    side : {"top", "bottom"}
        Side of the board. Default "top".
    layers : mapping of str to str, optional
        Layers of the files, as in `gpuvision.matching.artwork.artwork.read_artwork`.
    pads : sequence of Pad, optional
        Pads of the board; an aperture over a pad with a part gets the name of the part and the pin.

    Returns
    -------
    tuple of Aperture
        In the order of the file. Objects that touch are one aperture.

    Raises
    ------
    FileNotFoundError
        There is no such folder or file.
    ReadError
        The board has no paste layer on the side, or it is empty or not readable.
    """
    path = Path(path)
    with open_board(path, layers) as stack:
        found = stack.graphic_layers.get((side, "paste"))
        if found is None:
            raise ReadError(f"{path}: no paste layer on the {side} side; name its file with layers 'FILE={side} paste'")
        name = found.original_path.name
        with reading(name, "Gerber file"):
            objects = drawn_objects(parsed(found))
    groups = _touching(objects)
    # Most apertures of a board are copies of a few: each shape is measured once.
    measured: dict[tuple[bytes | bool, ...], tuple[float, Float64]] = {}
    apertures = []
    for number, group in enumerate(groups, 1):
        corner, key = _relative(group)
        if key not in measured:
            area, centroid = area_and_centroid(group)
            measured[key] = area, centroid - corner
        area, arm = measured[key]
        apertures.append(Aperture(name=str(number), shapes=group, area=area, centroid=corner + arm))
    kept = [each for each in apertures if each.area >= _SMALLEST_AREA]
    if not kept:
        raise ReadError(f"{path}: the paste layer {name} has no aperture; expected the apertures of a stencil")
    return _named(kept, pads)


def _relative(shapes: Sequence[Shape]) -> tuple[Float64, tuple[bytes | bool, ...]]:
    """Return the first corner of shapes, and a key that is equal for copies up to a nanometre."""
    corner = shapes[0].outline[0]
    parts: list[bytes | bool] = []
    for each in shapes:
        for outline in (each.outline, *each.holes):
            parts.append(np.rint((outline - corner) * 1e9).tobytes())
        parts.append(each.dark)
    return corner, tuple(parts)


def _touching(objects: Sequence[DrawnObject]) -> list[tuple[Shape, ...]]:
    """Return the shapes of objects that touch each other, in drawing order, grouped; order of the first object."""
    bounds = np.array([each.bounds for each in objects]).reshape(-1, 2, 2)
    order = np.argsort(bounds[:, 0, 0], kind="stable")
    sorted_left = bounds[order, 0, 0]
    group = np.arange(len(objects))
    for place, index in enumerate(order):
        low, high = bounds[index]
        near = order[place + 1 : np.searchsorted(sorted_left, high[0], side="right")]
        near = near[(bounds[near, 0, 1] <= high[1]) & (bounds[near, 1, 1] >= low[1])]
        for other in near:
            if group[other] != group[index] and _touch(objects[index], objects[other]):
                first, second = sorted((group[index], group[other]))
                group[group == second] = first
    members: dict[int, list[Shape]] = {}
    for each, owner in zip(objects, group, strict=True):
        members.setdefault(int(owner), []).extend(each.shapes)
    return [tuple(shapes) for shapes in members.values()]


def _touch(one: DrawnObject, other: DrawnObject) -> bool:
    return any(
        Outline(a.outline, closed=False).intersects_path(Outline(b.outline, closed=False), filled=True)
        for a in one.shapes
        for b in other.shapes
    )


def _named(apertures: Sequence[Aperture], pads: Sequence[Pad]) -> tuple[Aperture, ...]:
    """Return apertures with the names of the pads below their centroids; several over one pad are numbered."""
    owners = [_pad_below(each.centroid, pads) for each in apertures]
    names = [
        each.name if pad is None else ".".join(filter(None, (pad.part, pad.pin)))
        for each, pad in zip(apertures, owners, strict=True)
    ]
    total = {name: names.count(name) for name in set(names)}
    count: dict[str, int] = {}
    named = []
    for each, name in zip(apertures, names, strict=True):
        count[name] = count.get(name, 0) + 1
        unique = f"{name}/{count[name]}" if total[name] > 1 else name
        named.append(Aperture(name=unique, shapes=each.shapes, area=each.area, centroid=each.centroid))
    return tuple(named)


def _pad_below(point: Float64, pads: Sequence[Pad]) -> Pad | None:
    for pad in pads:
        if pad.part and bool(np.all(np.abs(point - pad.centre) <= np.hypot(*pad.size) / 2)):
            inside: npt.NDArray[np.bool_] = Outline(pad.outline, closed=False).contains_points([point])
            if inside.all():
                return pad
    return None
