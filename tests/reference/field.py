"""Reference of field localization: distances from lines by definition, poses by SciPy's least squares."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Float64 = NDArray[np.float64]


def distance_to_line(line: Any, points: Float64) -> Float64:
    """Return the distance [m] of points (..., 2) from the segment (x, y, x, y)."""
    a, b = np.array(line[:2]), np.array(line[2:])
    part = np.clip(((points - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - part[..., None] * (b - a), axis=-1))


def distance_to_arc(arc: Any, points: Float64) -> Float64:
    """Return the distance [m] of points (..., 2) from the arc (x, y, radius, start, end)."""
    x, y, radius, start, end = arc
    to = points - [x, y]
    in_opening = np.mod(np.arctan2(to[..., 1], to[..., 0]) - start, 2.0 * np.pi) <= end - start
    ends = [radius * np.array([np.cos(each), np.sin(each)]) for each in (start, end)]
    to_ends = np.minimum(*(np.linalg.norm(to - each, axis=-1) for each in ends))
    return np.asarray(np.where(in_opening, np.abs(np.linalg.norm(to, axis=-1) - radius), to_ends))


def distance(field: Any, points: Float64) -> Float64:
    """Return the distance [m] of points (..., 2) from the nearest line of a `gpuvision.Field`."""
    each = [distance_to_line(line, points) for line in field.lines]
    return np.asarray(np.min(each + [distance_to_arc(arc, points) for arc in field.arcs], axis=0))


def to_field(pose: Any, points: Float64) -> Float64:
    """Transform points (..., 2) from the robot's frame to the field's, at the robot's pose (x, y, theta)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + np.asarray(pose)[:2])


def cost(field: Any, pose: Any, points: Float64, scale: float) -> float:
    """Return the mean of d^2 / (scale^2 + d^2) over the points, with their distances d from the lines."""
    square = distance(field, to_field(pose, points)) ** 2
    return float(np.mean(square / (scale**2 + square)))


def refine_pose(field: Any, start: Any, points: Float64, scale: float) -> Float64:
    """Return the pose of least cost near a start."""

    def residuals(pose: Float64) -> Float64:
        away = distance(field, to_field(pose, points))
        return away / np.sqrt(scale**2 + away**2)

    return np.asarray(least_squares(residuals, start, xtol=1e-12, ftol=1e-14, gtol=1e-14, x_scale=[0.1, 0.1, 0.05]).x)


def pose_statistics(field: Any, pose: Any, points: Float64, scale: float, prior_points: float) -> dict[str, Any]:
    """Return the fields of a refined pose from the distances of the points and their numerical derivatives.

    The covariance is H^-1 S H^-1 (Huber, 1981, section 6.3) with the derivatives h of the distances r, w the weight of
    the Geman-McClure loss, H = sum w (4 sqrt(w) - 3) h h^T over the positive terms, and S the mean of sum (w r)^2 h h^T
    and of S for equal variances, weighted by the numbers of points and of ``prior_points``.
    """
    away = distance(field, to_field(pose, points))
    steps = 1e-7 * np.eye(3)
    ends = [[distance(field, to_field(pose + sign * step, points)) for sign in (1, -1)] for step in steps]
    rows = np.stack([(high - low) / 2e-7 for high, low in ends], axis=-1)
    share = scale**2 / (scale**2 + away**2)
    curvature = np.maximum(share**2 * (4.0 * share - 3.0), 0.0)
    square = (share**2 * away) ** 2
    hessian, scatter = (np.einsum("n,ni,nj->ij", each, rows, rows) for each in (curvature, square))
    free = curvature.sum() - 3.0
    variance = square.sum() / free
    own = len(points) / (len(points) + prior_points)
    # An estimate from n residuals and 3 parameters is too small by (n - 3) / n.
    spread = own * scatter * curvature.sum() / free + (1.0 - own) * variance * hessian
    covariance = np.linalg.solve(hessian, np.linalg.solve(hessian, spread).T)
    return {
        "covariance": covariance,
        "information": np.linalg.inv(covariance),
        "score": float(np.mean(1.0 - share)),
        "residual_std": float(np.sqrt(variance)),
        "inlier_fraction": float(np.mean(away < scale)),
    }


def draw_line_points(
    field: Any, pose: Any, rng: np.random.Generator, count: int, reach: float, sigma: float = 0.0
) -> Float64:
    """Draw points on lines within ``reach`` [m] of a robot, in the robot's frame, with noise ``sigma`` [m]."""
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
    return np.asarray(chosen + rng.normal(0.0, 1.0, chosen.shape) * sigma)
