"""Closed surfaces of a scene: only their outer sides are visible from a view point outside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.scene.scene import Scene

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ClosedSurfaceLimits:
    """Limits of `visible_sides`.

    Attributes
    ----------
    min_volume_fraction : float
        Least volume of a closed surface, as a fraction of its bounding box; of flatter surfaces both sides are visible.
        Chosen: the sign of smaller volumes may be rounding. Default 1e-9.
    """

    min_volume_fraction: float = 1e-9


def visible_sides(
    scene: Scene,
    eye: npt.ArrayLike,
    direction: npt.ArrayLike,
    *,
    limits: ClosedSurfaceLimits = ClosedSurfaceLimits(),
) -> npt.NDArray[np.int8]:
    """Return the side of each triangle that is visible from a view point that moves along a straight line.

    A closed surface is a set of connected triangles in which every edge belongs to exactly two of them. Only its outer
    side is visible from a line that does not meet the bounding box of the surface.

    Parameters
    ----------
    scene
        Triangles. Connected triangles share corners with identical coordinates.
    eye, direction
        A point of the line [m] and its direction, (3,) each.
    limits
        Limits of the volume.

    Returns
    -------
    numpy.ndarray
        int8 (n,): 1, the side to which the triangle's normal (by its winding) points; -1, the other side; 0, both.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    sides = np.zeros(len(scene.corners), np.int8)
    triangles = scene.bvh.numbers
    if not len(triangles):
        return sides
    corners = scene.corners[triangles]
    points = vertex_numbers(corners)
    tail, head = points.ravel(), np.roll(points, -1, axis=1).ravel()
    forward = tail < head
    edge = np.minimum(tail, head) * (points.max() + 1) + np.maximum(tail, head)
    _, number, uses = np.unique(edge, return_inverse=True, return_counts=True)
    number = number.ravel()
    face = np.repeat(np.arange(len(triangles)), 3)
    # An edge is closed if it has two triangles and they run along it in opposite directions.
    closed = (uses == 2) & (np.bincount(number, np.where(forward, 1.0, -1.0)) == 0.0)
    order = np.argsort(number, kind="stable")
    first, second = order[:-1], order[1:]
    joined = number[first] == number[second]
    one, two = face[first[joined]], face[second[joined]]
    links = coo_array((np.ones(len(one), np.int8), (one, two)), shape=(len(triangles), len(triangles)))
    count, part = connected_components(links, directed=False)
    is_closed = np.bincount(part, ~closed[number].reshape(-1, 3).all(axis=1), minlength=count) == 0
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, corners.min(axis=1))
    np.maximum.at(high, part, corners.max(axis=1))
    from_low = corners - low[part][:, None]
    volume = np.bincount(part, np.linalg.det(from_low) / 6.0, minlength=count)
    is_closed &= np.abs(volume) > limits.min_volume_fraction * np.prod(high - low, axis=1)
    is_closed &= ~_line_meets_boxes(np.asarray(eye, np.float64), np.asarray(direction, np.float64), low, high)
    sides[triangles] = np.where(is_closed, np.sign(volume), 0.0)[part]
    return sides


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


def _line_meets_boxes(eye: Float64, direction: Float64, low: Float64, high: Float64) -> npt.NDArray[np.bool_]:
    """Return whether a line meets boxes with lower and upper corners (k, 3), by the slab method."""
    moves = direction != 0.0
    outside = ((eye < low) | (eye > high))[:, ~moves].any(axis=1)
    one, two = ((each[:, moves] - eye[moves]) / direction[moves] for each in (low, high))
    enter, leave = np.minimum(one, two), np.maximum(one, two)
    hit = enter.max(axis=1, initial=-np.inf) <= leave.min(axis=1, initial=np.inf)
    return np.asarray(hit & ~outside)
