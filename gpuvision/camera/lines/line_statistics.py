"""What a fit to straight lines is worth: degrees of freedom, covariance, nested models, weights against outliers."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.special

from gpuvision.camera.lines.line_families import Float64, PackedLines
from gpuvision.camera.lines.straightness import Parameters, bound_lines, inner, projected_columns
from gpuvision.camera.lines.variable_projection import Minimum, linear_start, minimise

Loss = Literal["squared", "huber", "tukey"]

_TUNING = {"huber": 1.345, "tukey": 4.685}
_ROUNDS = 20
_SINGULAR = 1e-13
_SETTLED = 1e-3
_NORMAL_MAD = 1.4826
_LEAST_ROOT = 1e-4
# Residuals below this part of the image are rounding; to test them against each other would be noise.
_ROUNDING = 64.0 * float(np.finfo(np.float64).eps)


def same_points(packed: PackedLines) -> npt.NDArray[np.intp]:
    """Return the number (n,) of each measured point: a point of a grid lies on several lines."""
    key = packed.x + packed.y * 0.7548776662466927
    order = np.argsort(key)
    number = np.empty(len(key), dtype=np.intp)
    number[order] = np.cumsum(np.diff(key[order], prepend=np.nan) != 0.0) - 1
    return number


def line_parameters(packed: PackedLines, at: Parameters) -> int:
    """How many numbers say where the lines and their vanishing points are."""
    bound = bound_lines(packed, at)
    return 2 * len(bound) - int(np.count_nonzero(bound)) + 2 * len(set(packed.family[bound].tolist()))


def noise_dimensions(owner: npt.NDArray[np.intp]) -> int:
    """Independent errors among the residuals: a measured point has two, on however many lines it lies."""
    return int(np.sum(np.minimum(np.bincount(owner), 2)))


def chance(
    worse: float, better: float, more: int, residuals: tuple[int, int], freedom: int, variance: float | None
) -> float:
    """Probability that ``more`` parameters lower the sum of squares this far although they are not needed.

    Parameters
    ----------
    worse, better
        Sums of squares of the smaller and of the larger model.
    more
        Parameters that the larger one has in addition.
    residuals
        How many there are, and how many of them are independent.
    freedom
        Residuals less parameters of the larger model.
    variance
        Of a residual, if it is known.
    """
    if more == 0:
        return 1.0
    repeated = residuals[0] / residuals[1]
    gain = max(worse - better, 0.0) / (more * repeated)
    if variance is not None:
        return float(scipy.special.chdtrc(more, more * gain / max(variance, _ROUNDING**2)))
    if freedom <= 0:
        return 1.0
    return float(scipy.special.fdtrc(more, freedom / repeated, gain / max(better / freedom, _ROUNDING**2)))


def covariance(
    packed: PackedLines, found: Minimum, owner: npt.NDArray[np.intp], variance: float, *, keep_centre: bool
) -> Float64:
    """Covariance of (k..., centre, two tangents per vanishing point) in packed coordinates.

    A point's error is one vector of two equal, independent components; what it does to each of the lines that the
    point lies on is counted together. Parameters that the data do not fix have infinite variance.
    """
    columns = projected_columns(packed, found.at, found.here, found.slopes, found.normal.taken)
    points = found.here.points
    outward = 2.0 * points.slope * found.here.along
    normals = np.stack(
        [points.growth * found.here.nx + outward * points.dx, points.growth * found.here.ny + outward * points.dy]
    )
    normals *= found.here.inverse
    return (
        _sandwich(
            inner(columns, columns),
            [_per_point(columns * normal, owner) for normal in normals],
            len(found.at.k),
            keep_centre,
        )
        * variance
    )


def robust_covariance(
    packed: PackedLines,
    found: Minimum,
    owner: npt.NDArray[np.intp],
    weight: Float64,
    loss: Loss,
    scale: float,
    *,
    keep_centre: bool,
) -> Float64:
    """Covariance of an M-estimate, in the order of `covariance`, from the spread of its own equations."""
    columns = projected_columns(packed, found.at, found.here, found.slopes, found.normal.taken)
    bread = columns / np.sqrt(weight)
    slope = influence_slope(found.here.distance / scale, loss)
    spread = _per_point(columns * found.here.residual, owner)
    enlarged = len(weight) / max(len(weight) - line_parameters(packed, found.at) - len(columns), 1)
    return enlarged * _sandwich(inner(bread * slope, bread), [spread], len(found.at.k), keep_centre)


def _per_point(values: Float64, owner: npt.NDArray[np.intp]) -> Float64:
    """Sum of values (rows, n) over the occurrences of each measured point."""
    return np.stack([np.bincount(owner, each) for each in values]) if len(values) else np.empty((0, 1))


def _sandwich(bread: Float64, spreads: list[Float64], order: int, keep_centre: bool) -> Float64:
    """Return bread^-1 (sum of spread spread') bread^-1; infinite for what the data do not fix, 0 for what is known."""
    meat = sum((inner(each, each) for each in spreads), np.zeros_like(bread))
    kept = np.flatnonzero(bread.diagonal() > 0.0)
    if keep_centre:
        kept = kept[(kept < order) | (kept >= order + 2)]
    fixed = np.ix_(kept, kept)
    scale = 1.0 / np.sqrt(bread.diagonal()[kept])
    values, vectors = np.linalg.eigh(bread[fixed] * np.outer(scale, scale))
    seen = values > _SINGULAR
    turned = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T * np.outer(scale, scale)
    found = np.diag(np.full(len(bread), np.inf))
    if keep_centre and order:
        found[[order, order + 1], [order, order + 1]] = 0.0
    found[fixed] = turned @ meat[fixed] @ turned
    lost = kept[np.any(np.abs(vectors[:, ~seen]) > math.sqrt(_SINGULAR), axis=1)]
    found[lost, lost] = np.inf
    return found


def influence_slope(ratio: Float64, loss: Loss) -> Float64:
    """Return the derivative of weight(x) x at residuals in scales."""
    limit = _TUNING[loss]
    inside = np.abs(ratio) < limit
    if loss == "huber":
        return inside.astype(np.float64)
    square = (ratio / limit) ** 2
    return np.where(inside, (1.0 - square) * (1.0 - 5.0 * square), 0.0)


def weights(residual: Float64, scale: float, loss: Loss) -> Float64:
    """Weights of the squares of residuals."""
    limit = _TUNING[loss] * scale
    if loss == "huber":
        return np.asarray(limit / np.maximum(np.abs(residual), limit))
    # Not quite 0: a line of outliers alone is still a line.
    return np.maximum(1.0 - (residual / limit) ** 2, _LEAST_ROOT) ** 2


def robust_start(packed: PackedLines, centre: Float64 | None) -> tuple[Parameters, Float64]:
    """Return `linear_start` where outliers weigh little, and the weights (n,)."""
    weight = np.ones(len(packed.x))
    for _ in range(_ROUNDS):
        start = linear_start(packed, centre, weight)
        distance = start.distances(packed, weight)
        weight = weights(distance, max(_NORMAL_MAD * float(np.median(np.abs(distance))), _ROUNDING), "huber")
    return start.at, weight


def reweighted(
    packed: PackedLines, found: Minimum, loss: Loss, sigma: float | None, *, keep_centre: bool
) -> tuple[Minimum, Float64, float]:
    """Lower the weight of outliers until it settles; return the fit, the weights (n,) and the scale of the errors.

    Tukey's weights, which have several minima, start from Huber's.
    """
    weight, scale = np.ones(len(packed.x)), 0.0
    left = np.sqrt(len(packed.x) / max(len(packed.x) - line_parameters(packed, found.at), 1))
    stages: tuple[Loss, ...] = ("huber", "tukey") if loss == "tukey" else ("huber",)
    for stage in stages:
        for _ in range(_ROUNDS):
            distance, before = found.here.distance, weight
            scale = sigma if sigma is not None else float(_NORMAL_MAD * left * np.median(np.abs(distance)))
            scale = max(scale, _ROUNDING)
            weight = weights(distance, scale, stage)
            found = minimise(packed, found.at, weight=weight, keep_centre=keep_centre)
            if np.max(np.abs(weight - before)) <= _SETTLED:
                break
    return found, weight, scale
