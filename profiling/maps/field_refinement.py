"""Refinement of a pose on a field: angle between the two lines in view, and distance of the view from the origin."""

from __future__ import annotations

import functools

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.matching.field.distance_map import DistanceMap, Field
from gpuvision.matching.field.field_pose import FieldPoseRefinement
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.status import Status

_POINTS, _RANGE, _SCALE, _SIGMA = 64, 6.0, 0.25, 1e-3  # lengths in metres
_ROBOT = (1.0, 0.5)  # from the crossing of the lines [m]
_STEPS = 30
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the position over the angle between the lines and the coordinates of their crossing."""
    axes = Axis("angle between the lines [rad]", 0.03, 1.5), Axis("coordinates / range of the points", 0.1, 1e4)
    return Problem(axes, "range of the points", _errors, _bound)


def _normals(angle: float) -> Floats:
    """Return the unit normals (2, 2) of two lines, at half the angle on either side of the y axis."""
    half = 0.5 * angle
    return np.array([[-np.sin(half), np.cos(half)], [np.sin(half), np.cos(half)]])


@functools.lru_cache(maxsize=2048)
def _map(angle: float, away: float, device: Device) -> DistanceMap:
    """Return the map of two lines that cross at (away, away) [m]."""
    lines = []
    for nx, ny in _normals(angle):
        ends = away + 4.0 * _RANGE * np.outer((-1.0, 1.0), (ny, -nx))
        lines.append((float(ends[0, 0]), float(ends[0, 1]), float(ends[1, 0]), float(ends[1, 1])))
    size = 2.0 * (away + _RANGE)
    cell = max(size, _RANGE) / 100.0
    return DistanceMap(
        field=Field(length=size, width=size, lines=tuple(lines)),
        cell=cell, scale=_SCALE, max_range=_RANGE, device=device,
    )  # fmt: skip


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    errors = np.empty(len(places))
    for number, (angle, ratio) in enumerate(places):
        away, normals = _RANGE * ratio, _normals(angle)
        pose = np.array([*_ROBOT, rng.uniform(-np.pi, np.pi)])  # from the crossing
        points = _draw_points(normals, pose, rng).astype(np.float32)
        start = pose + rng.uniform(-0.02, 0.02, 3) + (away, away, 0.0)
        operation = FieldPoseRefinement(map=_map(angle, away, device), count=1)
        found = operation(points, start[None].astype(np.float32), device=device)
        exact = _least_cost(normals, pose, points.astype(np.float64))
        error = np.linalg.norm(to_numpy(found.poses)[0, :2] - away - exact[:2]) / _RANGE
        errors[number] = error if to_numpy(found.status)[0] in (Status.OK, Status.NOT_CONVERGED) else np.nan
    return errors


def _draw_points(normals: Floats, pose: Floats, rng: np.random.Generator) -> Floats:
    """Draw points on both lines in the frame of a robot, 0.5 to 4 m from the crossing."""
    along = np.stack([normals[:, 1], -normals[:, 0]], axis=-1)
    reach = rng.uniform(0.5, 4.0, (2, _POINTS // 2, 1)) * rng.choice([-1.0, 1.0], (2, _POINTS // 2, 1))
    on = reach * along[:, None] + _SIGMA * rng.normal(size=reach.shape) * normals[:, None]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.asarray((on.reshape(-1, 2) - pose[:2]) @ np.array([[c, -s], [s, c]]))


def _least_cost(normals: Floats, pose: Floats, points: Floats) -> Floats:
    """Return the pose of least cost about the crossing, by reweighted least squares from the true pose."""
    for _ in range(_STEPS):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        moved = points @ np.array([[c, s], [-s, c]])
        distance = (moved + pose[:2]) @ normals.T
        nearest = np.argmin(np.abs(distance), axis=1)
        r, by = distance[np.arange(len(points)), nearest], normals[nearest]
        design = np.column_stack([by, by[:, 1] * moved[:, 0] - by[:, 0] * moved[:, 1]])
        root = _SCALE**2 / (_SCALE**2 + r**2)  # of the weight
        pose = pose - np.linalg.lstsq(root[:, None] * design, root * r, rcond=None)[0]
    return pose


def _bound(places: Floats) -> Floats:
    angle, ratio = places.T
    # Coordinates are rounded to half an epsilon: the middles of the lines, the pose, and the points at the pose; the
    # last step is below 3e-6 m, 4 epsilon of the range. Lines at an angle fix the shift along their bisector by the
    # sine of half the angle.
    return np.asarray(_EPS * (4.0 + 1.5 * np.sqrt(2.0) * ratio) / np.sin(0.5 * angle))
