"""The thesis' alternating minimisation (F. de Jong, 3.3.6), to compare `gpuvision.camera.lines.vanishing_points` with.

Distances are those of the undistorted image from lines through the vanishing points (eq. 3.10, 3.14, 3.15). In turn the
vanishing points are sought for a fixed lens, by Nelder and Mead's simplex, and the lens for fixed vanishing points, by
one of three strategies. All work in packed coordinates: in pixels k1 and the centre differ by ten orders of magnitude.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import scipy.optimize

from gpuvision.camera.lines.line_families import Float64, PackedLines
from gpuvision.camera.lines.straightness import (
    LineSet,
    Parameters,
    Undistorted,
    best_lines,
    columns,
    evaluate,
    inner,
    moments,
    normal_equations,
    undistort,
)
from gpuvision.camera.lines.variable_projection import Minimum

_SETTLED = 1e-6
"""Part of the sum of squares that a round has to gain to be followed by another."""
_DESCENTS = 50
_SIMPLEX = {"xatol": 1e-6, "fatol": 1e-11, "maxfev": 2000}


class Alternation(NamedTuple):
    """How an alternating minimisation went.

    Attributes
    ----------
    minimum
        Where it ended; ``steps`` are its rounds.
    evaluations
        Sums of squares and gradients computed.
    """

    minimum: Minimum
    evaluations: int


class _Objective:
    """Sum of squared distances in the undistorted image, lines in closed form; counts how often it is asked for."""

    def __init__(self, packed: PackedLines, order: int) -> None:
        self.packed, self.order, self.evaluations = packed, order, 0

    def distances(self, lens: Float64, points: Float64) -> tuple[Undistorted, LineSet, Float64]:
        """Return undistorted points, their lines, and the distances (n,)."""
        self.evaluations += 1
        packed = self.packed
        moved = undistort(packed, lens[: self.order], lens[self.order :])
        at = Parameters(lens[: self.order], lens[self.order :], _homogeneous(points))
        lines = best_lines(packed, at, moments(packed, moved.x, moved.y, None))
        nx, ny = lines.nx[packed.line], lines.ny[packed.line]
        return moved, lines, nx * moved.x + ny * moved.y + lines.offset[packed.line]

    def cost(self, lens: Float64, points: Float64) -> float:
        """Sum of squares."""
        distance = self.distances(lens, points)[2]
        return float(inner(distance, distance))

    def slopes(self, lens: Float64, points: Float64) -> tuple[Float64, Float64]:
        """Distances (n,) and their derivatives (parameters, n) by the lens, the lines where they are."""
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


def _nelder_mead(objective: _Objective, lens: Float64, points: Float64) -> Float64:
    simplex = lens + np.vstack([np.zeros(len(lens)), np.diag(np.r_[np.full(objective.order, 0.05), 0.1, 0.1])])
    found = scipy.optimize.minimize(
        objective.cost, lens, args=(points,), method="Nelder-Mead", options=_SIMPLEX | {"initial_simplex": simplex}
    )
    return np.asarray(found.x)


def _steepest_descent(objective: _Objective, lens: Float64, points: Float64) -> Float64:
    """Go down the gradient, as far as a halved or doubled step still gains."""
    reach = 1e-3
    for _ in range(_DESCENTS):
        distance, slopes = objective.slopes(lens, points)
        gradient, here = inner(slopes, distance[None])[:, 0], float(inner(distance, distance))
        length = float(np.linalg.norm(gradient))
        if length == 0.0:
            break
        while objective.cost(lens - reach * gradient / length, points) >= here and reach > 1e-12:
            reach *= 0.5
        trial = lens - reach * gradient / length
        gained = here - objective.cost(trial, points)
        if gained <= _SETTLED * here:
            break
        lens, reach = trial, 2.0 * reach
    return lens


def _gauss_newton(objective: _Objective, lens: Float64, points: Float64) -> Float64:
    """Take linear steps, halved until they gain; lines are fitted again after each."""
    for _ in range(_DESCENTS):
        distance, slopes = objective.slopes(lens, points)
        here = float(inner(distance, distance))
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("in,in->i", slopes, slopes), 1e-30))
        slopes *= scale[:, None]
        step = -scale * np.linalg.lstsq(inner(slopes, slopes), inner(slopes, distance[None])[:, 0], rcond=1e-12)[0]
        after = objective.cost(lens + step, points)
        while after >= here and np.max(np.abs(step)) > 1e-12:
            step = 0.5 * step
            after = objective.cost(lens + step, points)
        if here - after <= _SETTLED * here:
            break
        lens = lens + step
    return lens


STRATEGIES: Mapping[str, Callable[[_Objective, Float64, Float64], Float64]] = {
    "nelder_mead": _nelder_mead,
    "steepest_descent": _steepest_descent,
    "gauss_newton": _gauss_newton,
}


def alternate(packed: PackedLines, order: int, strategy: str, *, rounds: int = 100) -> Alternation:
    """Alternate between vanishing points and lens until neither gains.

    Parameters
    ----------
    packed
        The measured points; each family needs two lines.
    order
        Coefficients of the lens.
    strategy
        How the lens is sought: "nelder_mead", "steepest_descent" or "gauss_newton".
    rounds
        At most.
    """
    objective = _Objective(packed, order)
    lens = np.concatenate([np.zeros(order), centre_from_curvature(packed)])
    points = points_from_intersections(packed)
    before, done = objective.cost(lens, points), 0
    while done < rounds:
        done += 1
        points = _best_points(objective, lens, points)
        lens = STRATEGIES[strategy](objective, lens, points)
        after = objective.cost(lens, points)
        if before - after <= _SETTLED * before:
            break
        before = after
    at = Parameters(lens[:order], lens[order:], _homogeneous(points))
    here = evaluate(packed, at)
    slopes = columns(order, here)
    normal = normal_equations(packed, at, here, slopes)
    return Alternation(Minimum(at, here, slopes, normal, done, ""), objective.evaluations)


def _best_points(objective: _Objective, lens: Float64, points: Float64) -> Float64:
    """Seek the vanishing points one after the other: a family's distances depend on its own alone."""
    points = points.copy()
    for number in range(len(points)):

        def cost(point: Float64, number: int = number) -> float:
            return objective.cost(lens, np.vstack([points[:number], point, points[number + 1 :]]))

        points[number] = scipy.optimize.minimize(cost, points[number], method="Nelder-Mead", options=_SIMPLEX).x
    return points


def points_from_intersections(packed: PackedLines) -> Float64:
    """Mean intersection (families, 2) of each family's pairs of lines, as they are measured."""
    none = Parameters(np.empty(0), np.zeros(2), None)
    lines = np.stack(evaluate(packed, none).lines, axis=-1)
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
    """Return the point nearest to the normals at the lines' points of extreme curvature: (sum t t')c = sum t t'p.

    A distorted line is symmetric about its perpendicular through the centre, so its curvature is extreme there. Along
    a chord it is a quartic in the distance; the middle of the data where no line shows an extreme.
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
    if values[0] <= 1e-3 * values[1]:
        return np.zeros(2)
    centre = np.linalg.solve(matrix, right)
    return np.where(np.all(np.abs(centre) < packed.corner), centre, 0.0)
