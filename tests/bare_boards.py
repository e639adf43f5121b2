"""Boards that are given by outlines, without files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.board_artwork import Holes
from gpuvision.matching.artwork.edges import BoardEdges
from gpuvision.matching.artwork.shapes import Shape


def board_of(
    *copper: npt.ArrayLike, holes: Sequence[tuple[float, float, float]] = (), size: float = 2e-3, **layers: Any
) -> Artwork:
    """Return a board with copper of these outlines [m], round holes (x, y, diameter) [m], and other layers.

    Without ``mask`` the copper is bare. The bounds are the square from 0 to ``size`` [m].
    """
    none, drilled = np.empty((0, 2)), np.reshape(holes, (-1, 3))
    given = {"mask": (), "silk": (), "copper": tuple(Shape(np.asarray(each, np.float64)) for each in copper), **layers}
    return Artwork(
        side="top",
        holes=Holes(drilled[:, :2], drilled[:, :2], drilled[:, 2], np.zeros(len(drilled), np.int8)),
        pads=(),
        edges=BoardEdges(none, none, none, np.empty(0), np.empty(0, bool), np.empty(0, int), np.empty(0, int)),
        bounds=np.array([[0.0, 0.0], [size, size]]),
        **given,
    )
