"""Reference of field localization in float64: distances by definition, scores by counting, poses by SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Float64 = NDArray[np.float64]


def distance_to_line(line: Any, points: Float64) -> Float64:
    """Distance of (..., 2) to the segment (x, y, x, y)."""
    a, b = np.array(line[:2]), np.array(line[2:])
    part = np.clip(((points - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(points - a - part[..., None] * (b - a), axis=-1)


def distance_to_arc(arc: Any, points: Float64) -> Float64:
    """Distance of (..., 2) to the arc: to the circle within its opening, to an end beside it."""
    x, y, radius, start, end = arc
    to = points - [x, y]
    within = np.mod(np.arctan2(to[..., 1], to[..., 0]) - start, 2.0 * np.pi) <= end - start
    ends = [radius * np.array([np.cos(each), np.sin(each)]) for each in (start, end)]
    to_ends = np.minimum(*(np.linalg.norm(to - each, axis=-1) for each in ends))
    return np.where(within, np.abs(np.linalg.norm(to, axis=-1) - radius), to_ends)


def distance(field: Any, points: Float64) -> Float64:
    """Distance of (..., 2) to the field's nearest line."""
    each = [distance_to_line(line, points) for line in field.lines]
    return np.min(each + [distance_to_arc(arc, points) for arc in field.arcs], axis=0)


def moved(pose: Any, points: Float64) -> Float64:
    """Return points of the robot's frame on the field."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + np.asarray(pose)[:2]


def cost(field: Any, pose: Any, points: Float64, scale: float) -> float:
    """Return the mean cost of the points."""
    square = distance(field, moved(pose, points)) ** 2
    return float(np.mean(square / (scale**2 + square)))


def refined(field: Any, start: Any, points: Float64, scale: float) -> Float64:
    """The pose of least cost near a start."""

    def residuals(pose: Float64) -> Float64:
        away = distance(field, moved(pose, points))
        return away / np.sqrt(scale**2 + away**2)

    return np.asarray(least_squares(residuals, start, xtol=1e-12, ftol=1e-14, gtol=1e-14, x_scale=[0.1, 0.1, 0.05]).x)


def seen(field: Any, pose: Any, rng: np.random.Generator, count: int, reach: float, sigma: float = 0.0) -> Float64:
    """Points on lines as a robot sees them within its reach."""
    on = []
    for line in field.lines:
        a, b = np.array(line[:2]), np.array(line[2:])
        part = rng.uniform(0.0, 1.0, (int(200 * np.linalg.norm(b - a)) + 2, 1))
        on.append(a + part * (b - a))
    for x, y, radius, start, end in field.arcs:
        angle = rng.uniform(start, end, int(200 * radius * (end - start)) + 2)
        on.append(np.array([x, y]) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    off = np.concatenate(on) - np.asarray(pose)[:2]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    points = off @ np.array([[c, -s], [s, c]])
    points = points[np.hypot(*points.T) < reach]
    chosen = points[rng.choice(len(points), count, replace=len(points) < count)]
    return chosen + rng.normal(0.0, 1.0, chosen.shape) * sigma
