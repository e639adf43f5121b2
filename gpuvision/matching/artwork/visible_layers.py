"""What lies along a line across a board's edge or mark: copper, and what may hide it."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.shapes import Float64, Layer, Shape, capsule, covered


class Sheet(NamedTuple):
    """A layer, how far it may lie off the copper, and whether it is dark where the others are bright: holes are."""

    layer: Layer
    off: float
    dark: bool = False


@lru_cache(maxsize=1)  # rulers and marks of a board are chosen one after the other
def sheets_of(artwork: Artwork, off: float) -> tuple[Sheet, ...]:
    """Return copper, and then what may lie on it, off by so much at most [m]."""
    holes = zip(artwork.holes.start, artwork.holes.end, artwork.holes.diameter, strict=True)
    drilled = tuple(Shape(capsule(start, end, across / 2)) for start, end, across in holes)
    return (
        Sheet(Layer(artwork.copper), 0.0),
        Sheet(Layer(artwork.mask), off),
        Sheet(Layer(artwork.silk), off),
        Sheet(Layer(drilled), off, dark=True),
    )


def steps_along(layer: Layer, point: Float64, normal: Float64, reach: float) -> tuple[Float64, npt.NDArray[np.bool_]]:
    """Return where a layer begins and ends along a normal, as far as a reach [m] either way, and whether it ends."""
    found = layer.crossings(point - reach * normal, point + reach * normal)
    cuts = np.unique(np.concatenate([np.array([0.0, 1.0]), *(where for _, where in found)]))
    cuts = cuts[(cuts >= 0) & (cuts <= 1)]
    laid = covered(found, (cuts[1:] + cuts[:-1]) / 2)
    step = laid[:-1] != laid[1:]
    return (cuts[1:-1][step] - 0.5) * 2 * reach, laid[:-1][step]
