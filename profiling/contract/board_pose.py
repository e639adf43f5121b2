"""Contract of poses: from features with every transform, outliers and missing rows, and from a frame of a board.

The reference is the fixed point of reweighted least squares in float64, from the true pose. For a frame the
reference finds the edges along the rulers in float64, and repeats total least squares until the lines stay the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.board_pose import BoardPoseEstimator
from gpuvision.matching.pose.pose import SolvePose, line_rows
from gpuvision.matching.robust import efficiency
from gpuvision.profiling import board_pose as benchmark
from gpuvision.profiling.contract.agreement import Case, Limit, equal, roundings
from gpuvision.profiling.contract.ruler import strongest_edge
from gpuvision.profiling.pose import PLACEMENT
from gpuvision.reference.robust import residuals, transform_of

LIMITS = {
    "SolvePose": (
        equal("status", "inliers", "rank", reason="counts and comparisons, except within rounding of a threshold"),
        roundings(
            8, "placement", of="sum over the rows of displacement and residual x influence on the placement, and an "
            "eighth of the placement [m]",
            reason="16 roundings of a residual, of displacements in it; rounding of the placement point",
        ),
    ),
    "BoardPoseEstimator": (
        equal(
            "status", "edge_status", "inliers",
            reason="counts and comparisons, except within rounding of a threshold",
        ),
        Limit(("edges",), 1e-4, 1e-4, "1 px for contrasts above 10 times the threshold", "error of RulerEdges"),
        Limit(
            ("placement",), 1e-4, 1e-4, "size of a pixel x sum over the lines of their influence on the placement [m]",
            "error of RulerEdges on each edge, in the worst combination of signs; the rounding of the lines and of the "
            "pose is a thousandth of it",
        ),
    ),
}  # fmt: skip
_BOARDS, _EDGES, _SIGMA, _EXTENT = 37, 33, 2e-6, 0.03  # lengths in metres
_MIDDLE, _PLACEMENT = (0.05, 0.08), (0.06, 0.07)
_FREEDOMS = {"rigid": 3, "similarity": 4, "affine": 6}
_STEPS, _MANY_STEPS = 60, 400  # Huber's loss converges slowly with gross errors, as in the frame
Floats = npt.NDArray[np.float64]


def cases() -> Iterator[Case]:
    """Yield every loss and transform, missing rows, and displacements as large as the board."""
    yield _case("tukey, rigid", loss="tukey", outliers=0.2)
    yield _case("huber, similarity", loss="huber", transform="similarity", outliers=0.05)
    yield _case("least squares, affine", loss="least_squares", transform="affine")
    yield _case("missing rows", loss="tukey", missing=0.3)
    yield _case("displacements of the board's size", loss="least_squares", shift=0.03, turn=0.5)
    for loss in ("tukey", "huber"):
        yield _frame_case(f"frame, {loss}", SolvePose(placement=PLACEMENT, loss=loss, max_iterations=200))


def _case(
    name: str, *, outliers: float = 0.0, missing: float = 0.0, shift: float = 1e-3, turn: float = 0.03, **settings: Any
) -> Case:
    rng = np.random.default_rng(34)
    operation = SolvePose(placement=_PLACEMENT, max_iterations=40, **settings)
    freedoms = _FREEDOMS[operation.transform]
    true = np.zeros((_BOARDS, freedoms))
    true[:, :2], true[:, 2] = rng.uniform(-shift, shift, (_BOARDS, 2)), rng.uniform(-turn, turn, _BOARDS)
    true[:, 3:] = rng.uniform(-1e-3, 1e-3, true[:, 3:].shape)
    rows = np.stack([_rows(rng, each, round(outliers * _EDGES)) for each in true])
    rows[rng.random((_BOARDS, _EDGES)) < missing, 4] = np.nan
    given = rows.astype(np.float32)
    fits = [
        fixed_point(each[np.isfinite(each[:, 4])], start, operation)
        for each, start in zip(given.astype(np.float64), true, strict=True)
    ]
    places, margins = np.array([each.placed[:2] for each in fits]), np.array([each.margin for each in fits])
    exact: dict[str, npt.NDArray[Any]] = {
        "placement": places,
        "inliers": np.array([each.inliers for each in fits]),
        "rank": np.full(_BOARDS, freedoms),
        "status": np.zeros(_BOARDS, np.uint8),
    }
    size = np.array([each.influence[:2] @ each.displacements for each in fits]) + 0.125 * np.abs(places)
    return Case("SolvePose", name, operation, (given,), exact, {"placement": size}, margins < 1e-2)


def _rows(rng: np.random.Generator, parameters: Floats, bad: int) -> Floats:
    """Return edges in all directions, measured at a pose; the first ones are gross errors."""
    angle = rng.uniform(0.0, np.pi, _EDGES)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    point = _MIDDLE + _EXTENT * rng.uniform(-0.5, 0.5, (_EDGES, 2))
    error = rng.normal(0.0, _SIGMA, (_EDGES, 1))
    error[:bad] += rng.uniform(1e-4, 4e-4, (bad, 1))
    matrix, shift = transform_of(parameters)
    return np.asarray(line_rows(normal, point, (point + error * normal) @ matrix.T + shift, _SIGMA))


class FixedPoint(NamedTuple):
    """Solution of reweighted least squares.

    Attributes
    ----------
    placed : (parameters,)
        x and y of the placement point and the further parameters of the pose.
    inliers : int
        Number of rows with a weight above 0.
    influence : (parameters, rows)
        Absolute derivative of `placed` by the residual of each row.
    displacements : (rows,)
        Sum of the absolute terms of a residual: displacement of the row, of its place by the pose, and the residual.
    margin : float
        Least distance of a residual from the tuning constant, in sigmas.
    """

    placed: Floats
    inliers: int
    influence: Floats
    displacements: Floats
    margin: float


def fixed_point(
    rows: Floats, start: Floats, operation: SolvePose, extent: float = _EXTENT, steps: int = _STEPS
) -> FixedPoint:
    """Return the solution from a pose near it. `extent` is that of the rows [m]."""
    pose = start.copy()
    size = np.array([1.0, 1.0, *(1.0 / extent,) * (len(pose) - 2)])
    for _ in range(steps):
        z = residuals(pose, rows) / rows[:, 6]
        moves = np.eye(len(pose)) * 1e-30j
        design = np.stack([residuals(pose + each, rows).imag / 1e-30 for each in moves], axis=-1) * size
        root = np.sqrt(_weight(z, operation))[:, None] / rows[:, 6:]
        pose = pose - size * np.linalg.lstsq(root * design, root[:, 0] * z * rows[:, 6], rcond=None)[0]
    matrix, shift = transform_of(pose)
    constant = np.inf if operation.loss == "least_squares" else operation.tuning_constant
    margin = float(np.abs(np.abs(z) - constant).min())
    placed = np.concatenate([matrix @ operation.placement + shift, pose[2:]])
    # The derivative of the sum of psi(z) by the pose has the slopes of psi in the place of the weights. An error of a
    # residual changes psi by the slope; a relative rounding of the sum changes it by the weight.
    slope = _slope(z, operation) / rows[:, 6] ** 2
    ends = [transform_of(pose + each) for each in moves]
    lever = np.eye(len(pose))
    lever[:2] = np.stack([(turn @ operation.placement + move).imag / 1e-30 for turn, move in ends], axis=-1)
    solved = np.linalg.solve(design.T @ (slope[:, None] * design), design.T)
    influence = np.abs(lever @ (size[:, None] * solved)) * np.maximum(np.abs(slope), root[:, 0] ** 2)
    middle = rows[:, 2:4].mean(axis=0)
    by_pose = np.abs(matrix @ middle + shift - middle) + np.abs(rows[:, 2:4] - middle) @ np.abs(matrix - np.eye(2)).T
    displacements = np.linalg.norm(np.abs(rows[:, 4:6]) + by_pose, axis=-1) + np.abs(z * rows[:, 6])
    return FixedPoint(placed, int(np.sum(root > 0.0)), influence, displacements, margin)


def _slope(z: Floats, operation: SolvePose) -> Floats:
    """Return the derivative of psi(z), the residual times its weight."""
    high, low = ((z + each) * _weight(z + each, operation) for each in (1e-4, -1e-4))
    return np.asarray((high - low) / 2e-4)


def _weight(z: Floats, operation: SolvePose) -> Floats:
    constant: Any = operation.tuning_constant
    if operation.loss == "tukey":
        return np.asarray(np.clip(1.0 - (z / constant) ** 2, 0.0, None) ** 2)
    if operation.loss == "huber":
        return np.asarray(np.minimum(1.0, constant / np.maximum(np.abs(z), 1e-300)))
    return np.ones_like(z)


def _frame_case(name: str, solver: SolvePose) -> Case:
    """Return the frame of the benchmark: a line is displaced, and a ruler of each line crosses a brighter spot."""
    image, rulers, lines = benchmark.scene()
    ruler = RulerEdges(threshold=20.0, length=64, width=5, smoothing_px=1.0, noise=2.0)
    operation = BoardPoseEstimator(ruler=ruler, lines=len(lines), rulers_per_line=rulers.shape[1], solver=solver)
    shape = rulers.shape[:2]
    found: Any = [strongest_edge(image, each[:4], ruler) for each in rulers.reshape(-1, rulers.shape[-1])]
    position = np.reshape([each["position"] for each in found], shape)
    of_lines = [
        _rows_of_line(line, *_places(edges, ruler, each, image.dtype), solver)
        for line, each, edges in zip(lines.astype(np.float64), rulers, np.reshape(found, shape), strict=True)
    ]
    rows, amplified = (np.concatenate(each) for each in zip(*of_lines, strict=True))
    extent = float(np.max(np.ptp(rows[:, 2:4], axis=0)))
    fit = fixed_point(rows, benchmark.TRUE_POSE, solver, extent, _MANY_STEPS)
    exact: dict[str, npt.NDArray[Any]] = {
        "placement": fit.placed[:2],
        "inliers": np.array(fit.inliers),
        "status": np.array(0),
        "edges": position,
        "edge_status": np.zeros(shape, np.uint8),
    }
    quantities = {"placement": benchmark.PIXEL * fit.influence[:2] @ amplified, "edges": 1.0}
    return Case("BoardPoseEstimator", name, operation, (image, rulers, lines), exact, quantities)


def edge_sigmas(edges: Any, ruler: RulerEdges, dtype: npt.DTypeLike) -> Floats:
    """Return the predicted standard deviations of edges [px]: the noise over the gradients beside the peak."""
    noise = float(ruler._packed(np.dtype(dtype))[2]) / ruler.width
    return np.array([noise * e["variance"] * np.exp(0.5 / e["variance"]) / abs(e["gradient"]) for e in edges])


def _places(edges: Any, ruler: RulerEdges, rows: Floats, dtype: npt.DTypeLike) -> tuple[Floats, Floats]:
    """Return the places (n, 2) of edges in the frame of their line [m], and one over their sigmas across it."""
    position = np.array([each["position"] for each in edges])
    *_, u, v, du, dv, projective = rows.astype(np.float64).T
    per = 1.0 / (1.0 + position * projective)
    at = np.stack([(u + position * du) * per, (v + position * dv) * per], axis=-1)
    return at, 1.0 / (np.abs(dv - at[:, 1] * projective) * per * edge_sigmas(edges, ruler, dtype))


def _rows_of_line(line: Floats, points: Floats, certainty: Floats, solver: SolvePose) -> tuple[Floats, Floats]:
    """Return the two rows of a line through points, where its offset and its angle are independent.

    Their displacements change by up to the second result (2,) times the largest error of the points across the line.
    """
    middle, along = np.median(points, axis=0), np.array([1.0, 0.0])
    for _ in range(_MANY_STEPS):
        away = points - middle
        z = (along[0] * away[:, 1] - along[1] * away[:, 0]) * certainty
        weight = certainty**2 * _weight(z, solver)
        middle = weight @ points / weight.sum()
        x, y = (points - middle).T
        angle = 0.5 * np.arctan2(2.0 * np.sum(weight * x * y), np.sum(weight * (x * x - y * y)))
        along = np.array([np.cos(angle), np.sin(angle)])
    constant: Any = solver.tuning_constant
    counted = np.where(weight > 0.0, certainty**2, 0.0) * efficiency(solver.loss, constant)
    spread = (points - middle) @ along
    offset, turn = 1.0 / counted.sum(), 1.0 / np.sum(counted * spread**2)
    normal, point = line[None, :2], line[2:4]
    ends = middle + np.sqrt(offset / turn) * along * np.array([[-1.0], [1.0]])
    way = np.array([line[1], -line[0]])
    on = point + ends[:, :1] * way
    sigma = np.sqrt(2.0 * offset + line[4] ** 2)
    rows = np.asarray(line_rows(np.repeat(normal, 2, axis=0), on, on + ends[:, 1:] * normal, sigma))
    # Offset and angle of the line change by the slopes of psi, as in `fixed_point`; here by the points across the line.
    slope = certainty**2 * _slope(z, solver)
    design = np.column_stack([np.ones_like(spread), spread])
    by_point = np.linalg.solve(design.T @ (slope[:, None] * design), design.T * slope)
    at = np.sqrt(offset / turn) * np.array([[-1.0], [1.0]])
    return rows, np.abs(by_point[0] + at * by_point[1]).sum(axis=1)
