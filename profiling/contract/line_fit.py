"""Contract of robust line fits: every loss, outliers, missing points and sigmas, lines far from the origin.

The reference is the fixed point of reweighted total least squares in extended precision, from the true line.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.matching.features.line_fit import FitLines
from gpuvision.profiling.contract.agreement import Case, Limit, equal
from gpuvision.status import Status

LIMITS = {
    "FitLines": (
        equal("status", "inliers", reason="counts and comparisons, except within rounding of the tuning constant"),
        Limit(
            ("centre",), 3e-7, 6e-16, "extent of the points x (1 + shift by the weights) + coordinate [unit of points]",
            "error model of the docstring: rounding relative to one of the points, and of the coordinates; an error of "
            "the distances changes the weights, which moves the centre along the line",
        ),
        Limit(
            ("normal",), 3e-7, 6e-16, "1 + extent over the spread along the line",
            "an error of the extent, seen from the spread of the points along the line",
        ),
    )
}  # fmt: skip
_LINES, _POINTS, _SIGMA, _HALF = 203, 20, 0.05, 30.0  # sigma and half of the length in pixels
_STEPS = 300
Floats = npt.NDArray[np.floating[Any]]


def cases() -> Iterator[Case]:
    """Yield every loss with outliers, missing points, double precision, and coordinates up to 1e5."""
    for loss in ("tukey", "huber", "least_squares"):
        outliers = {"tukey": 0.3, "huber": 0.1, "least_squares": 0.0}[loss]
        yield _case(f"{loss}, float32", loss, outliers, 1000.0, "float32")
    yield _case("tukey, float64", "tukey", 0.3, 1000.0, "float64")
    yield _case("missing points, float32", "tukey", 0.0, 1000.0, "float32", missing=0.3)
    yield _case("coordinates up to 1e5, float32", "tukey", 0.3, 1e5, "float32")


def _case(name: str, loss: Any, outliers: float, size: float, dtype: str, missing: float = 0.0) -> Case:
    rng = np.random.default_rng(31)
    angle, middle = rng.uniform(-np.pi / 2, np.pi / 2, _LINES), rng.uniform(0.0, size, (_LINES, 2))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    normal = along[:, ::-1] * (-1.0, 1.0)
    u, v = rng.uniform(-_HALF, _HALF, (_LINES, _POINTS)), rng.normal(0.0, _SIGMA, (_LINES, _POINTS))
    bad = round(outliers * _POINTS)
    v[:, :bad] += rng.uniform(1.0, 20.0, (_LINES, bad))
    points = middle[:, None] + u[..., None] * along[:, None] + v[..., None] * normal[:, None]
    points[rng.random((_LINES, _POINTS)) < missing] = np.nan
    given = points.astype(dtype)
    operation = FitLines(loss=loss, scale=_SIGMA, max_iterations=60)
    known = np.isfinite(given).all(axis=-1)
    fitted, centre, weights, change, margin = _fixed_point(given.astype(np.longdouble), known, middle, along, operation)
    inliers = np.sum(weights > 0.0, axis=-1)
    status = np.where(2 * inliers < known.sum(axis=-1), int(Status.AMBIGUOUS), 0)
    at = np.sum((given - centre[:, None]) * fitted[:, None], axis=-1)
    spread = np.sqrt(np.sum(np.where(known, weights * at**2, 0.0), axis=-1) / weights.sum(axis=-1))
    shift = np.sum(np.where(known, change * np.abs(at), 0.0), axis=-1) / weights.sum(axis=-1)
    upright = fitted * np.sign(fitted[:, :1])
    exact = {"normal": upright[:, ::-1] * (-1.0, 1.0), "centre": centre, "inliers": inliers, "status": status}
    turned = np.repeat((1.0 + 2.0 * _HALF / spread)[:, None], 2, axis=1)
    # Rounding decides at the tuning constant, and for the sign of an upright line.
    undecided = (margin < 1e-2) | (np.abs(fitted[:, 0]) < 1e-5)
    quantities = {"normal": turned, "centre": 2.0 * _HALF * (1.0 + shift[:, None]) + np.abs(centre)}
    return Case("FitLines", name, operation, (given,), exact, quantities, undecided)


def _fixed_point(
    points: Floats, known: npt.NDArray[np.bool_], middle: Floats, along: Floats, operation: FitLines
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return directions, centres, weights, their change by a distance, and the margin of the weights.

    The margin is the least distance of a residual from the tuning constant, in standard deviations.
    """
    points = np.where(known[..., None], points, 0.0)
    centre, direction = middle, along
    for _ in range(_STEPS):
        away = points - centre[:, None]
        z = (direction[:, :1] * away[..., 1] - direction[:, 1:] * away[..., 0]) / _SIGMA
        weights = np.where(known, _weight(z, operation), 0.0)
        centre = np.sum(weights[..., None] * points, axis=1) / weights.sum(axis=1)[:, None]
        x, y = np.moveaxis(points - centre[:, None], -1, 0)
        xx, xy, yy = (np.sum(weights * each, axis=1) for each in (x * x, x * y, y * y))
        angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    edge = np.abs(np.abs(z) - (operation.tuning_constant if operation.loss != "least_squares" else np.inf))
    change = np.abs(_weight(z + 1e-3, operation) - _weight(z - 1e-3, operation)) / (2e-3 * _SIGMA)
    return direction, centre, weights, change, np.where(known, edge, np.inf).min(axis=1)


def _weight(z: Floats, operation: FitLines) -> Floats:
    constant: Any = operation.tuning_constant
    if operation.loss == "tukey":
        return np.asarray(np.clip(1.0 - (z / constant) ** 2, 0.0, None) ** 2)
    if operation.loss == "huber":
        return np.asarray(np.minimum(1.0, constant / np.maximum(np.abs(z), 1e-300)))
    return np.ones_like(z)
