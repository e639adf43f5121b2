"""Artwork of one side of a board: areas of its layers, holes, pads and edges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.edges import BoardEdges
from gpuvision.matching.artwork.shapes import Float64, Shape

Side = Literal["top", "bottom"]
Role = Literal["via", "component", "fiducial"]


class Holes(NamedTuple):
    """Holes and slots of all drill files together, without duplicates.

    Attributes
    ----------
    start, end : (n, 2)
        Ends of a slot [m]; equal for a round hole.
    diameter : (n,)
        Diameter of the tool [m]; plating makes the hole smaller.
    plated : (n,), int8
        1 plated, 0 not plated, -1 where the files do not say it.
    """

    start: Float64
    end: Float64
    diameter: Float64
    plated: npt.NDArray[np.int8]


@dataclass(frozen=True, kw_only=True, eq=False)
class Pad:
    """Spot of copper: a via's pad, a component's pad, or a fiducial.

    Attributes
    ----------
    role
        "via", "component" or "fiducial": from the file's attributes, and without them by the rules of `read_artwork`.
    shape
        "circle", "rectangle" or "other" (rounded corners, obrounds, crosses).
    centre : (2,)
        Centre of the bounding box [m].
    size : (2,)
        Side lengths of the smallest enclosing rectangle [m]; for a circle twice the diameter.
    angle
        Angle of its first axis [rad], in [0, pi/2); 0 for a circle.
    outline : (n, 2)
        Corners, counter-clockwise [m]; the convex hull where several areas make one pad.
    hole
        Diameter of its hole, or width of its slot [m]; 0 without one. Default 0.0.
    opening
        Distance from the copper's edge to the edge of the mask opening [m], the least of four sides: negative where
        the mask covers copper, NaN without a concentric opening (a covered via).
    function, net, part, pin
        Attributes of Gerber X2; ``""`` where the file does not have them.
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
        "top" or "bottom".
    copper, mask, silk
        Areas in drawing order; of the mask these are the *openings*.
    holes
        `Holes`.
    pads
        Pads of all roles.
    edges
        `BoardEdges`: visible straight edges of traces and pads.
    bounds : (2, 2)
        Least and greatest x, y [m] of the board's outline; of the copper where there is no outline file.
    warnings
        What may be wrong with the layers: a side without a mask, files that are not recognised.
    """

    side: Side
    copper: tuple[Shape, ...]
    mask: tuple[Shape, ...]
    silk: tuple[Shape, ...]
    holes: Holes
    pads: tuple[Pad, ...]
    edges: BoardEdges
    bounds: Float64
    warnings: tuple[str, ...] = ()

    @property
    def vias(self) -> tuple[Pad, ...]:
        """Pads of vias."""
        return tuple(each for each in self.pads if each.role == "via")

    @property
    def component_pads(self) -> tuple[Pad, ...]:
        """Pads of components."""
        return tuple(each for each in self.pads if each.role == "component")

    @property
    def fiducials(self) -> tuple[Pad, ...]:
        """Pads that are fiducials."""
        return tuple(each for each in self.pads if each.role == "fiducial")
