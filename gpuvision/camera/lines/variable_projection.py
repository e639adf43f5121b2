"""Levenberg-Marquardt minimisation over lens and vanishing points, with the lines eliminated.

References
----------
G. Golub and V. Pereyra, Separable nonlinear least squares: the variable projection method and its applications, Inverse
Problems 19 (2003) R1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gpuvision.camera.lines.line_families import Float64, PackedLines
from gpuvision.camera.lines.normal_equations import (
    NormalEquations,
    ResidualJacobian,
    normal_equations,
    residual_jacobian,
)
from gpuvision.camera.lines.straightness import Evaluation, LineSet, Parameters, evaluate, is_monotonic, pencil_basis

_ROUNDING = 64.0 * float(np.finfo(np.float64).eps) ** 2
"""Squared residual at rounding level. Derived from double precision."""
_DAMPING = (1e-12, 1e-4, 1e10)
"""Levenberg-Marquardt damping: initial value, value after the first rejected step, value at which to stop."""


@dataclass(frozen=True, kw_only=True)
class MinimisationLimits:
    """Bounds and stopping criteria of the minimisation.

    Attributes
    ----------
    max_iterations : int
        Largest number of steps tried. Default 60.
    max_centre_distance : float
        Largest distance of the distortion centre from the middle of the data [half-diagonals]. Without a bound, data
        with little distortion move the centre to infinity while k1 tends to 0. Default 4.0.
    min_slope : float
        Least slope of r (1 + k1 r^2 + ...) over the data, relative to the slope at the centre: excludes folds. Default
        1e-3.
    min_gain : float
        Expected gain of the next step that ends the minimisation [variances of a residual]. Derived: 5e-3 corresponds
        to 0.07 standard deviations of the parameters. Default 5e-3.
    min_curvature : float
        Least mean square of a bend of the lines [half-diagonals^2] that the closed-form start uses. Default 1e-8.
    """

    max_iterations: int = 60
    max_centre_distance: float = 4.0
    min_slope: float = 1e-3
    min_gain: float = 5e-3
    min_curvature: float = 1e-8


DEFAULT_LIMITS = MinimisationLimits()


@dataclass(frozen=True)
class Minimum:
    """Result of a minimisation.

    Attributes
    ----------
    parameters, evaluation
        Final parameters and their evaluation.
    slopes, normal
        Residual Jacobian and normal equations of the last step.
    iterations
        Number of steps tried.
    at_bound
        Active bound: "", "centre" or "fold".
    converged
        Whether another criterion than the largest number of steps ended the minimisation. Default True.
    """

    parameters: Parameters
    evaluation: Evaluation
    slopes: ResidualJacobian
    normal: NormalEquations
    iterations: int
    at_bound: str
    converged: bool = True


def minimise(
    packed: PackedLines,
    start: Parameters,
    evaluation: Evaluation | None = None,
    *,
    weight: Float64 | None = None,
    keep_centre: bool = False,
    limits: MinimisationLimits = DEFAULT_LIMITS,
) -> Minimum:
    """Minimise the weighted sum of squared distances from straight lines.

    Parameters
    ----------
    packed : PackedLines
        Measured points.
    start : Parameters
        Starting parameters.
    evaluation : Evaluation, optional
        Evaluation of the starting parameters, if known.
    weight : numpy.ndarray, optional
        (n,) weights of the squared distances. Default: 1.
    keep_centre : bool
        Keep the distortion centre fixed. Default False.
    limits : MinimisationLimits
        Bounds and stopping criteria.

    Returns
    -------
    Minimum
    """
    parameters, damping, iterations, gained = start, _DAMPING[0], 0, 0.0
    evaluation = evaluate(packed, parameters, weight=weight) if evaluation is None else evaluation
    rounding = _ROUNDING * len(packed.x)
    variance = limits.min_gain / max(len(packed.x) - 2 * len(packed.counts), 1)
    while True:
        slopes = residual_jacobian(len(parameters.k), evaluation)
        normal = normal_equations(packed, parameters, evaluation, slopes)
        if keep_centre:
            normal = without_centre(normal, len(parameters.k))
        found = Minimum(parameters, evaluation, slopes, normal, iterations, "")
        if not len(normal.gradient):
            return found
        bounds: set[str] = set()
        while True:
            iterations += 1
            step = _damped_step(normal, damping)
            gain = -float(step @ normal.gradient)
            trial, bound = apply_step(packed, parameters, step, keep_centre, limits)
            bounds.add(bound)
            next_evaluation = None if bound == "fold" else evaluate(packed, trial, evaluation, weight)
            if next_evaluation is not None and next_evaluation.cost <= evaluation.cost + rounding:
                break
            damping = max(10.0 * damping, _DAMPING[1])
            is_least = damping > _DAMPING[2] or gain < variance * evaluation.cost
            if is_least or iterations >= limits.max_iterations:
                return replace(found, iterations=iterations, at_bound=max(bounds), converged=is_least)
        parameters, evaluation, damping = (
            trial,
            next_evaluation,
            0.1 * damping if damping > _DAMPING[1] else _DAMPING[0],
        )
        # Predict the next gain: gains decrease at least by the last ratio.
        coming = gain * min(gain / gained, 1.0) if gained > 0.0 else gain
        gained = gain
        is_least = coming <= max(variance * evaluation.cost, rounding)
        if is_least or iterations >= limits.max_iterations:
            return Minimum(parameters, evaluation, slopes, normal, iterations, max(bounds), is_least)


def _damped_step(normal: NormalEquations, damping: float) -> Float64:
    """Solve (H + damping diag H) step = -gradient; a parameter without effect on the residuals does not move."""
    diagonal = normal.matrix.diagonal()
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-24 * diagonal.max()))
    matrix = normal.matrix * scale * scale[:, None]
    matrix.ravel()[:: len(matrix) + 1] += damping
    return np.asarray(np.linalg.solve(matrix, -scale * normal.gradient) * scale)


def without_centre(normal: NormalEquations, order: int) -> NormalEquations:
    """Return the normal equations for a fixed centre."""
    kept = np.delete(np.arange(len(normal.gradient)), [order, order + 1] if order else [])
    return NormalEquations(normal.matrix[np.ix_(kept, kept)], normal.gradient[kept], normal.line_coefficients)


def apply_step(
    packed: PackedLines,
    parameters: Parameters,
    step: Float64,
    keep_centre: bool = False,
    limits: MinimisationLimits = DEFAULT_LIMITS,
) -> tuple[Parameters, str]:
    """Return the parameters after a step, with the centre clamped to its bound, and the bound that is active."""
    order = len(parameters.k)
    k, centre, bound = parameters.k + step[:order], parameters.centre, ""
    if order and not keep_centre:
        centre = centre + step[order : order + 2]
        distance = math.hypot(*centre)
        if distance > limits.max_centre_distance:
            centre, bound = centre * (limits.max_centre_distance / distance), "centre"
    if order and not is_monotonic(k, farthest_corner_square(packed, centre), least=limits.min_slope):
        # The bounding box violates the bound: test the farthest point itself.
        farthest = float(np.max((packed.x - centre[0]) ** 2 + (packed.y - centre[1]) ** 2))
        bound = bound if is_monotonic(k, farthest, least=limits.min_slope) else "fold"
    vanishing = parameters.vanishing
    if vanishing is not None:
        tangent = step[len(step) - 2 * packed.families :].reshape(-1, 2)
        vanishing = vanishing + np.sum(tangent[:, :, None] * pencil_basis(vanishing), axis=1)
        vanishing = vanishing / np.linalg.norm(vanishing, axis=1, keepdims=True)
    return Parameters(k, centre, vanishing), bound


def farthest_corner_square(packed: PackedLines, centre: Float64) -> float:
    """Return the squared distance from the centre to the farthest corner of the points' bounding box."""
    return math.hypot(*np.maximum(packed.corner - centre, packed.corner + centre).tolist()) ** 2


class LinearStart(NamedTuple):
    """Closed-form solution to first order in the distortion.

    Attributes
    ----------
    parameters
        k1 and the centre.
    rank
        Number of independent bends of the lines: 3 determine k1 and the centre; 1 determines k1 about a known centre.
    gain
        Decrease of the sum of squares against no lens.
    slopes, line_coefficients, mixed
        Residual Jacobian, its projection onto the lines, and the coefficients of its rows in the remaining distances.
    """

    parameters: Parameters
    rank: int
    gain: float
    slopes: ResidualJacobian
    line_coefficients: Float64
    mixed: Float64

    def distances(self, packed: PackedLines, weight: Float64) -> Float64:
        """Return the remaining distances (n,)."""
        own = np.einsum("k,ikl->il", self.mixed, self.line_coefficients)[:, packed.line]
        left = np.einsum("k,kn->n", self.mixed, self.slopes.lens) - np.sum(own * self.slopes.line, axis=0)
        return np.asarray(left / np.sqrt(weight))


def linear_start(
    packed: PackedLines,
    centre: Float64 | None = None,
    weight: Float64 | None = None,
    limits: MinimisationLimits = DEFAULT_LIMITS,
) -> LinearStart:
    """Estimate k1 and the centre in closed form.

    To first order in k1, a straight line is bent by ``k1 (n.p)|p|^2 - (k1 c).(|p|^2 n + 2 (n.p) p)`` up to a linear
    function along the line, which the line itself absorbs. The bend is linear in k1 and k1 c.
    """
    known = np.zeros(2) if centre is None else centre
    evaluation = evaluate(packed, Parameters(np.empty(0), known, None), weight=weight)
    points, nx, ny = evaluation.points, evaluation.nx, evaluation.ny
    # Project the points onto their lines, so that measurement errors do not act as bends.
    x, y, q = (
        points.dx - nx * evaluation.distance,
        points.dy - ny * evaluation.distance,
        evaluation.along - evaluation.distance,
    )
    square = x * x + y * y
    bends = [q * square]
    if centre is None:
        bends += [-square * nx - 2.0 * q * x, -square * ny - 2.0 * q * y]
    slopes = ResidualJacobian(
        np.stack([*(evaluation.inverse * bend for bend in bends), evaluation.residual]),
        residual_jacobian(0, evaluation).line,
    )
    normal = normal_equations(packed, Parameters(np.zeros(1), known, None), evaluation, slopes)
    values, vectors = np.linalg.eigh(normal.matrix)
    determined = values > limits.min_curvature * len(q)
    vectors = vectors[:, determined]
    step = -vectors @ (vectors.T @ normal.gradient / values[determined])
    k1, *moved = step.tolist()
    if centre is None and math.hypot(*moved) < abs(k1):
        known = np.array(moved) / k1
    elif determined.any():
        # A centre outside the image is noise, and so is its k1: estimate k1 about the middle.
        k1 = -float(normal.gradient[0] / normal.matrix[0, 0])
    k = np.array([k1])
    while not is_monotonic(k, farthest_corner_square(packed, known), least=limits.min_slope):
        k *= 0.7
    gain = -float(step @ normal.gradient)
    return LinearStart(
        Parameters(k, known, None),
        int(np.count_nonzero(determined)),
        gain,
        slopes,
        normal.line_coefficients,
        np.append(step, 1.0),
    )


def vanishing_start(packed: PackedLines, lines: LineSet) -> Float64:
    """Return the point nearest to the lines of each family, as homogeneous unit vectors (families, 3)."""
    rows = np.stack(lines)
    outer = rows[:, None] * rows
    present = packed.family[packed.family_starts]
    found = np.tile([0.0, 0.0, 1.0], (packed.families, 1))
    weight = 1.0
    for _ in range(2):
        scatter = np.add.reduceat(outer * weight, packed.family_starts, axis=-1)
        found[present] = np.linalg.eigh(scatter.transpose(2, 0, 1))[1][:, :, 0]
        # Weight each line by its inverse variance at the point; for distant points the directions alone say little.
        x, y, w = found[packed.family].T
        weight = 1.0 / ((rows[0] * y - rows[1] * x) ** 2 + w * w)
    return found
