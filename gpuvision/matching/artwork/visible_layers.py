"""Layers along a line across an edge or a pad of a board: copper, and the layers that may hide it."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.shapes import Float64, Layer, Shape, capsule, is_covered, sorted_unique

_ENDS = np.array([0.0, 1.0])


class VisibleLayer(NamedTuple):
    """Layer, its largest offset from the copper [m], and whether it looks dark where the others look bright (holes)."""

    layer: Layer
    max_offset: float
    dark: bool = False


@lru_cache(maxsize=1)  # rulers and fiducials of a board are selected one after the other
def visible_layers(artwork: Artwork, max_offset: float) -> tuple[VisibleLayer, ...]:
    """Return the copper, and then the layers that may hide it, with their largest offset [m]."""
    holes = zip(artwork.holes.start, artwork.holes.end, artwork.holes.diameter, strict=True)
    drilled = tuple(Shape(capsule(start, end, across / 2)) for start, end, across in holes)
    return (
        VisibleLayer(Layer(artwork.copper), 0.0),
        VisibleLayer(Layer(artwork.mask), max_offset),
        VisibleLayer(Layer(artwork.silk), max_offset),
        VisibleLayer(Layer(drilled), max_offset, dark=True),
    )


def layer_edges_along(
    layer: Layer, point: Float64, normal: Float64, reach: float
) -> tuple[Float64, npt.NDArray[np.bool_]]:
    """Return the positions along a normal at which a layer begins or ends, up to a distance [m] on both sides.

    Returns
    -------
    position : numpy.ndarray
        Positions relative to the point [m].
    ends : numpy.ndarray
        bool, whether the layer ends there in the direction of the normal.
    """
    found = layer.crossings(point - reach * normal, point + reach * normal)
    if not found:
        return np.empty(0), np.empty(0, np.bool_)
    cuts = sorted_unique(np.concatenate([_ENDS, *(where for _, where in found)]))
    cuts = cuts[(cuts >= 0) & (cuts <= 1)]
    inside = is_covered(found, (cuts[1:] + cuts[:-1]) / 2)
    step = inside[:-1] != inside[1:]
    return (cuts[1:-1][step] - 0.5) * 2 * reach, inside[:-1][step]
