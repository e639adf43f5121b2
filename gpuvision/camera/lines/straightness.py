"""Distances of measured points from straight lines under a lens model.

The lens maps a measured point p to ``u = c + d g(s)`` with ``d = p - c``, ``s = |d|^2``, ``g = 1 + k1 s + k2 s^2 +
...`` (F. de Jong, eq. 3.11-3.13). A line ``n.u + rho = 0``, |n| = 1, is a curve in the measured image. To first order
the distance of a point from this curve is ``r = (n.u + rho)/|J'n|`` with ``J = du/dp = g I + 2 g' d d'``. Distances in
the undistorted image (eq. 3.10) would shrink to 0 with g; distances in the measured image do not.

For a given lens each line follows in closed form. `gpuvision.camera.lines.normal_equations` has the derivatives.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 3.3.5-3.3.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lines.line_families import Float64, PackedLines


class Parameters(NamedTuple):
    """Lens and vanishing points, in packed coordinates.

    Attributes
    ----------
    k : numpy.ndarray
        (order,) coefficients of s, s^2, ...; empty for order 0.
    centre : numpy.ndarray
        (2,) distortion centre.
    vanishing : numpy.ndarray or None
        (families, 3) unit homogeneous vanishing points; None if the lines are not constrained to meet.
    """

    k: Float64
    centre: Float64
    vanishing: Float64 | None


class Undistorted(NamedTuple):
    """Undistorted points, with the terms that their derivatives need.

    Attributes
    ----------
    dx, dy, square
        Offsets of the measured points from the centre (n,), and their squared length (n,).
    growth, slope, bend
        g(s) (n,), its first derivative, and its second derivative.
    x, y
        Undistorted coordinates (n,).
    """

    dx: Float64
    dy: Float64
    square: Float64
    growth: Float64
    slope: Float64 | float
    bend: Float64 | float
    x: Float64
    y: Float64


class LineSet(NamedTuple):
    """Lines ``nx x + ny y + offset = 0`` (lines,), |n| = 1."""

    nx: Float64
    ny: Float64
    offset: Float64


@dataclass(frozen=True)
class Evaluation:
    """Distances of the points from straight lines for given parameters.

    Attributes
    ----------
    points, lines
        Undistorted points, and the best lines through them in closed form.
    nx, ny, along
        Normal of each point's line, and the point's offset from the centre along it (n,).
    squared_scale
        Squared local scale |J'n|^2 (n,).
    inverse
        Square root of the weight over the local scale (n,).
    distance
        Signed distances (n,) in the measured image.
    residual
        Distances times the square root of the weights (n,).
    cost
        Sum of the squared residuals.
    """

    points: Undistorted
    lines: LineSet
    nx: Float64
    ny: Float64
    along: Float64
    squared_scale: Float64
    inverse: Float64
    distance: Float64
    residual: Float64
    cost: float


def inner_products(first: Float64, second: Float64) -> Float64:
    """Return the matrix of inner products over the last axis: ``first @ second.T``.

    einsum instead of BLAS: for these sizes the synchronisation of the BLAS threads takes longer than the sums, above
    all next to the threads of an OpenCL runtime.
    """
    if first.ndim == 1:
        return np.asarray(np.einsum("n,n->", first, second))
    return np.asarray(np.einsum("in,jn->ij", first, second))


def undistort(packed: PackedLines, k: Float64, centre: Float64) -> Undistorted:
    """Undistort the points with a lens of any order."""
    dx, dy = packed.x - centre[0], packed.y - centre[1]
    square = dx * dx + dy * dy
    k1, k2, *further = (*k.tolist(), 0.0, 0.0)[: max(len(k), 2)]
    stretch = k1 * square
    slope: Float64 | float = k1
    bend: Float64 | float = 2.0 * k2
    power = square
    if len(k) > 1:
        tail = k2 * square
        slope = k1 + 2.0 * tail
        tail *= square
        stretch += tail
    for order, term in enumerate(further, 3):
        # `power` is s^(order - 2).
        bend = bend + (order * (order - 1) * term) * power
        power = power * square
        slope = slope + (order * term) * power
        stretch += term * (power * square)
    x, y = dx * stretch, dy * stretch
    x += packed.x
    y += packed.y
    stretch += 1.0
    return Undistorted(dx, dy, square, stretch, slope, bend, x, y)


def is_monotonic(k: Float64, square: float, *, least: float = 0.0) -> bool:
    """Return whether the slope of ``r (1 + k1 r^2 + k2 r^4 + ...)`` exceeds ``least`` for all r^2 up to ``square``."""
    factors = [1.0, *((2 * order + 1) * term for order, term in enumerate(k.tolist(), 1))]
    places = [square, *(s for s in _extrema(factors) if 0.0 < s < square)]
    return all(_polynomial(factors, s) > least for s in places)


def _polynomial(coefficients: Sequence[float], s: float) -> float:
    """Evaluate c0 + c1 s + c2 s^2 + ..."""
    total = 0.0
    for coefficient in reversed(coefficients):
        total = coefficient + total * s
    return total


def _extrema(coefficients: Sequence[float]) -> list[float]:
    """Return the real places at which the derivative of c0 + c1 s + c2 s^2 + ... vanishes."""
    derivative = [order * c for order, c in enumerate(coefficients)][1:]
    while len(derivative) > 1 and derivative[-1] == 0.0:
        derivative.pop()
    if len(derivative) < 2:
        return []
    if len(derivative) == 2:
        return [-derivative[0] / derivative[1]]
    roots = np.roots(derivative[::-1])
    # A pair of complex roots close to the axis is a flat place of the slope as well: test it too.
    return [float(root) for root in roots.real]


def moments(packed: PackedLines, x: Float64, y: Float64, weight: Float64 | None) -> Float64:
    """Return the weighted sums (6, lines) of 1, x, y, xx, xy, yy over each line."""
    terms = np.empty((6, len(x)))
    terms[0] = 1.0 if weight is None else weight
    np.multiply(x, terms[0], out=terms[1])
    np.multiply(y, terms[0], out=terms[2])
    np.multiply(terms[1], x, out=terms[3])
    np.multiply(terms[1], y, out=terms[4])
    np.multiply(terms[2], y, out=terms[5])
    return packed.sums(terms)


def free_lines(moments: Float64) -> LineSet:
    """Return the lines of least squared distance: through the centre of gravity, along the scatter's longer axis."""
    total, x, y, xx, xy, yy = moments
    x, y = x / total, y / total
    angle = 0.5 * np.arctan2(2.0 * (xy - total * x * y), (xx - total * x * x) - (yy - total * y * y))
    nx, ny = -np.sin(angle), np.cos(angle)
    return LineSet(nx, ny, -(nx * x + ny * y))


def pencil_basis(vanishing: Float64) -> Float64:
    """Return orthonormal pairs (points, 2, 3) that span all lines through homogeneous points (points, 3)."""
    least = np.eye(3)[np.argmin(np.abs(vanishing), axis=-1)]
    first = np.cross(vanishing, least)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(vanishing, first)], axis=1)


def pencil_lines(moments: Float64, basis: Float64) -> LineSet:
    """Return the line of least squared distance within each line's pencil (lines, 2, 3).

    Among the lines ``l = cos(phi) b1 + sin(phi) b2`` of a pencil, the best one minimises ``l'S l / (l1^2 + l2^2)`` with
    the 3 x 3 scatter S: the eigenvector of the smaller eigenvalue of a 2 x 2 problem. This also holds for pencils of
    parallel lines.
    """
    total, x, y, xx, xy, yy = moments
    scatter = np.array([[xx, xy, x], [xy, yy, y], [x, y, total]])
    m = np.einsum("lia,abl,ljb->ijl", basis, scatter, basis)
    n = np.einsum("lia,lja->ijl", basis[..., :2], basis[..., :2])
    a = n[0, 0] * n[1, 1] - n[0, 1] ** 2
    b = m[0, 0] * n[1, 1] + m[1, 1] * n[0, 0] - 2.0 * m[0, 1] * n[0, 1]
    c = m[0, 0] * m[1, 1] - m[0, 1] ** 2
    # Smaller root of a t^2 - b t + c = 0, in the form that is also valid for a = 0.
    m = m - 2.0 * c / (b + np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0))) * n
    # Both rows give the eigenvector; the longer row is better conditioned.
    top = m[0, 0] ** 2 >= m[1, 1] ** 2
    mix = np.where(top, np.stack([-m[0, 1], m[0, 0]]), np.stack([-m[1, 1], m[0, 1]]))
    line = mix[0, :, None] * basis[:, 0] + mix[1, :, None] * basis[:, 1]
    line /= np.hypot(line[:, 0], line[:, 1])[:, None]
    return LineSet(*line.T)


def evaluate(
    packed: PackedLines, parameters: Parameters, before: Evaluation | None = None, weight: Float64 | None = None
) -> Evaluation:
    """Return the distances of the points from the best lines.

    Parameters
    ----------
    packed : PackedLines
        Measured points.
    parameters : Parameters
        Lens and vanishing points.
    before : Evaluation, optional
        Evaluation for nearby parameters; its line directions give the local scale. Default: a first pass without scale.
    weight : numpy.ndarray, optional
        (n,) weights of the squared distances. Default: 1.
    """
    points = undistort(packed, parameters.k, parameters.centre)
    inverse = weight
    if len(parameters.k):
        if before is None:
            lines = fit_lines(packed, parameters, moments(packed, points.x, points.y, weight))
            nx, ny = lines.nx[packed.line], lines.ny[packed.line]
        else:
            nx, ny = before.nx, before.ny
        inverse = (1.0 if weight is None else weight) / _squared_scale(points, nx, ny)[1]
    lines = fit_lines(packed, parameters, moments(packed, points.x, points.y, inverse))
    nx, ny, distance = lines.nx[packed.line], lines.ny[packed.line], lines.offset[packed.line]
    along, squared_scale = _squared_scale(points, nx, ny)
    inverse = 1.0 / np.sqrt(squared_scale)
    distance += nx * points.x
    distance += ny * points.y
    distance *= inverse
    residual = distance
    if weight is not None:
        root = np.sqrt(weight)
        inverse *= root
        residual = distance * root
    return Evaluation(
        points,
        lines,
        nx,
        ny,
        along,
        squared_scale,
        inverse,
        distance,
        residual,
        float(inner_products(residual, residual)),
    )


def fit_lines(packed: PackedLines, parameters: Parameters, moments: Float64) -> LineSet:
    """Return the lines of least squared distance, through the vanishing points if the parameters have any."""
    lines = free_lines(moments)
    bound = constrained_lines(packed, parameters)
    if parameters.vanishing is None or not bound.any():
        return lines
    basis = pencil_basis(parameters.vanishing)[packed.family[bound]]
    inside = pencil_lines(moments[:, bound], basis)
    for all_lines, some in zip(lines, inside, strict=True):
        all_lines[bound] = some
    return lines


def constrained_lines(packed: PackedLines, parameters: Parameters) -> npt.NDArray[np.bool_]:
    """Return which lines (lines,) are constrained to a vanishing point; a family of one line is not constrained."""
    if parameters.vanishing is None:
        return np.zeros(len(packed.counts), dtype=bool)
    return np.bincount(packed.family, minlength=packed.families)[packed.family] > 1


def _squared_scale(points: Undistorted, nx: Float64, ny: Float64) -> tuple[Float64, Float64]:
    """Return n.d and the squared local scale |J'n|^2."""
    along = nx * points.dx
    along += ny * points.dy
    squared_scale = points.slope * points.square
    squared_scale += points.growth
    squared_scale *= along
    squared_scale *= along
    squared_scale *= 4.0 * points.slope
    squared_scale += points.growth * points.growth
    return along, squared_scale
