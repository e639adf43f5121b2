"""Occlusion by a triangle: cosine of incidence, and distance of the segment's start.

A segment passes an edge inside or outside. The error is its distance from the edge where the result is wrong, else 0.
"""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.maps.rays import AXES, CORNERS, EDGE, INWARD, NORMAL, SIZE, directions
from gpuvision.profiling.maps.stability import Floats, Problem
from gpuvision.reference.rays import crossings
from gpuvision.simulation.scene.rays import AnyHit
from gpuvision.simulation.scene.scene import Scene

_HIT = AnyHit(scene=Scene(CORNERS[None]))
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the distance of wrong results from the edge over the cosine of incidence and the distance of the start."""
    return Problem(AXES, "size of the scene + distance", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    cosine, away = places.T
    way = directions(cosine, rng)
    aside = rng.choice([-1.0, 1.0], len(places)) * SIZE * 10.0 ** rng.uniform(-9.0, -3.0, len(places))
    target = CORNERS[0] + rng.uniform(0.4, 0.6, (len(places), 1)) * EDGE + aside[:, None] * INWARD
    start, end = target - SIZE * away[:, None] * way, target + 0.1 * SIZE * way
    segments = np.concatenate([start, end], axis=1).astype(np.float32)
    found = np.asarray(_HIT(segments, device=device).occluded) != 0
    wide = segments.astype(np.float64)
    step = wide[:, 3:] - wide[:, :3]
    t, _, _ = crossings(CORNERS[None], wide[:, :3], step)
    met = wide[:, :3] + ((CORNERS[0] - wide[:, :3]) @ NORMAL / (step @ NORMAL))[:, None] * step
    wrong = found != np.isfinite(t[:, 0])
    return np.where(wrong, np.abs((met - CORNERS[0]) @ INWARD) / (SIZE * (1.0 + away)), 0.0)


def _bound(places: Floats) -> Floats:
    # Contract of the rays: positions are rounded by 8 epsilon of the size and of the distance, seen at the cosine of
    # incidence.
    return np.asarray(8.0 * _EPS / places[:, 0])
