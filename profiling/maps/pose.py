"""Pose from edges: spread of their directions, and displacement of the board."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.profiling.maps.stability import Axis, Floats, Problem

_EDGES, _EXTENT, _STEPS = 24, 0.02, 12  # extent in metres; steps of the reference
_EPS = float(np.finfo(np.float32).eps)
SOLVE = SolvePose(loss="least_squares", max_condition=512.0, max_leverage=1.0, max_iterations=12)


def problem() -> Problem:
    """Return the error of the centre of the edges over the spread of their normals and the displacement."""
    axes = Axis("spread of the normals [rad]", 1e-4, 1.5), Axis("displacement / extent of the edges", 1e-5, 0.3)
    return Problem(axes, "extent of the edges", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    spread, away = places.T
    count = len(places)
    angle = rng.uniform(-np.pi, np.pi, (count, 1)) + spread[:, None] * np.linspace(-1.0, 1.0, _EDGES)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    point = _EXTENT * rng.uniform(-0.5, 0.5, (count, _EDGES, 2))
    heading = rng.uniform(-np.pi, np.pi, count)
    pose = np.stack([_EXTENT * away * np.cos(heading), _EXTENT * away * np.sin(heading), away], axis=-1)
    moved = _moved(point, pose) - point
    rows = np.concatenate([normal, point, moved, np.full((count, _EDGES, 1), 1e-6)], axis=-1).astype(np.float32)
    found = np.asarray(SOLVE(rows, device=device).pose, np.float64)
    exact = _least_squares(rows.astype(np.float64), pose)
    middle = rows[..., 2:4].mean(axis=1, keepdims=True, dtype=np.float64)
    return np.asarray(np.linalg.norm(_moved(middle, found) - _moved(middle, exact), axis=-1)[:, 0] / _EXTENT)


def _moved(point: Floats, pose: Floats) -> Floats:
    """Return points (n, k, 2) at poses (n, 3)."""
    x, y = np.moveaxis(point, -1, 0)
    c, s = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
    return np.stack([c * x - s * y + pose[:, :1], s * x + c * y + pose[:, 1:2]], axis=-1)


def _least_squares(rows: Floats, pose: Floats) -> Floats:
    """Return the poses (n, 3) of least squared distance along the normals, by Gauss-Newton from the true ones."""
    normal, point = rows[..., :2], rows[..., 2:4]
    seen = point + rows[..., 4:6]
    for _ in range(_STEPS):
        c, s = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
        x, y = np.moveaxis(seen - pose[:, None, :2], -1, 0)
        back = np.stack([c * x + s * y, c * y - s * x], axis=-1)
        residual = np.sum(normal * (back - point), axis=-1)
        by_x, by_y = c * normal[..., 0] - s * normal[..., 1], s * normal[..., 0] + c * normal[..., 1]
        turn = normal[..., 0] * back[..., 1] - normal[..., 1] * back[..., 0]
        design = np.stack([by_x, by_y, -turn / _EXTENT], axis=-1)
        step = np.einsum("nij,nj->ni", np.linalg.pinv(design, rcond=1e-14), residual)
        pose = pose + step * (1.0, 1.0, 1.0 / _EXTENT)
    return pose


def _bound(places: Floats) -> Floats:
    spread, away = places.T
    # Error model of the pose: 3e-7 of the extent, and a millionth of the displacement, for a pose that its edges fix
    # well. Shifts across and along the mean normal have standard deviations in the ratio of the root of 3 over the
    # spread of the directions. The operation refuses conditions from 1 / sqrt(32 epsilon) on.
    condition = 1.0 + np.sqrt(3.0) / spread
    return np.where(32.0 * condition**2 * _EPS < 1.0, (3e-7 + 1e-6 * away) * condition, np.inf)
