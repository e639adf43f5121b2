"""Localization of a robot on its field: cell of the map of the search, and steps of the refinement.

Views of 64 points with noise of 1 cm, from random poses. The error is that of the position. The search knows the
heading, and the refinement starts 5 cm and 0.05 rad away.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.formats.field_file import read_field
from gpuvision.host import Device, to_numpy
from gpuvision.matching.field.distance_map import DistanceMap
from gpuvision.matching.field.field_pose import FieldPoseRefinement, FieldPoseSearch
from gpuvision.profiling.curves.curve import Errors, Setting, distance
from gpuvision.profiling.harness import bind_with
from gpuvision.reference.field import draw_line_points

_POINTS, _VIEWS, _SIGMA, _SCALE, _RANGE = 64, 6, 0.01, 0.05, 1.5  # [m]


def settings(device: Device) -> Iterator[Setting]:
    """Yield cells of the map for the search, and numbers of steps for the refinement."""
    rng, field = np.random.default_rng(16), read_field("robocup_junior")
    poses = np.column_stack([rng.uniform(-0.5, 0.5, (_VIEWS, 2)), rng.uniform(-np.pi, np.pi, _VIEWS)])
    views = [draw_line_points(field, each, rng, _POINTS, 0.9 * _RANGE, _SIGMA).astype(np.float32) for each in poses]
    for cell in (0.01, 0.02, 0.04, 0.08):
        field_map = DistanceMap(field=field, cell=cell, scale=_SCALE, max_range=_RANGE, device=device)
        found = []
        for pose, points in zip(poses, views, strict=True):
            bound = bind_with(FieldPoseSearch(map=field_map, headings=(float(pose[2]),)), device, points)
            found.append(_place(field_map, bound.outputs))
        errors = Errors(distance(found, poses[:, :2]))
        yield Setting("field_pose", "search, heading known", {"cell": cell}, bound.run, errors, "m")
        if cell == 0.02:
            yield from _refinements(device, field_map, poses, views)


def _refinements(device: Device, field_map: DistanceMap, poses: Any, views: Any) -> Iterator[Setting]:
    starts = (poses + np.random.default_rng(17).uniform(-0.05, 0.05, poses.shape)).astype(np.float32)
    for steps in (1, 2, 4, 8, 40):
        found = []
        for start, points in zip(starts, views, strict=True):
            operation = FieldPoseRefinement(map=field_map, max_iterations=steps, count=1)
            bound = bind_with(operation, device, points, start[None])
            found.append(to_numpy(bound.outputs.poses)[0, :2].copy())
        errors = Errors(distance(found, poses[:, :2]))
        yield Setting("field_pose", "refinement", {"max_iterations": steps}, bound.run, errors, "m")


def _place(field_map: DistanceMap, costs: Any) -> npt.NDArray[np.float64]:
    """Return the position of least cost."""
    least = to_numpy(costs.least)
    _, row, block = np.unravel_index(np.argmin(least), least.shape)
    column = to_numpy(costs.column)[0, row, block]
    x, y = field_map.first_position
    return np.array([x + field_map.cell * column, y + field_map.cell * row])
