"""Closed surfaces of a scene: their inside is not seen from outside."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.scene.scene import Scene

Float64 = npt.NDArray[np.float64]
# A surface that holds less of its box's volume has no inside to speak of.
_LEAST_VOLUME = 1e-9


def visible_sides(scene: Scene, eye: npt.ArrayLike, direction: npt.ArrayLike) -> npt.NDArray[np.int8]:
    """Return which side of triangles an eye may see that moves along a straight line.

    Of a closed surface (triangles that hang together, every edge between two of them) it sees the outside only, if its
    line does not meet the surface's box.

    Parameters
    ----------
    scene
        Triangles that touch share corners, to the last digit.
    eye, direction
        (3,): a place [m], and how it moves.

    Returns
    -------
    numpy.ndarray
        int8 (n,): 1 or -1, the side that the triangle's normal, as it is wound, points to or the other; 0: both.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    sides = np.zeros(len(scene.corners), np.int8)
    there = scene.bvh.numbers
    if not len(there):
        return sides
    corners = scene.corners[there]
    points = vertex_numbers(corners)
    tail, head = points.ravel(), np.roll(points, -1, axis=1).ravel()
    forward = tail < head
    edge = np.minimum(tail, head) * (points.max() + 1) + np.maximum(tail, head)
    _, number, uses = np.unique(edge, return_inverse=True, return_counts=True)
    number = number.ravel()
    face = np.repeat(np.arange(len(there)), 3)
    # Each edge once forward and once back.
    closed = (uses == 2) & (np.bincount(number, np.where(forward, 1.0, -1.0)) == 0.0)
    order = np.argsort(number, kind="stable")
    first, second = order[:-1], order[1:]
    joined = number[first] == number[second]
    one, two = face[first[joined]], face[second[joined]]
    links = coo_array((np.ones(len(one), np.int8), (one, two)), shape=(len(there), len(there)))
    count, part = connected_components(links, directed=False)
    whole = np.bincount(part, ~closed[number].reshape(-1, 3).all(axis=1), minlength=count) == 0
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, corners.min(axis=1))
    np.maximum.at(high, part, corners.max(axis=1))
    from_low = corners - low[part][:, None]
    volume = np.bincount(part, np.linalg.det(from_low) / 6.0, minlength=count)
    whole &= np.abs(volume) > _LEAST_VOLUME * np.prod(high - low, axis=1)
    whole &= ~_meets(np.asarray(eye, np.float64), np.asarray(direction, np.float64), low, high)
    sides[there] = np.where(whole, np.sign(volume), 0.0)[part]
    return sides


def vertex_numbers(corners: Float64) -> npt.NDArray[np.int64]:
    """Return a number for every corner (n, 3, 3) to (n, 3), the same where the place is to the last digit."""
    # Zero has one sign here.
    points = corners.reshape(-1, 3) + 0.0
    order = np.lexsort(points.T)
    in_order = points[order]
    fresh = np.any(in_order[1:] != in_order[:-1], axis=1)
    number = np.empty(len(points), np.int64)
    number[order] = np.concatenate([np.zeros(min(len(points), 1), np.int64), np.cumsum(fresh)])
    return number.reshape(-1, 3)


def _meets(eye: Float64, direction: Float64, low: Float64, high: Float64) -> npt.NDArray[np.bool_]:
    """Return whether a line meets boxes (k, 3), (k, 3)."""
    moves = direction != 0.0
    beside = ((eye < low) | (eye > high))[:, ~moves].any(axis=1)
    one, two = ((each[:, moves] - eye[moves]) / direction[moves] for each in (low, high))
    enter, leave = np.minimum(one, two), np.maximum(one, two)
    met = enter.max(axis=1, initial=-np.inf) <= leave.min(axis=1, initial=np.inf)
    return np.asarray(met & ~beside)
