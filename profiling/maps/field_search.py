"""Search of a pose on a field: cell of the map, and distance of a point from its line, both over the scale of the cost.

The error is that of the method: a point is taken at the centre of its cell.
"""

from __future__ import annotations

import functools

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.matching.field.distance_map import COST_LEVELS, DistanceMap, Field
from gpuvision.matching.field.field_pose import FieldPoseSearch
from gpuvision.profiling.maps.stability import Axis, Floats, Problem

_REACH = 6.0  # largest distance of a point from the robot [cells]
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the score of a pose over the cell and the distance of the point from the line."""
    return Problem((Axis("cell / scale", 1e-5, 1.0), Axis("distance / scale", 1e-3, 10.0)), "1", _errors, _bound)


@functools.lru_cache(maxsize=1024)
def _map(cell: float, away: float, device: Device) -> DistanceMap:
    """Return the map of a single cell beside a long line along x at a distance from it, with the scale 1 m."""
    field = Field(length=cell, width=cell, lines=((-100.0, away, 100.0, away),))
    return DistanceMap(field=field, cell=cell, scale=1.0, max_range=_REACH * cell, device=device)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    errors = np.empty(len(places))
    for number, (cell, away) in enumerate(places):
        heading, bearing = rng.uniform(-np.pi, np.pi, 2)
        reach = _REACH * cell * rng.uniform(0.0, 0.99)
        point = np.array([[reach * np.cos(bearing), reach * np.sin(bearing)]], np.float32)
        search = FieldPoseSearch(map=_map(cell, away, device), headings=(heading,), with_scores=True)
        found = to_numpy(search(point, device=device).scores)
        x, y = point[0].astype(np.float64)
        square = (away - np.sin(heading) * x - np.cos(heading) * y) ** 2
        errors[number] = np.abs(found[0, 0, 0] - square / (1.0 + square))
    return errors


def _bound(places: Floats) -> Floats:
    cell, away = places.T
    # The centre of the cell is half a diagonal from the point at most, on which the distance is up to `_REACH` cells
    # from that of the robot. The slope of the cost, 2 d / (1 + d^2)^2, rises to 0.65 at d = 3^-0.5 and falls beyond.
    # Levels are rounded to half of 1 / COST_LEVELS, distances to some epsilon.
    nearest, farthest = (np.abs(away + each * (_REACH + 1.0) * cell) for each in (-1.0, 1.0))
    nearest = np.where(away < (_REACH + 1.0) * cell, 0.0, nearest)
    steepest = np.clip(3.0**-0.5, nearest, farthest)
    slope = 2.0 * steepest / (1.0 + steepest**2) ** 2
    return np.asarray(slope * cell * 0.5**0.5 + 0.5 / COST_LEVELS + 8.0 * _EPS * (1.0 + away))
