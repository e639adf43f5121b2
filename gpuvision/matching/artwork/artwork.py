"""Artwork of a board from its Gerber and Excellon files: measurable edges and pads, and the areas that may hide them.

Positions are in metres in the files' frame, x to the right and y up in a view of the *top* side. The bottom side is in
the same frame (seen through the board), so that a camera below sees a mirror image of it. gerbonara reads RS-274X with
and without the attributes of X2, and Excellon.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from gerbonara import LayerStack
from gerbonara.graphic_objects import Flash, Line
from gerbonara.utils import MM
from scipy.spatial import cKDTree

from gpuvision.host.errors import ReadError
from gpuvision.host.reading import reading
from gpuvision.matching.artwork.artwork_cache import artwork_key, load_artwork, store_artwork
from gpuvision.matching.artwork.board_artwork import Artwork, Holes, Pad, Role, Side
from gpuvision.matching.artwork.board_files import board_folder, layer_warnings, open_layers, parsed
from gpuvision.matching.artwork.drawn_objects import drawn_objects
from gpuvision.matching.artwork.edges import board_edges
from gpuvision.matching.artwork.shapes import DrawnObject, Float64, Layer, area, hull

__all__ = ["Artwork", "Holes", "Pad", "Role", "Side", "read_artwork"]

# Values of ``.AperFunction`` in Gerber X2; all others are component pads.
_ROLES: Mapping[str, Role] = {"ViaPad": "via", "FiducialPad": "fiducial"}

_SAME_PLACE = 5e-6  # distance of equal centres [m]: files round to about a micrometre
# Distance of a hole or a mask opening from the centre of its pad [m]: CAD tools round them separately.
_CONCENTRIC = 50e-6
# Least mask opening of a fiducial in diameters: IPC-7351 requires 2 or more; a component pad's opening is about 0.1 mm
# larger than the pad.
_FIDUCIAL_OPENING = 1.5
# Least ratio of the area to the area of the enclosing circle: a polygon of 16 corners has 0.974, one of 24 has 0.989.
_ROUND_AREA = 0.985
_MIN_CACHED = 0.2  # processor time from which on parsed artwork is stored in the cache [s] (chosen)
_RECTANGLE_AREA = 0.995  # least ratio of the area to the area of the enclosing rectangle


class _Finder:
    """Nearest hole, mask opening and paste around a centre."""

    def __init__(
        self, holes: Holes, openings: tuple[DrawnObject, ...], pastes: tuple[DrawnObject, ...], via_drill: float
    ) -> None:
        self.holes, self.openings, self.via_drill = holes, openings, via_drill
        self._holes = _tree((holes.start + holes.end) / 2)
        self._openings = _tree(_centres(openings))
        self._pastes = _tree(_centres(pastes))

    def hole(self, centre: Float64) -> int | None:
        return _nearest(self._holes, centre)

    def opening(self, centre: Float64) -> DrawnObject | None:
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


def _centres(objects: Sequence[DrawnObject]) -> Float64:
    return np.array([each.centre for each in objects]).reshape(-1, 2)


def read_artwork(
    path: str | Path,
    *,
    side: Side = "top",
    layers: Mapping[str, str] | None = None,
    clearance: float = 50e-6,
    via_drill: float = 0.55e-3,
) -> Artwork:
    """Read one side of a board.

    Parameters
    ----------
    path : str or Path
        Folder, or ZIP file, of Gerber and Excellon files.
    side : {"top", "bottom"}
        Side of the board, "top" or "bottom".
    layers : mapping of str to str, optional
        Regular expressions of whole file names, and the layer of each: ``"top copper"``, ``"bottom mask"``, ``"top
        silk"``, ``"top paste"``, ``"mechanical outline"``, ``"drill plated"``, ``"drill nonplated"``, ``"drill
        unknown"``. Other files are then ignored. None: names and contents of the files determine the layers.
    clearance : float
        Distance [m], above 0, default 50 um, that a visible edge keeps from silk, and over which there is copper on its
        one side, and bare laminate or mask on its other side.
    via_drill : float
        Rule for pads without attributes: a round pad with a plated hole up to this diameter [m] is a via, default 0.55
        mm. A round pad without a hole and without paste, in a mask opening of 1.5 diameters or more, is a fiducial. All
        others are component pads; so are regions in a mask opening, whose attributes gerbonara does not provide.

    Returns
    -------
    Artwork
        Outlines, edges and fiducials of the side, in the frame of the files [m].

    Raises
    ------
    ValueError
        An argument is out of range.
    FileNotFoundError
        There is no such folder or file.
    ReadError
        The layers of the files cannot be determined, the side has no copper, gerbonara cannot read a file of the side,
        or the board exceeds a `gpuvision.host.FileLimit`.

    Notes
    -----
    Artwork that takes 0.2 s or more of processor time to parse is kept in the user's cache folder, up to 256 MiB of all
    boards. An entry is used again only for equal files, parameters, limits and versions of the parser.
    """
    if side not in ("top", "bottom"):
        raise ValueError(f"side must be 'top' or 'bottom', not {side!r}")
    if not (clearance > 0 and math.isfinite(clearance) and via_drill >= 0):
        raise ValueError(f"clearance must be positive and via_drill not negative, not {clearance} and {via_drill}")
    path = Path(path)
    with board_folder(path) as place:
        key = artwork_key(place, [side, sorted((layers or {}).items()), clearance, via_drill])
        artwork = load_artwork(key)
        if artwork is None:
            began = time.process_time()
            artwork = _parse_artwork(place, path, side, layers, clearance, via_drill)
            if time.process_time() - began >= _MIN_CACHED:
                store_artwork(key, artwork)
        return artwork


def _parse_artwork(
    place: Path, path: Path, side: Side, layers: Mapping[str, str] | None, clearance: float, via_drill: float
) -> Artwork:
    """Read one side of a board from the files in a folder; parameters as in `read_artwork`."""
    stack = open_layers(place, path, layers)
    with reading(path, "board"):
        drawn = {use: _layer(stack, side, use) for use in ("copper", "mask", "silk", "paste")}
        if not drawn["copper"]:
            raise ReadError(f"{path}: no copper on the {side} side; name the file of '{side} copper' with layers")
        holes = _holes(stack)
        pads = _pads(drawn["copper"], _Finder(holes, drawn["mask"], drawn["paste"], via_drill))
        shapes = {use: tuple(shape for each in objects for shape in each.shapes) for use, objects in drawn.items()}
        masked = (side, "mask") in stack.graphic_layers
        edges = board_edges(
            [each for each in drawn["copper"] if each.kind == "stroke"],
            [each.outline for each in pads],
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
            pads=pads,
            edges=edges,
            bounds=_bounds(stack, drawn["copper"]),
            warnings=layer_warnings(stack, place, side, layers),
        )


def _layer(stack: LayerStack, side: str, use: str) -> tuple[DrawnObject, ...]:
    found = stack.graphic_layers.get((side, use))
    if found is None:
        return ()
    with reading(found.original_path.name, "Gerber file"):
        return drawn_objects(parsed(found))


def _bounds(stack: LayerStack, copper: tuple[DrawnObject, ...]) -> Float64:
    """Return the bounds of the centre line of the outline, along which the board is cut."""
    found = stack.graphic_layers.get(("mechanical", "outline"))
    ends = [] if found is None else [point for each in parsed(found).objects for point in _outline_points(each)]
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
    rows = [row for layer, plated in files if layer is not None for row in _drilled(parsed(layer), plated)]
    table = np.array(rows).reshape(-1, 6)
    keep = _first_of_equals(np.concatenate([(table[:, :2] + table[:, 2:4]) / 2, table[:, 4:5]], axis=1))
    table = table[keep]
    return Holes(table[:, :2], table[:, 2:4], table[:, 4], table[:, 5].astype(np.int8))


def _drilled(layer: Any, plated: int) -> list[tuple[float, ...]]:
    """Return rows of start, end, diameter [m] and plating; a drill file may be Gerber, with flashes."""
    rows = []
    for item in layer.objects:
        if not isinstance(item, Flash | Line):
            continue
        is_plated = getattr(item.aperture, "plated", None)
        tool = item.aperture.equivalent_width(MM)
        ends = (item.x, item.y, item.x, item.y) if isinstance(item, Flash) else (*item.p1, *item.p2)
        metres = [float(MM(each, item.unit)) * 1e-3 for each in ends]
        rows.append((*metres, float(tool) * 1e-3, plated if is_plated is None else int(is_plated)))
    return rows


def _first_of_equals(points: Float64) -> npt.NDArray[np.int64]:
    """Return the indices of the points (n, dimensions) that have no earlier point within ``_SAME_PLACE``."""
    if not len(points):
        return np.empty(0, dtype=np.int64)
    # The diagonal of a cell is at most `_SAME_PLACE`, so all points of a cell are duplicates of its first point. A file
    # may repeat a hole 1e5 times; testing all pairs would exhaust the memory. The side of a cell is a power of two,
    # so that distinct points beyond the 53 bits of a cell number stay in distinct cells.
    side = 2.0 ** math.floor(math.log2(_SAME_PLACE / math.sqrt(points.shape[1])))
    first = np.sort(np.unique(np.floor(points / side), axis=0, return_index=True)[1])
    near = cKDTree(points[first]).query_ball_tree(cKDTree(points), _SAME_PLACE)
    return np.array([index for index, others in zip(first, near, strict=True) if min(others) == index], dtype=np.int64)


def _pads(copper: tuple[DrawnObject, ...], finder: _Finder) -> tuple[Pad, ...]:
    """Return flashes, and regions that the mask opens; of several about one centre the largest."""
    found = [each for each in copper if each.kind != "stroke" and each.shapes[-1].outline.size]
    spots = [each for each in found if each.kind == "flash" or _is_opened(each, finder)]
    spots = [each for each in spots if each.shapes[0].dark]
    spots.sort(key=lambda each: -max(abs(area(shape.outline)) for shape in each.shapes))
    chosen = [spots[index] for index in _first_of_equals(_centres(spots))]
    order = {id(each): place for place, each in enumerate(copper)}
    chosen.sort(key=lambda each: order[id(each)])
    return tuple(_pad(each, finder) for each in chosen)


def _is_opened(spot: DrawnObject, finder: _Finder) -> bool:
    """Return whether a mask opening belongs to the object.

    A copper pour and an opening in it differ in centre or size.
    """
    opening = finder.opening(spot.centre)
    return opening is not None and bool(np.all(np.ptp(opening.bounds, axis=0) > 0.5 * np.ptp(spot.bounds, axis=0)))


def _pad(spot: DrawnObject, finder: _Finder) -> Pad:
    outlines = [each.outline for each in spot.shapes]
    outline = _counter_clockwise(outlines[0]) if len(outlines) == 1 else hull(np.concatenate(outlines))
    shape, size, angle = _described(outline)
    index, opening = finder.hole(spot.centre), finder.opening(spot.centre)
    hole = 0.0 if index is None else float(finder.holes.diameter[index])
    margin = math.nan
    if opening is not None:
        margin = float(np.min((opening.bounds - spot.bounds) * np.array([[-1.0], [1.0]])))
    return Pad(
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


def _role(
    spot: DrawnObject, shape: str, across: float, hole: int | None, opening: DrawnObject | None, finder: _Finder
) -> Role:
    if spot.function:
        return _ROLES.get(spot.function, "component")
    if shape != "circle":
        return "component"
    if hole is not None:
        small = finder.holes.diameter[hole] <= finder.via_drill and finder.holes.plated[hole] != 0
        return "via" if small else "component"
    wide = opening is not None and bool(np.all(np.ptp(opening.bounds, axis=0) >= _FIDUCIAL_OPENING * across))
    return "fiducial" if wide and not finder.paste(spot.centre) else "component"


def _counter_clockwise(outline: Float64) -> Float64:
    return outline if area(outline) >= 0 else outline[::-1]


def _described(outline: Float64) -> tuple[Literal["circle", "rectangle", "other"], Float64, float]:
    """Return shape, size and angle, from the smallest enclosing rectangle.

    One side of that rectangle lies on a side of the convex hull.
    """
    corners = hull(outline)
    inside = abs(area(outline))
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = float(np.hypot(*(corners - middle).T).max())
    if inside > _ROUND_AREA * math.pi * radius**2:
        diameter = 2 * math.sqrt(inside / math.pi)
        return "circle", np.array([diameter, diameter]), 0.0
    sides = np.roll(corners, -1, axis=0) - corners
    angle = np.arctan2(sides[:, 1], sides[:, 0]) % (math.pi / 2)
    axes = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    first = np.ptp(axes @ corners.T, axis=1)
    second = np.ptp(np.stack([-axes[:, 1], axes[:, 0]], axis=1) @ corners.T, axis=1)
    best = int(np.argmin(first * second))
    size = np.array([first[best], second[best]])
    return "rectangle" if inside > _RECTANGLE_AREA * size[0] * size[1] else "other", size, float(angle[best])
