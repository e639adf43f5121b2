"""Contract of the localization on a field: scores of all poses, and refined poses, from points on lines and beside."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.formats.field_file import read_field
from gpuvision.host import Device
from gpuvision.matching.field.distance_map import COST_LEVELS, Arc, DistanceMap, Field
from gpuvision.matching.field.field_pose import FieldPoseRefinement, FieldPoseSearch
from gpuvision.profiling.contract.agreement import Case, Limit, equal, roundings
from gpuvision.reference import field as reference

_EPS = float(np.finfo(np.float32).eps)
LIMITS = {
    "FieldPoseSearch": (
        equal("seen", reason="count of finite points within the range"),
        roundings(
            1, "scores", of="1",
            reason="integer sum over the cells, divided once, for points that are not within rounding of a cell's side",
        ),
    ),
    "FieldPoseRefinement": (
        equal("status", reason="counts and comparisons"),
        Limit(
            ("poses",), 2.0 * _EPS, 2.0 * _EPS,
            "pose + sum over the points of their coordinates x influence on the pose [m], [rad], at least 13",
            "rounding of the pose, of the points at the pose and of the lines; the last step is below 3e-6",
        ),
    ),
}  # fmt: skip
_HEADINGS = (0.3, -2.0, 1.1)
_LAST_STEP = 3e-6  # of a refinement [m], [rad]
_SIDE = 1e-3  # least distance of a point from the side of a cell [cells]


def cases() -> Iterator[Case]:
    """Yield searches of few and many points with holes, and refinements of poses all over a field."""
    field = Field(length=0.7, width=0.9, lines=((-1.0, 0.13, 2.0, 0.41),), arcs=(Arc(0.2, -0.3, 0.5, -1, 2),))
    small = DistanceMap(field=field, cell=0.1, max_range=2.0, device=Device.best())
    for count in (1, 65, 300):
        yield _search(f"{count} points", small, count)
    large = DistanceMap(field=read_field("robocup_msl"), cell=0.1, margin=1.0, device=Device.best())
    for number in range(4):
        yield _refinement(f"view {number}", large, number)


def _search(name: str, field_map: DistanceMap, count: int) -> Case:
    """Return a search; the map is the same array on all devices."""
    operation = FieldPoseSearch(map=field_map, headings=_HEADINGS, with_scores=True)
    points = np.random.default_rng(37).uniform(-1.0, 1.0, (4 * count + 40, 2)).astype(np.float32)
    cells = _cells(operation, points)
    points = points[(np.abs(cells - np.floor(cells) - 0.5) > _SIDE).all(axis=(0, 2))][:count]
    at = np.rint(_cells(operation, points)).astype(int) + field_map.border
    rows, columns = field_map.positions
    scores = np.zeros((len(_HEADINGS), rows, columns))
    for turn, places in enumerate(at):
        for row, column in places:
            scores[turn] += field_map.cells.level[row : row + rows, column : column + columns]
    exact = {"scores": scores / (COST_LEVELS * len(points)), "seen": np.full(len(_HEADINGS), len(points))}
    given = np.concatenate([points, np.array([(np.nan, 0.0), (0.0, np.inf), (1e6, 0.0)], np.float32)])
    return Case("FieldPoseSearch", name, operation, (given,), exact, {"scores": 1.0})


def _cells(operation: FieldPoseSearch, points: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return row and column of the points from the robot's cell (headings, points, 2), not rounded."""
    c, s = np.cos(operation.angles)[:, None], np.sin(operation.angles)[:, None]
    x, y = points.T.astype(np.float64)
    return np.asarray(np.stack([s * x + c * y, c * x - s * y], axis=-1) / operation.map.cell)


def _refinement(name: str, field_map: DistanceMap, number: int) -> Case:
    rng = np.random.default_rng(40 + number)
    pose = rng.uniform([-10.0, -6.0, -np.pi], [10.0, 6.0, np.pi])
    points = reference.draw_line_points(field_map.field, pose, rng, 96, 5.0, 0.03).astype(np.float32)
    start = (pose + rng.uniform(-1.0, 1.0, 3) * (0.1, 0.1, 0.05)).astype(np.float32)
    found: Any = start
    for _ in range(3):  # SciPy may stop at a kink of the cost, where two lines are equally near
        found = reference.refine_pose(field_map.field, found, points.astype(np.float64), field_map.scale)
    exact = {"poses": found[None], "status": np.zeros(1, np.uint8)}
    operation = FieldPoseRefinement(map=field_map)
    size = np.abs(found) + _influence(field_map, found, points.astype(np.float64))
    quantities = {"poses": np.maximum(size, _LAST_STEP / (2.0 * _EPS))[None]}
    return Case("FieldPoseRefinement", name, operation, (points, start[None]), exact, quantities)


def _influence(field_map: DistanceMap, pose: Any, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the sum over points of their coordinates times the absolute derivative of the pose by their distance."""
    field, steps = field_map.field, 1e-6 * np.eye(3)
    places = reference.to_field(pose, points)
    away = reference.distance(field, places)
    ends = [[reference.distance(field, reference.to_field(pose + s * each, points)) for s in (1, -1)] for each in steps]
    rows = np.stack([(high - low) / 2e-6 for high, low in ends], axis=-1)
    share = field_map.scale**2 / (field_map.scale**2 + away**2)
    slope = share**2 * (4.0 * share - 3.0)  # of psi, in the place of the weight share^2
    influence = np.abs(np.linalg.solve(rows.T @ (slope[:, None] * rows), rows.T)) * np.maximum(np.abs(slope), share**2)
    return np.asarray(influence @ (np.abs(places).sum(axis=1) + np.abs(points).sum(axis=1)))
