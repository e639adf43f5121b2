"""Triangulation: distance from the horizon, and of the sheet's origin from the measuring range."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.reference.triangulation import triangulate

_REGION = ((0.0, 1000.0), (0.0, 1000.0))
_RANGE = 0.1  # size of the measuring range [m]
_HORIZON = 1e-4
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of a point over the denominator of the homography and the distance of the origin."""
    axes = Axis("denominator (1: middle of the region)", 1e-3, 1.0), Axis("distance of the origin / range", 0.1, 1e4)
    return Problem(axes, "range / denominator", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    errors = np.empty(len(places))
    for away in np.unique(places[:, 1]):
        chosen = places[:, 1] == away
        errors[chosen] = _of_one_origin(device, places[chosen, 0], float(away), rng)
    return errors


def _of_one_origin(device: Device, denominator: Floats, away: float, rng: np.random.Generator) -> Floats:
    """Return the errors for denominators w = 1 - (u - 500) / 500: the horizon lies at the end of the region."""
    origin = np.array([[1.0, 0.0, away * _RANGE], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    scale = _RANGE / 1000.0
    homography = origin @ [[0.3 * scale, scale, 0.0], [scale, 0.2 * scale, 0.0], [-1.0 / 500.0, 0.0, 2.0]]
    rows = tuple(tuple(float(each) for each in row) for row in homography)
    operation = Triangulation(homography=rows, region=_REGION, horizon=_HORIZON)  # type: ignore[arg-type]
    u = (500.0 * (2.0 - denominator)).astype(np.float32)
    v = rng.uniform(0.0, 1000.0, len(u)).astype(np.float32)
    found = operation(u, v, device=device)
    g, h, _ = triangulate(u, v, rows, _REGION, horizon=_HORIZON)
    exact = 2.0 - u.astype(np.float64) / 500.0
    return np.asarray(np.hypot(to_numpy(found.g) - g, to_numpy(found.h) - h) / (_RANGE / exact))


def _bound(places: Floats) -> Floats:
    denominator, away = places.T
    # Contract of the triangulation: 4 epsilon of the largest coordinate over the denominator, in g and in h. Here the
    # largest coordinate is the distance of the origin plus 1.3 ranges over the denominator.
    return np.asarray(np.sqrt(2.0) * 4.0 * _EPS * (away + 1.3 / denominator))
