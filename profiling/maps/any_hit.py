"""Occlusion by a triangle: cosine of incidence, and distance of the segment's start.

A segment passes an edge inside or outside. The error is its distance from the edge where the result is wrong, else 0.
"""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.reference.rays import crossings
from gpuvision.simulation.scene.rays import AnyHit
from gpuvision.simulation.scene.scene import Scene

_CORNERS = np.array([[-1.1, -0.7, 0.3], [1.3, -0.4, -0.6], [-0.2, 1.2, 0.5]], np.float32).astype(np.float64)  # [m]
_SIZE = 2.6  # longest edge, which the segments pass [m]
_HIT = AnyHit(scene=Scene(_CORNERS[None]))
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the distance of wrong results from the edge over the cosine of incidence and the distance of the start."""
    axes = Axis("cosine of incidence", 1e-3, 1.0), Axis("distance / size of the scene", 1e-2, 1e3)
    return Problem(axes, "size of the scene + distance", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    cosine, away = places.T
    first, one, two = _CORNERS[0], _CORNERS[1] - _CORNERS[0], _CORNERS[2] - _CORNERS[0]
    normal = np.cross(one, two) / np.linalg.norm(np.cross(one, two))
    along = one / np.linalg.norm(one)
    inward = np.cross(normal, along)
    turn, sine = rng.uniform(-np.pi, np.pi, (len(places), 1)), np.sqrt(1.0 - cosine[:, None] ** 2)
    way = sine * (np.cos(turn) * along + np.sin(turn) * inward) - cosine[:, None] * normal
    aside = rng.choice([-1.0, 1.0], len(places)) * _SIZE * 10.0 ** rng.uniform(-9.0, -3.0, len(places))
    target = first + rng.uniform(0.4, 0.6, (len(places), 1)) * one + aside[:, None] * inward
    start, end = target - _SIZE * away[:, None] * way, target + 0.1 * _SIZE * way
    segments = np.concatenate([start, end], axis=1).astype(np.float32)
    found = np.asarray(_HIT(segments, device=device).occluded) != 0
    wide = segments.astype(np.float64)
    step = wide[:, 3:] - wide[:, :3]
    t, _, _ = crossings(_CORNERS[None], wide[:, :3], step)
    met = wide[:, :3] + ((first - wide[:, :3]) @ normal / (step @ normal))[:, None] * step
    wrong = found != np.isfinite(t[:, 0])
    return np.where(wrong, np.abs((met - first) @ inward) / (_SIZE * (1.0 + away)), 0.0)


def _bound(places: Floats) -> Floats:
    # Contract of the rays: positions are rounded by 8 epsilon of the size and of the distance, seen at the cosine of
    # incidence.
    return np.asarray(8.0 * _EPS / places[:, 0])
