"""Closest hit on a triangle: cosine of incidence, and distance of the ray's start."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.simulation.scene.rays import ClosestHit
from gpuvision.simulation.scene.scene import Scene

_CORNERS = np.array([[-1.1, -0.7, 0.3], [1.3, -0.4, -0.6], [-0.2, 1.2, 0.5]], np.float32).astype(np.float64)  # [m]
_SIZE = 2.6  # longest edge [m]
_HIT = ClosestHit(scene=Scene(_CORNERS[None]))
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the distance over the cosine of incidence and the distance of the start."""
    axes = Axis("cosine of incidence", 1e-3, 1.0), Axis("distance / size of the scene", 1e-2, 1e3)
    return Problem(axes, "size of the scene + distance", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    cosine, away = places.T
    first, one, two = _CORNERS[0], _CORNERS[1] - _CORNERS[0], _CORNERS[2] - _CORNERS[0]
    normal = np.cross(one, two) / np.linalg.norm(np.cross(one, two))
    along = one / np.linalg.norm(one)
    turn, sine = rng.uniform(-np.pi, np.pi, (len(places), 1)), np.sqrt(1.0 - cosine[:, None] ** 2)
    way = sine * (np.cos(turn) * along + np.sin(turn) * np.cross(normal, along)) - cosine[:, None] * normal
    share = rng.uniform(0.1, 0.4, (len(places), 2))
    target = first + share[:, :1] * one + share[:, 1:] * two
    rays = np.concatenate([target - _SIZE * away[:, None] * way, way], axis=1).astype(np.float32)
    found = np.asarray(_HIT(rays, device=device).distance, np.float64)
    wide = rays.astype(np.float64)
    exact = (first - wide[:, :3]) @ normal / (wide[:, 3:] @ normal) * np.linalg.norm(wide[:, 3:], axis=1)
    return np.asarray(np.abs(found - exact) / (_SIZE + exact))


def _bound(places: Floats) -> Floats:
    # Contract of the closest hit: 8 epsilon over the cosine, times the square of the longest edge over twice the area,
    # which is 1.6 for this triangle.
    return np.asarray(8.0 * _EPS * 1.6 / places[:, 0])
