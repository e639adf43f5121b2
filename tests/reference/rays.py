"""Reference of rays and segments: intersection with every triangle.

References
----------
T. Moeller and B. Trumbore, "Fast, minimum storage ray/triangle intersection", Journal of Graphics Tools 2(1), 1997.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def crossings(corners: Float64, origins: Float64, directions: Float64) -> tuple[Float64, ...]:
    """Intersect rays with triangles (n, 3, 3).

    Returns
    -------
    t, u, v : numpy.ndarray
        (rays, triangles) each: ray parameter, NaN without an intersection (edges belong to the triangle), and the
        barycentric weights of the second and third corner.
    """
    a, one, two = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(directions[:, None], two)
    det = np.sum(across * one, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        to = origins[:, None] - a
        u = np.sum(to * across, axis=-1) / det
        normal_to = np.cross(to, one)
        v = np.sum(normal_to * directions[:, None], axis=-1) / det
        t = np.sum(normal_to * two, axis=-1) / det
    hits = (det != 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
    return np.where(hits, t, np.nan), u, v


def closest(corners: Float64, rays: Float64) -> tuple[Float64, ...]:
    """Return the closest hits of rays (n, 6): triangle (-1: none), distance [m], u and v."""
    lengths = np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
    t, u, v = crossings(corners, rays[:, :3], rays[:, 3:] / lengths)
    t = np.where(t > 0.0, t, np.inf)
    triangle = np.argmin(t, axis=1)
    rows = np.arange(len(rays))
    hit = np.isfinite(t[rows, triangle])
    values = (np.where(hit, each[rows, triangle], np.nan) for each in (t, u, v))
    return np.where(hit, triangle, -1), *values


def occluded(corners: Float64, segments: Float64, margin: float = 0.0) -> NDArray[np.bool_]:
    """Return whether segments (n, 6) are occluded, except within a fraction of the length at both ends (may be < 0)."""
    t = crossings(corners, segments[:, :3], segments[:, 3:] - segments[:, :3])[0]
    with np.errstate(invalid="ignore"):
        return np.asarray(((t > margin) & (t < 1.0 - margin)).any(axis=1))
