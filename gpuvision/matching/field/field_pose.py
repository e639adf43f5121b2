"""Global and local localization of a robot on a field from points on its lines.

`FieldPoseSearch` scores every pose of a grid; `FieldPoseRefinement` minimises the cost from the best ones and gives
their covariance; `find_pose_candidates` does both. Fields and their distance maps are in
`gpuvision.matching.field.distance_map`; `gpuvision.matching.field.odometry` combines the pose with odometry.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 6.4.
.. [2] M. Lauer, S. Lange and M. Riedmiller, "Calculating the perfect match: an efficient and accurate approach for
   robot self-localization", RoboCup 2005.
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import (
    Define,
    Device,
    FitStatusArray,
    FloatArray,
    IntArray,
    Launch,
    LaunchBuilder,
    Spec,
    Variant,
    WorkSize,
    capacity,
    ceil_div,
    flags,
    round_up,
    to_numpy,
)
from gpuvision.matching.field.distance_map import COST_LEVELS, DistanceMap
from gpuvision.operation import VisionOperation
from gpuvision.status import Status
from gpuvision.validation import finite

_BLOCK, _MOST_POINTS = 64, 4096
# The kernel reads cosine and sine of the headings from constant memory, of which OpenCL guarantees 64 KiB.
_MOST_HEADINGS = (64 << 10) // (2 * 4)
# Least size of the kernels' array of shifts, so that searches with fewer points share programs.
_MIN_SHIFTS = 1024
# Shares of the rows per core, so that the cores finish together, and number of rows above which shifting a point takes
# less time.
_SHARES_PER_CORE, _FEWEST_ROWS = 4, 4
# Additions of a search up to which one thread is faster than waking workers (measured: one core adds 50 levels in a
# nanosecond, and PoCL needs 30 to 50 us to wake its workers).
_INLINE = 1 << 22
# Ratio of eigenvalues of the information below which the points do not determine the pose (chosen).
_MIN_EIGENVALUE_RATIO = 1e-3
# Number of points with the mean variance that the covariance counts in addition (chosen: one more than unknowns).
_PRIOR_POINTS = 4.0
# Differences up to which two refined poses are the same [m], [rad] (chosen: refinements of one minimum end nearer).
_SAME_PLACE, _SAME_HEADING = 0.03, 0.02


class PoseCosts(NamedTuple):
    """Mean cost of the points, 0 (all on lines) to 1, by heading and position.

    Attributes
    ----------
    scores : float32, (headings, rows, columns), optional
        Mean cost of the points at every pose; None unless ``with_scores``.
    least : float32, (headings, rows, blocks)
        Least score of each block of 64 adjacent positions. NaN where no point is used.
    column : int32, (headings, rows, blocks)
        Column of the least score; the first one of equal scores.
    seen : int32, (headings,)
        Number of points used: finite points within the range of the map.
    """

    scores: FloatArray | None
    least: FloatArray
    column: IntArray
    seen: IntArray


def pose_grid_work(build: LaunchBuilder, headings: int, rows: int, columns: int) -> WorkSize:
    """Return the work size of a search over a grid of poses; a work-item of the vector variant takes ``each`` rows."""
    shares = ceil_div(_SHARES_PER_CORE * build.device.compute_units, headings)
    each = max(ceil_div(rows, shares), min(_FEWEST_ROWS, rows))
    if build.uses_vectors:
        return WorkSize((ceil_div(rows, each), headings), (1, 1), each, vectors=True)
    return WorkSize((round_up(columns, _BLOCK), rows, headings), (_BLOCK, 1, 1), each)


def pose_grid_defines(work: WorkSize, columns: int, points: int, *, with_scores: bool) -> dict[str, Define]:
    """Return the build options of a search over a grid of poses (``shift_sums.h``).

    A row is summed in equal strips of vectors of 32 positions, 8 at most: the sums of a strip stay in registers.
    """
    vectors = max(ceil_div(columns, 32), 2)
    strip = {"STRIP": ceil_div(vectors, ceil_div(vectors, 8))} if work.vectors else {}
    size = capacity(points, least=_MIN_SHIFTS)
    return {"CAPACITY": size, "COST_LEVELS": COST_LEVELS, **strip, **flags(WITH_SCORES=with_scores)}


def is_short_search(work: WorkSize, positions: int, points: int) -> bool:
    """Return whether waking worker threads takes longer than a search; ``positions`` counts all headings."""
    return work.vectors and positions * points <= _INLINE


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
    """Score of every pose of a grid: ``op(points) -> PoseCosts``.

    The points are float32 (points, 2), in the robot's frame [m], up to 4096.

    Parameters
    ----------
    map : DistanceMap
        Distance map of the field. The positions are its cells: row ``r`` and column ``c`` is at ``map.first_position +
        map.cell * (c, r)``.
    headings : int or tuple of float
        Number of headings, evenly from 0 all around, default 72; or the headings [rad].
    with_scores : bool
        Whether to return the score of every pose, besides the least of each block. Default False.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: "vector" computes 64 positions at once (CPU runtimes), "work_item" one position per work-item
        (GPUs).

    Raises
    ------
    TypeError, ValueError
        The map is not a `DistanceMap`, or there is no heading.

    Notes
    -----
    A point costs d^2 / (c^2 + d^2) with c the scale of the map, taken at the centre of the nearest cell, half a cell
    diagonal away at most. The slope of the cost is 0.65 / c at most, so that a score is wrong by 0.46 cell / c at most;
    the mean over many points is far better. Costs are rounded to 1/2046; the sum is exact.
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
        if len(self.angles) > _MOST_HEADINGS:
            raise ValueError(f"FieldPoseSearch.headings has {len(self.angles)}, expected {_MOST_HEADINGS} at most")

    @property
    def angles(self) -> npt.NDArray[np.float64]:
        """Headings [rad]."""
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
            "field_pose/field_pose.cl",
            "field_pose_search",
            work=work,
            outputs=pose_cost_outputs(build, len(angles), rows, columns, with_scores=self.with_scores),
            defines=pose_grid_defines(work, columns, count, with_scores=self.with_scores),
            arguments=[
                self.map.cells.level,
                np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32),
                *map(np.int32, (count, rows, columns, self.map.border, self.map.cells.level.shape[1])),
                np.float32(1.0 / self.map.cell),
                np.float32(self.map.max_range**2),
                np.int32(work.each),
            ],
            passes_once=is_short_search(work, len(angles) * rows * columns, count),
        )

    def best(
        self, costs: PoseCosts, max_candidates: int = 8, *, separation: tuple[float, float] | None = None
    ) -> RoughPoses:
        """Return the best poses of the grid, best first, with non-maximum suppression.

        Parameters
        ----------
        costs : PoseCosts
            Result of this operation, NumPy arrays.
        max_candidates : int
            Largest number of poses, default 8.
        separation : pair of floats, optional
            Distance [m] and angle [rad]: a pose within both of a better one is suppressed. None: twice the scale of the
            map, and 20 degrees.
        """
        far, turned = (2.0 * self.map.scale, math.radians(20.0)) if separation is None else separation
        least_of_block = to_numpy(costs.least)
        least = least_of_block.ravel().copy()
        least[~np.isfinite(least)] = np.inf
        heading, row, _ = np.unravel_index(np.arange(least.size), least_of_block.shape)
        x0, y0 = self.map.first_position
        x, y = x0 + self.map.cell * to_numpy(costs.column).ravel(), y0 + self.map.cell * row
        angles = self.angles[heading]
        chosen: list[int] = []
        while len(chosen) < max_candidates:
            number = int(np.argmin(least))
            if not np.isfinite(least[number]):
                break
            chosen.append(number)
            close = np.flatnonzero((x - x[number]) ** 2 + (y - y[number]) ** 2 < far**2)
            least[close[np.abs(_wrapped(angles[close] - angles[number])) < turned]] = np.inf
            least[number] = np.inf
        poses = np.stack([x[chosen], y[chosen], angles[chosen]], axis=-1)
        return RoughPoses(poses, least_of_block.ravel()[chosen])


class RoughPoses(NamedTuple):
    """Poses (poses, 3), x, y [m] and heading [rad], and their costs (poses,), 0 to 1."""

    poses: npt.NDArray[np.float64]
    scores: npt.NDArray[np.float32]


class FieldPoses(NamedTuple):
    """Poses of least cost, one for each start.

    Attributes
    ----------
    poses : float32, (starts, 3)
        x, y [m] and heading [rad], -pi to pi.
    covariance : float32, (starts, 3, 3)
        Covariance of the pose; NaN where the points do not determine it.
    information : float32, (starts, 3, 3)
        Inverse covariance, defined also where the points determine a part of the pose only.
    score : float32, (starts,)
        Mean cost of the points used, 0 to 1.
    residual_std : float32, (starts,)
        Standard deviation of an inlier's distance to its line [m].
    inlier_fraction : float32, (starts,)
        Share of the points within the scale of the map from a line.
    status : uint16, (starts,)
        `Status` flags. AMBIGUOUS (with a pose): the points determine only a part of the pose, for example points on a
        single line or circle; the rest of the pose stays near the start. NOT_CONVERGED (with a pose):
        ``max_iterations`` ended the refinement at a pose from which the next step to the least cost exceeds a tenth of
        its standard deviations, and 3e-5 m or rad. Otherwise all fields are NaN: LOW_SIGNAL (fewer than four points on
        lines), OUT_OF_RANGE (the pose left the map), NOT_FINITE (the start is not finite, or beyond 1e6 m).
    """

    poses: FloatArray
    covariance: FloatArray
    information: FloatArray
    score: FloatArray
    residual_std: FloatArray
    inlier_fraction: FloatArray
    status: FitStatusArray


@dataclass(frozen=True, kw_only=True)
class FieldPoseRefinement(VisionOperation[FieldPoses]):
    """Refinement of rough poses to the least cost: ``op(points, starts) -> FieldPoses``.

    Points are float32 (points, 2), in the robot's frame [m]; starts are float32 (starts, 3), x, y [m] and heading
    [rad].

    Parameters
    ----------
    map : DistanceMap
        Distance map of the field; its ``scale`` is c of the cost r^2 / (c^2 + r^2) (Geman-McClure loss).
    max_iterations : int
        Largest number of Levenberg-Marquardt steps, 1 or more, default 40. A pose that has not converged after them has
        the flag NOT_CONVERGED.
    count : int, optional
        Number of starts. None takes the number from a call; `bind` needs a number.

    Raises
    ------
    TypeError, ValueError
        A parameter is out of its range or of a wrong type.

    Notes
    -----
    Error: distances to lines are exact; the map only gives the lines to consider (four for each cell: where five lines
    meet in one cell, the wrong one may be taken). The pose minimises the cost to 3e-5 m and rad, the rounding in a
    field of 20 m. The covariance is the covariance of an M-estimator for residuals of unequal variance, from the
    curvature of the cost and the residuals of the points: over random poses on the middle-size field, with 128 points
    of 1 to 3 cm noise, equal or increasing with the distance, its standard deviations are right to 10 %. It does not
    contain errors that the points have in common, such as a wrong scale of the
    camera.
    """

    Result: ClassVar[type[Any]] = FieldPoses

    map: DistanceMap
    max_iterations: int = 40
    count: int | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.map, DistanceMap):
            raise TypeError(f"FieldPoseRefinement.map is {self.map!r}, expected a DistanceMap")
        if operator.index(self.max_iterations) < 1:
            raise ValueError(f"FieldPoseRefinement.max_iterations is {self.max_iterations}, expected 1 or more")

    def __call__(self, *inputs: Any, device: Device | None = None, out: FieldPoses | None = None) -> FieldPoses:
        """Run once, as every `Operation`; with ``count=None`` for any number of starts."""
        if self.count is None and len(inputs) == 2 and getattr(inputs[1], "ndim", 0) == 2:
            return replace(self, count=len(inputs[1]))(*inputs, device=device, out=out)
        return super().__call__(*inputs, device=device, out=out)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype)
        points = _checked_points(build)
        if self.count is None:
            raise ValueError(
                "FieldPoseRefinement takes points and start poses; to bind it, set its count to the number of poses"
            )
        cells, starts = self.map.cells.nearest, (self.count,)
        shapes = {"poses": (*starts, 3), "covariance": (*starts, 3, 3), "information": (*starts, 3, 3)}
        return build.launch(
            "field_pose/field_pose.cl",
            "field_pose_refinement",
            work=WorkSize(starts, (1,)),
            more_inputs=[((self.count, 3), build.real)],
            outputs=build.outputs(
                shapes | dict.fromkeys(("score", "residual_std", "inlier_fraction", "status"), starts), status=np.uint16
            ),
            defines={"MIN_EIGENVALUE_RATIO": f"{_MIN_EIGENVALUE_RATIO}f", "PRIOR_POINTS": f"{_PRIOR_POINTS}f"},
            arguments=[
                self.map.field.shapes.astype(np.float32).ravel(),
                cells,
                *map(np.int32, (points, *cells.shape[:2])),
                *map(np.float32, (*self.map.first, self.map.cell, self.map.scale**2, self.map.max_range**2)),
                np.int32(self.max_iterations),
            ],
            passes_once=self.count == 1,
        )


class PoseCandidate(NamedTuple):
    """A candidate for the pose of a robot.

    Attributes
    ----------
    pose : (3,)
        x, y [m] and heading [rad].
    covariance, information : (3, 3)
        Covariance and its inverse; the covariance is NaN where the points do not determine the pose.
    score : float
        Mean cost of the points used, 0 to 1.
    residual_std : float
        Standard deviation of an inlier's distance to its line [m].
    inlier_fraction : float
        Share of the points that lie on lines.
    symmetric_twin : int, optional
        Index of the candidate that the field's symmetry maps this one to: no measurement of lines can tell them apart.
        None: it is not among the candidates.
    status : Status
        OK; AMBIGUOUS: the points determine a part of the pose only; NOT_CONVERGED: see `FieldPoses`.
    """

    pose: npt.NDArray[np.float64]
    covariance: npt.NDArray[np.float64]
    information: npt.NDArray[np.float64]
    score: float
    residual_std: float
    inlier_fraction: float
    symmetric_twin: int | None
    status: Status


def find_pose_candidates(
    field_map: DistanceMap,
    points: npt.NDArray[np.float32],
    *,
    initial_pose: npt.ArrayLike | None = None,
    headings: int | tuple[float, ...] = 72,
    max_candidates: int = 6,
    device: Device | None = None,
) -> tuple[PoseCandidate, ...]:
    """Return the poses that fit the points, best first; an empty tuple where no pose does.

    A robot that sees 6 m of a middle-size field is found with 70 % of its points in clutter (150 of 150 trials, up to
    the field's symmetry). A robot that sees 3 m is often not found: another place fits equally well. In 4 of 22 such
    views the true pose was not among the candidates.

    Parameters
    ----------
    field_map
        Distance map of the field.
    points
        float32 (points, 2), points on lines in the robot's frame [m].
    initial_pose
        One rough pose (3,), or several (poses, 3), to refine without a search. None: search everywhere.
    headings
        Number of headings of the search, all around, default 72; or the headings [rad], for instance from a compass.
    max_candidates
        Largest number of candidates, default 6.
    device
        Where to run; None: `Device.best`.

    Raises
    ------
    TypeError, ValueError
        The points or the initial poses have a wrong type or shape.
    """
    if initial_pose is None:
        search = FieldPoseSearch(map=field_map, headings=headings)
        starts = search.best(search(points, device=device), max_candidates).poses
    else:
        starts = _checked_poses(initial_pose)
    if not len(starts):
        return ()
    fits = FieldPoseRefinement(map=field_map)(points, starts.astype(np.float32), device=device)
    return _candidates(fits, field_map.field.is_symmetric)


def _checked_poses(initial_pose: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return one rough pose or several as (poses, 3)."""
    poses = np.atleast_2d(np.asarray(initial_pose, np.float64))
    if poses.ndim != 2 or poses.shape[1] != 3:
        raise ValueError(f"initial_pose has shape {np.shape(initial_pose)}, expected (3,) or (poses, 3): x, y, heading")
    return poses


def _candidates(fits: FieldPoses, is_symmetric: bool) -> tuple[PoseCandidate, ...]:
    """Return the different refined poses, best first."""
    score, fitted = to_numpy(fits.score), to_numpy(fits.poses)
    kept: list[int] = []
    for number in np.argsort(score):
        if np.isfinite(score[number]) and not any(_same(fitted[number], fitted[other]) for other in kept):
            kept.append(int(number))
    poses = [fitted[number].astype(np.float64) for number in kept]
    covariance, information, status = to_numpy(fits.covariance), to_numpy(fits.information), to_numpy(fits.status)
    residual_std, inlier_fraction = to_numpy(fits.residual_std), to_numpy(fits.inlier_fraction)
    return tuple(
        PoseCandidate(
            pose=pose,
            covariance=covariance[number].astype(np.float64),
            information=information[number].astype(np.float64),
            score=float(score[number]),
            residual_std=float(residual_std[number]),
            inlier_fraction=float(inlier_fraction[number]),
            symmetric_twin=_index_of_twin(pose, poses) if is_symmetric else None,
            status=Status(int(status[number])),
        )
        for number, pose in zip(kept, poses, strict=True)
    )


def symmetric_twin(pose: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the pose (..., 3) half a turn about the centre of the field away."""
    x, y, heading = np.moveaxis(np.asarray(pose, np.float64), -1, 0)
    return np.stack([-x, -y, _wrapped(heading + math.pi)], axis=-1)


def _index_of_twin(pose: npt.NDArray[np.float64], poses: list[npt.NDArray[np.float64]]) -> int | None:
    other = symmetric_twin(pose)
    return next((number for number, each in enumerate(poses) if _same(other, each)), None)


def _same(pose: npt.NDArray[Any], other: npt.NDArray[Any]) -> bool:
    """Return whether two poses are the same up to `_SAME_PLACE` and `_SAME_HEADING`."""
    dx, dy, angle = np.asarray(pose, np.float64) - other
    return bool(math.hypot(dx, dy) < _SAME_PLACE and abs(_wrapped(angle)) < _SAME_HEADING)


def _wrapped(angle: Any) -> Any:
    return angle - 2.0 * math.pi * np.rint(angle / (2.0 * math.pi))


def _checked_points(build: LaunchBuilder) -> int:
    """Check the points of a launch and return their number."""
    build.check_dtype("float32", of="points")
    is_valid = len(build.shape) == 2 and build.shape[1] == 2 and 1 <= build.shape[0] <= _MOST_POINTS
    build.check_shape(is_valid, f"points (1 to {_MOST_POINTS}, 2)")
    return build.shape[0]
