"""Closest hit on a triangle: cosine of incidence, and distance of the ray's start."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.simulation.scene.rays import ClosestHit
from gpuvision.simulation.scene.scene import Scene

CORNERS = np.array([[-1.1, -0.7, 0.3], [1.3, -0.4, -0.6], [-0.2, 1.2, 0.5]], np.float32).astype(np.float64)  # [m]
SIZE = 2.6  # longest edge, from the first corner to the second one [m]
EDGE = CORNERS[1] - CORNERS[0]
_AREA = np.cross(EDGE, CORNERS[2] - CORNERS[0])
NORMAL = _AREA / np.linalg.norm(_AREA)
_ALONG = EDGE / np.linalg.norm(EDGE)
INWARD = np.cross(NORMAL, _ALONG)  # in the plane, from the longest edge to the third corner
AXES = Axis("cosine of incidence", 1e-3, 1.0), Axis("distance / size of the scene", 1e-2, 1e3)
_HIT = ClosestHit(scene=Scene(CORNERS[None]))
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the distance over the cosine of incidence and the distance of the start."""
    return Problem(AXES, "size of the scene + distance", _errors, _bound)


def directions(cosine: Floats, rng: np.random.Generator) -> Floats:
    """Return unit vectors (n, 3) that meet the plane of the triangle at cosines of incidence (n,), turned at random."""
    turn, sine = rng.uniform(-np.pi, np.pi, (len(cosine), 1)), np.sqrt(1.0 - cosine[:, None] ** 2)
    return np.asarray(sine * (np.cos(turn) * _ALONG + np.sin(turn) * INWARD) - cosine[:, None] * NORMAL)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    cosine, away = places.T
    way = directions(cosine, rng)
    share = rng.uniform(0.1, 0.4, (len(places), 2))
    target = CORNERS[0] + share[:, :1] * EDGE + share[:, 1:] * (CORNERS[2] - CORNERS[0])
    rays = np.concatenate([target - SIZE * away[:, None] * way, way], axis=1).astype(np.float32)
    found = np.asarray(_HIT(rays, device=device).distance, np.float64)
    wide = rays.astype(np.float64)
    exact = (CORNERS[0] - wide[:, :3]) @ NORMAL / (wide[:, 3:] @ NORMAL) * np.linalg.norm(wide[:, 3:], axis=1)
    return np.asarray(np.abs(found - exact) / (SIZE + exact))


def _bound(places: Floats) -> Floats:
    # Contract of the closest hit: 8 epsilon over the cosine, times the square of the longest edge over twice the area,
    # which is 1.6 for this triangle.
    return np.asarray(8.0 * _EPS * 1.6 / places[:, 0])
