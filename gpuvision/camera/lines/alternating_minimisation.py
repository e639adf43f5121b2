"""Alternating minimisation over lens and vanishing points, the thesis' method, for comparison.

The residuals are distances, in the undistorted image, of points from lines through the vanishing points. Each round
estimates the vanishing points for a fixed lens by the Nelder-Mead simplex, then the lens for fixed vanishing points by
one of three solvers. All work in packed coordinates: in pixels, k1 and the centre differ by ten orders of magnitude.
`gpuvision.camera.lines.vanishing_points` has the faster method.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 3.3.6, eq. 3.10,
3.14 and 3.15.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import scipy.optimize

from gpuvision.camera.lines.line_families import Float64, PackedLines
from gpuvision.camera.lines.normal_equations import normal_equations, residual_jacobian
from gpuvision.camera.lines.straightness import (
    LineSet,
    Parameters,
    Undistorted,
    evaluate,
    fit_lines,
    inner_products,
    moments,
    undistort,
)
from gpuvision.camera.lines.variable_projection import Minimum

# Step below which a line search stops, in units of the normalised parameters. Chosen: far below `_SETTLED`, far above
# the rounding of float64.
_MIN_STEP = 1e-12
# Ratio of eigenvalues of the normal equations below which the curvatures determine the centre in one direction only.
# Chosen: the standard deviations then differ by a factor of 30.
_MIN_EIGENVALUE_RATIO = 1e-3
_SETTLED = 1e-6
"""Least relative decrease of the sum of squares by a round or a descent step that is followed by another one."""
_MAX_DESCENTS = 50
# Options of scipy's Nelder-Mead, in packed coordinates.
_SIMPLEX = {"xatol": 1e-6, "fatol": 1e-11, "maxfev": 2000}


class AlternatingMinimum(NamedTuple):
    """Result of an alternating minimisation.

    Attributes
    ----------
    minimum : Minimum
        Final parameters; ``iterations`` counts the rounds.
    evaluations : int
        Number of evaluations of the sum of squares or its gradient.
    """

    minimum: Minimum
    evaluations: int


class _Objective:
    """Sum of squared distances in the undistorted image, with lines in closed form; counts its evaluations."""

    def __init__(self, packed: PackedLines, order: int) -> None:
        self.packed, self.order, self.evaluations = packed, order, 0

    def distances(self, lens: Float64, points: Float64) -> tuple[Undistorted, LineSet, Float64]:
        """Return undistorted points, their lines, and the distances (n,)."""
        self.evaluations += 1
        packed = self.packed
        moved = undistort(packed, lens[: self.order], lens[self.order :])
        parameters = Parameters(lens[: self.order], lens[self.order :], _homogeneous(points))
        lines = fit_lines(packed, parameters, moments(packed, moved.x, moved.y, None))
        nx, ny = lines.nx[packed.line], lines.ny[packed.line]
        return moved, lines, nx * moved.x + ny * moved.y + lines.offset[packed.line]

    def cost(self, lens: Float64, points: Float64) -> float:
        """Return the sum of squares."""
        distance = self.distances(lens, points)[2]
        return float(inner_products(distance, distance))

    def slopes(self, lens: Float64, points: Float64) -> tuple[Float64, Float64]:
        """Return distances (n,) and their derivatives by the lens (parameters, n) for fixed lines."""
        moved, lines, distance = self.distances(lens, points)
        nx, ny = lines.nx[self.packed.line], lines.ny[self.packed.line]
        along = nx * moved.dx + ny * moved.dy
        powers = [along * moved.square ** (power + 1) for power in range(self.order)]
        outward = 2.0 * moved.slope * along
        shifts = [n * (1.0 - moved.growth) - outward * d for n, d in ((nx, moved.dx), (ny, moved.dy))]
        return distance, np.stack([*powers, *shifts])


def _homogeneous(points: Float64) -> Float64:
    """Return unit vectors of finite points (families, 2)."""
    lifted = np.column_stack([points, np.ones(len(points))])
    return np.asarray(lifted / np.linalg.norm(lifted, axis=1, keepdims=True))


def _fit_nelder_mead(objective: _Objective, lens: Float64, points: Float64) -> Float64:
    simplex = lens + np.vstack([np.zeros(len(lens)), np.diag(np.r_[np.full(objective.order, 0.05), 0.1, 0.1])])
    found = scipy.optimize.minimize(
        objective.cost, lens, args=(points,), method="Nelder-Mead", options=_SIMPLEX | {"initial_simplex": simplex}
    )
    return np.asarray(found.x)


def _fit_steepest_descent(objective: _Objective, lens: Float64, points: Float64) -> Float64:
    """Follow the negative gradient; halve or double the step length as long as the cost decreases."""
    length_of_step = 1e-3
    for _ in range(_MAX_DESCENTS):
        distance, slopes = objective.slopes(lens, points)
        gradient, evaluation = inner_products(slopes, distance[None])[:, 0], float(inner_products(distance, distance))
        length = float(np.linalg.norm(gradient))
        if length == 0.0:
            break
        while (
            objective.cost(lens - length_of_step * gradient / length, points) >= evaluation
            and length_of_step > _MIN_STEP
        ):
            length_of_step *= 0.5
        trial = lens - length_of_step * gradient / length
        gained = evaluation - objective.cost(trial, points)
        if gained <= _SETTLED * evaluation:
            break
        lens, length_of_step = trial, 2.0 * length_of_step
    return lens


def _fit_gauss_newton(objective: _Objective, lens: Float64, points: Float64) -> Float64:
    """Take Gauss-Newton steps, halved until the cost decreases; the lines are fitted again after each step."""
    for _ in range(_MAX_DESCENTS):
        distance, slopes = objective.slopes(lens, points)
        evaluation = float(inner_products(distance, distance))
        step = -np.linalg.lstsq(slopes.T, distance, rcond=None)[0]
        after = objective.cost(lens + step, points)
        while after >= evaluation and np.max(np.abs(step)) > _MIN_STEP:
            step = 0.5 * step
            after = objective.cost(lens + step, points)
        if evaluation - after <= _SETTLED * evaluation:
            break
        lens = lens + step
    return lens


ALTERNATING_SOLVERS: Mapping[str, Callable[[_Objective, Float64, Float64], Float64]] = {
    "nelder_mead": _fit_nelder_mead,
    "steepest_descent": _fit_steepest_descent,
    "gauss_newton": _fit_gauss_newton,
}


def minimise_alternating(packed: PackedLines, order: int, solver: str, *, max_rounds: int = 100) -> AlternatingMinimum:
    """Alternate between vanishing points and lens until the cost no longer decreases.

    Parameters
    ----------
    packed : PackedLines
        Measured points; each family needs two lines.
    order : int
        Number of distortion coefficients, 1 or 2.
    solver : {"nelder_mead", "steepest_descent", "gauss_newton"}
        Solver of the lens.
    max_rounds : int
        Largest number of rounds. Default 100.

    Returns
    -------
    AlternatingMinimum
    """
    objective = _Objective(packed, order)
    lens = np.concatenate([np.zeros(order), centre_from_curvature(packed)])
    points = mean_intersections(packed)
    before, done, is_least = objective.cost(lens, points), 0, False
    while done < max_rounds:
        done += 1
        points = _fit_vanishing_points(objective, lens, points)
        lens = ALTERNATING_SOLVERS[solver](objective, lens, points)
        after = objective.cost(lens, points)
        is_least = before - after <= _SETTLED * before
        if is_least:
            break
        before = after
    parameters = Parameters(lens[:order], lens[order:], _homogeneous(points))
    evaluation = evaluate(packed, parameters)
    slopes = residual_jacobian(order, evaluation)
    normal = normal_equations(packed, parameters, evaluation, slopes)
    return AlternatingMinimum(
        Minimum(parameters, evaluation, slopes, normal, done, "", is_least), objective.evaluations
    )


def _fit_vanishing_points(objective: _Objective, lens: Float64, points: Float64) -> Float64:
    """Estimate the vanishing points one by one: a family's distances depend on no other vanishing point."""
    points = points.copy()
    for number in range(len(points)):

        def cost(point: Float64, number: int = number) -> float:
            return objective.cost(lens, np.vstack([points[:number], point, points[number + 1 :]]))

        points[number] = scipy.optimize.minimize(cost, points[number], method="Nelder-Mead", options=_SIMPLEX).x
    return points


def mean_intersections(packed: PackedLines) -> Float64:
    """Return the mean intersection (families, 2) of all pairs of measured lines of each family."""
    no_lens = Parameters(np.empty(0), np.zeros(2), None)
    lines = np.stack(evaluate(packed, no_lens).lines, axis=-1)
    points = np.zeros((packed.families, 2))
    for number in range(packed.families):
        members = lines[packed.family == number]
        first, second = np.triu_indices(len(members), 1)
        crossed = np.cross(members[first], members[second])
        finite = np.abs(crossed[:, 2]) > 0.0
        if finite.any():
            points[number] = np.mean(crossed[finite, :2] / crossed[finite, 2:], axis=0)
    return points


def centre_from_curvature(packed: PackedLines) -> Float64:
    """Estimate the distortion centre from the lines' points of extreme curvature.

    A distorted line is symmetric about its perpendicular through the centre, so its curvature is extreme there. A
    quartic along the chord approximates the line. The centre is the point nearest to the normals at these points:
    (sum t t') c = sum t t' p with tangents t and points p. The result is the middle of the data if the lines show no
    extreme curvature.
    """
    matrix, right = np.zeros((2, 2)), np.zeros(2)
    for start, count in zip(packed.starts, packed.counts, strict=True):
        if count < 6:
            continue
        places = np.column_stack([packed.x[start : start + count], packed.y[start : start + count]])
        middle = places.mean(axis=0)
        along = np.linalg.svd(places - middle)[2]
        t, h = along @ (places - middle).T
        curve = np.polynomial.Polynomial.fit(t, h, 4, domain=[-1.0, 1.0]).coef
        if curve[4] == 0.0 or not t.min() < -curve[3] / (4.0 * curve[4]) < t.max():
            continue
        extreme = -curve[3] / (4.0 * curve[4])
        slope = np.polynomial.polynomial.polyval(extreme, np.polynomial.polynomial.polyder(curve))
        height = np.polynomial.polynomial.polyval(extreme, curve)
        tangent = np.array([1.0, slope]) / np.hypot(1.0, slope) @ along
        place = middle + np.array([extreme, height]) @ along
        matrix += np.outer(tangent, tangent)
        right += tangent * (tangent @ place)
    values = np.linalg.eigvalsh(matrix)
    if values[0] <= _MIN_EIGENVALUE_RATIO * values[1]:
        return np.zeros(2)
    centre = np.linalg.solve(matrix, right)
    return np.where(np.all(np.abs(centre) < packed.corner), centre, 0.0)
