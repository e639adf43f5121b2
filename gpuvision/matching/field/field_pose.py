"""Where on a field a robot is: points on lines that it sees, against the map of the lines (thesis, section 6.4).

Two tiers. `FieldPoseSearch` looks at every pose of a grid; `FieldPoseRefinement` takes the best ones to where the cost
is least, with a covariance. `locate` does both. Fields are in `gpuvision.matching.field.distance_map`, what is known
from odometry goes in by `gpuvision.matching.field.odometry`.
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Launch, LaunchBuilder, Spec, Variant, WorkSize, capacity, ceil_div, flags, round_up
from gpuvision.matching.field.distance_map import LEVELS, DistanceMap
from gpuvision.operation import VisionOperation
from gpuvision.status import Status
from gpuvision.validation import finite

_BLOCK, _MOST_POINTS = 64, 4096
# Shares of the rows per core, so that the cores end together, and rows for which a point's shift is worth its work.
_SHARES_PER_CORE, _FEWEST_ROWS = 4, 4
_WEAKEST = 1e-3


class PoseCosts(NamedTuple):
    """What the points cost, 0 (all on lines) to 1, by heading and position.

    Attributes
    ----------
    scores
        float32 (headings, rows, columns), mean cost of the points; None unless asked for.
    least
        float32 (headings, rows, blocks), the least score of 64 positions side by side. NaN where no point is used.
    column
        int32 (headings, rows, blocks), where that is; the first of several.
    seen
        int32 (headings,), how many points are used: those that are finite and no further than the map's reach.
    """

    scores: Any
    least: Any
    column: Any
    seen: Any


def pose_grid_work(build: LaunchBuilder, headings: int, rows: int, columns: int) -> WorkSize:
    """Return the work size of a search over a grid of poses; a work-item of the vector variant takes ``each`` rows."""
    shares = ceil_div(_SHARES_PER_CORE * build.device.compute_units, headings)
    each = max(ceil_div(rows, shares), min(_FEWEST_ROWS, rows))
    if build.uses_vectors:
        return WorkSize((ceil_div(rows, each), headings), (1, 1), each, vectors=True)
    return WorkSize((round_up(columns, _BLOCK), rows, headings), (_BLOCK, 1, 1), each)


def pose_cost_outputs(
    build: LaunchBuilder, headings: int, rows: int, columns: int, *, with_scores: bool
) -> dict[str, Spec | None]:
    """Return the outputs of a search over a grid of poses, the fields of `PoseCosts`."""
    blocks = (headings, rows, ceil_div(columns, _BLOCK))
    scores = (headings, rows, columns) if with_scores else None
    shapes = {"scores": scores, "least": blocks, "column": blocks, "seen": (headings,)}
    return build.outputs(shapes, column=np.int32, seen=np.int32)


@dataclass(frozen=True, kw_only=True)
class FieldPoseSearch(VisionOperation[PoseCosts]):
    """Score all poses of a grid: ``op(points) -> PoseCosts``, points float32 (points, 2), in the robot's frame [m].

    Parameters
    ----------
    map
        The field. Positions are its cells; row ``r`` and column ``c`` is ``map.first_position + map.cell * (c, r)``.
    headings
        How many, all around from 0; or which [rad].
    with_scores
        Also give every pose's score, not only the least of each block.
    variant
        "vector" (64 positions at once, for CPU runtimes), "work_item" (a work-item per position, for GPUs), or "auto".

    Raises
    ------
    ValueError
        There is no heading.

    Notes
    -----
    A point costs d^2 / (c^2 + d^2) at the middle of the nearest cell: half a cell's diagonal at most from where it
    is, and c and the slope 0.65 / c of the cost bound what that makes of a score: 0.46 cell / c; in the mean over many
    points it is far less. The cost itself is rounded to 1/2046. The sum is exact.
    """

    Result: ClassVar[type[Any]] = PoseCosts

    map: DistanceMap
    headings: int | tuple[float, ...] = 72
    with_scores: bool = False
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        if not isinstance(self.map, DistanceMap):
            raise TypeError(f"FieldPoseSearch.map is {self.map!r}, expected a DistanceMap")
        if isinstance(self.headings, tuple):
            object.__setattr__(
                self, "headings", tuple(finite(each, "FieldPoseSearch.headings") for each in self.headings)
            )
        if not len(self.angles):
            raise ValueError(f"FieldPoseSearch.headings is {self.headings}, expected one at least")

    @property
    def angles(self) -> npt.NDArray[np.float64]:
        """The headings, rad."""
        if isinstance(self.headings, tuple):
            return np.array(self.headings, np.float64)
        count = max(operator.index(self.headings), 0)
        return np.array(np.arange(count) * (2.0 * math.pi / max(count, 1)), np.float64)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, variant=self.variant)
        count = _checked_points(build)
        rows, columns = self.map.positions
        angles = self.angles
        work = pose_grid_work(build, len(angles), rows, columns)
        return build.launch(
            "field/field_search.cl",
            "field_search",
            work=work,
            outputs=pose_cost_outputs(build, len(angles), rows, columns, with_scores=self.with_scores),
            defines={
                "CAPACITY": capacity(count, least=64),
                "FIELD_LEVELS": LEVELS,
                **flags(WITH_SCORES=self.with_scores),
            },
            arguments=[
                self.map.cells.level,
                np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32),
                *map(np.int32, (count, rows, columns, self.map.border, self.map.cells.level.shape[1])),
                np.float32(1.0 / self.map.cell),
                np.float32(self.map.reach**2),
                np.int32(work.each),
            ],
        )

    def best(self, costs: PoseCosts, most: int = 8, *, apart: tuple[float, float] | None = None) -> RoughPoses:
        """Return the best poses that are ``apart`` (m or rad) from each better one, best first.

        Parameters
        ----------
        costs
            What this operation gave, NumPy arrays.
        most
            How many at most.
        apart
            Poses that are nearer than this to a better one, in place (m) and in heading (rad), are the same. None:
            twice the map's scale, and 20 degrees.
        """
        far, turned = (2.0 * self.map.scale, math.radians(20.0)) if apart is None else apart
        least = costs.least.ravel().copy()
        least[~np.isfinite(least)] = np.inf
        turn, row, _ = np.unravel_index(np.arange(least.size), costs.least.shape)
        x0, y0 = self.map.first_position
        x, y = x0 + self.map.cell * costs.column.ravel(), y0 + self.map.cell * row
        angles = self.angles[turn]
        chosen: list[int] = []
        while len(chosen) < most:
            number = int(np.argmin(least))
            if not np.isfinite(least[number]):
                break
            chosen.append(number)
            near = np.flatnonzero((x - x[number]) ** 2 + (y - y[number]) ** 2 < far**2)
            least[near[np.abs(_wrapped(angles[near] - angles[number])) < turned]] = np.inf
            least[number] = np.inf
        poses = np.stack([x[chosen], y[chosen], angles[chosen]], axis=-1)
        return RoughPoses(poses, costs.least.ravel()[chosen])


class RoughPoses(NamedTuple):
    """Poses (poses, 3): x, y [m] and heading [rad]; and what each costs, 0 to 1."""

    poses: npt.NDArray[np.float64]
    scores: npt.NDArray[np.float32]


class FieldPoses(NamedTuple):
    """Poses of least cost, one for each start.

    Attributes
    ----------
    poses
        (starts, 3): x, y [m] and heading [rad], -pi to pi.
    covariance
        (starts, 3, 3) of them; NaN where the points do not fix the pose.
    information
        (starts, 3, 3), its inverse, which is known also where the points fix a part of the pose only.
    score
        (starts,) mean cost of the points used, 0 to 1.
    scale
        (starts,) standard deviation of a point's distance, of one without outliers, m.
    share
        (starts,) of the points that lie within ``scale`` of the map (its c) from a line.
    status
        uint8 `Status` flags. AMBIGUOUS (with a pose): the points fix a part of the pose only, as those of one line or
        of one circle do; along the rest the pose is about where it started. LOW_SIGNAL: fewer than four points on
        lines. OUT_OF_RANGE: the pose left the map. NOT_FINITE: the start is not, or lies beyond 1e6 m. All else is NaN
        then.
    """

    poses: Any
    covariance: Any
    information: Any
    score: Any
    scale: Any
    share: Any
    status: Any


@dataclass(frozen=True, kw_only=True)
class FieldPoseRefinement(VisionOperation[FieldPoses]):
    """Take rough poses to the least cost: ``op(points, starts) -> FieldPoses``, float32 (points, 2) and (starts, 3).

    Parameters
    ----------
    map
        The field; its ``scale`` is c of the cost r^2 / (c^2 + r^2).
    steps
        At most so many steps (Levenberg-Marquardt).
    count
        How many starts; None: as many as a call brings. To bind it must be said.

    Notes
    -----
    Distances to lines are exact, the map only says which ones to look at (four for a cell: where five meet in one cell,
    the wrong one may be taken). So the pose is that of least cost to 3e-5 m and rad: rounding in a field of 20 m.
    The covariance is an M-estimator's: from the curvature of the cost and the scatter of the
    points themselves: over random poses on the middle-size field, 128 points of 1 to 3 cm, sigmas are right to 5 %. It
    knows nothing of errors that points have in common, such as a wrong scale of the camera's.
    """

    Result: ClassVar[type[Any]] = FieldPoses

    map: DistanceMap
    steps: int = 40
    count: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.map, DistanceMap):
            raise TypeError(f"FieldPoseRefinement.map is {self.map!r}, expected a DistanceMap")
        if operator.index(self.steps) < 1:
            raise ValueError(f"FieldPoseRefinement.steps is {self.steps}, expected 1 or more")

    def __call__(self, *inputs: Any, device: Device | None = None, out: FieldPoses | None = None) -> FieldPoses:
        """Run once, as every `Operation`; with ``count=None`` for as many starts as there are."""
        if self.count is None and len(inputs) == 2 and getattr(inputs[1], "ndim", 0) == 2:
            return replace(self, count=len(inputs[1]))(*inputs, device=device, out=out)
        return super().__call__(*inputs, device=device, out=out)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype)
        points = _checked_points(build)
        if self.count is None:
            raise ValueError("FieldPoseRefinement.count is None; to bind it say how many starts there will be")
        cells, starts = self.map.cells.nearest, (self.count,)
        shapes = {"poses": (*starts, 3), "covariance": (*starts, 3, 3), "information": (*starts, 3, 3)}
        return build.launch(
            "field/field_refine.cl",
            "field_refine",
            work=WorkSize(starts, (1,)),
            more_inputs=[((self.count, 3), build.real)],
            outputs=build.outputs(shapes | dict.fromkeys(("score", "scale", "share", "status"), starts)),
            defines={"WEAKEST": f"{_WEAKEST}f"},
            arguments=[
                self.map.field.shapes.astype(np.float32).ravel(),
                cells,
                *map(np.int32, (points, *cells.shape[:2])),
                *map(np.float32, (*self.map.first, self.map.cell, self.map.scale**2, self.map.reach**2)),
                np.int32(self.steps),
            ],
            passes_once=self.count == 1,
        )


class Candidate(NamedTuple):
    """A pose that a robot may have.

    Attributes
    ----------
    pose
        (3,): x, y [m] and heading [rad].
    covariance, information
        (3, 3) of it; the covariance is NaN where the points do not fix the pose.
    score
        Mean cost of the points used, 0 to 1.
    scale
        Standard deviation of a point's distance to its line, m.
    share
        Of the points, those that lie on lines.
    twin
        Number of the candidate that the field's symmetry makes of this one: nothing seen tells them apart. None: not
        among the candidates.
    status
        OK; or AMBIGUOUS: the points fix a part of the pose only.
    """

    pose: npt.NDArray[np.float64]
    covariance: npt.NDArray[np.float64]
    information: npt.NDArray[np.float64]
    score: float
    scale: float
    share: float
    twin: int | None
    status: Status


def locate(
    field_map: DistanceMap,
    points: npt.NDArray[np.float32],
    *,
    near: npt.ArrayLike | None = None,
    headings: int | tuple[float, ...] = 72,
    most: int = 6,
    device: Device | None = None,
) -> tuple[Candidate, ...]:
    """Return the poses that fit the points, best first; none where no pose does.

    A robot that sees 6 m of a middle-size field is found with 70 % of its points in clutter (150 of 150, up to the
    field's symmetry). One that sees 3 m often is not: another place fits as well, and the candidates say so.

    Parameters
    ----------
    field_map
        The field.
    points
        float32 (points, 2), on lines, in the robot's frame [m].
    near
        A rough pose (3,), or several (poses, 3): refined, nothing else is searched. None: everywhere.
    headings
        How many are looked at, all around; or which [rad], where a compass says.
    most
        At most so many candidates.
    device
        Where; None: the best.

    Raises
    ------
    TypeError, ValueError
        The points or the rough poses are not what was expected.
    """
    if near is None:
        search = FieldPoseSearch(map=field_map, headings=headings)
        starts = search.best(search(points, device=device), most).poses
    else:
        starts = np.atleast_2d(np.asarray(near, np.float64))
        if starts.ndim != 2 or starts.shape[1] != 3:
            raise ValueError(f"near has shape {np.shape(near)}, expected (3,) or (poses, 3): x, y, heading")
    if not len(starts):
        return ()
    fits = FieldPoseRefinement(map=field_map)(points, starts.astype(np.float32), device=device)
    order = [each for each in np.argsort(fits.score) if np.isfinite(fits.score[each])]
    kept: list[int] = []
    for number in order:
        if not any(_same(fits.poses[number], fits.poses[other]) for other in kept):
            kept.append(int(number))
    poses = [fits.poses[number].astype(np.float64) for number in kept]
    return tuple(
        Candidate(
            pose=pose,
            covariance=fits.covariance[number].astype(np.float64),
            information=fits.information[number].astype(np.float64),
            score=float(fits.score[number]),
            scale=float(fits.scale[number]),
            share=float(fits.share[number]),
            twin=_twin_of(pose, poses) if field_map.field.is_symmetric else None,
            status=Status(int(fits.status[number])),
        )
        for number, pose in zip(kept, poses, strict=True)
    )


def twin_of(pose: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the pose half a turn about the field's middle away, (..., 3)."""
    x, y, heading = np.moveaxis(np.asarray(pose, np.float64), -1, 0)
    return np.stack([-x, -y, _wrapped(heading + math.pi)], axis=-1)


def _twin_of(pose: npt.NDArray[np.float64], poses: list[npt.NDArray[np.float64]]) -> int | None:
    other = twin_of(pose)
    return next((number for number, each in enumerate(poses) if _same(other, each)), None)


def _same(pose: npt.NDArray[Any], other: npt.NDArray[Any]) -> bool:
    """Whether two poses are one: 3 cm and 1 degree, more than where two starts of one valley end."""
    dx, dy, turn = np.asarray(pose, np.float64) - other
    return bool(math.hypot(dx, dy) < 0.03 and abs(_wrapped(turn)) < 0.02)


def _wrapped(angle: Any) -> Any:
    return angle - 2.0 * math.pi * np.rint(angle / (2.0 * math.pi))


def _checked_points(build: LaunchBuilder) -> int:
    """Check the points of a launch and return their number."""
    build.check_dtype("float32", of="points")
    is_valid = len(build.shape) == 2 and build.shape[1] == 2 and 1 <= build.shape[0] <= _MOST_POINTS
    build.check_shape(is_valid, f"points (1 to {_MOST_POINTS}, 2)")
    return build.shape[0]
