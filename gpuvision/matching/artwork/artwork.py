"""A board's artwork from its Gerber and Excellon files: what a camera can measure on it, and what may hide it.

Everything is in metres in the files' own frame, x to the right and y up as the board is seen from its *top*; the bottom
side is in the same frame (seen through the board), so that a camera below sees a mirror image of it. Files of RS-274X
with and without the attributes of X2, and Excellon, are read by gerbonara.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from gerbonara import LayerStack
from gerbonara.graphic_objects import Flash, Line
from gerbonara.utils import MM
from scipy.spatial import cKDTree

from gpuvision.matching.artwork.edges import BoardEdges, board_edges
from gpuvision.matching.artwork.shapes import Drawn, Float64, Layer, Shape, area, drawn_objects, hull

Side = Literal["top", "bottom"]
Role = Literal["via", "pad", "fiducial"]

# What Gerber X2 calls what is no pad; its other words are of pads.
_SAID: Mapping[str, Role] = {"ViaPad": "via", "FiducialPad": "fiducial"}

_SAME = 5e-6  # [m] centres as near as this are one: files round to a micrometre or so
_CONCENTRIC = 50e-6  # [m] a hole, and an opening of the mask, may lie as far from its pad's centre: tools round apart
_FIDUCIAL_OPENING = 1.5  # diameters; IPC-7351 asks for 2 or more, a pad's opening is larger by 0.1 mm or so
_ROUND = 0.985  # of the circle round it: a polygon of 16 corners has 0.974 of the area, one of 24 has 0.989
_RECTANGULAR = 0.995


class Holes(NamedTuple):
    """Holes and slots, of all drill files together, each once.

    Attributes
    ----------
    start, end
        (n, 2) [m]; the same for a round hole.
    diameter
        (n,) of the tool [m]; copper plated inside makes a hole smaller.
    plated
        (n,) int8: 1 plated, 0 not, -1 where the files do not say it.
    """

    start: Float64
    end: Float64
    diameter: Float64
    plated: npt.NDArray[np.int8]


@dataclass(frozen=True, kw_only=True, eq=False)
class Land:
    """A spot of copper: a via's, a pad, a fiducial.

    Attributes
    ----------
    role
        ``"via"``, ``"pad"`` or ``"fiducial"``: the file's word for it, and where it has none what
        :func:`read_artwork` says of holes and of openings.
    shape
        ``"circle"``, ``"rectangle"`` or ``"other"`` (rounded corners, obrounds, crosses).
    centre
        (2,) middle of the bounds [m].
    size
        (2,) along its own axes [m], of the least rectangle round it; the diameter twice for a circle.
    angle
        Of its first axis [rad], in [0, pi/2); 0 for a circle.
    outline
        (n, 2) corners, counter-clockwise [m]; the convex hull where several areas make one spot.
    hole
        Diameter of the hole in it, or width of the slot [m]; 0 without one.
    opening
        How far the mask's opening reaches beyond the copper [m], the least of four sides: negative where the mask
        lies on the copper, NaN where there is no opening about the same centre (a covered via).
    function, net, part, pin
        From Gerber X2; ``""`` where the file does not say it.
    """

    role: Role
    shape: Literal["circle", "rectangle", "other"]
    centre: Float64
    size: Float64
    angle: float
    outline: Float64
    hole: float = 0.0
    opening: float = math.nan
    function: str = ""
    net: str = ""
    part: str = ""
    pin: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Artwork:
    """One side of a board.

    Attributes
    ----------
    side
        ``"top"`` or ``"bottom"``.
    copper, mask, silk
        Areas in the order of drawing; of the mask the *openings*. A hole of an aperture takes away what was drawn
        before it, too: under a pad's hole that is drilled in any case.
    holes
        :class:`Holes`.
    lands
        Vias, pads and fiducials.
    edges
        :class:`~gpuvision.matching.artwork.edges.BoardEdges`: straight edges of traces and pads that can be seen.
    bounds
        (2, 2): least and greatest x, y [m] of the board's outline; of the copper where there is no file of it.
    """

    side: Side
    copper: tuple[Shape, ...]
    mask: tuple[Shape, ...]
    silk: tuple[Shape, ...]
    holes: Holes
    lands: tuple[Land, ...]
    edges: BoardEdges
    bounds: Float64

    @property
    def vias(self) -> tuple[Land, ...]:
        """Lands whose role is a via."""
        return tuple(each for each in self.lands if each.role == "via")

    @property
    def pads(self) -> tuple[Land, ...]:
        """Lands whose role is a pad."""
        return tuple(each for each in self.lands if each.role == "pad")

    @property
    def fiducials(self) -> tuple[Land, ...]:
        """Lands whose role is a fiducial."""
        return tuple(each for each in self.lands if each.role == "fiducial")


class _Finder:
    """What lies about a centre: a hole, an opening of the mask, paste."""

    def __init__(self, holes: Holes, openings: tuple[Drawn, ...], pastes: tuple[Drawn, ...], via_drill: float) -> None:
        self.holes, self.openings, self.via_drill = holes, openings, via_drill
        self._holes = _tree((holes.start + holes.end) / 2)
        self._openings = _tree(_centres(openings))
        self._pastes = _tree(_centres(pastes))

    def hole(self, centre: Float64) -> int | None:
        return _nearest(self._holes, centre)

    def opening(self, centre: Float64) -> Drawn | None:
        index = _nearest(self._openings, centre)
        return None if index is None else self.openings[index]

    def paste(self, centre: Float64) -> bool:
        return _nearest(self._pastes, centre) is not None


def _tree(centres: Float64) -> Any:
    return cKDTree(centres) if len(centres) else None


def _nearest(tree: Any, centre: Float64) -> int | None:
    if tree is None:
        return None
    distance, index = tree.query(centre)
    return int(index) if distance <= _CONCENTRIC else None


def _centres(objects: Sequence[Drawn]) -> Float64:
    return np.array([each.centre for each in objects]).reshape(-1, 2)


def read_artwork(
    path: str | Path,
    *,
    side: Side = "top",
    layers: Mapping[str, str] | None = None,
    clearance: float = 50e-6,
    via_drill: float = 0.55e-3,
) -> Artwork:
    """Artwork of one side of a board.

    Parameters
    ----------
    path
        Folder, or ZIP, of Gerber and Excellon files.
    side
        Which copper.
    layers
        Regular expressions of whole file names, and what each is: ``"top copper"``, ``"bottom mask"``, ``"top silk"``,
        ``"top paste"``, ``"mechanical outline"``, ``"drill plated"``, ``"drill nonplated"``, ``"drill unknown"``. Then
        other files are not looked at; without it the names and the contents tell.
    clearance
        An edge counts as far as copper on its one side, bare laminate or mask on its other side and no silk reach
        this far from it [m].
    via_drill
        Where a file does not say what a land is for: a round one with a plated hole up to this wide [m] is a via. One
        without a hole, without paste, in an opening of the mask of 1.5 diameters or more is a fiducial. The others are
        pads; so are areas (regions) whose place the mask opens, of which gerbonara does not hand on attributes.

    Raises
    ------
    ValueError
        Files whose layers cannot be told, no copper for the side, or what gerbonara cannot read.
    """
    if side not in ("top", "bottom"):
        raise ValueError(f"side must be 'top' or 'bottom', not {side!r}")
    if not (clearance > 0 and math.isfinite(clearance) and via_drill >= 0):
        raise ValueError(f"clearance must be positive and via_drill not negative, not {clearance} and {via_drill}")
    stack = _opened(Path(path), layers)
    drawn = {use: _layer(stack, side, use) for use in ("copper", "mask", "silk", "paste")}
    if not drawn["copper"]:
        raise ValueError(f"{path}: no copper on the {side} side; say with layers which file is '{side} copper'")
    holes = _holes(stack)
    lands = _lands(drawn["copper"], _Finder(holes, drawn["mask"], drawn["paste"], via_drill))
    shapes = {use: tuple(shape for each in objects for shape in each.shapes) for use, objects in drawn.items()}
    masked = (side, "mask") in stack.graphic_layers
    edges = board_edges(
        [each for each in drawn["copper"] if each.kind == "stroke"],
        [each.outline for each in lands],
        Layer(shapes["copper"]),
        Layer(shapes["mask"]) if masked else None,
        Layer(shapes["silk"]),
        clearance,
    )
    return Artwork(
        side=side,
        copper=shapes["copper"],
        mask=shapes["mask"],
        silk=shapes["silk"],
        holes=holes,
        lands=lands,
        edges=edges,
        bounds=_bounds(stack, drawn["copper"]),
    )


def _opened(path: Path, layers: Mapping[str, str] | None) -> LayerStack:
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder or ZIP of Gerber files")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of old spellings, and of names that are told by their contents
            return LayerStack.open(path, overrides=dict(layers) if layers else None, autoguess=not layers)
    except (ValueError, SyntaxError, SystemError, KeyError, IndexError, UnicodeDecodeError) as problem:
        reason = " ".join(str(problem).split())[:300]
        raise ValueError(
            f"{path}: gerbonara cannot read this board ({reason}); name its files with layers"
        ) from problem


def _layer(stack: LayerStack, side: str, use: str) -> tuple[Drawn, ...]:
    found = stack.graphic_layers.get((side, use))
    return () if found is None else drawn_objects(found)


def _bounds(stack: LayerStack, copper: tuple[Drawn, ...]) -> Float64:
    """Of the outline's middle line, which is where the board is cut."""
    found = stack.graphic_layers.get(("mechanical", "outline"))
    ends = [] if found is None else [point for each in found.objects for point in _outline_points(each)]
    if not ends:
        ends = [point for each in copper for point in each.bounds]
    return np.stack([np.min(ends, axis=0), np.max(ends, axis=0)])


def _outline_points(item: Any) -> list[Float64]:
    if isinstance(item, Flash):
        return []
    primitives = list(item.to_primitives(MM))
    half = [getattr(each, "width", 0.0) / 2 for each in primitives]
    boxes = [np.array(each.bounding_box()) for each in primitives]
    return [
        corner * 1e-3 for box, inset in zip(boxes, half, strict=True) for corner in (box[0] + inset, box[1] - inset)
    ]


def _holes(stack: LayerStack) -> Holes:
    files = [(stack.drill_pth, 1), (stack.drill_npth, 0), *((each, -1) for each in stack._drill_layers)]
    rows = [row for layer, plated in files if layer is not None for row in _drilled(layer, plated)]
    table = np.array(rows).reshape(-1, 6)
    keep = _first_of_equals(np.concatenate([(table[:, :2] + table[:, 2:4]) / 2, table[:, 4:5]], axis=1))
    table = table[keep]
    return Holes(table[:, :2], table[:, 2:4], table[:, 4], table[:, 5].astype(np.int8))


def _drilled(layer: Any, plated: int) -> list[tuple[float, ...]]:
    """Rows of start, end, diameter [m] and plating; a file of holes may be Gerber, with flashes."""
    rows = []
    for item in layer.objects:
        if not isinstance(item, Flash | Line):
            continue
        said = getattr(item.aperture, "plated", None)
        tool = item.aperture.equivalent_width(MM)
        ends = (item.x, item.y, item.x, item.y) if isinstance(item, Flash) else (*item.p1, *item.p2)
        metres = [float(MM(each, item.unit)) * 1e-3 for each in ends]
        rows.append((*metres, float(tool) * 1e-3, plated if said is None else int(said)))
    return rows


def _first_of_equals(points: Float64) -> npt.NDArray[np.int64]:
    """Pick, by index, the points that no earlier one lies within ``_SAME`` of."""
    gone = {second for _, second in cKDTree(points).query_pairs(_SAME)} if len(points) else set()
    return np.array([index for index in range(len(points)) if index not in gone], dtype=np.int64)


def _lands(copper: tuple[Drawn, ...], finder: _Finder) -> tuple[Land, ...]:
    """Flashes, and regions that the mask opens; of several about one centre the largest."""
    found = [each for each in copper if each.kind != "stroke" and each.shapes[-1].outline.size]
    spots = [each for each in found if each.kind == "flash" or _is_opened(each, finder)]
    spots = [each for each in spots if any(shape.dark for shape in each.shapes)]
    spots.sort(key=lambda each: -max(abs(area(shape.outline)) for shape in each.shapes if shape.dark))
    chosen = [spots[index] for index in _first_of_equals(_centres(spots))]
    chosen.sort(key=copper.index)
    return tuple(_land(each, finder) for each in chosen)


def _is_opened(spot: Drawn, finder: _Finder) -> bool:
    """Whether the mask opens it, and not only a piece of it: what is poured has another centre than what is opened."""
    opening = finder.opening(spot.centre)
    return opening is not None and bool(np.all(np.ptp(opening.bounds, axis=0) > 0.5 * np.ptp(spot.bounds, axis=0)))


def _land(spot: Drawn, finder: _Finder) -> Land:
    dark = [each.outline for each in spot.shapes if each.dark]
    outline = _counter_clockwise(dark[0]) if len(dark) == 1 else hull(np.concatenate(dark))
    shape, size, angle = _described(outline)
    index, opening = finder.hole(spot.centre), finder.opening(spot.centre)
    hole = 0.0 if index is None else float(finder.holes.diameter[index])
    margin = math.nan
    if opening is not None:
        margin = float(np.min((opening.bounds - spot.bounds) * np.array([[-1.0], [1.0]])))
    return Land(
        role=_role(spot, shape, float(size[0]), index, opening, finder),
        shape=shape,
        centre=spot.centre,
        size=size,
        angle=angle,
        outline=outline,
        hole=hole,
        opening=margin,
        function=spot.function,
        net=spot.net,
        part=spot.part,
        pin=spot.pin,
    )


def _role(spot: Drawn, shape: str, across: float, hole: int | None, opening: Drawn | None, finder: _Finder) -> Role:
    if spot.function:
        return _SAID.get(spot.function, "pad")
    if shape != "circle":
        return "pad"
    if hole is not None:
        small = finder.holes.diameter[hole] <= finder.via_drill and finder.holes.plated[hole] != 0
        return "via" if small else "pad"
    wide = opening is not None and bool(np.all(np.ptp(opening.bounds, axis=0) >= _FIDUCIAL_OPENING * across))
    return "fiducial" if wide and not finder.paste(spot.centre) else "pad"


def _counter_clockwise(outline: Float64) -> Float64:
    return outline if area(outline) >= 0 else outline[::-1]


def _described(outline: Float64) -> tuple[Literal["circle", "rectangle", "other"], Float64, float]:
    """Shape, size along its own axes and angle: of the least rectangle round it, one of whose sides lies on a side."""
    corners = hull(outline)
    inside = abs(area(outline))
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = float(np.hypot(*(corners - middle).T).max())
    if inside > _ROUND * math.pi * radius**2:
        diameter = 2 * math.sqrt(inside / math.pi)
        return "circle", np.array([diameter, diameter]), 0.0
    sides = np.roll(corners, -1, axis=0) - corners
    angle = np.arctan2(sides[:, 1], sides[:, 0]) % (math.pi / 2)
    axes = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    first = np.ptp(axes @ corners.T, axis=1)
    second = np.ptp(np.stack([-axes[:, 1], axes[:, 0]], axis=1) @ corners.T, axis=1)
    best = int(np.argmin(first * second))
    size = np.array([first[best], second[best]])
    return "rectangle" if inside > _RECTANGULAR * size[0] * size[1] else "other", size, float(angle[best])
