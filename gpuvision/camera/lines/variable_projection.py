"""Levenberg-Marquardt over lens and vanishing points, the lines eliminated."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gpuvision.camera.lines.line_families import Float64, PackedLines
from gpuvision.camera.lines.straightness import (
    Columns,
    Evaluation,
    LineSet,
    NormalEquations,
    Parameters,
    columns,
    evaluate,
    monotone,
    normal_equations,
    pencil_basis,
)

_MOST_STEPS = 60
_FARTHEST = 4.0
"""Half-diagonals that the centre may lie off the middle: without a bound the data pull it away (k1 -> 0)."""
_LEAST_SLOPE = 1e-3
"""Of r (1 + k1 r^2 + ...) over the data, in parts of that at the centre."""
_NEGLIGIBLE = 5e-3
"""What another step would still gain, in variances, at the end: 0.07 standard deviations of the parameters."""
_ROUNDING = 64.0 * float(np.finfo(np.float64).eps) ** 2
_FLAT = 1e-8
"""Mean square of a bend, in half-diagonals, below which the lines do not have it."""
_DAMPING = (1e-12, 1e-4, 1e10)
"""At first, at the first step that fails, and where it is given up."""


@dataclass(frozen=True)
class Minimum:
    """Where the minimisation ended.

    Attributes
    ----------
    at, here, slopes, normal
        Parameters, and what belongs to them; ``slopes`` and ``normal`` are those of the step that led there.
    steps
        Steps that were tried.
    at_bound
        What keeps it from going farther: "", "centre" or "fold".
    """

    at: Parameters
    here: Evaluation
    slopes: Columns
    normal: NormalEquations
    steps: int
    at_bound: str


def minimise(
    packed: PackedLines,
    start: Parameters,
    here: Evaluation | None = None,
    *,
    weight: Float64 | None = None,
    keep_centre: bool = False,
) -> Minimum:
    """Minimise the weighted squares of the distances from straight lines.

    Parameters
    ----------
    packed
        The measured points.
    start, here
        Where to begin, and its evaluation if it is known.
    weight
        Weights (n,) of the squares.
    keep_centre
        Whether the centre stays where it is.
    """
    at, damping, steps, gained = start, _DAMPING[0], 0, 0.0
    here = evaluate(packed, at, weight=weight) if here is None else here
    rounding = _ROUNDING * len(packed.x)
    variance = _NEGLIGIBLE / max(len(packed.x) - 2 * len(packed.counts), 1)
    while True:
        slopes = columns(len(at.k), here)
        normal = normal_equations(packed, at, here, slopes)
        if keep_centre:
            normal = without_centre(normal, len(at.k))
        found = Minimum(at, here, slopes, normal, steps, "")
        if not len(normal.gradient):
            return found
        bounds: set[str] = set()
        while True:
            steps += 1
            step = _damped_step(normal, damping)
            gain = -float(step @ normal.gradient)
            trial, bound = stepped(packed, at, step, keep_centre)
            bounds.add(bound)
            there = None if bound == "fold" else evaluate(packed, trial, here, weight)
            if there is not None and there.cost <= here.cost + rounding:
                break
            damping = max(10.0 * damping, _DAMPING[1])
            if damping > _DAMPING[2] or gain < variance * here.cost or steps >= _MOST_STEPS:
                return replace(found, steps=steps, at_bound=max(bounds))
        at, here, damping = trial, there, 0.1 * damping if damping > _DAMPING[1] else _DAMPING[0]
        # Gains shrink at least as fast as they did last.
        coming = gain * min(gain / gained, 1.0) if gained > 0.0 else gain
        gained = gain
        if coming <= max(variance * here.cost, rounding) or steps >= _MOST_STEPS:
            return Minimum(at, here, slopes, normal, steps, max(bounds))


def _damped_step(normal: NormalEquations, damping: float) -> Float64:
    """Solve (H + damping diag H) step = -gradient; a parameter without any effect stays where it is."""
    diagonal = normal.matrix.diagonal()
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-24 * diagonal.max()))
    matrix = normal.matrix * scale * scale[:, None]
    matrix.ravel()[:: len(matrix) + 1] += damping
    return np.asarray(np.linalg.solve(matrix, -scale * normal.gradient) * scale)


def without_centre(normal: NormalEquations, order: int) -> NormalEquations:
    """Return the normal equations for a centre that is known."""
    kept = np.delete(np.arange(len(normal.gradient)), [order, order + 1] if order else [])
    return NormalEquations(normal.matrix[np.ix_(kept, kept)], normal.gradient[kept], normal.taken)


def stepped(packed: PackedLines, at: Parameters, step: Float64, keep_centre: bool = False) -> tuple[Parameters, str]:
    """Take a step; within the bounds of the centre, and telling whether the lens folds over the data there."""
    order = len(at.k)
    k, centre, bound = at.k + step[:order], at.centre, ""
    if order and not keep_centre:
        centre = centre + step[order : order + 2]
        far = math.hypot(*centre)
        if far > _FARTHEST:
            centre, bound = centre * (_FARTHEST / far), "centre"
    if order and not monotone(k, reach(packed, centre), least=_LEAST_SLOPE):
        # The corner of the data's box: rather the farthest point itself.
        farthest = float(np.max((packed.x - centre[0]) ** 2 + (packed.y - centre[1]) ** 2))
        bound = bound if monotone(k, farthest, least=_LEAST_SLOPE) else "fold"
    vanishing = at.vanishing
    if vanishing is not None:
        tangent = step[len(step) - 2 * packed.families :].reshape(-1, 2)
        vanishing = vanishing + np.sum(tangent[:, :, None] * pencil_basis(vanishing), axis=1)
        vanishing = vanishing / np.linalg.norm(vanishing, axis=1, keepdims=True)
    return Parameters(k, centre, vanishing), bound


def reach(packed: PackedLines, centre: Float64) -> float:
    """Squared distance of the farthest corner around the points from the centre."""
    return math.hypot(*np.maximum(packed.corner - centre, packed.corner + centre).tolist()) ** 2


class LinearStart(NamedTuple):
    """What follows in closed form to first order in the distortion.

    Attributes
    ----------
    at
        k1 and the centre.
    rank
        How many ways the lines could bend: 3 fix k1 and the centre; 1 fixes k1 about a known centre.
    gain
        By how much the sum of squares falls from that without a lens.
    slopes, taken, mixed
        Columns, what of the lines is in them, and how much of each is in the distances that are left.
    """

    at: Parameters
    rank: int
    gain: float
    slopes: Columns
    taken: Float64
    mixed: Float64

    def distances(self, packed: PackedLines, weight: Float64) -> Float64:
        """Distances (n,) that are left."""
        own = np.einsum("k,ikl->il", self.mixed, self.taken)[:, packed.line]
        left = np.einsum("k,kn->n", self.mixed, self.slopes.lens) - np.sum(own * self.slopes.line, axis=0)
        return np.asarray(left / np.sqrt(weight))


def linear_start(packed: PackedLines, centre: Float64 | None = None, weight: Float64 | None = None) -> LinearStart:
    """Find k1 and the centre in closed form.

    To first order in k1 a straight line is bent by ``k1 (n.p)|p|^2 - (k1 c).(|p|^2 n + 2 (n.p) p)``, plus what is
    linear along it and belongs to the line: linear in k1 and k1 c.
    """
    known = np.zeros(2) if centre is None else centre
    here = evaluate(packed, Parameters(np.empty(0), known, None), weight=weight)
    points, nx, ny = here.points, here.nx, here.ny
    # The points' feet on their lines, so that errors do not look like bends.
    x, y, q = points.dx - nx * here.distance, points.dy - ny * here.distance, here.along - here.distance
    square = x * x + y * y
    bends = [q * square]
    if centre is None:
        bends += [-square * nx - 2.0 * q * x, -square * ny - 2.0 * q * y]
    slopes = Columns(np.stack([*(here.inverse * bend for bend in bends), here.residual]), columns(0, here).line)
    normal = normal_equations(packed, Parameters(np.zeros(1), known, None), here, slopes)
    values, vectors = np.linalg.eigh(normal.matrix)
    seen = values > _FLAT * len(q)
    vectors = vectors[:, seen]
    step = -vectors @ (vectors.T @ normal.gradient / values[seen])
    k1, *moved = step.tolist()
    if centre is None and math.hypot(*moved) < abs(k1):
        known = np.array(moved) / k1
    elif seen.any():
        # A centre outside the image is noise, and so is k1 beside it: k1 about the middle.
        k1 = -float(normal.gradient[0] / normal.matrix[0, 0])
    k = np.array([k1])
    while not monotone(k, reach(packed, known), least=_LEAST_SLOPE):
        k *= 0.7
    gain = -float(step @ normal.gradient)
    return LinearStart(
        Parameters(k, known, None), int(np.count_nonzero(seen)), gain, slopes, normal.taken, np.append(step, 1.0)
    )


def vanishing_start(packed: PackedLines, lines: LineSet) -> Float64:
    """Return the point nearest to each family's lines, as unit vectors (families, 3)."""
    rows = np.stack(lines)
    outer = rows[:, None] * rows
    present = packed.family[packed.family_starts]
    found = np.tile([0.0, 0.0, 1.0], (packed.families, 1))
    weight = 1.0
    for _ in range(2):
        scatter = np.add.reduceat(outer * weight, packed.family_starts, axis=-1)
        found[present] = np.linalg.eigh(scatter.transpose(2, 0, 1))[1][:, :, 0]
        # Of far points the lines' directions alone say little, so each line is weighed by its error at the point.
        x, y, w = found[packed.family].T
        weight = 1.0 / ((rows[0] * y - rows[1] * x) ** 2 + w * w)
    return found
