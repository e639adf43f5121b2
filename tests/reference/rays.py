"""Rays against every triangle, in float64 (Moeller and Trumbore)."""

from __future__ import annotations

import numpy as np


def crossings(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return t, u, v (rays, triangles): t NaN where a ray does not meet a triangle, its edges included."""
    a, one, two = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(directions[:, None], two)
    det = np.sum(across * one, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        to = origins[:, None] - a
        u = np.sum(to * across, axis=-1) / det
        turned = np.cross(to, one)
        v = np.sum(turned * directions[:, None], axis=-1) / det
        t = np.sum(turned * two, axis=-1) / det
    meets = (det != 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
    return np.where(meets, t, np.nan), u, v


def closest(corners: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return triangle (-1: none), distance, u, v of rays (n, 6)."""
    lengths = np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
    t, u, v = crossings(corners, rays[:, :3], rays[:, 3:] / lengths)
    t = np.where(t > 0.0, t, np.inf)
    triangle = np.argmin(t, axis=1)
    rows = np.arange(len(rays))
    met = np.isfinite(t[rows, triangle])
    values = (np.where(met, each[rows, triangle], np.nan) for each in (t, u, v))
    return np.where(met, triangle, -1), *values


def occluded(corners: np.ndarray, segments: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Return whether any triangle lies between the ends, but for so much of the length (may be negative)."""
    t = crossings(corners, segments[:, :3], segments[:, 3:] - segments[:, :3])[0]
    with np.errstate(invalid="ignore"):
        return ((t > margin) & (t < 1.0 - margin)).any(axis=1)
