"""Statistics of a fit to straight lines: degrees of freedom, covariance, nested models, robust weights."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.special

from gpuvision.camera.lines.line_families import Float64, PackedLines
from gpuvision.camera.lines.normal_equations import projected_columns
from gpuvision.camera.lines.straightness import Parameters, constrained_lines, inner_products
from gpuvision.camera.lines.variable_projection import Minimum, linear_start, minimise
from gpuvision.normal_distribution import MAD_TO_SIGMA

Loss = Literal["squared", "huber", "tukey"]

# Tuning constants of Huber's and Tukey's loss [standard deviations]: 95 % efficiency for normal errors (P. Huber,
# Robust Statistics, 1981).
_TUNING_CONSTANTS = {"huber": 1.345, "tukey": 4.685}
# Reweighting: largest number of rounds, and largest change of a weight that ends them.
_MAX_ROUNDS = 20
_SETTLED = 1e-3
# Relative eigenvalue below which the data do not determine a parameter. Derived: above double rounding.
_SINGULAR = 1e-13
# Standard deviation of a normal distribution over its median absolute deviation.
# Square root of Tukey's least weight.
_LEAST_ROOT = 1e-4
# Residuals [half-diagonals] at rounding level, which no test may compare. Derived from double precision.
_ROUNDING = 64.0 * float(np.finfo(np.float64).eps)


def point_identifiers(packed: PackedLines) -> npt.NDArray[np.intp]:
    """Return an identifier (n,) of each measured point; a grid point on several lines has one identifier."""
    # The second coordinate gets an irrational factor, so that different points have different keys.
    key = packed.x + packed.y * 0.7548776662466927
    order = np.argsort(key)
    number = np.empty(len(key), dtype=np.intp)
    number[order] = np.cumsum(np.diff(key[order], prepend=np.nan) != 0.0) - 1
    return number


def count_line_parameters(packed: PackedLines, parameters: Parameters) -> int:
    """Return the number of parameters of the lines and their vanishing points."""
    bound = constrained_lines(packed, parameters)
    return 2 * len(bound) - int(np.count_nonzero(bound)) + 2 * len(set(packed.family[bound].tolist()))


def count_independent_errors(owner: npt.NDArray[np.intp]) -> int:
    """Return the number of independent errors among the residuals: at most two per measured point."""
    return int(np.sum(np.minimum(np.bincount(owner), 2)))


def p_value_of_gain(
    worse: float, better: float, more: int, residuals: tuple[int, int], degrees_of_freedom: int, variance: float | None
) -> float:
    """Return the p-value of the test of a smaller model against a larger one that contains it.

    F test, or chi-square test if the variance is known: the probability of at least this decrease of the sum of squares
    if the smaller model is true.

    Parameters
    ----------
    worse, better : float
        Sums of squares of the smaller and of the larger model.
    more : int
        Number of additional parameters of the larger model.
    residuals : (int, int)
        Number of residuals, and number of independent ones.
    degrees_of_freedom : int
        Degrees of freedom of the larger model: residuals minus parameters.
    variance : float or None
        Variance of a residual, if known.
    """
    if more == 0:
        return 1.0
    repeated = residuals[0] / residuals[1]
    gain = max(worse - better, 0.0) / (more * repeated)
    if variance is not None:
        return float(scipy.special.chdtrc(more, more * gain / max(variance, _ROUNDING**2)))
    if degrees_of_freedom <= 0:
        return 1.0
    return float(
        scipy.special.fdtrc(more, degrees_of_freedom / repeated, gain / max(better / degrees_of_freedom, _ROUNDING**2))
    )


def covariance(
    packed: PackedLines, found: Minimum, owner: npt.NDArray[np.intp], variance: float, *, keep_centre: bool
) -> Float64:
    """Return the covariance of (k..., centre, two tangents per vanishing point) in packed coordinates.

    A point's error is a vector with two independent components of equal variance. Its effects on all lines through the
    point are summed. Parameters that the data do not determine have infinite variance.
    """
    columns = projected_columns(
        packed, found.parameters, found.evaluation, found.slopes, found.normal.line_coefficients
    )
    return (
        _sandwich(
            inner_products(columns, columns),
            [_per_point(columns * normal, owner) for normal in image_normals(found)],
            len(found.parameters.k),
            keep_centre,
        )
        * variance
    )


def image_normals(found: Minimum) -> Float64:
    """Return the normals (2, n) of the lines' curves at the points in the measured image, times the root of the weight.

    They are the derivatives of the residuals by a displacement of the measured point.
    """
    points = found.evaluation.points
    outward = 2.0 * points.slope * found.evaluation.along
    normals = np.stack(
        [
            points.growth * found.evaluation.nx + outward * points.dx,
            points.growth * found.evaluation.ny + outward * points.dy,
        ]
    )
    normals *= found.evaluation.inverse
    return normals


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
    """Return the covariance of an M-estimate, ordered as in `covariance`, by the sandwich estimator."""
    columns = projected_columns(
        packed, found.parameters, found.evaluation, found.slopes, found.normal.line_coefficients
    )
    bread = columns / np.sqrt(weight)
    slope = influence_slope(found.evaluation.distance / scale, loss)
    spread = _per_point(columns * found.evaluation.residual, owner)
    enlarged = len(weight) / max(len(weight) - count_line_parameters(packed, found.parameters) - len(columns), 1)
    return enlarged * _sandwich(inner_products(bread * slope, bread), [spread], len(found.parameters.k), keep_centre)


def _per_point(values: Float64, owner: npt.NDArray[np.intp]) -> Float64:
    """Sum values (rows, n) over the occurrences of each measured point."""
    return np.stack([np.bincount(owner, each) for each in values]) if len(values) else np.empty((0, 1))


def _sandwich(bread: Float64, spreads: list[Float64], order: int, keep_centre: bool) -> Float64:
    """Return bread^-1 (sum of s s') bread^-1; infinite for undetermined parameters, 0 for known ones."""
    meat = sum((inner_products(each, each) for each in spreads), np.zeros_like(bread))
    kept = np.flatnonzero(bread.diagonal() > 0.0)
    if keep_centre:
        kept = kept[(kept < order) | (kept >= order + 2)]
    fixed = np.ix_(kept, kept)
    scale = 1.0 / np.sqrt(bread.diagonal()[kept])
    values, vectors = np.linalg.eigh(bread[fixed] * np.outer(scale, scale))
    determined = values > _SINGULAR
    turned = (vectors[:, determined] / values[determined]) @ vectors[:, determined].T * np.outer(scale, scale)
    found = np.diag(np.full(len(bread), np.inf))
    if keep_centre and order:
        found[[order, order + 1], [order, order + 1]] = 0.0
    found[fixed] = turned @ meat[fixed] @ turned
    lost = kept[np.any(np.abs(vectors[:, ~determined]) > math.sqrt(_SINGULAR), axis=1)]
    found[lost, lost] = np.inf
    return found


def influence_slope(ratio: Float64, loss: Loss) -> Float64:
    """Return the derivative of weight(x) x at residuals x [standard deviations]."""
    limit = _TUNING_CONSTANTS[loss]
    inside = np.abs(ratio) < limit
    if loss == "huber":
        return inside.astype(np.float64)
    square = (ratio / limit) ** 2
    return np.where(inside, (1.0 - square) * (1.0 - 5.0 * square), 0.0)


def robust_weights(residual: Float64, scale: float, loss: Loss) -> Float64:
    """Return the weights of the squared residuals."""
    limit = _TUNING_CONSTANTS[loss] * scale
    if loss == "huber":
        return np.asarray(limit / np.maximum(np.abs(residual), limit))
    # The weight stays above 0, so that a line of outliers alone remains defined.
    return np.maximum(1.0 - (residual / limit) ** 2, _LEAST_ROOT) ** 2


def robust_start(packed: PackedLines, centre: Float64 | None) -> tuple[Parameters, Float64]:
    """Return the parameters of a robust `linear_start` with Huber weights, and the weights (n,)."""
    weight = np.ones(len(packed.x))
    for _ in range(_MAX_ROUNDS):
        start = linear_start(packed, centre, weight)
        distance = start.distances(packed, weight)
        weight = robust_weights(distance, max(MAD_TO_SIGMA * float(np.median(np.abs(distance))), _ROUNDING), "huber")
    return start.parameters, weight


def fit_reweighted(
    packed: PackedLines, found: Minimum, loss: Loss, sigma: float | None, *, keep_centre: bool
) -> tuple[Minimum, Float64, float]:
    """Minimise a robust loss by iterative reweighting; return the fit, the weights (n,) and the scale of the errors.

    Tukey's loss has several minima; its minimisation starts from Huber's minimum.
    """
    weight, scale = np.ones(len(packed.x)), 0.0
    left = np.sqrt(len(packed.x) / max(len(packed.x) - count_line_parameters(packed, found.parameters), 1))
    stages: tuple[Loss, ...] = ("huber", "tukey") if loss == "tukey" else ("huber",)
    for stage in stages:
        for _ in range(_MAX_ROUNDS):
            distance, before = found.evaluation.distance, weight
            scale = sigma if sigma is not None else float(MAD_TO_SIGMA * left * np.median(np.abs(distance)))
            scale = max(scale, _ROUNDING)
            weight = robust_weights(distance, scale, stage)
            found = minimise(packed, found.parameters, weight=weight, keep_centre=keep_centre)
            is_settled = bool(np.max(np.abs(weight - before)) <= _SETTLED)
            if is_settled:
                break
    return replace(found, converged=found.converged and is_settled), weight, scale
