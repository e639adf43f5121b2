"""Contract of poses from features: every transform, outliers, missing rows, and displacements of a board's size.

The reference is the fixed point of reweighted least squares in extended precision, from the true pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.matching.pose.pose import SolvePose, line_rows
from gpuvision.profiling.contract.agreement import Case, Limit, equal
from gpuvision.reference.robust import residuals, transform_of

LIMITS = {
    "SolvePose": (
        equal("status", "inliers", "rank", reason="counts and comparisons, except within rounding of a threshold"),
        Limit(
            ("placement",), 3e-7, 6e-16, "(extent of the rows + 3 displacements) x condition [m]",
            "error model of the docstring: 3e-7 of the extent and a millionth of the displacement; both grow with the "
            "condition",
        ),
    )
}  # fmt: skip
_BOARDS, _EDGES, _SIGMA, _EXTENT = 37, 33, 2e-6, 0.03  # lengths in metres
_MIDDLE, _PLACEMENT = (0.05, 0.08), (0.06, 0.07)
_FREEDOMS = {"rigid": 3, "similarity": 4, "affine": 6}
_STEPS = 60
Floats = npt.NDArray[np.float64]


def cases() -> Iterator[Case]:
    """Yield every loss and transform, missing rows, and displacements as large as the board."""
    yield _case("tukey, rigid", loss="tukey", outliers=0.2)
    yield _case("huber, similarity", loss="huber", transform="similarity", outliers=0.05)
    yield _case("least squares, affine", loss="least_squares", transform="affine")
    yield _case("missing rows", loss="tukey", missing=0.3)
    yield _case("displacements of the board's size", loss="least_squares", shift=0.03, turn=0.5)


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
        _fixed_point(each[np.isfinite(each[:, 4])], start, operation)
        for each, start in zip(given.astype(np.float64), true, strict=True)
    ]
    places, inliers, conditions, margins = (np.array(each) for each in zip(*fits, strict=True))
    exact: dict[str, npt.NDArray[Any]] = {
        "placement": places,
        "inliers": inliers,
        "rank": np.full(_BOARDS, freedoms),
        "status": np.zeros(_BOARDS, np.uint8),
    }
    size = _EXTENT + 3.0 * np.linalg.norm(places - _PLACEMENT, axis=-1, keepdims=True) + np.abs(places)
    return Case(
        "SolvePose", name, operation, (given,), exact, {"placement": size * conditions[:, None]}, margins < 1e-2
    )


def _rows(rng: np.random.Generator, parameters: Floats, bad: int) -> Floats:
    """Return edges in all directions, measured at a pose; the first ones are gross errors."""
    angle = rng.uniform(0.0, np.pi, _EDGES)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    point = _MIDDLE + _EXTENT * rng.uniform(-0.5, 0.5, (_EDGES, 2))
    error = rng.normal(0.0, _SIGMA, (_EDGES, 1))
    error[:bad] += rng.uniform(1e-4, 4e-4, (bad, 1))
    matrix, shift = transform_of(parameters)
    return np.asarray(line_rows(normal, point, (point + error * normal) @ matrix.T + shift, _SIGMA))


def _fixed_point(rows: Floats, start: Floats, operation: SolvePose) -> tuple[Floats, int, float, float]:
    """Return the placement, the number of inliers, the condition, and the least distance from the tuning constant."""
    pose = start.copy()
    size = np.array([1.0, 1.0, *(1.0 / _EXTENT,) * (len(pose) - 2)])
    for _ in range(_STEPS):
        z = residuals(pose, rows) / rows[:, 6]
        moves = np.eye(len(pose)) * 1e-30j
        design = np.stack([residuals(pose + each, rows).imag / 1e-30 for each in moves], axis=-1) * size
        root = np.sqrt(_weight(z, operation))[:, None] / rows[:, 6:]
        pose = pose - size * np.linalg.lstsq(root * design, root[:, 0] * z * rows[:, 6], rcond=None)[0]
    # The condition of motions about the middle of the rows: turns and deformations do not move it.
    middle = rows[:, 2:4].mean(axis=0)
    moved = np.stack([transform_of(pose + each)[0].imag @ middle / 1e-30 for each in moves], axis=-1) * size
    singular = np.linalg.svd(root * (design - design[:, :2] @ moved), compute_uv=False)
    matrix, shift = transform_of(pose)
    constant = np.inf if operation.loss == "least_squares" else operation.tuning_constant
    margin = float(np.abs(np.abs(z) - constant).min())
    return matrix @ _PLACEMENT + shift, int(np.sum(root > 0.0)), float(singular[0] / singular[-1]), margin


def _weight(z: Floats, operation: SolvePose) -> Floats:
    constant: Any = operation.tuning_constant
    if operation.loss == "tukey":
        return np.asarray(np.clip(1.0 - (z / constant) ** 2, 0.0, None) ** 2)
    if operation.loss == "huber":
        return np.asarray(np.minimum(1.0, constant / np.maximum(np.abs(z), 1e-300)))
    return np.ones_like(z)
