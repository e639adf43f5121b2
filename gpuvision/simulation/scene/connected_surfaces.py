"""Connected surfaces of triangles, and whether they are closed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


class ConnectedSurfaces(NamedTuple):
    """Connected surfaces of triangles.

    Attributes
    ----------
    number
        int32 (n,), number of the surface of each triangle.
    is_closed
        bool (k,): every edge belongs to exactly two triangles, which run along it in opposite directions.
    volume
        float64 (k,), enclosed volume of closed surfaces [m^3]: positive where the corners run counterclockwise, seen
        from outside.
    low, high
        float64 (k, 3), corners of the bounding boxes [m].
    """

    number: npt.NDArray[np.int32]
    is_closed: npt.NDArray[np.bool_]
    volume: Float64
    low: Float64
    high: Float64


def connected_surfaces(corners: Float64) -> ConnectedSurfaces:
    """Return the surfaces of triangles (n, 3, 3) that are connected by edges with identical corners, n at least 1."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    points = vertex_numbers(corners)
    tail, head = points.ravel(), np.roll(points, -1, axis=1).ravel()
    forward = tail < head
    edge = np.minimum(tail, head) * (points.max() + 1) + np.maximum(tail, head)
    _, number, uses = np.unique(edge, return_inverse=True, return_counts=True)
    number = number.ravel()
    face = np.repeat(np.arange(len(corners)), 3)
    # An edge is closed if it has two triangles and they run along it in opposite directions.
    closed = (uses == 2) & (np.bincount(number, np.where(forward, 1.0, -1.0)) == 0.0)
    order = np.argsort(number, kind="stable")
    first, second = order[:-1], order[1:]
    joined = number[first] == number[second]
    one, two = face[first[joined]], face[second[joined]]
    links = coo_array((np.ones(len(one), np.int8), (one, two)), shape=(len(corners), len(corners)))
    count, part = connected_components(links, directed=False)
    is_closed = np.bincount(part, ~closed[number].reshape(-1, 3).all(axis=1), minlength=count) == 0
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, corners.min(axis=1))
    np.maximum.at(high, part, corners.max(axis=1))
    from_low = corners - low[part][:, None]
    volume: Float64 = np.bincount(part, np.linalg.det(from_low) / 6.0, minlength=count).astype(np.float64)
    return ConnectedSurfaces(part, is_closed, volume, low, high)


def vertex_numbers(corners: Float64) -> npt.NDArray[np.int64]:
    """Return vertex numbers (n, 3) of corners (n, 3, 3): corners with identical coordinates have the same number."""
    # Adding 0.0 turns -0.0 into 0.0.
    points = corners.reshape(-1, 3) + 0.0
    order = np.lexsort(points.T)
    in_order = points[order]
    fresh = np.any(in_order[1:] != in_order[:-1], axis=1)
    number = np.empty(len(points), np.int64)
    number[order] = np.concatenate([np.zeros(min(len(points), 1), np.int64), np.cumsum(fresh)])
    return number.reshape(-1, 3)
