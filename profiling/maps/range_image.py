"""Range image of a straight transport: distance of the origin, and travel, over the measuring range."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.ranging.range_image import RangeImage
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.reference.range_image import points_of_straight_transport

_RANGE = 0.1  # size of the measuring range [m]
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of a point over the distance of the origin and the travel."""
    axes = Axis("distance of the origin / range", 0.1, 1e5), Axis("travel / range", 0.1, 1e5)
    return Problem(axes, "range", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    errors = np.empty(len(places))
    for away in np.unique(places[:, 0]):
        chosen = places[:, 0] == away
        geometry = StraightTransport(h_axis=(0.0, 0.7, 1.0), origin=(_RANGE * away / 3.0, _RANGE * away / 3.0, 0.0))
        g, h = rng.uniform(-0.5 * _RANGE, 0.5 * _RANGE, (2, chosen.sum(), 1)).astype(np.float32)
        travel = (_RANGE * places[chosen, 1]).astype(np.float32)
        good = np.zeros(g.shape, np.uint8)
        found = RangeImage(geometry=geometry)(g, h, travel, good, device=device)
        exact = points_of_straight_transport(geometry, g, h, travel)[:, 0]
        points = np.concatenate([found.x, found.y, found.z], axis=1)
        errors[chosen] = np.linalg.norm(points - exact, axis=1) / _RANGE
    return errors


def _bound(places: Floats) -> Floats:
    # Contract of the range image: 6 epsilon of the largest term of each coordinate.
    return np.asarray(np.sqrt(3.0) * 6.0 * _EPS * np.maximum(np.maximum(places[:, 0] / 3.0, places[:, 1]), 0.5))
