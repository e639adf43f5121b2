"""Closed surfaces of a scene: only their outer sides are visible from a view point outside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.scene.connected_surfaces import Float64, connected_surfaces
from gpuvision.simulation.scene.scene import Scene


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
    sides = np.zeros(len(scene.corners), np.int8)
    triangles = scene.bvh.numbers
    if not len(triangles):
        return sides
    surfaces = connected_surfaces(scene.corners[triangles])
    low, high = surfaces.low, surfaces.high
    is_closed = surfaces.is_closed & (
        np.abs(surfaces.volume) > limits.min_volume_fraction * np.prod(high - low, axis=1)
    )
    is_closed &= ~_line_meets_boxes(np.asarray(eye, np.float64), np.asarray(direction, np.float64), low, high)
    sides[triangles] = np.where(is_closed, np.sign(surfaces.volume), 0.0)[surfaces.number]
    return sides


def _line_meets_boxes(eye: Float64, direction: Float64, low: Float64, high: Float64) -> npt.NDArray[np.bool_]:
    """Return whether a line meets boxes with lower and upper corners (k, 3), by the slab method."""
    moves = direction != 0.0
    outside = ((eye < low) | (eye > high))[:, ~moves].any(axis=1)
    one, two = ((each[:, moves] - eye[moves]) / direction[moves] for each in (low, high))
    enter, leave = np.minimum(one, two), np.maximum(one, two)
    hit = enter.max(axis=1, initial=-np.inf) <= leave.min(axis=1, initial=np.inf)
    return np.asarray(hit & ~outside)
