"""Division of triangles at the middle of their longest edge."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


def longest_edges(corners: Reals) -> tuple[Reals, Integers]:
    """Return the lengths of the longest edges of triangles (n, 3, 3), and the corners at which they start."""
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    return lengths.max(axis=1, initial=0.0), lengths.argmax(axis=1)


def bisect_triangles(corners: Reals) -> Reals:
    """Return the first halves of triangles (n, 3, 3), cut at their longest edge, and then the second halves."""
    corner_order = (longest_edges(corners)[1][:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, corner_order[:, :, None], axis=1), 1, 0)
    between = 0.5 * (a + b)
    return np.concatenate([np.stack([a, between, c], axis=1), np.stack([between, b, c], axis=1)])


def subdivide_to(corners: Reals, numbers: Integers, size: float) -> tuple[Reals, Integers]:
    """Halve triangles until no edge is longer than ``size``; return the pieces and the numbers of their triangles.

    Whether an edge is halved depends on its ends alone: the pieces of two triangles meet at bit-equal points of a
    common edge.
    """
    done, of = [corners[:0]], [numbers[:0]]
    while len(corners):
        fits = longest_edges(corners)[0] <= size
        done.append(corners[fits])
        of.append(numbers[fits])
        corners, numbers = bisect_triangles(corners[~fits]), np.tile(numbers[~fits], 2)
    return np.concatenate(done), np.concatenate(of)
